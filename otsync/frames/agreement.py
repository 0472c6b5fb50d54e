"""Two videos laid over each other at a clock and a similarity: who is near whom and moves alike, and how many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..costs.linear import Cosine
from ..types import Similarity
from .clouds import Cloud, seen_and_filled

SPACING, MOST_MOMENTS = 0.1, 1200
"""Seconds between the common moments that are looked at, and how many at most (two minutes; then further apart)."""

LEAST_MOMENTS = 6
"""That both tracks of a pair are seen at, however long the videos are: a track lives for a part of them."""

PLACE, MOTION, FEATURE = 0.05, 0.025, 2.0
"""What costs 1 in matching: distance of place and of motion in units of the scene, and distance of features."""

NEAR = 0.12
"""Units at which two tracks are no longer near each other, for :meth:`Overlay.agreement`."""


@dataclass(frozen=True, eq=False)
class Overlay:
    """Distances of all tracks at common moments (:func:`otsync.frames.kernels.laid_over`), nan where hardly seen."""

    place: Float[np.ndarray, "Na Nb"]
    motion: Float[np.ndarray, "Na Nb"]
    alike: Float[np.ndarray, "Na Nb"]

    def agreement(self) -> float:
        """How many tracks have a counterpart that is near and moves alike: a sum of mutually best pairs, 0 to N.

        What a wrong answer cannot reach: bodies laid over other bodies are near, but do not move alike.
        """
        near = np.maximum(0.0, 1 - np.nan_to_num(self.place, nan=np.inf) / NEAR)
        score = near * np.maximum(0.0, np.nan_to_num(self.alike))
        if not score.size:
            return 0.0
        best = score.argmax(1)
        rows = np.flatnonzero(score.argmax(0)[best] == np.arange(len(score)))
        return float(score[rows, best[rows]].sum())

    def matches(
        self, features: Float[np.ndarray, "Na Nb"] | None, k: int, top: int
    ) -> tuple[Int[np.ndarray, "M 2"], Float[np.ndarray, " M"]]:
        """Pairs among the ``k`` best of each other, at most ``top``, best first, and what they cost.

        On basketball the errors of rotation fall from 2.0 to 1.4 degrees (median) when both tracks must have each other
        among their three best, instead of either.
        """
        cost = self.place / PLACE + self.motion / MOTION
        if features is not None:
            cost = cost + features / FEATURE
        cost = np.where(np.isfinite(cost), cost, np.inf)
        mutual = (_rank(cost, 1) < k) & (_rank(cost, 0) < k) & np.isfinite(cost)
        pairs = np.argwhere(mutual)
        order = np.argsort(cost[mutual], kind="stable")[:top]
        return pairs[order], cost[mutual][order]


def overlay(a: Cloud, b: Cloud, offset: float, rate: float, transform: Similarity) -> Overlay:
    """Lay b over a: ``t_a = rate t_b + offset``, ``x_a = transform(x_b)``, both in units."""
    from . import kernels

    first = max(a.curves.times[0], rate * b.curves.times[0] + offset)
    last = min(a.curves.times[-1], rate * b.curves.times[-1] + offset)
    place, motion, alike = np.full((3, len(a), len(b)), np.nan)
    if last > first:
        t = np.linspace(first, last, min(MOST_MOMENTS, max(LEAST_MOMENTS, round((last - first) / SPACING))))
        root = np.sqrt(transform.scale)
        xa, wa = seen_and_filled(a.curves.sample(t) / root)
        xb, wb = seen_and_filled(transform(b.curves.sample((t - offset) / rate)) / root)
        kernels.laid_over(xa, wa, xb, wb, LEAST_MOMENTS, place, motion, alike)
    return Overlay(place, motion, alike)


def feature_distances(a: Cloud, b: Cloud) -> Float[np.ndarray, "Na Nb"] | None:
    """Cosine distances, None without features."""
    if a.tracks.features is None or b.tracks.features is None:
        return None
    return Cosine().matrix(a.tracks, b.tracks)


def _rank(cost: np.ndarray, axis: int) -> np.ndarray:
    order = np.argsort(cost, axis=axis, kind="stable")
    rank = np.empty_like(order)
    places = np.arange(cost.shape[axis])
    np.put_along_axis(rank, order, places[None] if axis else places[:, None], axis)
    return rank
