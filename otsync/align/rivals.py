"""Whether all tracks would fit as well at another time, were they matched anew: what the matches of one answer hide.

Matches that were made for one offset agree with it. Like things that take each other's places (a carousel, parcels on a
belt, a motion that repeats) fit as well at another one, with other partners.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..compute.indices import evenly
from ..costs.linear import cosine_distance, unit_features
from ..types import Matches, TrackSet

PARTNERS = 10
"""Tracks of the other video whose features are likest: one of them is the partner."""

TRACKS, MOMENTS = 120, 24
"""Tracks of one video that are asked, and moments at which they are compared."""

NEAREST, FEWEST = 0.15, 30
"""Quantile of the tracks' distances that tells, and of how many tracks at least."""

STEP, REACH = 2 / 30, 4.0
"""Seconds between the offsets that are tried, and how far from the answer they go."""

NEAR = 8 / 30
"""Seconds beside the answer that are the answer's own."""

LEAST_COMMON, LEAST_SEEN = 40 / 30, 8
"""Seconds that must be common, and moments at which both must be seen."""

AS_GOOD = 1.05
"""Distance of the tracks at another time, over that at the answer, below which that time is as good: carousels .4 to
1.06, exact loops .9 to 1; presets mid 2 and more, hard 1.22, like people 1.29, brutal 1 to 1.22, real cameras 1.14 and
more (24 pairs; 10 each of the others)."""

NEARLY, NOTHING = 1.6, 0.03
"""The same where next to nothing of the motion is left unexplained, and the share that is: like things on one path stay
somewhat apart. Carousels (seeds 520-527, 22007) have 1.12 to 1.4 and .003 to .01 where 1.05 trusted two wrong answers;
what else moves has either 2 and more, or leaves .07 and more."""

AS_LITTLE_LEFT, LITTLE = 1.3, 0.02
"""Times as much of the motion may be left unexplained at another time as at the answer, and a share beside it, if it is
to suit as well, unless the tracks are sure (:data:`SURE`) that it does not. Left at the answer and at the best of the
near times: carousels .00 and .01, exact loops .02 and .02 to .06 and .06, belts .00 and .02; noisy tracks that are near
by chance .03 and .39 (mid), .07 and .14 (hard), .24 and 1.2 (brutal). Seeds below 10."""

SURE = 3.5
"""Standard errors of the mean logarithm, over the tracks, of what is left there over what is left here, from which the
other time suits worse, however little: noisy tracks leave much at any time. Carousels, exact loops and belts, where
more than :data:`LITTLE` is added (mid to brutal, 60 worlds): at most 3.0, and one of 5.6 that other flags refuse;
brutal tracks 1.5 to 33 (28 worlds below 600)."""

RESTING = 0.25
"""Share of the matched tracks that move least: these suit any time, and are not asked what is left."""

MOST_TRIED = 8
"""Times whose motion is looked at, the nearest ones."""

AT_ONCE = 2_000_000
"""Pairs of samples that are compared at once."""


@dataclass(frozen=True)
class Rival:
    """How well another time suits.

    Args:
        ratio: the least distance of tracks to their nearest likely partners at any other offset, over that at the
            answer. 1: they are as near; inf: no offset is far enough to be tried.
        as_good: whether there is an offset at which they are as near and move alike, too.
    """

    ratio: float
    as_good: bool


def rival(a: TrackSet, b: TrackSet, matches: Matches, offset: float) -> Rival:
    """How well any other offset suits the tracks of the better half of the matches that move.

    Distances are those of the nearest :data:`NEAREST` of the tracks: others may show what the other video does not see.
    Positions are in one declared world frame; both sets have features.
    """
    best = np.unique(matches.best(max((len(matches) + 1) // 2, FEWEST)).pairs[:, 0])
    some = _moving(a, best, 0.5)  # what rests is as near at any time
    assert a.features is not None and b.features is not None
    fa, fb = unit_features(a.features, center=True), unit_features(b.features, center=True)
    likely = np.argsort(cosine_distance(fa[some], fb), 1, kind="stable")[:, :PARTNERS]
    xa, xb = a.positions(some), b.positions()
    here = _distance(xa, xb, a.times, b.times, likely, offset)
    steps = np.arange(math.ceil(NEAR / STEP), round(REACH / STEP) + 1)
    others = offset + STEP * np.concatenate([-steps, steps])
    apart = np.array([_distance(xa, xb, a.times, b.times, likely, at) for at in others])
    apart = np.concatenate([_beyond_the_valley(apart[: len(steps)]), _beyond_the_valley(apart[len(steps) :])])
    if not np.isfinite(apart).any() or not here > 0:
        return Rival(math.inf, False)
    ratio = apart / here
    least = float(np.nanmin(ratio))
    if least >= NEARLY:
        return Rival(least, False)
    every = a.positions(_moving(a, np.unique(matches.pairs[:, 0]), RESTING))
    left, left_of_all = (Left.at(x, xb, a.times, b.times, offset) for x in (xa, every))

    def suits(at: float, ratio: float) -> bool:
        there = Left.at(xa, xb, a.times, b.times, at)
        if there.share <= NOTHING:
            return not there.much_worse_than(left)
        if ratio >= AS_GOOD:
            return False
        there_of_all = Left.at(every, xb, a.times, b.times, at)
        return not (there.much_worse_than(left) or there_of_all.surely_worse_than(left_of_all))

    nearest = [i for i in np.argsort(ratio, kind="stable")[:MOST_TRIED] if ratio[i] < NEARLY]
    return Rival(least, any(suits(float(others[i]), float(ratio[i])) for i in nearest))


def _beyond_the_valley(apart: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    """Distances further and further from the answer, nan as long as they only grow: these are shoulders of the answer's
    own valley, which is wide where things move slowly, and no other times.
    """
    known = np.flatnonzero(np.isfinite(apart))
    falls = np.flatnonzero(np.diff(apart[known]) < 0)
    first = known[falls[0] + 1] if len(falls) else len(apart)
    return np.where(np.arange(len(apart)) >= first, apart, np.nan)


def _moving(a: TrackSet, index: Int[np.ndarray, " M"], resting: float) -> Int[np.ndarray, " N"]:
    """Of the tracks of ``index``, up to :data:`TRACKS` of those that move more than a share ``resting`` of them."""
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of tracks that are never seen
        moved = np.nan_to_num(np.nanstd(a.positions(index), 1).sum(1))
    index = index[moved >= np.quantile(moved, resting)]
    return index[evenly(len(index), TRACKS)]


def _common_moments(ta: np.ndarray, tb: np.ndarray, offset: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Moments that both videos have at an offset, as indices into each; None where too little is common."""
    at = np.flatnonzero((ta - offset >= tb[0]) & (ta - offset <= tb[-1]))
    if not len(at) or ta[at[-1]] - ta[at[0]] < LEAST_COMMON:
        return None
    at = at[evenly(len(at), MOMENTS)]
    return at, np.abs(np.interp(ta[at] - offset, tb, np.arange(len(tb)))).round().astype(np.int64)


def _distance(
    xa: np.ndarray, xb: np.ndarray, ta: np.ndarray, tb: np.ndarray, likely: np.ndarray, offset: float
) -> float:
    """Rms distance of a's tracks to the nearest of their likely partners, the quantile :data:`NEAREST` of the tracks;
    nan where too little is common.
    """
    common = _common_moments(ta, tb, offset)
    if common is None:
        return math.nan
    at, with_b = common
    nearest = np.sqrt(_mean_square(xa[:, None, at] - xb[:, with_b][likely])).min(1)
    known = nearest[np.isfinite(nearest)]
    return float(np.quantile(known, NEAREST)) if len(known) >= LEAST_SEEN else math.nan


def _mean_square(x: np.ndarray, axis: int = 2) -> np.ndarray:
    """Of vectors over the moments of an axis that are seen; inf where these are fewer than :data:`LEAST_SEEN`."""
    square = (x**2).sum(-1)
    seen = np.isfinite(square)
    count = seen.sum(axis)
    return np.where(count >= LEAST_SEEN, np.where(seen, square, 0.0).sum(axis) / np.maximum(count, 1), np.inf)


@dataclass(frozen=True, eq=False)
class Left:
    """Of the motion of tracks and of their nearest partners at some time: all of it, and what the two do not have in
    common; variances of every track, nan where too little of it is seen.

    All tracks may be partners: features that are noise leave out the right ones.
    """

    power: Float[np.ndarray, " N"]
    left: Float[np.ndarray, " N"]

    @classmethod
    def at(cls, xa: np.ndarray, xb: np.ndarray, ta: np.ndarray, tb: np.ndarray, offset: float) -> Left:
        """At an offset between the videos."""
        unknown = np.full(len(xa), np.nan)
        common = _common_moments(ta, tb, offset)
        if common is None:
            return cls(unknown, unknown)
        at, with_b = common
        a, b = xa[:, at], xb[:, with_b]
        rows = max(1, AT_ONCE // max(b.shape[0] * b.shape[1], 1))
        apart = np.concatenate([_mean_square(a[i : i + rows, None] - b) for i in range(0, len(a), rows)])
        partner = apart.argmin(1)
        known = np.isfinite(apart[np.arange(len(a)), partner])
        u, v = a, b[partner]
        seen = np.isfinite(u[..., 0]) & np.isfinite(v[..., 0])
        power = _variance(u, seen) + _variance(v, seen)
        return cls(np.where(known, power, np.nan), np.where(known, _variance(u - v, seen), np.nan))

    def much_worse_than(self, other: Left) -> bool:
        """Whether much more is left than at another time. What nobody can tell is not worse."""
        mine, others = self._shares(other)
        return mine > AS_LITTLE_LEFT * others + LITTLE

    def surely_worse_than(self, other: Left) -> bool:
        """Whether more is left than at another time, however little, and the tracks are sure of it."""
        mine, others = self._shares(other)
        if not mine > others + LITTLE:
            return False
        with np.errstate(invalid="ignore", divide="ignore"):
            more = np.log(self.left / self.power) - np.log(other.left / other.power)
        more = more[np.isfinite(more)]
        return len(more) >= LEAST_SEEN and float(more.mean()) > SURE * float(more.std(ddof=1)) / math.sqrt(len(more))

    def _shares(self, other: Left) -> tuple[float, float]:
        """What is left at both times as a share of the motion of the tracks that both know; nan where they are few."""
        both = np.isfinite(self.power) & np.isfinite(other.power)
        if both.sum() < LEAST_SEEN:
            return math.nan, math.nan
        return self._share(both), other._share(both)

    @property
    def share(self) -> float:
        """Of the motion of all tracks that are known; nan where these are few."""
        known = np.isfinite(self.power)
        return self._share(known) if known.sum() >= LEAST_SEEN else math.nan

    def _share(self, tracks: np.ndarray) -> float:
        """Of the motion of some tracks, taken together; nan where none moves."""
        power = float(self.power[tracks].sum())
        return float(self.left[tracks].sum()) / power if power > 0 else math.nan


def _variance(x: Float[np.ndarray, "N S 3"], seen: np.ndarray) -> Float[np.ndarray, " N"]:
    """Of every track over the moments that are seen, summed over coordinates."""
    count = np.maximum(seen.sum(1), 1)
    filled = np.where(seen[..., None], x, 0.0)
    mean = filled.sum(1) / count[:, None]
    apart = np.where(seen[..., None], x - mean[:, None], 0.0)
    return np.asarray((apart**2).sum((1, 2)) / count)
