"""The answer for a recording, and how it came about."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..types import Offsets, TrackSet


@dataclass(frozen=True, eq=False)
class Synchronized:
    """The outcome of :func:`synchronize_scene`.

    Args:
        offsets: the answer. tracks: what it was made from.
        route, why: which way was taken, and the reasons in words.
        first: offsets of the epipolar route where the stereo route went on from them.
        seconds: wall time per stage.
    """

    offsets: Offsets
    tracks: tuple[TrackSet, ...]
    route: str
    why: tuple[str, ...]
    first: Offsets | None = None
    seconds: dict[str, float] = field(default_factory=dict)
