"""Whether cameras stand where the scene says: by their calibration's own doubts, and by how their pairs fare."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from ..types import Offsets, Status

SOUND = 0.3
"""Share of a camera's pairs that must be trusted and agree with the answer. On the dome: cameras in the right place .5
to 1, far ones included; cameras 72 degrees off 0."""

LEAST_PAIRS = 3
"""Pairs of a camera below which their share says nothing."""

AGREES = 1 / 30
"""Seconds by which a pair may miss the answer, or a frame where that is longer: with 120 frames a second all is sound
that misses it by four."""


OF_CLOCKS = frozenset({Status.SHORT_OVERLAP, Status.BROKEN_CLOCK, Status.RATE_MISMATCH})
"""Flags that tell of clocks and clips: a pair that has no others, and fits the answer, accuses no camera."""


def with_doubts(offsets: Offsets, doubtful: Collection[str]) -> Offsets:
    """The offsets with MISPLACED for the named videos."""
    if not set(doubtful) & set(offsets.names):
        return offsets
    named = zip(offsets.names, offsets.flags, strict=True)
    return replace(offsets, flags=tuple((*own, Status.MISPLACED) if n in doubtful else own for n, own in named))


def misplaced(offsets: Offsets) -> set[str]:
    """Names of the videos most of whose pairs are flagged, by more than clocks, or contradict the answer.

    The worst comes first, and its pairs then count no more.

    A camera in a wrong place spoils the pairs of the others too; without it theirs are sound.
    """
    least = max(AGREES, 1 / offsets.fps[offsets.reference])
    sound = {
        pair: OF_CLOCKS.issuperset(a.flags) and abs(a.stats.get("residual", np.nan)) < least
        for pair, a in offsets.alignments.items()
    }
    found: set[int] = set()
    while True:
        shares = {}
        for v in range(len(offsets)):
            own = [good for pair, good in sound.items() if v in pair and not found & set(pair)]
            if v not in found and len(own) >= LEAST_PAIRS:
                shares[v] = sum(own) / len(own)
        worst = min(shares, key=lambda v: shares[v], default=None)
        if worst is None or shares[worst] >= SOUND:
            return {offsets.names[v] for v in found}
        found.add(worst)
