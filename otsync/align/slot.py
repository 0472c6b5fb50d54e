"""The slot of aligners: what one is, and what it may declare."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..types import Alignment, Matches, TrackSet

AlignerLike = Callable[[TrackSet, TrackSet, Matches], Alignment]
"""Anything that aligns two matched track sets: an :class:`Aligner`, or a callable of your own."""


class Aligner:
    """Base of otsync's aligners. A callable of your own needs none of it; what it lacks has these defaults.

    Attributes:
        needs_xyz: whether it reads positions in space; one that reads pixels alone says False.
        flags_itself: whether it says itself when its answer is not to be trusted; the answers of others are compared
            with the likelihood scan's (:mod:`otsync.align.vouch`).
    """

    needs_xyz: bool = True
    flags_itself: bool = False

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches) -> Alignment:
        raise TypeError(f"{type(self).__name__}: an aligner is called with (a, b, matches); it defines no such call.")

    @staticmethod
    def of(aligner: AlignerLike) -> Aligner:
        """``aligner`` itself, or a callable of somebody else's with the defaults."""
        return aligner if isinstance(aligner, Aligner) else Foreign(aligner)


@dataclass(frozen=True)
class Foreign(Aligner):
    """A callable that knows nothing of :class:`Aligner`; attributes of the same names are heeded all the same."""

    call: AlignerLike

    @property
    def needs_xyz(self) -> bool:  # type: ignore[override]
        return getattr(self.call, "needs_xyz", True)

    @property
    def flags_itself(self) -> bool:  # type: ignore[override]
        return getattr(self.call, "flags_itself", False)

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches) -> Alignment:
        return self.call(a, b, matches)
