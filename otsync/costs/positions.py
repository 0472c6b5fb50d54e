"""Cost objects that compare where tracks are, for cameras that share a world frame; they need no time.

Both measure in units of the scene: ``scale`` times the median distance between the tracks of both videos.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ..compute.indices import blocks
from ..types import Clock, TrackSet
from .linear import Cost

SCALE_SAMPLES = 2000
"""Tracks that the size of the scene is measured on; all pairs of 50,000 would take gigabytes."""


@dataclass(frozen=True)
class CurveDistance:
    """How far apart the two paths run, wherever on them the other one was at the time.

    Every sample of a path has a distance to the nearest sample of the other path. The smaller ``share`` of them is
    averaged, in both directions, and the two means once more. The trimming forgives the parts of a path that the
    other video never saw. The largest single gain in matching on basketball.

    Args:
        weight: factor of this term. scale: distance that costs 1, relative to the scene's (.15: 20 cm in basketball).
        cap: largest value of the cost: beyond it a pair is wrong, however far.
        share: of the samples that count. samples: most samples of a path that are looked at.
    """

    weight: float = 1.0
    scale: float = 0.15
    cap: float = 3.0
    share: float = 0.8
    samples: int = 50

    needs_xyz = True

    def at(self, clock: Clock) -> SynchronousDistance:
        """What tells the same better once the clocks are known."""
        return SynchronousDistance(clock.offset, rate=clock.rate)

    def matrix(self, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
        return all_pairs(self, a, b)

    def pairs(
        self, a: TrackSet, b: TrackSet, i: Int[np.ndarray, " P"], j: Int[np.ndarray, " P"]
    ) -> Float[np.ndarray, " P"]:
        from .kernels import curve_distances

        check_common_frame(a, b)
        paths = (x.positions(frames=_few(x.n_frames, self.samples)) for x in (a, b))
        distance = curve_distances(*map(np.ascontiguousarray, paths), i, j, self.share)
        return capped(distance, self.scale * scene_scale(a, b), self.cap)


@dataclass(frozen=True)
class MedianPosition:
    """Distance of the tracks' median positions: about half of what synchronised times would tell, without time."""

    weight: float = 1.0
    scale: float = 0.3
    cap: float = 3.0

    needs_xyz = True

    def at(self, clock: Clock) -> SynchronousDistance:
        """What tells the same better once the clocks are known."""
        return SynchronousDistance(clock.offset, rate=clock.rate)

    def matrix(self, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
        return all_pairs(self, a, b)

    def pairs(
        self, a: TrackSet, b: TrackSet, i: Int[np.ndarray, " P"], j: Int[np.ndarray, " P"]
    ) -> Float[np.ndarray, " P"]:
        check_common_frame(a, b)
        distance = np.linalg.norm(_medians(a)[i] - _medians(b)[j], axis=1)
        return capped(distance, self.scale * scene_scale(a, b), self.cap)


@dataclass(frozen=True)
class SynchronousDistance:
    """Mean distance at equal times under a known offset: what to match by once a first answer is there.

    Args:
        offset, rate: t_a = rate * t_b + offset, seconds. Samples are paired with the nearest frame of the other video.
        min_overlap: seconds that two tracks must share.
    """

    offset: float
    weight: float = 1.0
    scale: float = 0.11
    cap: float = 3.0
    min_overlap: float = 12 / 30
    rate: float = 1.0

    needs_xyz = True

    @property
    def clock(self) -> Clock:
        """Of b against a."""
        return Clock(self.offset, self.rate)

    def at(self, clock: Clock) -> SynchronousDistance:
        """The same at another clock."""
        return replace(self, offset=clock.offset, rate=clock.rate)

    def matrix(self, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
        return all_pairs(self, a, b)

    def pairs(
        self, a: TrackSet, b: TrackSet, i: Int[np.ndarray, " P"], j: Int[np.ndarray, " P"]
    ) -> Float[np.ndarray, " P"]:
        from .kernels import add_frame_distances

        check_common_frame(a, b)
        ta, tb = a.times, self.rate * b.times + self.offset
        step = _step(ta, alone=1.0)
        at = np.clip(np.round(np.interp(ta, tb, np.arange(len(tb)))).astype(int), 0, len(tb) - 1)
        at = np.where(np.abs(tb[at] - ta) <= 0.51 * max(step, _step(tb, alone=0.0)), at, -1)
        least = max(2, round(self.min_overlap / step))
        total, count = np.zeros(len(i)), np.zeros(len(i))
        for some in blocks(len(ta), max(len(a), len(b))):
            known = at[some] >= 0
            xa, xb = a.positions(frames=np.flatnonzero(known) + some.start), b.positions(frames=at[some][known])
            add_frame_distances(xa, xb, i, j, total, count)
        distance = np.where(count >= least, total / np.maximum(count, 1), np.nan)
        return capped(distance, self.scale * scene_scale(a, b), self.cap)


def at_clock(costs: tuple[Cost, ...], clock: Clock) -> tuple[Cost, ...]:
    """The costs to match by once ``t_a = rate * t_b + offset`` is known.

    A cost with a form for known times (a method ``at(clock)``) takes it; the others stay. Where none has one, the
    distance at equal times joins them.
    """
    told = [c.at(clock) if hasattr(c, "at") else c for c in costs]
    if all(new is old for new, old in zip(told, costs, strict=True)):
        told.append(SynchronousDistance(clock.offset, rate=clock.rate))
    return tuple(dict.fromkeys(told))


def capped(distance: np.ndarray, unit: float, cap: float) -> np.ndarray:
    """Distances in units, at most ``cap``; unknown ones cost as much as any wrong pair."""
    return np.where(np.isfinite(distance), np.minimum(distance / unit, cap), cap)


def all_pairs(cost: Cost, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
    """The matrix of a cost that is written for pairs."""
    i, j = np.indices((len(a), len(b))).reshape(2, -1)
    return cost.pairs(a, b, i, j).reshape(len(a), len(b))


def check_common_frame(a: TrackSet, b: TrackSet) -> None:
    """ValueError unless both sets have positions and declare the same world frame."""
    a.check("a")
    b.check("b")
    if a.frame is None or a.frame != b.frame:
        raise ValueError(
            f"frame: expected the same world frame in a and b to compare positions; found {a.frame!r} and {b.frame!r}. "
            "Declare it (TrackSet.frame) when the cameras are calibrated together, or use costs without positions."
        )


def scene_scale(a: TrackSet, b: TrackSet) -> float:
    """Median distance between the median positions of all tracks: the size of the scene, in its own unit."""
    from scipy.spatial.distance import pdist

    medians = np.concatenate([_medians(a), _medians(b)])
    medians = medians[np.isfinite(medians[:, 0])]
    medians = medians[:: max(1, len(medians) // SCALE_SAMPLES)]
    distance = pdist(medians) if len(medians) > 1 else np.zeros(0)
    return float(np.median(distance)) if distance.size and np.median(distance) > 0 else 1.0


def _step(times: Float[np.ndarray, " T"], alone: float) -> float:
    """Seconds from a frame to the next; ``alone`` for a single one."""
    return float(np.median(np.diff(times))) if len(times) > 1 else alone


def _medians(tracks: TrackSet) -> Float[np.ndarray, "N 3"]:
    out = np.full((len(tracks), 3), np.nan)
    for n in range(len(tracks)):
        track = tracks.positions(n)
        seen = track[np.isfinite(track[:, 0])]
        if len(seen):
            out[n] = np.median(seen, 0)
    return out


def _few(frames: int, samples: int) -> slice:
    """Every n-th frame, so that a path has at most ``samples``."""
    step = max(1, -(-frames // samples))
    return slice(step // 2, None, step)
