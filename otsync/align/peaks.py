"""Peaks of a score curve: where they are, to a fraction of a step, and which of them compete."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

OTHERS = 8
"""Local maxima of a curve that are looked at besides the highest."""


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


def separate_peaks(
    score: Float[np.ndarray, " K"], apart: int, n: int | None = None, prefer: Float[np.ndarray, " K"] | None = None
) -> list[int]:
    """Indices of the ``n`` highest local maxima (default: all), best first, each at least ``apart`` from a higher one.

    The global maximum is always among them. Of equal scores the one of smaller ``prefer`` comes first; default: the
    first one.
    """
    padded = np.pad(score, 1, constant_values=-np.inf)
    local = np.flatnonzero(np.isfinite(score) & (score >= padded[:-2]) & (score >= padded[2:]))
    rank = np.arange(len(score)) if prefer is None else prefer
    chosen: list[int] = []
    for i in sorted(local, key=lambda i: (-score[i], rank[i])):
        if len(chosen) == n:
            break
        if all(abs(i - j) >= apart for j in chosen):
            chosen.append(int(i))
    return chosen


def vertex(lags: Int[np.ndarray, " K"], score: Float[np.ndarray, " K"], i: int) -> float:
    """Lag of the parabola's top through a peak and its neighbours."""
    if 0 < i < len(score) - 1 and np.isfinite(score[i - 1]) and np.isfinite(score[i + 1]):
        bend = score[i - 1] - 2 * score[i] + score[i + 1]
        if bend < 0:
            return float(lags[i] + np.clip(0.5 * (score[i - 1] - score[i + 1]) / bend, -0.5, 0.5))
    return float(lags[i])


def likely(evidence: Float[np.ndarray, " K"], least: int) -> list[int]:
    """The best local maxima but the first, at least ``least`` lags apart, best first, up to :data:`OTHERS` of them."""
    inner = np.flatnonzero((evidence[1:-1] >= evidence[:-2]) & (evidence[1:-1] > evidence[2:])) + 1
    found = [int(np.argmax(evidence))]
    for k in inner[np.argsort(-evidence[inner], kind="stable")]:
        if all(abs(int(k) - j) >= least for j in found):
            found.append(int(k))
        if len(found) > OTHERS:
            break
    return found[1:]
