"""How much of the motion at the answer both videos have: what tells an offset, against what noise alone would do."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ..clocks.splines import TrackSplines
from ..types import Clock
from .samples import Pieces, detrended, sample_weights


def common_motion(
    a: TrackSplines,
    b: TrackSplines,
    clock: Clock,
    weight: Float[np.ndarray, " M"],
    window: float,
) -> float:
    """Correlation of the matched velocities, moment by moment, with the fit's weights.

    With u and v the velocities of a match in both videos, without their means over ± ``window``, it is
    ``Σ w u·v / √(Σ w u·u Σ w v·v)``. The cost of the fit curves by ``Σ w u·v`` at the answer, while Gauss-Newton takes
    it to curve by ``Σ w v·v``, the noise of v included: so this is also the share of the way that one step goes. Tracks
    that have only noise, or drifts, in common have next to none, however many there are. Read at the frames of both
    videos, so that exchanging them changes nothing.

    Args:
        a, b: curves of the matched tracks, m-th to m-th. weight: of the matches.

    Returns -1 to 1; 0 where nothing moves.
    """
    sums = np.zeros(3)
    for own, other, there in ((a, b, clock.own), (b, a, clock.world)):
        sums += _products(own, other, there, weight, window)
    uv, uu, vv = (float(s) for s in sums)
    return uv / math.sqrt(uu * vv) if uu > 0 and vv > 0 else 0.0


def _products(
    own: TrackSplines,
    other: TrackSplines,
    there: Callable[[np.ndarray], np.ndarray],
    weight: Float[np.ndarray, " M"],
    window: float,
) -> Float[np.ndarray, " 3"]:
    """Σ w u·v, Σ w u·u, Σ w v·v at the frames of ``own``."""
    sums = np.zeros(3)
    parts = Pieces.of(own, window)
    for frames, middle in parts:
        times = own.times[frames]
        seen = own.support(times) & other.support(there(times))
        x, y = own.joined(times), other.joined(there(times))
        u, v = own.velocity(times), other.velocity(there(times))
        r, u, v = (detrended(values, seen, parts.near)[:, middle] for values in (x - y, u, v))
        w = sample_weights(r, seen[:, middle], weight)[..., None]
        sums += [float((w * p).sum()) for p in (u * v, u * u, v * v)]
    return sums
