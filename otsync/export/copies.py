"""Every video cut to what all of them show without encoding a frame anew."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..io.frames import CONTAINERS
from ..progress import counted
from .encode import TICKS, whole_file
from .slot import Aligned, Clip, Export, file_names
from .sound import container_seconds

SUFFIXES = (".mp4", ".mov", ".m4v")
"""Files whose streams go into an mp4 as they are."""

SAME_PITCH = 1e-3
"""Relative difference of rates up to which sound is copied: its timestamps are stretched, its samples are not."""


class Copies(Export):
    """The same cut as :class:`Clips` without loss and in no time: compressed frames and sound are copied.

    A copy can begin at a key frame only: it begins at the last one before what all videos show. Second 0 is the same
    moment in all files, the first of those key frames; a file that begins later shows nothing until then. Clocks that
    break, images, and other containers than mp4 and mov need :class:`Clips`.
    """

    name = "copies"
    default = False

    def targets(self, videos: Aligned, folder: Path) -> list[Path]:
        return [folder / "copies" / name for name in file_names([c.name for c in videos.clips], ".mp4")]

    def write(self, videos: Aligned, folder: Path, *, width: int, fps: float) -> list[str]:
        start, stop = videos.shared
        notes, copies = [], []
        for clip, out in zip(videos.clips, self.targets(videos, folder), strict=True):
            why = _not_copied(clip)
            if why:
                notes.append(f"{clip.name}: {why}, so it is not copied; --what clips encodes it anew")
            else:
                copies.append((Streams.of(clip, start), out))
        if not copies:
            none = "--what copies: expected a video that can be copied; found none."
            raise ValueError(f"{none} {'. '.join(notes)}.")
        begin = min(streams.begin for streams, _ in copies)
        for streams, out in counted(copies, "copying", "video", len(copies)):
            silent = streams.write(out, begin, stop)
            notes += [silent] if silent else []
        if start - begin > 0.5 / videos.fps:
            notes.append(f"copies begin at key frames: all videos are there from second {start - begin:.3f} on")
        return notes


def _not_copied(clip: Clip) -> str:
    if clip.broken:
        return "its clock breaks"
    if clip.file is None:
        return "it is images"
    return "" if clip.file.suffix.lower() in SUFFIXES else f"it is a {clip.file.suffix} file"


@dataclass(frozen=True, eq=False)
class Streams:
    """The compressed streams of a clip.

    Args:
        inside: (T,) seconds of the file's own timestamps, frame by frame. seek: where to look for the key frame, in
            these. begin: the key frame's world second.
    """

    clip: Clip
    inside: Float[np.ndarray, " T"]
    seek: float
    begin: float

    @classmethod
    def of(cls, clip: Clip, start: float) -> Streams:
        """Those that hold world second ``start``."""
        inside = container_seconds(clip, clip.video.times)
        first = clip.index[min(int(np.searchsorted(clip.world, start - 1e-9)), len(clip.index) - 1)]
        streams = cls(clip, inside, float(inside[first]), math.nan)
        with streams._opened() as source:
            packets = source.demux(source.streams.video[0])
            key = next((p for p in packets if p.is_keyframe and p.pts is not None), None)
            if key is None:
                raise ValueError(f"{clip.file}: expected a key frame; found none. Write it with --what clips.")
            return replace(streams, begin=streams.world(float(key.pts * key.time_base)))

    @contextlib.contextmanager
    def _opened(self) -> Iterator[Any]:
        """The file, at the key frame."""
        import av

        assert self.clip.file is not None
        with av.open(f"file:{self.clip.file.resolve()}", options={"format_whitelist": CONTAINERS}) as source:
            picture = source.streams.video[0]
            source.seek(round(self.seek / (picture.time_base or Fraction(1, TICKS))), stream=picture, backward=True)
            yield source

    def world(self, seconds: float) -> float:
        """World second of one of the file's own timestamps; beyond its frames at their mean rate."""
        inside, own = self.inside, self.clip.video.times
        slope = (own[-1] - own[0]) / (inside[-1] - inside[0]) if len(inside) > 1 else 1.0
        beyond = min(seconds - inside[0], 0.0) + max(seconds - inside[-1], 0.0)
        return float(self.clip.clock.world(np.interp(seconds, inside, own) + slope * beyond))

    def write(self, out: Path, begin: float, stop: float) -> str:
        """Write an mp4 up to world second ``stop``, whose second 0 is world second ``begin``.

        Returns why its sound is left out ("" where it is not). The file appears under its name once it is complete.
        """
        import av

        silent = ""
        with (
            whole_file(out) as part,
            self._opened() as source,
            av.open(str(part), "w", format="mp4", options={"movie_timescale": str(TICKS)}) as target,
        ):
            kept = {source.streams.video[0].index: _copied(target, source.streams.video[0])}
            if source.streams.audio and abs(self.clip.clock.rate - 1) <= SAME_PITCH:
                kept[source.streams.audio[0].index] = _copied(target, source.streams.audio[0])
            elif source.streams.audio:
                silent = (
                    f"{self.clip.name}: its rate of {self.clip.clock.rate:.4f} would need other samples, so its "
                    "sound is left out of the copy"
                )
            for packet in source.demux([source.streams[n] for n in kept]):
                if packet.pts is None or not packet.size or not self._wanted(packet, stop):
                    continue
                self._place(packet, begin)
                packet.stream = kept[packet.stream.index]
                target.mux(packet)
        return silent

    def _wanted(self, packet: Any, stop: float) -> bool:
        """Whether a packet belongs to the copy: sound that is heard in it, pictures that it shows or is made from."""
        base = packet.time_base
        if packet.stream.type == "video":  # in the order of decoding: what is shown later may be needed earlier
            needed = packet.pts if packet.dts is None else packet.dts
            return self.world(float(needed * base)) <= stop + 1e-9
        return self.begin <= self.world(float(packet.pts * base)) <= stop

    def _place(self, packet: Any, begin: float) -> None:
        """Give a packet its timestamps: ticks after world second ``begin``."""
        base, pts, dts = packet.time_base, packet.pts, packet.dts
        ticks = [round((self.world(float(t * base)) - begin) * TICKS) for t in (pts, pts if dts is None else dts)]
        packet.duration = round(float((packet.duration or 0) * base) * TICKS)
        (packet.pts, packet.dts), packet.time_base = ticks, Fraction(1, TICKS)


def _copied(target: Any, stream: Any) -> Any:
    copied = target.add_stream_from_template(stream)
    copied.time_base = Fraction(1, TICKS) if stream.type == "video" else stream.time_base
    return copied
