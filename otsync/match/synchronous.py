"""Matching once more when the clocks are known: position and motion at the same moments join the features."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ..clocks.splines import sampled
from ..costs.linear import Cosine, Cost, binary_scale, total_cost
from ..costs.positions import SynchronousDistance
from ..types import Clock, Matches, Status, TrackSet
from .slot import Matcher

MOMENTS = 48
"""Synchronous moments that distances are averaged over."""

LEAST_MOMENTS = 6

FEATURE, PLACE, MOTION = 0.25, 1 / 3, 1 / 9
"""What counts as one unit: of feature distance; of distance and of distance in motion, as shares of the scene's extent.

(.15 m and .05 m for a person, whose rms extent is about .45 m.)
"""

FARTHEST = 3.0
"""Units at which the distance of place is cut off."""


@dataclass(frozen=True)
class SynchronousMatching(Matcher):
    """Mutual nearest neighbours in features, place and motion at synchronised times: a matcher for one pair of videos.

    The cost of two tracks is the sum of their feature distance, the mean (each moment cut off at three units) of their
    distance at the same moments, and the rms of that distance after removing its mean, each in units of its own scale.
    Place counts only when both sets declare one world frame. Pairs hardly ever seen together are not matched.

    Args:
        offset, rate: t_a = rate * t_b + offset, from :func:`otsync.align`.
        costs: the linear terms of features, as of any matcher.
        limit: of larger sets only so many tracks take part, those seen longest: the cost is a dense matrix.
    """

    offset: float
    rate: float = 1.0
    costs: tuple[Cost, ...] = (Cosine(),)
    limit: int = 2000

    @property
    def clock(self) -> Clock:
        return Clock(self.offset, self.rate)

    @property
    def needs_xyz(self) -> bool:
        return True

    def at(self, clock: Clock) -> SynchronousMatching:
        """The same, at another clock; costs of known times at it, too."""
        costs = tuple(c.at(clock) if hasattr(c, "at") else c for c in self.costs)
        return replace(self, offset=clock.offset, rate=clock.rate, costs=costs)

    def checked_by(self, a: TrackSet, b: TrackSet) -> tuple[Cost, ...]:
        """Features, and places at equal times in a common world frame."""
        if a.frame is None or a.frame != b.frame:
            return self.costs
        return (*self.costs, SynchronousDistance(self.offset, rate=self.rate))

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        a.check("a")
        b.check("b")
        own_a, own_b = longest_seen(a, self.limit), longest_seen(b, self.limit)
        cost = self.cost(a.take(own_a), b.take(own_b))
        if not np.isfinite(cost).any():
            return Matches(np.zeros((0, 2), int), flags=(Status.NO_OVERLAP,))
        i, j = mutual(cost)
        value = cost[i, j]
        order = np.argsort(value, kind="stable")
        flags = () if len(i) else (Status.NO_MATCH,)
        return Matches(
            np.stack([own_a[i], own_b[j]], 1)[order],
            -value[order],
            flags=flags,
            stats={"objective": float(value.sum()), "mass": len(i) / max(min(len(a), len(b)), 1)},
        )

    def cost(self, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
        """In units; infinite where two tracks are not seen together at enough moments."""
        return joined(self.unlike(a, b), *self.distances(a, b), placed(a, b))

    def unlike(self, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"] | float:
        """The part of features, in units; 0 without any."""
        known = a.features is not None and b.features is not None
        return total_cost(self.costs, a, b) / FEATURE if known else 0.0

    def distances(self, a: TrackSet, b: TrackSet) -> tuple[Float[np.ndarray, "Na Nb"], Float[np.ndarray, "Na Nb"]]:
        """Truncated mean distance and rms demeaned distance at common moments, in extents of the scene; nan: unseen."""
        first = max(a.times[0], self.rate * b.times[0] + self.offset)
        last = min(a.times[-1], self.rate * b.times[-1] + self.offset)
        unseen = np.full((len(a), len(b)), np.nan)
        if last <= first:
            return unseen, unseen
        t = np.linspace(first, last, MOMENTS)
        assert a.xyz is not None and b.xyz is not None
        at_a = sampled(a.times, a.xyz, a.seen, t)
        at_b = sampled(b.times, b.xyz, b.seen, (t - self.offset) / self.rate)
        scale = max(binary_scale(at_a), binary_scale(at_b))  # a power of two: what is divided by it stays exact
        at_a, at_b = at_a / scale, at_b / scale
        extent = 0.5 * (rms_extent(at_a) + rms_extent(at_b))
        return apart(at_a, at_b, extent) if extent > 0 else (unseen, unseen)


def placed(a: TrackSet, b: TrackSet) -> bool:
    """Whether both declare one world frame, so that places count."""
    return a.frame is not None and a.frame == b.frame


def apart(
    a: Float[np.ndarray, "Na S 3"], b: Float[np.ndarray, "Nb S 3"], extent: float
) -> tuple[Float[np.ndarray, "Na Nb"], Float[np.ndarray, "Na Nb"]]:
    """Truncated mean distance and rms demeaned distance of tracks at S moments, in extents; nan: hardly seen together.

    Args:
        a, b: positions, nan where unseen. extent: of the scene, in the same unit.
    """
    from ..compute.threads import for_each, ranges
    from .kernels import synchronous_distances

    wa, wb = np.isfinite(a[..., 0]), np.isfinite(b[..., 0])
    fa = np.where(wa[..., None], a, 0.0) / extent
    fb = np.where(wb[..., None], b, 0.0) / extent
    place, motion = (np.full((len(a), len(b)), np.nan) for _ in range(2))

    def work(*rows: int) -> None:
        synchronous_distances(fa, wa, fb, wb, FARTHEST * PLACE, LEAST_MOMENTS, *rows, place, motion)

    for_each(work, ranges(len(a), 64))
    return place, motion


def joined(
    features: Float[np.ndarray, "Na Nb"] | float,
    place: Float[np.ndarray, "Na Nb"],
    motion: Float[np.ndarray, "Na Nb"],
    both: bool,
) -> Float[np.ndarray, "Na Nb"]:
    """The cost of every two tracks, in units; infinite where their motion is not known. ``both``: places count."""
    cost = features + motion / MOTION + (place / PLACE if both else 0.0)
    return np.where(np.isfinite(motion), cost, np.inf)


def mutual(cost: Float[np.ndarray, "Na Nb"]) -> tuple[Int[np.ndarray, " M"], Int[np.ndarray, " M"]]:
    """Rows and columns that are each other's cheapest, at a finite cost."""
    best_b, best_a = cost.argmin(1), cost.argmin(0)
    i = np.flatnonzero((best_a[best_b] == np.arange(len(cost))) & np.isfinite(cost.min(1)))
    return i, best_b[i]


def longest_seen(tracks: TrackSet, limit: int) -> Int[np.ndarray, " n"]:
    """At most ``limit`` tracks, those with the most observed samples, in their order."""
    return np.sort(np.argsort(-tracks.seen.sum(1), kind="stable")[:limit])


def rms_extent(x: Float[np.ndarray, "N S 3"]) -> float:
    """Rms distance of the tracks' mean positions from their centre; 0 when nothing is seen."""
    seen = np.isfinite(x[..., 0])
    there = seen.any(1)
    if not there.any():
        return 0.0
    filled = np.where(seen[..., None], x, 0.0)[there]
    mean = filled.sum(1) / seen[there].sum(1)[:, None]
    return float(np.sqrt(((mean - np.median(mean, 0)) ** 2).sum(1).mean()))
