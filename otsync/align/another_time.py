"""Whether an answer may show another time: a scene that returns tells nothing of a video that saw it later."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ..clocks.common import CommonClock
from ..compute.indices import evenly
from ..types.trust import Trust
from .evidence import DIRECT, MIN_FRAMES, SLOW, evidence, statistics_by_part

MATCHES = 40
"""Matches that are looked at, at least; more of short clips."""

RETURNS_FROM, RETURN_SEEN, RETURN_SHARE = 0.5, 1.2, 0.25
"""Seconds later, at least, at which a video is compared with itself; seconds of it that must be compared, and which
share of the frames and of the samples that both videos share at the answer: ends that are alike, or a few tracks that
are seen again, say little of all the others."""

AGREEING = 0.5
"""What a match must have of the upper quartile's correlation at the answer to agree with it. Partners that are wrong
make two videos less alike; a video is like itself whatever its tracks are matched to."""


def returning(
    pair: CommonClock, answer: int, least: int, max_lag: float | None, weight: Float[np.ndarray, " M"]
) -> tuple[float, float]:
    """How like two videos are at a lag, and either to itself at another time, at most: nats a match and common sample.

    Of times only at which the other one, were this what it shows, would leave fewer than ``least`` frames in common: no
    peak is there to say so. Those beyond ``max_lag`` (s) are ruled out by the caller. A scene that returns tells
    nothing of a video that began when the other had ended. Both are read from the matches that agree with the answer;
    of long clips from a few of them.
    """
    some = np.flatnonzero(agreeing(pair, answer))
    longest = max(pair.a.shape[1], pair.b.shape[1])
    some = some[evenly(len(some), max(MATCHES, DIRECT // (4 * longest**2)))]
    pair, weight = replace(pair, a=pair.a[some], b=pair.b[some]), weight[some]
    common = int(pair.overlap(np.array([answer]))[0])
    if not len(some) or common < 1:
        return 0.0, 0.0
    here, told = (x[0] for x in by_sample(pair, np.array([answer]), weight))
    reach, again = pair.lags(least, None), 0.0
    seen = max(round(RETURN_SEEN * pair.fps), math.ceil(RETURN_SHARE * common))

    def unseen(lags: Int[np.ndarray, " K"]) -> Bool[np.ndarray, " K"]:
        allowed = True if max_lag is None else np.abs(pair.origin + lags / pair.fps) <= max_lag + 1e-9
        return allowed & ((lags > reach[-1]) | (lags < reach[0]))

    for x in (pair.a, pair.b):
        later = np.arange(round(RETURNS_FROM * pair.fps), x.shape[1] - seen + 1)
        later = later[unseen(answer + later) | unseen(answer - later)] if len(reach) else later[:0]
        if len(later):
            alike, samples = by_sample(replace(pair, a=x, b=x), later, weight)
            again = max(again, float(np.max(alike, where=samples >= RETURN_SHARE * told, initial=0.0)))
    return float(here), again


def agreeing(pair: CommonClock, answer: int) -> Bool[np.ndarray, " M"]:
    """The matches whose slow velocities correlate at a lag as those of matches that are right do."""
    half, least = max(1, round(SLOW * pair.fps)), max(1, round(MIN_FRAMES * pair.fps))
    count, power, residual = (x[:, 0] for x in statistics_by_part(pair, np.array([answer]), least, half))
    known = (count > 0) & (power > 0)
    if not known.any():
        return known
    correlation = np.where(known, 1 - residual / np.where(known, power, 1.0), -np.inf)
    return correlation >= AGREEING * max(float(np.quantile(correlation[known], 0.75)), 0.0)


def by_sample(
    pair: CommonClock, lags: Int[np.ndarray, " K"], weight: Float[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """The scan's score at every lag by what a match is seen of there, 0 where none is; and what it is seen of."""
    curves = evidence(pair, lags, weight / max(float(weight.mean()), 1e-12))
    told = np.isfinite(curves.total) & (curves.samples > 0)
    return np.where(told, curves.total, 0.0) / np.where(told, curves.samples, 1.0), curves.samples


def may_be_another_time(returning: float, likeness: float, trust: Trust) -> bool:
    """Whether an answer may show what a video shows at another time too, for either is nearly as like itself then."""
    return returning > trust.returning * max(likeness, 0.0)
