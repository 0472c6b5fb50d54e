"""Samples of matched curves, piece by piece: without slow errors, and with the weights that the fit gives them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ..clocks.splines import TrackSplines
from ..compute.indices import evenly

PIECE = 10.0
"""Seconds that are looked at together: memory stays that of a short clip, and errors are forgotten within less."""

MOST_PIECES = 24
"""Of a longer clip so many pieces, evenly spread, stand for all."""

ROBUST = 2.0
"""Samples beyond this many noise scales count for less, as in the fit."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """The pieces of a clip that are looked at.

    Args:
        length: frames of a piece. near: frames in half a window of detrending. some: (S,) which pieces. count: of all.
    """

    length: int
    near: int
    some: Int[np.ndarray, " S"]
    count: int

    @classmethod
    def of(cls, own: TrackSplines, window: float) -> Pieces:
        return cls.at(own.frame, len(own.times), window)

    @classmethod
    def at(cls, frame: float, frames: int, window: float) -> Pieces:
        """Of a clip of so many frames, each ``frame`` s after the one before."""
        near = max(1, round(window / frame))
        length = max(round(PIECE / frame), 4 * near)
        count = max(1, math.ceil(frames / length))
        return cls(length, near, evenly(count, MOST_PIECES), count)

    @property
    def share(self) -> float:
        """Of all pieces, those that are looked at."""
        return len(self.some) / self.count

    def __iter__(self) -> Iterator[tuple[slice, slice]]:
        """Frames to read, and which of these count: the others are there for means."""
        for first in self.length * self.some:
            frames = slice(max(0, first - self.near), first + self.length + self.near)
            yield frames, slice(first - frames.start, first - frames.start + self.length)


def sample_weights(
    r: Float[np.ndarray, "M T 3"], seen: Bool[np.ndarray, "M T"], weight: Float[np.ndarray, " M"]
) -> Float[np.ndarray, "M T"]:
    """Weights of samples, by their residuals."""
    size = np.sqrt((r**2).sum(2))
    noise = float(np.median(size[seen])) if seen.any() else 0.0
    return np.where(seen, weight[:, None] / (1 + (size / max(ROBUST * noise, 1e-300)) ** 2), 0.0)


def detrended(x: Float[np.ndarray, "M T 3"], seen: Bool[np.ndarray, "M T"], near: int) -> Float[np.ndarray, "M T 3"]:
    """``x`` less its mean over the seen frames within ``near``; 0 where unseen."""
    T = x.shape[1]
    low, high = np.maximum(np.arange(T) - near, 0), np.minimum(np.arange(T) + near + 1, T)
    known = np.where(seen[..., None], x, 0.0)
    total = np.concatenate([np.zeros((len(x), 1, 3)), np.cumsum(known, 1)], 1)
    count = np.concatenate([np.zeros((len(x), 1)), np.cumsum(seen, 1)], 1)
    mean = (total[:, high] - total[:, low]) / np.maximum(count[:, high] - count[:, low], 1)[..., None]
    return np.where(seen[..., None], known - mean, 0.0)
