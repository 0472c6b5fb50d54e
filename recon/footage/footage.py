"""Footage of one video: frames at working size, masks, the background, and where something moves.

Everything is kept as uint8: 150 frames of 320 x 180 are 26 MB, their masks 9 MB more. In a run they lie in files, and
only what is looked at is in memory.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from otsync.compute.indices import evenly
from otsync.files.scratch import Scratch, release
from otsync.types import Camera, Video

log = logging.getLogger("recon.footage")

FOREGROUND = 0.3
"""Share of a working pixel from which it counts as foreground."""

GROWTH, MARGIN = 3, 10
"""Pixels, at 320 of width: growth of masks before the background is taken; margin of boxes around what moves."""


@dataclass(frozen=True, eq=False, repr=False)
class Footage:
    """One video as a fit reads it: T frames of h x w working pixels.

    Args:
        images: RGB. Those of bad frames are black.
        times: seconds of every frame on the video's own clock.
        K: intrinsics in working pixels, pixel centres at +0.5, no distortion.
        w2c: world to camera, OpenCV axes; (4,4) when static, (T,4,4) when the camera moves.
        masks: soft foreground, 255 = all of the pixel; None: unknown.
        background: masked median over time of a fixed camera; None without masks or when the camera moves. Where
            moving things always hide it, it holds the plain median, which may show a ghost.
        background_seen: where the background was seen at least twice.
        boxes: (T,4) x0, y0, x1, y1 (exclusive) around what moves, with a margin; without masks the whole image; all
            zeros where nothing moves and in bad frames.
        readout: seconds from the first to the last row of a rolling shutter, or None.
        bad: frames that could not be read.
        depth: z in world units [h,w] by frame, 0 where unknown; for a depth loss.
        tracks: :class:`recon.losses.Sightings` by frame; for a track loss.
        features: extracted features [h,w,C] by frame; for a feature loss.
        bend: seconds by which the scene that a fit begins with had this clock bent, along the wave: of one second, at
            every frame (:mod:`recon.footage.bends`).
    """

    name: str
    images: UInt8[np.ndarray, "T h w 3"]
    times: Float[np.ndarray, " T"]
    K: Float[np.ndarray, "3 3"]
    w2c: Float[np.ndarray, "*T 4 4"]
    masks: UInt8[np.ndarray, "T h w"] | None
    background: UInt8[np.ndarray, "h w 3"] | None
    background_seen: Bool[np.ndarray, "h w"] | None
    boxes: Int[np.ndarray, "T 4"]
    readout: float | None
    bad: Bool[np.ndarray, " T"]
    depth: Mapping[int, np.ndarray] | None = None
    tracks: Mapping[int, Any] | None = None
    features: Mapping[int, np.ndarray] | None = None
    bend: float = 0.0
    wave: Float[np.ndarray, " T"] | None = None

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.images)

    def __repr__(self) -> str:
        first, last = (float(self.times[k]) for k in (0, -1)) if len(self) else (0.0, 0.0)
        has = [
            name for name in ("masks", "background", "depth", "tracks", "features") if getattr(self, name) is not None
        ]
        camera = "fixed" if self.w2c.ndim == 2 else "moving"
        return (
            f"Footage({self.name!r}, {len(self)} frames of {self.size[0]} x {self.size[1]}, "
            f"{first:.3f} to {last:.3f} s, {camera} camera{''.join(f', {name}' for name in has)})"
        )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in working pixels."""
        return int(self.images.shape[2]), int(self.images.shape[1])

    @property
    def camera(self) -> Camera:
        """The camera at working size."""
        return Camera(self.K, self.w2c, *self.size, readout=self.readout)

    @property
    def nbytes(self) -> int:
        """Bytes that the pixels take, in memory or in a file."""
        return sum(a.nbytes for a in (self.images, self.masks, self.background) if a is not None)

    def release(self) -> None:
        """Give the memory of the pixels back, where they lie in files: they are read again when they are asked for."""
        release(self.images)
        release(self.masks)

    def pose(self, frame: int) -> Float[np.ndarray, "4 4"]:
        """World to camera of a frame."""
        return self.w2c if self.w2c.ndim == 2 else self.w2c[frame]

    def pose_after(self, frame: int, later: float) -> Float[np.ndarray, "4 4"]:
        """World to camera ``later`` seconds after a frame (before it where below 0), on the video's own clock.

        From frame to frame a moving camera turns about one axis and moves along a line; beyond its ends it goes on so.
        """
        if self.w2c.ndim == 2 or len(self) < 2 or later == 0:
            return self.pose(frame)
        first = min(max(frame if later > 0 else frame - 1, 0), len(self) - 2)
        c2w = np.linalg.inv(self.w2c[first : first + 2])
        start, end = self.times[first : first + 2]
        share = (self.times[frame] + later - start) / (end - start)
        turn = Rotation.from_matrix(c2w[0, :3, :3].T @ c2w[1, :3, :3]).as_rotvec()
        between = np.eye(4)
        between[:3, :3] = c2w[0, :3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
        between[:3, 3] = c2w[0, :3, 3] + share * (c2w[1, :3, 3] - c2w[0, :3, 3])
        return np.linalg.inv(between)

    def nearest(self, seconds: float) -> int | None:
        """The readable frame nearest to ``seconds`` on the video's own clock; None where no frame is readable."""
        good = np.flatnonzero(~self.bad)
        return int(good[np.argmin(np.abs(self.times[good] - seconds))]) if len(good) else None


def footage_of(
    video: Video,
    masks: Sequence[Any] | None = None,
    *,
    width: int = 320,
    frames: slice | None = None,
    samples: int = 40,
    folder: Path | None = None,
) -> Footage:
    """Read a video at working size.

    Args:
        masks: foreground of every frame of the video, (H,W) of any size: bool, uint8 (0..1 or 0..255) or float (0..1).
        width: working pixels; a narrower video stays as it is. Images and masks are area-averaged, and distortion is
            undone (which needs OpenCV, and crops to the pixels that are seen).
        frames: which frames; None: all.
        samples: frames, spread over the clip, from which the background is taken (2 bytes of memory per value).
        folder: where images and masks are put into files without a name (:class:`otsync.files.scratch.Scratch`); None:
            they are held in memory.

    A frame that cannot be read, differs in size from the camera, or holds NaN is marked bad, with a warning that names
    it. Raises ValueError when no frame can be used, or when masks and frames do not pair up.
    """
    if masks is not None and len(masks) != len(video.frames):
        raise ValueError(
            f"masks of {video.name!r}: expected {len(video.frames)}, one per frame; found {len(masks)}. Leave them "
            "out, or make one for every frame."
        )
    lens = Lens.of(video.camera, width)
    picks = range(len(video.frames))[frames or slice(None)]
    if not picks:
        raise ValueError(f"frames: expected some of the {len(video.frames)} of {video.name!r}; found none.")
    seen = Scratch((lens.size[1], lens.size[0], 3), folder=folder)
    over = None if masks is None else Scratch(seen.row[:2], folder=folder)
    bad = np.zeros(len(picks), bool)
    reason = ""
    for i, k in enumerate(picks):
        image = mask = None
        try:
            image = lens.shrink(_image(video.frames[k], lens.full))
            if masks is not None:
                mask = lens.shrink(_mask(masks[k], lens.full))
        except (ValueError, OSError, EOFError, SyntaxError) as error:
            image, bad[i], reason = None, True, f"{type(error).__name__}: {error}"
            log.warning("video %r, frame %d is left out: %s", video.name, k, reason)
        seen.append(image)
        if over is not None:
            over.append(mask)
    if bad.all():
        raise ValueError(f"video {video.name!r}: expected frames that can be read; found none. The last one: {reason}")
    images, soft = seen.array(), None if over is None else over.array()
    w2c = video.camera.w2c
    w2c = w2c[np.array(picks)] if w2c.ndim == 3 else w2c
    background, shown = None, None
    if soft is not None and w2c.ndim == 2:
        good = np.flatnonzero(~bad)
        chosen = good[evenly(len(good), samples)]
        background, shown = median_background(images[chosen], soft[chosen], samples)
    footage = Footage(
        name=video.name,
        images=images,
        times=video.times[np.array(picks)],
        K=lens.K,
        w2c=w2c,
        masks=soft,
        background=background,
        background_seen=shown,
        boxes=boxes_of(soft, bad, lens.size),
        readout=video.camera.readout,
        bad=bad,
    )
    footage.release()
    return footage


def boxes_of(
    masks: UInt8[np.ndarray, "T h w"] | None, bad: Bool[np.ndarray, " T"], size: tuple[int, int]
) -> Int[np.ndarray, "T 4"]:
    """Boxes around the foreground of every frame, with the margin of :class:`Footage`."""
    w, h = size
    margin = round(MARGIN * w / 320)
    boxes = np.zeros((len(bad), 4), np.int64)
    for k in np.flatnonzero(~bad):
        if masks is None:
            boxes[k] = 0, 0, w, h
            continue
        inside = masks[k] > 255 * FOREGROUND
        if not inside.any():
            continue
        x, y = np.flatnonzero(inside.any(0)), np.flatnonzero(inside.any(1))
        boxes[k] = (
            max(x[0] - margin, 0),
            max(y[0] - margin, 0),
            min(x[-1] + 1 + margin, w),
            min(y[-1] + 1 + margin, h),
        )
    return boxes


def median_background(
    images: UInt8[np.ndarray, "T h w 3"], masks: UInt8[np.ndarray, "T h w"], samples: int = 40
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Median over time of the background, and where at least two samples show it (one, where there is but one).

    A plain median shows ghosts of people who move slowly; masks, grown a little, keep them out.
    """
    picks = evenly(len(images), samples)
    grow = 2 * max(1, round(GROWTH * images.shape[2] / 320)) + 1
    covered = np.stack([maximum_filter(masks[k] > 255 * FOREGROUND, size=grow) for k in picks])
    count = (~covered).sum(0)
    seen = count >= min(2, len(picks))
    covered[:, ~seen] = False
    count = np.where(seen, count, len(picks))
    values = images[picks].astype(np.int16)
    values[covered] = 256  # sorts after all colours
    values.sort(axis=0)

    def ranked(k: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, k[None, :, :, None], 0)[0]

    return ((ranked((count - 1) // 2) + ranked(count // 2) + 1) // 2).astype(np.uint8), seen


@dataclass(frozen=True, eq=False)
class Lens:
    """From a camera's pixels to working pixels without distortion.

    Args:
        full, size: (width, height) of the camera's and of the working image.
        K: intrinsics of the working image.
        maps: OpenCV's maps that undo the distortion at full size, or None.
    """

    full: tuple[int, int]
    size: tuple[int, int]
    K: Float[np.ndarray, "3 3"]
    maps: tuple[np.ndarray, np.ndarray] | None = field(default=None, repr=False)

    @classmethod
    def of(cls, camera: Camera, width: int) -> Lens:
        if width < 1:
            raise ValueError(f"width: expected at least 1 working pixel; found {width}.")
        full = (camera.width, camera.height)
        scale = min(1.0, width / full[0])
        size = (max(1, round(full[0] * scale)), max(1, round(full[1] * scale)))
        K, maps = camera.K.copy(), None
        if camera.distortion is not None and np.any(camera.distortion):
            K, maps = _undistort(camera)
        K[0] *= size[0] / full[0]
        K[1] *= size[1] / full[1]
        return cls(full, size, K, maps)

    def shrink(self, image: np.ndarray) -> UInt8[np.ndarray, "h w *C"]:
        """Area averages of an image at full size."""
        if self.maps is not None:
            import cv2

            image = cv2.remap(image, *self.maps, cv2.INTER_LINEAR)
        if self.size == self.full:
            return image
        rows, columns = self._filters
        H, W = image.shape[:2]
        down = (rows @ image.reshape(H, -1).astype(np.float32)).reshape(self.size[1], W, -1)
        both = columns @ down.transpose(1, 0, 2).reshape(W, -1)
        both = both.reshape(self.size[0], self.size[1], -1).transpose(1, 0, 2)
        return np.rint(both).clip(0, 255).astype(np.uint8).reshape(self.size[1], self.size[0], *image.shape[2:])

    def pick(self, values: np.ndarray) -> np.ndarray:
        """The samples of a map (of any size, over the same field of view) nearest to the working pixels' centres."""
        if self.maps is not None:
            import cv2

            values = cv2.resize(values, self.full, interpolation=cv2.INTER_NEAREST)
            values = cv2.remap(values, *self.maps, cv2.INTER_NEAREST)
        H, W = values.shape
        rows = ((np.arange(self.size[1]) + 0.5) * H / self.size[1]).astype(int)
        columns = ((np.arange(self.size[0]) + 0.5) * W / self.size[0]).astype(int)
        return values[rows[:, None], columns]

    @cached_property
    def _filters(self) -> tuple[sp.csr_matrix, sp.csr_matrix]:
        return _averages(self.size[1], self.full[1]), _averages(self.size[0], self.full[0])


def _averages(n: int, N: int) -> sp.csr_matrix:
    """[n,N] sparse: row i averages the samples i*N/n to (i+1)*N/n, those at the ends by their share."""
    edges = np.linspace(0, N, n + 1)
    first, last = np.floor(edges[:-1]).astype(int), np.ceil(edges[1:] - 1e-9).astype(int)
    row = np.repeat(np.arange(n), last - first)
    column = np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)])
    share = np.minimum(edges[row + 1], column + 1) - np.maximum(edges[row], column)
    return sp.csr_matrix(((share * n / N).astype(np.float32), (row, column)), shape=(n, N))


def _undistort(camera: Camera) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """(K without distortion, maps), cropped to pixels that are all seen. OpenCV has pixel centres at whole numbers."""
    try:
        import cv2
    except ImportError:
        raise ValueError(
            "Camera.distortion: undoing it needs OpenCV; found none. pip install 'otsync[video]', or give undistorted "
            "images without coefficients."
        ) from None
    size, half = (camera.width, camera.height), np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    K, _ = cv2.getOptimalNewCameraMatrix(camera.K - half, camera.distortion, size, 0)
    maps = cv2.initUndistortRectifyMap(camera.K - half, camera.distortion, None, K, size, cv2.CV_32FC1)
    return K + half, maps


def _image(frame: Any, full: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """A frame as uint8; ValueError when it is no image of the camera's size. Floats are 0..1."""
    image = np.asarray(frame)
    if image.shape != (full[1], full[0], 3):
        raise ValueError(f"expected {full[0]} x {full[1]} RGB pixels as the camera says; found shape {image.shape}")
    return image if image.dtype == np.uint8 else _from_float(image)


def _mask(mask: Any, full: tuple[int, int]) -> UInt8[np.ndarray, "H W"]:
    """A mask as uint8 0..255 at full size."""
    values = np.asarray(mask)
    if values.ndim != 2 or 0 in values.shape:
        raise ValueError(f"expected a mask of shape (H,W); found shape {values.shape}")
    if values.dtype == bool or (values.dtype.kind in "iu" and values.max() <= 1):
        values = values.astype(np.uint8) * np.uint8(255)
    elif values.dtype != np.uint8:
        values = _from_float(values)
    if values.shape != (full[1], full[0]):
        rows = ((np.arange(full[1]) + 0.5) * values.shape[0] / full[1]).astype(int)
        columns = ((np.arange(full[0]) + 0.5) * values.shape[1] / full[0]).astype(int)
        values = values[rows[:, None], columns]
    return values


def _from_float(values: np.ndarray) -> np.ndarray:
    if values.dtype.kind != "f":
        raise ValueError(f"expected uint8, or floats in 0..1; found {values.dtype}")
    if not ((values >= 0) & (values <= 1)).all():
        raise ValueError("expected floats in 0..1; found NaN or values beyond")
    return np.rint(values * 255).astype(np.uint8)
