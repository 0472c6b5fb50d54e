"""Videos on the common clock, and the slot of what is written of them."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from ..io import Scene
from ..io.frames import FrameRange, LazyFrames, VideoFrames
from ..types import Clock, Offsets, Video, mended_frames


@dataclass(frozen=True, eq=False)
class Clip:
    """One video on the common clock: its S frames that tell a time, in the order of what they show.

    Args:
        index: (S,) frames of the video. own: (S,) seconds on its own clock, breaks undone. world: (S,) world seconds.
        clock: from its own seconds to the world's. sigma: of its offset, s; nan when not estimated.
        broken: whether its clock breaks, so that its frames are not in the order of the file, or some are left out.
        status: code of the gravest flag of its offset.
    """

    video: Video
    index: Int[np.ndarray, " S"]
    own: Float[np.ndarray, " S"]
    world: Float[np.ndarray, " S"]
    clock: Clock
    sigma: float = np.nan
    broken: bool = False
    status: str = "ok"

    @property
    def name(self) -> str:
        return self.video.name

    @property
    def step(self) -> float:
        """Median world seconds between frames."""
        return float(np.median(np.diff(self.world))) if len(self.world) > 1 else 1.0 / (self.video.fps or 30.0)

    @property
    def file(self) -> Path | None:
        """The video file that the frames come from; None for images."""
        frames = self.video.frames
        while isinstance(frames, FrameRange):
            frames = frames.base
        return frames.path if isinstance(frames, VideoFrames) else None

    def as_filmed(self, origin: float) -> Float[np.ndarray, " S"]:
        """Where the frames stand as if nothing had been synchronised: all videos begin at world second ``origin``."""
        return self.own - self.own[0] + origin

    def nearest(self, t: float, begins: float | None = None) -> int:
        """The frame of the video that shows world second ``t``: the nearest within a frame's length, else -1.

        begins: as filmed, when all videos begin at this world second; None: synchronised.
        """
        seconds = self.world if begins is None else self.as_filmed(begins)
        k = int(np.clip(np.searchsorted(seconds, t), 1, max(len(seconds) - 1, 1))) if len(seconds) > 1 else 0
        if k and t - seconds[k - 1] <= seconds[k] - t:
            k -= 1
        return int(self.index[k]) if abs(seconds[k] - t) <= self.step else -1


@dataclass(frozen=True, eq=False)
class Aligned:
    """The videos of a recording on the clock of one of them.

    Args:
        clips: of every video that has a place on it. fps: of the reference. left_out: why others have none, by name.
    """

    clips: tuple[Clip, ...]
    fps: float
    reference: str
    left_out: dict[str, str] = field(default_factory=dict)

    @property
    def span(self) -> tuple[float, float]:
        """First and last world second that any video shows."""
        return min(float(c.world[0]) for c in self.clips), max(float(c.world[-1]) for c in self.clips)

    @property
    def origin(self) -> float:
        """World second of the reference's first frame, where all videos begin as filmed."""
        return next((float(c.world[0]) for c in self.clips if c.name == self.reference), self.span[0])

    @property
    def shared(self) -> tuple[float, float]:
        """First and last world second that all videos show. ValueError where there is none."""
        start, stop = max(float(c.world[0]) for c in self.clips), min(float(c.world[-1]) for c in self.clips)
        if start >= stop:
            late = max(self.clips, key=lambda c: c.world[0]).name
            early = min(self.clips, key=lambda c: c.world[-1]).name
            raise ValueError(
                f"offsets: expected a moment that all videos show; {early} ends before {late} begins. Leave videos out "
                "with --cameras."
            )
        return start, stop


def aligned(scene: Scene, offsets: Offsets) -> Aligned:
    """A recording's videos on the clock of the offsets' reference.

    Videos without an offset, or on another clock, are left out. ValueError where fewer than two are left.
    """
    clips, left_out = [], {}
    for video in scene.videos:
        if video.name not in offsets.names:
            left_out[video.name] = "it has no offset"
            continue
        v = offsets.names.index(video.name)
        if not np.isfinite(offsets.seconds[v]) or offsets.component[v] != offsets.reference:
            left_out[video.name] = f"nothing ties it to {offsets.names[offsets.reference]}"
            continue
        clock, breaks = offsets.clock(v), offsets.breaks[v]
        index, own = mended_frames(video.times, breaks)
        status = offsets.status[v].code
        world = np.asarray(clock.world(own), float)
        clips.append(Clip(video, index, own, world, clock, float(offsets.sigma[v]), bool(breaks), status))
    if len(clips) < 2:
        why = "".join(f" {name}: {reason}." for name, reason in left_out.items())
        raise ValueError(f"offsets: expected two videos on one clock; found {len(clips)}.{why} Synchronise them first.")
    reference = offsets.names[offsets.reference]
    fps = float(offsets.fps[offsets.reference])
    return Aligned(tuple(clips), fps, reference, left_out)


class Export(ABC):
    """A kind of file that synchronised videos are written to."""

    name: ClassVar[str]
    """How the shell spells it."""

    heeds: ClassVar[frozenset[str]] = frozenset()
    """Which of the options ``width`` and ``fps`` it reads."""

    default: ClassVar[bool] = True
    """Whether it is written where nobody says what."""

    @abstractmethod
    def targets(self, videos: Aligned, folder: Path) -> list[Path]:
        """The files that :meth:`write` would write."""

    @abstractmethod
    def write(self, videos: Aligned, folder: Path, *, width: int, fps: float) -> list[str]:
        """Write them.

        Args:
            width: pixels of a picture in a mosaic. fps: frames per second of the common clock.

        Returns what the user should know, in words.
        """


def grid(videos: Aligned, span: tuple[float, float], fps: float) -> Float[np.ndarray, " S"]:
    """World seconds over a span, ``fps`` a second, that hold the reference's own frames where ``fps`` is its own."""
    origin = videos.origin
    first, last = np.ceil((span[0] - origin) * fps - 1e-6), np.floor((span[1] - origin) * fps + 1e-6)
    return origin + np.arange(first, last + 1) / fps


def file_names(names: Sequence[str], suffix: str) -> list[str]:
    """A file name for each name, no two alike: letters, digits, dot, hyphen and underscore stay as they are."""
    found: list[str] = []
    for n, name in enumerate(names):
        plain = re.sub(r"[^\w.-]+", "_", name).strip("._")[:80] or f"video{n}"
        while f"{plain}{suffix}".lower() in (other.lower() for other in found):
            plain += f"_{n}"
        found.append(f"{plain}{suffix}")
    return found


def reopened(frames: Sequence) -> Sequence:
    """The same frames with a decoder of their own, so that two readers of one file do not disturb each other."""
    if isinstance(frames, FrameRange):
        base = reopened(frames.base)
        return FrameRange(base, frames.picks) if isinstance(base, LazyFrames) else frames
    return VideoFrames(frames.path) if isinstance(frames, VideoFrames) else frames
