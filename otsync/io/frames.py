"""Frames of a video without holding the video: image files and video files as lazy sequences.

Memory: one decoded frame at a time for images, at most ``KEPT`` (8) for a video file, besides what the caller keeps;
8 frames of 1920 x 1080 are 50 MB.
"""

from __future__ import annotations

import hashlib
import os
import threading
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
from jaxtyping import Float

from ..files.arrays import existing
from .images import MAX_PIXELS, read_image, read_npy

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,flv,mxf,ogg"
"""Containers that hold their own frames. FFmpeg also knows playlists, which would have it read other files."""

KEPT = 8
"""Decoded frames that a video file keeps, so that a step back does not seek."""


class LazyFrames(Sequence[np.ndarray]):
    """A sequence that decodes frame k when it is asked for; slices stay lazy."""

    @abstractmethod
    def frame(self, k: int) -> np.ndarray:
        """Decode frame ``k``, 0 <= k < len."""

    @abstractmethod
    def digest(self) -> str:
        """A hash of the content, for caches."""

    @overload
    def __getitem__(self, k: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, k: slice) -> Sequence[np.ndarray]: ...
    def __getitem__(self, k: int | slice) -> Any:
        if isinstance(k, slice):
            return FrameRange(self, range(len(self))[k])
        if not -len(self) <= k < len(self):
            raise IndexError(f"frame {k} of {len(self)}")
        return self.frame(int(k) % len(self))


class FrameRange(LazyFrames):
    """Some frames of a sequence, in a new order or number."""

    def __init__(self, base: LazyFrames, index: Sequence[int]):
        self.base, self.picks = base, index

    def __len__(self) -> int:
        return len(self.picks)

    def frame(self, k: int) -> np.ndarray:
        return self.base[self.picks[k]]

    def digest(self) -> str:
        if isinstance(self.base, ImageFrames):
            return ImageFrames([self.base.paths[i] for i in self.picks], self.base.read, self.base.tag).digest()
        return hashlib.blake2b(f"{self.base.digest()} {list(self.picks)}".encode(), digest_size=16).hexdigest()


class ImageFrames(LazyFrames):
    """One file per frame. ``read`` decodes one; ``tag`` says how, for the content's hash."""

    def __init__(self, paths: Sequence[Path], read: Callable[[Path], np.ndarray] = read_image, tag: str = "rgb"):
        self.paths, self.read, self.tag = tuple(paths), read, tag

    def __len__(self) -> int:
        return len(self.paths)

    def frame(self, k: int) -> np.ndarray:
        return self.read(self.paths[k])

    def digest(self) -> str:
        total = hashlib.blake2b(self.tag.encode(), digest_size=16)
        for path in self.paths:
            total.update(hashlib.blake2b(existing(path).read_bytes(), digest_size=16).digest())
        return total.hexdigest()


class ArrayFrames(LazyFrames):
    """Maps (T,H,W) stacked in one ``.npy`` file, read through a memory map."""

    def __init__(self, path: Path, scale: float = 1.0):
        self.path, self.scale = path, scale
        self.array = read_npy(path, memmap=True)
        if self.array.ndim != 3 or self.array.dtype.kind not in "iuf":
            raise ValueError(
                f"{path}: expected numbers of shape (T,H,W); found {self.array.dtype} of {self.array.shape}."
            )

    def __len__(self) -> int:
        return len(self.array)

    def frame(self, k: int) -> np.ndarray:
        depth = np.asarray(self.array[k], np.float32) * np.float32(self.scale)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))

    def digest(self) -> str:
        return f"{file_digest(self.path)}*{self.scale:g}"


class VideoFrames(LazyFrames):
    """A video file by PyAV, in order of presentation; ``timestamps`` (T,) are the container's own, in seconds.

    The count and the timestamps come from demuxing alone (sorted, because B-frames are stored out of order); frame k
    is the one that carries the k-th timestamp, found by seeking to the key frame before it.
    """

    def __init__(self, path: str | os.PathLike[str], *, max_frames: int = 2_000_000):
        self.path = existing(path)
        self._lock = threading.Lock()
        self._container: Any = None
        self._decoded: Any = None
        self._next = -1
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()
        stamps: list[int] = []
        with self._errors(), self._open() as container:
            stream = container.streams.video[0]
            self.width, self.height = int(stream.codec_context.width), int(stream.codec_context.height)
            if self.width * self.height > MAX_PIXELS:
                raise ValueError(f"{self.width} x {self.height} pixels, more than the {MAX_PIXELS} allowed")
            self._base = float(stream.time_base or 0)
            self.rate = float(stream.average_rate) if stream.average_rate else None
            for packet in container.demux(stream):
                if packet.pts is not None and packet.size:
                    stamps.append(packet.pts)
                if len(stamps) > max_frames:
                    raise ValueError(f"more than {max_frames} frames; cut the video, or raise max_frames")
        self._pts = sorted(set(stamps))
        if not self._pts:
            raise ValueError(f"{self.path}: expected video frames with timestamps; found none. Remux the file.")
        self.timestamps: Float[np.ndarray, " T"] = np.array(self._pts) * self._base

    def _open(self) -> Any:
        import av

        container = av.open(f"file:{self.path.resolve()}", options={"format_whitelist": CONTAINERS})
        if not container.streams.video:
            container.close()
            raise ValueError("no video in it")
        # a frame may claim more pixels than the header: the decoder is told before it takes the memory
        container.streams.video[0].codec_context.options = {"max_pixels": str(MAX_PIXELS)}
        return container

    def _errors(self) -> _Errors:
        return _Errors(self.path)

    def __len__(self) -> int:
        return len(self._pts)

    def frame(self, k: int) -> np.ndarray:
        with self._lock, self._errors():
            if k not in self._kept:
                self._decode_until(k)
            return self._kept[k]

    def _decode_until(self, k: int) -> None:
        if self._decoded is None or not self._next <= k <= self._next + 64:
            self._seek(k)
        wanted = self._pts[k]
        for frame in self._decoded:
            if frame.pts is None:
                continue
            n = int(np.searchsorted(self._pts, frame.pts))
            if n < len(self._pts) and self._pts[n] == frame.pts:
                self._next = n + 1
                if n > k - KEPT:
                    self._kept[n] = frame.to_ndarray(format="rgb24")
                    while len(self._kept) > KEPT:
                        self._kept.popitem(last=False)
            if frame.pts >= wanted:
                break
        if k not in self._kept:
            self._decoded = None
            raise ValueError(f"frame {k} at {wanted * self._base:.3f} s does not decode; the file may be truncated")

    def _seek(self, k: int) -> None:
        if self._container is None:
            self._container = self._open()
        stream = self._container.streams.video[0]
        self._container.seek(self._pts[k], stream=stream, backward=True)
        self._decoded = self._container.decode(stream)
        self._next = k

    @property
    def turned(self) -> int:
        """Degrees (0 to 359) by which players turn the image clockwise; frames are as they are stored all the same."""
        with self._lock, self._errors(), self._open() as container:
            first = next(container.decode(container.streams.video[0]), None)
            return -int(getattr(first, "rotation", 0)) % 360

    def digest(self) -> str:
        return file_digest(self.path)


class _Errors:
    """Turns PyAV's exceptions into ValueError with the file's name."""

    def __init__(self, path: Path):
        self.path = path

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if error is None or not isinstance(error, Exception) or isinstance(error, ImportError):
            return
        if type(error) is MemoryError:  # PyAV's own one comes from sizes that a damaged file makes up
            raise MemoryError(
                f"{self.path}: expected frames that fit into memory; found none left. Use a smaller video."
            ) from None
        if isinstance(error, ValueError) and str(error).startswith(str(self.path)):
            return
        found = "something else" if type(error).__name__ == "InvalidDataError" else f"{type(error).__name__}: {error}"
        raise ValueError(
            f"{self.path}: expected a readable video; found {found}. Copy or remux the file, or take it out of the "
            "folder."
        ) from None


def file_digest(path: Path) -> str:
    """A hash of one file's bytes."""
    with open(existing(path), "rb") as stream:
        return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
