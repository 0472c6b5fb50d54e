"""A pair in windows: how well its videos agree there, at every lag or at one."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import CommonClock
from ..compute.indices import blocks
from .signal import Signal

STEP = 10 / 30
"""Half the length, s, of the windows that are compared, and how far they are apart."""

LEAST_WINDOW = 8 / 30
"""Seconds that a match must be seen in both videos within a window."""

MOVES = 6.0
"""Variance of a match within a window, in units of the noise floor, above which it moves there."""

BEST_QUARTER, LEAST_MOVING = 0.75, 5

LEAST_MISSING = 0.15
"""What counts as missing at all, of the motion that a window should have in common."""


def local_curves(
    pair: CommonClock, lags: Int[np.ndarray, " K"], floor: float, weight: Float[np.ndarray, " M"]
) -> Float[np.ndarray, "W K"]:
    """Evidence of every window of a's frames (two steps long) at every lag, nats a match."""
    from . import kernels

    def frames(seconds: float) -> int:
        return max(1, round(seconds * pair.fps))

    step = frames(STEP)
    count = -(-pair.a.shape[1] // step) + 1
    out = np.zeros((count, len(lags)))
    begin = np.zeros(len(lags), np.int64)
    for some in blocks(len(pair.a), max(pair.a.shape[1], pair.b.shape[1])):  # of long clips few matches at a time
        a, b = Signal.of(pair.a[some]), Signal.of(pair.b[some])
        arrays = *a.for_kernels, *b.for_kernels, lags, begin, step, frames(LEAST_WINDOW), floor, weight[some], out
        kernels.windowed_evidence(*arrays)
    out /= max(len(pair.a), 1)
    return out


def seen_share(pair: CommonClock, lag: int, step: int) -> Float[np.ndarray, " W"]:
    """Of the samples in every window of :func:`local_curves`, the share that both videos see at a lag."""
    T = pair.a.shape[1]
    share = np.zeros(-(-T // step) + 1)
    first, end = max(0, lag), min(T, pair.b.shape[1] + lag)
    if end > first:
        both = np.isfinite(pair.a[:, first:end, 0]) & np.isfinite(pair.b[:, first - lag : end - lag, 0])
        total = np.concatenate([[0.0], np.cumsum(both.mean(0))])
        low, high = (np.clip((np.arange(len(share)) + k) * step - first, 0, end - first) for k in (-1, 1))
        share = (total[high] - total[low]) / (2 * step)
    return share


def explained(pair: CommonClock, lag: int, floor: float, step: int) -> tuple[float, float]:
    """How much of the motion within a window both videos have in common at a lag, in the least window: 1 - Var(a - b) /
    (Var a + Var b) of the best quarter of the matches that move there; 1 where none does. And what is missing to 1 in
    the least two in a row, as a multiple of what is usually missing.
    """
    first, end = max(0, lag), min(pair.a.shape[1], pair.b.shape[1] + lag)
    shares = []
    for begin in range(first, end - 2 * step + 1, step):
        x, y = pair.a[:, begin : begin + 2 * step], pair.b[:, begin - lag : begin - lag + 2 * step]
        seen = np.isfinite(x[..., 0]) & np.isfinite(y[..., 0])
        use = seen.sum(1) >= LEAST_WINDOW * pair.fps
        if use.sum() < LEAST_MOVING:
            continue
        x, y, seen = x[use], y[use], seen[use]
        power = variance(x, seen) + variance(y, seen)
        moves = power > MOVES * floor
        if moves.sum() >= LEAST_MOVING:
            common = 1 - variance(x - y, seen)[moves] / power[moves]
            shares.append(float(np.quantile(common, BEST_QUARTER)))
        else:
            shares.append(1.0)
    if not shares:
        return 1.0, 1.0
    pairs = np.maximum(shares[:-1], shares[1:]) if len(shares) > 1 else np.array(shares)
    missing = 1 - float(pairs.min())
    ratio = missing / max(1 - float(np.median(shares)), 1e-3) if missing > LEAST_MISSING else 1.0
    return min(shares), ratio


def agreement(pair: CommonClock, begin: int, end: int, lag: int, floor: float) -> float:
    """The share of its motion that the median match has in common with its partner, over a's frames from ``begin`` to
    ``end`` at a lag."""
    begin = max(0, lag, begin)
    end = min(pair.a.shape[1], pair.b.shape[1] + lag, end)
    if end - begin < LEAST_WINDOW * pair.fps:
        return 0.0
    x, y = pair.a[:, begin:end], pair.b[:, begin - lag : end - lag]
    seen = np.isfinite(x[..., 0]) & np.isfinite(y[..., 0])
    use = seen.sum(1) >= LEAST_WINDOW * pair.fps
    if use.sum() < LEAST_MOVING:
        return 0.0
    x, y, seen = x[use], y[use], seen[use]
    power = variance(x, seen) + variance(y, seen)
    moves = power > MOVES * floor
    if moves.sum() < LEAST_MOVING:
        return 0.0
    return float(np.median(1 - variance(x - y, seen)[moves] / power[moves]))


def variance(x: Float[np.ndarray, "M T 3"], seen: np.ndarray) -> Float[np.ndarray, " M"]:
    """Over the samples that are seen, all three coordinates together."""
    filled, count = np.where(seen[..., None], x, 0.0), seen.sum(1)
    mean = filled.sum(1) / count[:, None]
    return np.asarray((np.where(seen[..., None], x - mean[:, None], 0.0) ** 2).sum((1, 2)) / count)
