"""Sub-frame offsets in continuous time: ``refine(a, b, matches, alignment, refiner)``.

A refiner is an object in a slot: any callable ``refiner(a, b, matches, alignment) -> Alignment``.
"""

from __future__ import annotations

import time
from typing import Protocol

from .types import Alignment, Matches, Refused, TrackSet


class Refiner(Protocol):
    """The ``refiner`` slot."""

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment) -> Alignment: ...


def refine(
    a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment, refiner: Refiner, *, throw: bool = True
) -> Alignment:
    """Improve an alignment beyond the frame grid.

    Args:
        a, b, matches: as for :func:`otsync.align`.
        alignment: where to start; its flags stay in the answer.
        refiner: the algorithm.
        throw: raise :class:`otsync.Refused` when the answer is flagged, instead of returning it.
    """
    a.check("a")
    b.check("b")
    matches.check("matches", len(a), len(b))
    started = time.perf_counter()
    found = refiner(a, b, matches, alignment)
    found.stats.setdefault("refine_seconds", time.perf_counter() - started)
    if throw and not found.status.ok:
        raise Refused("refine", found)
    return found
