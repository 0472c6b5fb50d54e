"""``refine(a, b, matches, alignment, refiner)``: sub-frame offsets, and the slot that refiners go in."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Protocol

from ..clocks.shutter import at_frame_times
from ..types import Alignment, Matches, Refused, TrackSet, check_same_world
from .splines import SplineRefine


class Refiner(Protocol):
    """The ``refiner`` slot."""

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment) -> Alignment: ...


def refine(
    a: TrackSet,
    b: TrackSet,
    matches: Matches,
    alignment: Alignment,
    refiner: Refiner | None = None,
    *,
    throw: bool = True,
) -> Alignment:
    """Improve an alignment beyond the frame grid.

    Args:
        a, b, matches: as for :func:`otsync.align`.
        alignment: where to start; its flags stay in the answer.
        refiner: the algorithm; default :class:`SplineRefine`. :class:`Unrefined` leaves the alignment as it is.
        throw: raise :class:`otsync.Refused` when the answer is flagged, instead of returning it.
    """
    needs_xyz = getattr(refiner, "needs_xyz", True)  # the epipolar fit reads pixels
    a.check("a", xyz=needs_xyz)
    b.check("b", xyz=needs_xyz)
    check_same_world(a, b)
    matches.check("matches", len(a), len(b))
    a, b = at_frame_times(a), at_frame_times(b)
    started = time.perf_counter()
    found = (refiner or SplineRefine())(a, b, matches, alignment)
    seconds = found.stats.get("refine_seconds", time.perf_counter() - started)
    found = replace(found, stats=found.stats | {"refine_seconds": seconds})
    if throw and not found.status.ok:
        raise Refused("refine", found)
    return found


@dataclass(frozen=True)
class Unrefined:
    """Takes the aligner's answer as it is."""

    needs_xyz = False

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment) -> Alignment:
        return alignment
