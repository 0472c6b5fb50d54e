"""``align(a, b, matches, aligner)``: the time offset of a pair, and the slot that aligners go in (paper, Sec. 3.4)."""

from __future__ import annotations

import time
from dataclasses import replace

from ..clocks.shutter import at_frame_times
from ..types import Alignment, Matches, Refused, TrackSet, check_same_world
from .likelihood import LikelihoodScan
from .slot import Aligner, AlignerLike
from .vouch import vouch


def align(
    a: TrackSet, b: TrackSet, matches: Matches, aligner: AlignerLike | None = None, *, throw: bool = True
) -> Alignment:
    """When b happened on a's clock: ``offset(a, b)`` in seconds, positive when b started later.

    Args:
        a, b: track sets with positions in one common world frame.
        matches: from :func:`otsync.match`, or ``Matches(pairs, score)`` of your own.
        aligner: the algorithm; default :class:`LikelihoodScan`; the paper's is :class:`DTW`.
        throw: raise :class:`otsync.Refused` when the answer is flagged, instead of returning it.
    """
    chosen = LikelihoodScan() if aligner is None else Aligner.of(aligner)
    a.check("a", xyz=chosen.needs_xyz)
    b.check("b", xyz=chosen.needs_xyz)
    check_same_world(a, b)
    matches.check("matches", len(a), len(b))
    a, b = at_frame_times(a), at_frame_times(b)
    started = time.perf_counter()
    alignment = chosen(a, b, matches)
    seconds = alignment.stats.get("seconds", time.perf_counter() - started)
    alignment = replace(alignment, stats=alignment.stats | {"seconds": seconds})
    alignment = vouch(alignment, a, b, matches, chosen)
    if throw and not alignment.status.ok:
        raise Refused("align", alignment)
    return alignment
