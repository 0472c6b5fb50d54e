"""Peaks of a score curve: where they are, to a fraction of a step, and which of them compete."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def is_constant(values: np.ndarray) -> bool:
    """Whether values differ by no more than rounding: costs of things at rest, which tell no time."""
    return float(np.ptp(values)) <= 1e-9 * float(np.abs(values).max(initial=0.0))


def most_frequent(offsets: Int[np.ndarray, " P"]) -> float:
    """The mode; the mean of the modes when several are equally frequent."""
    values, counts = np.unique(offsets, return_counts=True)
    return float(values[counts == counts.max()].mean())


def peak(lags: Int[np.ndarray, " K"], score: Float[np.ndarray, " K"]) -> float:
    """The lag of the highest score, moved to the vertex of the parabola through it and its neighbours.

    Equal scores are decided for the smallest |lag|.
    """
    top = np.flatnonzero(score == score.max())
    return vertex(lags, score, int(top[np.argmin(np.abs(lags[top]))]))


def separate_peaks(curve: Float[np.ndarray, " K"], apart: int) -> Int[np.ndarray, " P"]:
    """Local maxima, best first, each at least ``apart`` from a better one; the global one is always among them."""
    padded = np.concatenate([[-np.inf], curve, [-np.inf]])
    local = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]) & np.isfinite(curve))
    chosen: list[int] = []
    for k in local[np.argsort(-curve[local], kind="stable")]:
        if all(abs(k - c) >= apart for c in chosen):
            chosen.append(int(k))
    return np.array(chosen, int)


def local_peaks(lags: Int[np.ndarray, " K"], score: Float[np.ndarray, " K"], apart: int, n: int) -> list[int]:
    """Indices of the ``n`` highest local maxima at least ``apart`` lags from a higher one; the smallest |lag| on ties."""
    padded = np.pad(score, 1, constant_values=-np.inf)
    top = np.isfinite(score) & (score >= padded[:-2]) & (score >= padded[2:])
    found: list[int] = []
    for i in sorted(np.flatnonzero(top), key=lambda i: (-score[i], abs(lags[i]))):
        if all(abs(lags[i] - lags[j]) >= apart for j in found):
            found.append(int(i))
        if len(found) == n:
            break
    return found


def vertex(lags: Int[np.ndarray, " K"], score: Float[np.ndarray, " K"], i: int) -> float:
    """Lag of the parabola's top through a peak and its neighbours."""
    if 0 < i < len(score) - 1 and np.isfinite(score[i - 1]) and np.isfinite(score[i + 1]):
        bend = score[i - 1] - 2 * score[i] + score[i + 1]
        if bend < 0:
            return float(lags[i] + np.clip(0.5 * (score[i - 1] - score[i + 1]) / bend, -0.5, 0.5))
    return float(lags[i])
