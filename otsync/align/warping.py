"""The time offset of a pair from matched tracks, to the frame (paper, Sec. 3.4): ``align(a, b, matches, aligner)``.

An aligner is an object in a slot: any callable ``aligner(a, b, matches) -> Alignment``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import CommonClock, common_clock
from ..costs.linear import frame_cost, velocity
from ..types import Alignment, Matches, Status, TrackSet
from .likelihood import MIN_OVERLAP, unanswered
from .peaks import is_constant, most_frequent, peak
from .slot import Aligner

VELOCITY_HALF = 3
"""Half window, in frames at 30 fps, of the velocities of the velocity cost."""


@dataclass(frozen=True)
class DTW(Aligner):
    """The paper's coarse synchronisation: dynamic time warping over D_geo, then the most frequent offset of its path.

    D_geo is the mean L1 distance over the matches seen in both frames; cells without any get the median of the
    others. Offsets that are equally frequent are averaged, so that swapping a and b flips the sign and no more.

    Args:
        cost: ``position`` (the paper) or ``velocity`` (blind to constant offsets between matched points).
        open_ends: let the path start and end on any border instead of corner to corner. Corner to corner, a true
            offset costs as many unmatched frames at both ends: the paper's failure on large offsets.
    """

    cost: Literal["position", "velocity"] = "position"
    open_ends: bool = False

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches) -> Alignment:
        pair = common_clock(a, b, matches)
        cost = geometric_cost(pair, self.cost)
        known = np.isfinite(cost)
        if not known.any() or min(cost.shape) < round(MIN_OVERLAP * pair.fps):
            return unanswered(pair, matches, cost)
        if is_constant(cost[known]):
            return unanswered(pair, matches, cost, Status.STATIC)
        filled = np.where(known, cost, np.median(cost[known]))
        path = self._path(filled)
        lag = most_frequent(path[:, 0] - path[:, 1])
        on_path = float(filled[path[:, 0], path[:, 1]].mean())
        return Alignment(
            float(pair.seconds(lag)),
            hypotheses=np.array([[pair.seconds(lag), -on_path]]),
            path=path,
            cost=cost,
            fps=pair.fps,
            stats={"matches": float(len(matches)), "path_cost": on_path},
        )

    def _path(self, cost: Float[np.ndarray, "Ta Tb"]) -> Int[np.ndarray, "P 2"]:
        if self.open_ends:
            from .kernels import open_end_path

            # cells below the median look like overlap; they pull the path along, the others push it out
            return open_end_path(cost, float(np.median(cost)))
        from tslearn.metrics import dtw_path_from_metric

        path, _ = dtw_path_from_metric(cost, metric="precomputed")
        return np.asarray(path)


@dataclass(frozen=True)
class ConstantShift(Aligner):
    """Best constant shift of the same cost: DTW without the freedom to warp, its first rival.

    The mean cost along every diagonal, the lowest one, and the vertex of a parabola through its neighbours.

    Args:
        cost: as in :class:`DTW`. min_overlap: seconds in common. max_lag: largest |offset| in seconds, or None.
    """

    cost: Literal["position", "velocity"] = "position"
    min_overlap: float = MIN_OVERLAP
    max_lag: float | None = None

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches) -> Alignment:
        pair = common_clock(a, b, matches)
        cost = geometric_cost(pair, self.cost)
        least = max(1, round(self.min_overlap * pair.fps))
        lags = pair.lags(least, self.max_lag)
        score = np.full(len(lags), -np.inf)
        for n, k in enumerate(lags):
            diagonal = np.diagonal(cost, -k)
            known = np.isfinite(diagonal)
            if known.sum() >= least:
                score[n] = -diagonal[known].mean()
        if not np.isfinite(score).any():
            return unanswered(pair, matches, cost)
        if is_constant(score[np.isfinite(score)]):
            return unanswered(pair, matches, cost, Status.STATIC)
        lag = peak(lags, score)
        return Alignment(
            float(pair.seconds(lag)),
            hypotheses=np.array([[pair.seconds(lag), score.max()]]),
            curve=np.stack([pair.origin + lags / pair.fps, score], 1),
            cost=cost,
            fps=pair.fps,
            stats={"matches": float(len(matches)), "path_cost": float(-score.max())},
        )


def geometric_cost(pair: CommonClock, kind: Literal["position", "velocity"]) -> Float[np.ndarray, "Ta Tb"]:
    """D_geo of positions, or of velocities."""
    if kind == "position":
        return frame_cost(pair.a, pair.b)[0]
    if kind != "velocity":
        raise ValueError(f"cost: expected 'position' or 'velocity'; found {kind!r}.")
    half = max(1, round(VELOCITY_HALF * pair.fps / 30))
    return frame_cost(velocity(pair.a, half), velocity(pair.b, half))[0]
