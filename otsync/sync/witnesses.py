"""Whether all parts of a scene tell one time: every neighbourhood of matches answers for itself.

A fit of all matches gives those that disagree less weight, a whole performer too: where one of two is shown late (by a
screen, by another tracker), it settles on either, and says that it fits well. A fit of one neighbourhood alone goes
where that one leads. Matches that were made anew for the answer may all be of the performer that it is right for; so
those that were made before there was an answer are heard as well, where they are sure.
"""

from __future__ import annotations

import math

import numpy as np

from ..clocks.common import readable, strongest
from ..refine.common_motion import common_motion
from ..refine.gauss_newton import fit_clock, neighbours
from ..refine.splines import SplineRefine
from ..types import Clock, Matches, TrackSet
from .verdict import Answer

GROUPS, FEWEST = 6, 5
"""Neighbourhoods that are asked, and matches of one at least."""

TOLD_BY = 1.5
"""Neighbourhoods of equal information that one must fall into by itself: fewer matches agree with themselves."""

ITERATIONS = 20

FLOOR, OF_BLUR = 0.3 / 30, 0.1
"""Seconds, and share of the fit's blur, by which a neighbourhood may be off whatever its sigma says: its errors are in
common."""


ALIKE, BLURRED = 0.5, 1.75
"""Common motion that a neighbourhood of the first matches must have at the time that it tells, and how many times the
answer's blur it may have there. Wrong matches go anywhere, and some say that they know it well: neighbourhoods of right
answers that are off by 4 and more units have .42 at most, or 1.9 to 3.5 times the blur (an arm matched with the other
arm); of performers that are late one at least has .7 and more, and 1.6 times the blur at most (mid, hard, brutal; seeds
500-529, 41000-41039, 50000-50019)."""


def parted(answer: Answer, a: TrackSet, b: TrackSet, first: Matches | None = None) -> float:
    """How far the neighbourhood that contradicts a pair's answer most is from it, in units of how well it is known.

    Args:
        first: matches that were made before there was an answer.
    """
    told = _parted(answer, answer.matches, a, b, sure=False)
    if first is None or first is answer.matches:
        return told
    return max(told, _parted(answer, first, a, b, sure=True))


def _parted(answer: Answer, matches: Matches, a: TrackSet, b: TrackSet, *, sure: bool) -> float:
    """Of such matches; with ``sure``, of neighbourhoods alone that fit the time which they tell (:data:`ALIKE`)."""
    refiner = SplineRefine()
    matches = strongest(matches, readable(refiner.limit, a, b))
    first, second = refiner.splines(a, b, matches)
    weight = None if matches.weight is None else matches.shares
    clock = Clock(answer.refined.offset, answer.refined.rate)
    blur = answer.refined.stats.get("blur", 0.0)
    floor = math.hypot(FLOOR, OF_BLUR * blur)
    window = refiner.windows[0]
    group = neighbours(first.mean + second.mean, GROUPS)
    worst = 0.0
    for k in range(GROUPS):
        some = np.flatnonzero(group == k)
        if len(some) < FEWEST:
            continue
        own = None if weight is None else weight[some]
        curves = first.take(some), second.take(some)
        fit = fit_clock(*curves, clock, window, weight=own, iterations=ITERATIONS)
        if fit is None or fit.witnesses < TOLD_BY:
            continue
        scatter = math.sqrt(max(float(fit.covariance[0, 0]), 0.0))
        off = abs(fit.clock.offset - clock.offset) / math.hypot(scatter, floor)
        if off <= worst:
            continue
        fits = fit.blur <= BLURRED * blur and common_motion(*curves, fit.clock, fit.weights, window) >= ALIKE
        if fits or not sure:
            worst = off
    return worst
