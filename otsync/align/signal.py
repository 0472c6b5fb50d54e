"""Matched tracks in the form that the compiled loops of the scan read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..compute.indices import blocks


@dataclass(frozen=True, eq=False)
class Signal:
    """One video's matched tracks in the kernels' form: (M,3,T) zero where unseen, (M,T) seen, (M,T) |x|²."""

    arrays: tuple[np.ndarray, np.ndarray, np.ndarray]
    extent: float

    @classmethod
    def of(cls, x: Float[np.ndarray, "M T 3"]) -> Signal:
        """After subtracting each track's own mean, which only serves the numerics."""
        M, T, _ = x.shape
        spread, weight, square, mean = np.empty((M, 3, T)), np.empty((M, T)), np.empty((M, T)), np.empty((M, 3))
        for some in blocks(M, T):
            seen = np.isfinite(x[some, :, 0])
            count = np.maximum(seen.sum(1), 1)[:, None]
            filled = np.where(seen[..., None], x[some], 0.0)
            mean[some] = filled.sum(1) / count
            y = np.where(seen[..., None], x[some] - mean[some, None], 0.0)
            spread[some] = y.transpose(0, 2, 1)
            weight[some], square[some] = seen, (spread[some] ** 2).sum(1)
        there = mean[weight.any(1)]
        extent = float(np.sqrt(((there - there.mean(0)) ** 2).sum(1).mean())) if len(there) else 0.0
        return cls((spread, weight, square), extent)
