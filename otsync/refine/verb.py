"""``refine(a, b, matches, alignment, refiner)``: sub-frame offsets, and the slot that refiners go in."""

from __future__ import annotations

import time
from dataclasses import replace

from ..clocks.shutter import at_frame_times
from ..types import Alignment, Matches, Refused, TrackSet, check_same_world
from .slot import Refiner, RefinerLike
from .splines import SplineRefine


def refine(
    a: TrackSet,
    b: TrackSet,
    matches: Matches,
    alignment: Alignment,
    refiner: RefinerLike | None = None,
    *,
    throw: bool = True,
) -> Alignment:
    """Improve an alignment beyond the frame grid.

    Args:
        a, b, matches: as for :func:`otsync.align`.
        alignment: where to start; its flags stay in the answer.
        refiner: the algorithm; default :class:`SplineRefine`. :class:`otsync.Unrefined` leaves the alignment as it is.
        throw: raise :class:`otsync.Refused` when the answer is flagged, instead of returning it.
    """
    chosen = SplineRefine() if refiner is None else Refiner.of(refiner)
    a.check("a", xyz=chosen.needs_xyz)
    b.check("b", xyz=chosen.needs_xyz)
    check_same_world(a, b)
    matches.check("matches", len(a), len(b))
    a, b = at_frame_times(a), at_frame_times(b)
    started = time.perf_counter()
    refined = chosen(a, b, matches, alignment)
    seconds = refined.stats.get("refine_seconds", time.perf_counter() - started)
    refined = replace(refined, stats=refined.stats | {"refine_seconds": seconds})
    if throw and not refined.status.ok:
        raise Refused("refine", refined)
    return refined
