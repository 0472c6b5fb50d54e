"""``align(a, b, matches, aligner)``: the time offset of a pair, and the slot that aligners go in (paper, Sec. 3.4)."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Protocol

from ..clocks.shutter import at_frame_times
from ..types import Alignment, Matches, Refused, TrackSet, check_same_world
from .likelihood import LikelihoodScan


class Aligner(Protocol):
    """The ``aligner`` slot."""

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches) -> Alignment: ...


def align(
    a: TrackSet, b: TrackSet, matches: Matches, aligner: Aligner | None = None, *, throw: bool = True
) -> Alignment:
    """When b happened on a's clock: ``offset(a, b)`` in seconds, positive when b started later.

    Args:
        a, b: track sets with positions in one common world frame.
        matches: from :func:`otsync.match`, or ``Matches(pairs, score)`` of your own.
        aligner: the algorithm; default :class:`LikelihoodScan`; the paper's is :class:`DTW`.
        throw: raise :class:`otsync.Refused` when the answer is flagged, instead of returning it.
    """
    needs_xyz = getattr(aligner, "needs_xyz", True)  # the epipolar scan reads pixels
    a.check("a", xyz=needs_xyz)
    b.check("b", xyz=needs_xyz)
    check_same_world(a, b)
    matches.check("matches", len(a), len(b))
    a, b = at_frame_times(a), at_frame_times(b)
    started = time.perf_counter()
    found = (aligner or LikelihoodScan())(a, b, matches)
    seconds = found.stats.get("seconds", time.perf_counter() - started)
    found = replace(found, stats=found.stats | {"seconds": seconds})
    if throw and not found.status.ok:
        raise Refused("align", found)
    return found
