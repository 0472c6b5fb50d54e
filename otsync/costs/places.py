"""Whether matched tracks are at one place at equal times: what velocities cannot see."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from ..clocks.common import CommonClock, common_clock, readable, strongest
from ..compute.indices import blocks
from ..compute.medians import known_median
from ..types import Matches, TrackSet
from .linear import velocity

FAST = 2 / 30
"""Half window, s, of the velocities that are compared."""

MATCHES = 200
"""Most matches that places are compared of."""

SUPPORTS, ENOUGH = 0.5, 4
"""Correlation of velocities from which a match supports an offset, and how many such matches a verdict needs."""


def apart(a: TrackSet, b: TrackSet, matches: Matches, offset: float) -> float:
    """Median distance at equal times of the matched tracks that move alike, relative to the size of the scene.

    The size: the median distance between matched tracks within a video. nan where too few matches move alike.
    Velocities do not see a constant offset: somebody else who does the same a little later fits as well as the same
    point, but is somewhere else.
    """
    pair = common_clock(a, b, strongest(matches, readable(MATCHES, a, b)))
    x, y = in_common(pair, round(pair.lag(offset)))
    supporting = moves_alike(x, y, max(1, round(FAST * pair.fps)))
    if supporting.sum() < ENOUGH:
        return float("nan")
    x, y = x[supporting], y[supporting]
    parts = list(blocks(*x.shape[:2]))
    distance = known_median(np.concatenate([known_median(np.linalg.norm(x[p] - y[p], axis=2), 1) for p in parts]), 0)
    sizes = [size(z) for z in (x, y)]
    scale = float(np.mean(sizes))
    return float(distance / scale) if scale > 0 else float("nan")


def in_common(pair: CommonClock, lag: int) -> tuple[Float[np.ndarray, "M T 3"], Float[np.ndarray, "M T 3"]]:
    """Samples of both at the frames that they share at ``lag``."""
    first, last = max(0, lag), min(pair.a.shape[1], pair.b.shape[1] + lag)
    if last <= first:
        return pair.a[:, :0], pair.b[:, :0]
    return pair.a[:, first:last], pair.b[:, first - lag : last - lag]


def moves_alike(x: Float[np.ndarray, "M T 3"], y: Float[np.ndarray, "M T 3"], half: int) -> Bool[np.ndarray, " M"]:
    """Which matches' velocities over ±``half`` frames correlate at equal times."""
    alike = np.zeros(len(x), bool)
    for some in blocks(*x.shape[:2]):
        u, v = velocity(x[some], half), velocity(y[some], half)
        known = np.isfinite(u[..., 0]) & np.isfinite(v[..., 0])
        u, v = (np.where(known[..., None], w, 0.0) for w in (u, v))
        uv, uu, vv = ((p * q).sum((1, 2)) for p, q in ((u, v), (u, u), (v, v)))
        power = np.sqrt(uu * vv)
        alike[some] = (power > 0) & (uv > SUPPORTS * power)
    return alike


def size(x: Float[np.ndarray, "M T 3"]) -> float:
    """Median distance between the tracks' median positions."""
    from scipy.spatial.distance import pdist

    medians = np.concatenate([known_median(x[some], 1) for some in blocks(*x.shape[:2])] or [np.zeros((0, 3))])
    distance = pdist(medians[np.isfinite(medians[:, 0])])
    return float(np.median(distance)) if len(distance) else 0.0
