"""Matched tracks in the form that the compiled loops of the scan read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ..compute.indices import blocks, lives


@dataclass(frozen=True, eq=False)
class Signal:
    """One video's matched tracks in the kernels' form.

    Args:
        arrays: (M,3,T) zero where unseen, (M,T) seen, (M,T) |x|². lives: (M,2) from and before which frame.
    """

    arrays: tuple[np.ndarray, np.ndarray, np.ndarray]
    lives: Int[np.ndarray, "M 2"]

    @classmethod
    def of(cls, x: Float[np.ndarray, "M T 3"]) -> Signal:
        """After subtracting each track's own mean, which only serves the numerics."""
        M, T, _ = x.shape
        spread, weight, square = np.empty((M, 3, T)), np.empty((M, T)), np.empty((M, T))
        alive = np.zeros((M, 2), int)
        for some in blocks(M, T):
            seen, mean = means(x[some])
            y = np.where(seen[..., None], x[some] - mean[:, None], 0.0)
            spread[some] = y.transpose(0, 2, 1)
            weight[some], square[some] = seen, (spread[some] ** 2).sum(1)
            alive[some] = lives(seen)
        return cls((spread, weight, square), alive)

    @property
    def for_kernels(self) -> tuple[np.ndarray, ...]:
        """What loops over lags and frames read."""
        return *self.arrays, self.lives


def means(x: Float[np.ndarray, "M T 3"]) -> tuple[Bool[np.ndarray, "M T"], Float[np.ndarray, "M 3"]]:
    """Where tracks are seen, and the mean of each; 0 of one that never is."""
    seen = np.isfinite(x[..., 0])
    filled = np.where(seen[..., None], x, 0.0)
    return seen, filled.sum(1) / np.maximum(seen.sum(1), 1)[:, None]


def extent_of(x: Float[np.ndarray, "M T 3"]) -> float:
    """Rms distance of the tracks' means from their own mean; 0 when nothing is seen."""
    there = []
    for some in blocks(*x.shape[:2]):
        seen, mean = means(x[some])
        there.append(mean[seen.any(1)])
    known = np.concatenate(there)
    return float(np.sqrt(((known - known.mean(0)) ** 2).sum(1).mean())) if len(known) else 0.0
