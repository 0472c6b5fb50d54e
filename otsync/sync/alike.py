"""How well the positions of matched tracks agree: samples as they were seen, and how far apart they usually are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..clocks.common import missing
from ..compute.medians import known_median
from ..types import TrackSet

LIMIT = 200
"""Matches that a break is located by."""

MARGIN = 3 / 30
"""Seconds beside a break that the fits of its parts leave out: curves are smoothed across it."""

LEAST_KNOWN = 5
"""Samples that tell where a match's own constant difference lies, at least."""

LEAST_BESIDE = 4
"""Frames that are asked beside a break, at least."""


@dataclass(frozen=True, eq=False)
class Raw:
    """Matched tracks as they were seen: curves are smoothed across a break, samples are not.

    Args:
        times: (T,) s. x: (M,T,3), nan where not seen.
    """

    times: np.ndarray
    x: np.ndarray

    @classmethod
    def of(cls, tracks: TrackSet, index: np.ndarray) -> Raw:
        return cls(tracks.times, tracks.take(index).positions())

    def around(self, when: float, seconds: float) -> Raw:
        """The frames within so many seconds of a moment of the video's own clock."""
        near = slice(*np.searchsorted(self.times, [when - seconds, when + seconds]))
        return Raw(self.times[near], self.x[:, near])

    def at(self, t: np.ndarray) -> np.ndarray:
        """(M,S,3) between two samples on a line; nan outside, and in a gap, of which nothing is known."""
        if len(self.times) < 2:
            return np.full((len(self.x), len(t), 3), np.nan)
        right = np.clip(np.searchsorted(self.times, t), 1, len(self.times) - 1)
        step = self.times[right] - self.times[right - 1]
        share = (t - self.times[right - 1]) / step
        x = (1 - share)[None, :, None] * self.x[:, right - 1] + share[None, :, None] * self.x[:, right]
        unknown = (share < 0) | (share > 1) | ((share > 0) & (share < 1) & self._missing[right - 1])
        return np.where(unknown[None, :, None], np.nan, x)

    def sampled(self, t: np.ndarray) -> np.ndarray:
        """(S,) whether a moment lies between two samples that are no gap apart."""
        if len(self.times) < 2:
            return np.zeros(len(t), bool)
        return np.asarray(~self._missing[np.clip(np.searchsorted(self.times, t), 1, len(self.times) - 1) - 1])

    @cached_property
    def _missing(self) -> np.ndarray:
        return missing(self.times)

    @cached_property
    def _bends(self) -> np.ndarray:
        square = np.zeros(self.x.shape[:2])
        second = ((self.x[:, 2:] - 2 * self.x[:, 1:-1] + self.x[:, :-2]) ** 2).sum(2) / 64
        square[:, 1:-1] = np.where(np.isfinite(second), second, 0.0)
        return square

    def bent(self, t: np.ndarray) -> np.ndarray:
        """(M,S) how far a curve may lie off such a line, squared: an eighth of the second difference; 0 where unknown.

        At a sample it is an eighth as well: curves that bend there are not known better than their samples are apart.
        """
        right = np.clip(np.searchsorted(self.times, t), 1, len(self.times) - 1)
        return np.maximum(self._bends[:, right - 1], self._bends[:, right])


@dataclass(frozen=True, eq=False)
class Usual:
    """How far apart matched tracks usually are, which tells how well they agree elsewhere.

    Args:
        known: (M,) matches of which enough is seen. middle: (M',3) the constant difference of each of them, its median.
        spread: the median squared distance from it.
    """

    known: np.ndarray
    middle: np.ndarray
    spread: float

    @classmethod
    def of(cls, apart: np.ndarray, inside: np.ndarray) -> Usual:
        """From the differences (M,S,3) at the moments ``inside`` (S,)."""
        seen = np.isfinite(apart[..., 0]) & inside
        known = seen.sum(1) >= LEAST_KNOWN
        if not known.any():
            return cls(known, np.zeros((0, 3)), 1.0)
        middle = known_median(np.where(seen[known][..., None], apart[known], np.nan), 1)
        off = ((apart[known] - middle[:, None]) ** 2).sum(2)
        return cls(known, middle, float(np.median(off[seen[known]])) + 1e-300)

    def levels(self, apart: np.ndarray, bent: np.ndarray | None = None) -> np.ndarray:
        """(M',S) how well each known match agrees at each moment, in (-inf, 1]; nan where it is not seen.

        Args:
            apart: (M,S,3) differences. bent: (M,S) squared error of what was read between samples; it counts for
                nothing.
        """
        off = ((apart[self.known] - self.middle[:, None]) ** 2).sum(2)
        usual = self.spread if bent is None else self.spread + bent[self.known]
        return np.asarray(1 - np.log1p(off / (4 * usual)))
