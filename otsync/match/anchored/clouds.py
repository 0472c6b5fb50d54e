"""Track sets in the form in which the anchored solver reads them: canonical order and unit, time-major, float32."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ...clocks.common import missing, nominal_fps
from ...compute.indices import evenly
from ...costs.linear import binary_scale, unit_features
from ...types import TrackSet

FAR = 1e6
"""Positions are clipped to this many scene sizes: squares of what is farther would leave float32."""

TOGETHER, MOMENTS = 0.1, 32
"""Seconds of which one mean position is read, at most, and into how many such moments a clip is divided at least: two
frames each from 64 frames, three from 96 on, at 30 a second. The largest distance of two points that move is nearly the
same at ten moments a second, with less noise, and takes a third of the time to find."""

BLOCK = 1024
"""Tracks or frames a block of work."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Tracks, or mean tracks of groups of them.

    Args:
        columns: (3,T,N) positions about ``middle`` in units of ``size`` at T moments of the clip; 0 where unseen.
        weight: (T,N) 1 where seen and 0 elsewhere.
        times: (T,) of the moments, s.
        source: the track set behind it, for the ``costs``.
        index: (N,) which track of ``source`` each one is.
        middle, size: where and how large the scene is, in the source's units.
    """

    columns: Float[np.ndarray, "3 T N"]
    weight: Float[np.ndarray, "T N"]
    times: Float[np.ndarray, " T"]
    source: TrackSet
    index: Int[np.ndarray, " N"]
    middle: Float[np.ndarray, " 3"]
    size: float

    def __len__(self) -> int:
        return self.columns.shape[2]

    @cached_property
    def gaps(self) -> bool:
        return not self.weight.all()

    def take(self, index: Int[np.ndarray, " M"]) -> Cloud:
        """The tracks at ``index``."""
        columns, weight = (np.ascontiguousarray(x[..., index]) for x in (self.columns, self.weight))
        return Cloud(columns, weight, self.times, self.source, self.index[index], self.middle, self.size)

    def poses(self, frames: int) -> Float[np.ndarray, "N 3F"]:
        """Positions at ``frames`` times over the clip; of an unseen track at the nearest frame where it is seen."""
        from . import kernels

        if frames not in self._poses:
            at = evenly(len(self.weight), frames)
            out = np.empty((len(self), 3 * len(at)), np.float32)
            run(kernels.poses, len(self), self.columns, self.weight, at, out)
            self._poses[frames] = out
        return self._poses[frames]

    @cached_property
    def _poses(self) -> dict[int, Float[np.ndarray, "N 3F"]]:
        """Those that were asked for, by the number of frames: every round of the solver asks again."""
        return {}

    def groups(self, label: Int[np.ndarray, " N"], n: int) -> Cloud:
        """The mean tracks of ``n`` groups, none empty: position over the members seen, mean unit feature and label."""
        from . import kernels

        T = len(self.weight)
        columns, count = np.zeros((3, T, n), np.float32), np.zeros((T, n), np.float32)
        run(kernels.group_means, T, self.columns, self.weight, label, columns, count, block=16)
        weight = np.minimum(count, 1)
        xyz = columns.transpose(2, 1, 0).astype(float) * self.size + self.middle
        source = self.source
        means: dict[str, Any] = {}
        for name in ("features", "labels"):
            values = getattr(source, name)
            if values is not None:
                rows = unit_features(values) if name == "features" else values
                means[name] = group_rows(rows[self.index], label, n)
        tracks = TrackSet(
            xyz,
            weight.T > 0,
            timestamps=self.times,
            frame=source.frame,
            camera=source.camera if source.n_frames == T else None,  # of one that moves there is a pose for each frame
            **means,
        )
        return Cloud(columns, weight, self.times, tracks, np.arange(n), self.middle, self.size)


def clouds(a: TrackSet, b: TrackSet, every_frame: bool = False) -> tuple[Cloud, Cloud]:
    """Both videos about their middles and in one unit, that of the scenes; tracks that are never seen are left out.

    Middle and unit are found in float64 before positions become float32, so that a world in metres and the same in
    micrometres give the same numbers. Tracks are put in the order of their features (equal ones by distance from the
    middle): what the solver draws at random then goes with a track, not with its place in the caller's array.
    """
    from . import kernels

    found = []
    for tracks in (a, b):
        assert tracks.xyz is not None
        mean = np.full((len(tracks), 3), np.nan)
        run(kernels.visible_means, len(tracks), tracks.xyz, tracks.seen, mean)
        index = np.flatnonzero(np.isfinite(mean[:, 0]))
        middle = np.median(mean[index], axis=0) if len(index) else np.zeros(3)
        away = mean[index] - middle
        unit = binary_scale(away)
        radius = np.linalg.norm(away / unit, axis=1)
        found.append((tracks, index[canonical_order(tracks, index, radius)], middle, unit, radius))
    sizes = [unit * (np.median(radius) or radius.max()) for *_, unit, radius in found if radius.size and radius.any()]
    size = float(np.mean(sizes)) if sizes else 1.0
    made = []
    for tracks, index, middle, _, _ in found:
        first = np.arange(tracks.n_frames + 1) if every_frame else moments(tracks)
        times = np.add.reduceat(tracks.times, first[:-1]) / np.diff(first)
        columns = np.empty((3, len(times), len(index)), np.float32)
        weight = np.empty(columns.shape[1:], np.float32)
        run(kernels.to_columns, len(index), tracks.xyz, tracks.seen, index, middle, size, FAR, first, columns, weight)
        made.append(Cloud(columns, weight, times, tracks, index, middle, size))
    return made[0], made[1]


def moments(tracks: TrackSet) -> Int[np.ndarray, " T1"]:
    """The frames that moments begin with, and how many frames there are; none goes on where frames are missing."""
    step = max(1, min(round(TOGETHER * nominal_fps(tracks)), tracks.n_frames // MOMENTS))
    behind = np.flatnonzero(missing(tracks.times)) + 1 if step > 1 else np.zeros(0, int)
    ends = [0, *behind.tolist(), tracks.n_frames]
    begun = [np.arange(begin, end, step) for begin, end in pairwise(ends)]
    return np.concatenate([*begun, [tracks.n_frames]])


def canonical_order(tracks: TrackSet, index: Int[np.ndarray, " N"], radius: Float[np.ndarray, " N"]) -> np.ndarray:
    """An order of ``tracks[index]`` that no permutation, rigid motion or unit changes."""
    keys: list[np.ndarray] = [radius]
    if tracks.features is not None:
        keys += [tracks.features[index, c] for c in reversed(range(min(3, tracks.features.shape[1])))]
    return np.lexsort(keys)


def comes_first(a: Cloud, b: Cloud) -> bool:
    """Whether a comes before b in an order of videos that depends on their contents alone."""

    def key(cloud: Cloud) -> tuple[Any, ...]:
        features = cloud.source.features
        first = () if features is None or not len(cloud) else tuple(features[cloud.index[0]].tolist())
        return len(cloud), len(cloud.weight), first, float(np.abs(cloud.columns).sum(dtype=float))

    return key(a) <= key(b)


def group_rows(values: Float[np.ndarray, "N D"], label: Int[np.ndarray, " N"], n: int) -> Float[np.ndarray, "n D"]:
    """Mean row of every group, none empty."""
    order = np.argsort(label, kind="stable")
    start = np.searchsorted(label[order], np.arange(n))
    means = np.add.reduceat(values[order], start, axis=0) / np.bincount(label, minlength=n)[:, None]
    # opposite rows may cancel; a row of zeros would be no feature at all
    cancelled = np.abs(means).max(1) == 0
    means[cancelled] = values[order[start[cancelled]]]
    return means


def run(kernel: Any, n: int, *arguments: Any, block: int = BLOCK) -> None:
    """``kernel(*arguments, start, stop)`` over blocks of 0..n on a small pool."""
    from ...compute.threads import for_each, ranges

    for_each(lambda start, stop: kernel(*arguments, start, stop), ranges(n, block))
