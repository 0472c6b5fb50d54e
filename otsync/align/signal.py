"""Matched tracks in the form that the compiled loops of the scan read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Signal:
    """One video's matched tracks in the kernels' form: (M,3,T) zero where unseen, (M,T) seen, (M,T) |x|²."""

    arrays: tuple[np.ndarray, np.ndarray, np.ndarray]
    extent: float

    @classmethod
    def of(cls, x: Float[np.ndarray, "M T 3"]) -> Signal:
        """After subtracting each track's own mean, which only serves the numerics."""
        seen = np.isfinite(x[..., 0])
        count = np.maximum(seen.sum(1), 1)[:, None]
        filled = np.where(seen[..., None], x, 0.0)
        mean = filled.sum(1) / count
        y = np.where(seen[..., None], x - mean[:, None], 0.0)
        there = mean[seen.any(1)]
        extent = float(np.sqrt(((there - there.mean(0)) ** 2).sum(1).mean())) if len(there) else 0.0
        spread = np.ascontiguousarray(y.transpose(0, 2, 1))
        return cls((spread, seen.astype(float), (spread**2).sum(1)), extent)
