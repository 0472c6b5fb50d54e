"""Whether all parts of a scene tell one time: every neighbourhood of matches answers for itself.

A fit of all matches gives those that disagree less weight, a whole performer too: where one of two is shown late (by a
screen, by another tracker), it settles on either, and says that it fits well. A fit of one neighbourhood alone goes
where that one leads.
"""

from __future__ import annotations

import math

import numpy as np

from ..clocks.common import readable, strongest
from ..refine.gauss_newton import fit_clock, neighbours
from ..refine.splines import SplineRefine
from ..types import Clock, TrackSet
from .verdict import Answer

GROUPS, FEWEST = 6, 5
"""Neighbourhoods that are asked, and matches of one at least."""

TOLD_BY = 1.5
"""Neighbourhoods of equal information that one must fall into by itself: fewer matches agree with themselves."""

ITERATIONS = 20

FLOOR, OF_BLUR = 0.3 / 30, 0.1
"""Seconds, and share of the fit's blur, by which a neighbourhood may be off whatever its sigma says: its errors are in
common."""


def parted(answer: Answer, a: TrackSet, b: TrackSet) -> float:
    """How far the neighbourhood that contradicts a pair's answer most is from it, in units of how well it is known."""
    refiner = SplineRefine()
    matches = strongest(answer.matches, readable(refiner.limit, a, b))
    first, second = refiner.splines(a, b, matches)
    weight = None if matches.weight is None else matches.shares
    clock = Clock(answer.refined.offset, answer.refined.rate)
    floor = math.hypot(FLOOR, OF_BLUR * answer.refined.stats.get("blur", 0.0))
    group = neighbours(first.mean + second.mean, GROUPS)
    worst = 0.0
    for k in range(GROUPS):
        some = np.flatnonzero(group == k)
        if len(some) < FEWEST:
            continue
        own = None if weight is None else weight[some]
        window = refiner.windows[0]
        fit = fit_clock(first.take(some), second.take(some), clock, window, weight=own, iterations=ITERATIONS)
        if fit is not None and fit.witnesses >= TOLD_BY:
            scatter = math.sqrt(max(float(fit.covariance[0, 0]), 0.0))
            worst = max(worst, abs(fit.clock.offset - clock.offset) / math.hypot(scatter, floor))
    return worst
