"""Two videos' matched tracks on one uniform clock, the form in which aligners read them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view

from ..compute.indices import blocks, evenly
from ..types import Matches, TrackSet
from .splines import TrackSplines

SAME_FPS = 1e-9
"""Relative difference of frame rates that is rounding."""

EVEN = 1e-3
"""Frames that timestamps may lie beside an even grid: containers round them to ticks of a millisecond and less."""

GAP = 2.5
"""Frames beyond which what lies between two samples is a gap in a clock, of which nothing is known."""

AROUND = 5
"""Steps on either side of one that tell how long a frame is there."""

WHOLE = 1e-6
"""Frames by which a clip may fall short of a whole number of them, for rounding."""

SAMPLES = 1_500_000
"""Samples of one video that aligners and refiners read, at most: 13 tracks of an hour at 30 fps, 166 of five minutes.
Memory and time are bounded by it. More would change an offset by less than what limbs and drifts have in common.
"""

LEAST_FRAMES, LEAST_FPS = 5000, 7.5
"""Frames, and frames a second, that a clip is never thinned below: swings of limbs stay what they are."""

LONG = 20_000
"""Frames from which on positions are held in single precision where that loses nothing: eleven minutes at 30 fps."""

LOOKS = 1000
"""Frames that tell the noise."""

BELOW_NOISE = 0.01
"""Rounding, as a share of what the samples of a track differ by from a line through their neighbours, that is nothing:
it adds a ten thousandth to the variance of the noise."""

USUAL_FPS = 30.0
"""Rate of a single frame, which has none."""


@dataclass(frozen=True, eq=False)
class CommonClock:
    """Matched tracks, sample i of ``a`` and j of ``b`` showing the same moment when i - j = k, the lag.

    Args:
        a: (M,Ta,3), b: (M,Tb,3): positions in world units, nan where unobserved.
        fps: of both. origin: the offset in seconds that lag 0 means. start: of a's clock, s, at its first sample.
    """

    a: Float[np.ndarray, "M Ta 3"]
    b: Float[np.ndarray, "M Tb 3"]
    fps: float
    origin: float
    start: float = 0.0

    def seconds(self, lag: Float[np.ndarray, " K"] | float) -> Float[np.ndarray, " K"] | float:
        """offset(a, b) of a lag in frames."""
        return self.origin + lag / self.fps

    def lag(self, seconds: float) -> float:
        return (seconds - self.origin) * self.fps

    def lags(self, min_overlap: int, max_lag: float | None) -> np.ndarray:
        """All integer lags that leave ``min_overlap`` frames in common, within ±``max_lag`` seconds of offset."""
        k = np.arange(-(self.b.shape[1] - min_overlap), self.a.shape[1] - min_overlap + 1)
        return k if max_lag is None else k[np.abs(self.origin + k / self.fps) <= max_lag + 1e-9]

    def overlap(self, lags: np.ndarray) -> np.ndarray:
        """Frames in common at each lag."""
        return np.minimum(self.a.shape[1], self.b.shape[1] + lags) - np.maximum(0, lags)


def common_clock(a: TrackSet, b: TrackSet, matches: Matches) -> CommonClock:
    """Bring matched tracks on the slower of the two clocks.

    Samples of another clock (another fps, timestamps) come from the track's spline: see :func:`on_clock`.
    """
    i, j = matches.pairs.T
    fps = min(nominal_fps(a), nominal_fps(b))
    xa, xb = (on_clock(tracks, tracks.positions(some), fps) for tracks, some in ((a, i), (b, j)))
    return CommonClock(xa, xb, fps, float(a.times[0] - b.times[0]), float(a.times[0]))


def within(tracks: TrackSet, begin: float, end: float) -> TrackSet:
    """The tracks, seen only from ``begin`` to ``end`` s of their clock."""
    inside = (tracks.times >= begin) & (tracks.times < end)
    return replace(tracks, visible=tracks.seen & inside)


def strongest(matches: Matches, limit: int) -> Matches:
    """At most ``limit`` matches, the best by score in their given order; ties are drawn by a fixed shuffle."""
    if len(matches) <= limit:
        return matches
    assert matches.score is not None
    shuffled = np.random.default_rng(0).permutation(len(matches))
    chosen = np.sort(shuffled[np.argsort(-matches.score[shuffled], kind="stable")[:limit]])
    return matches.take(chosen)


def readable(limit: int, a: TrackSet, b: TrackSet, samples: float = SAMPLES) -> int:
    """Matches of two clips that are read, at most: ``limit``, or what ``samples`` allow."""
    return max(1, min(limit, int(samples) // max(a.n_frames, b.n_frames)))


def thinned(tracks: TrackSet) -> TrackSet:
    """Every k-th frame of a long clip, so that all its tracks together have about :data:`SAMPLES`: for what looks at
    where tracks are, not at what a frame's difference tells.
    """
    most = min(tracks.n_frames // LEAST_FRAMES, int(nominal_fps(tracks) / LEAST_FPS))
    step = min(-(-len(tracks) * tracks.n_frames // SAMPLES), most)
    if step < 2:
        return tracks
    taken = {f: v[:, ::step] for f in ("xyz", "visible", "uv", "sigma") if (v := getattr(tracks, f)) is not None}
    fps = None if tracks.fps is None else tracks.fps / step
    timestamps = None if tracks.timestamps is None else tracks.timestamps[::step]
    camera = tracks.camera
    if camera is not None and camera.w2c.ndim == 3:
        camera = replace(camera, w2c=camera.w2c[::step])
    return replace(tracks, **taken, fps=fps if timestamps is None else None, timestamps=timestamps, camera=camera)


def narrowed(tracks: TrackSet) -> TrackSet:
    """A long clip with its positions in single precision, where rounding is far below their noise; else as it is.

    An hour of 100 tracks has 260 MB in double precision.
    """
    x = tracks.xyz
    if x is None or x.dtype != np.float64 or tracks.n_frames < LONG:
        return tracks
    largest = 0.0
    for some in blocks(*tracks.seen.shape):
        largest = max(largest, float(np.max(np.abs(x[some]), where=tracks.seen[some, :, None], initial=0.0)))
    at = evenly(tracks.n_frames - 2, LOOKS) + 1
    before, now, after = (tracks.positions(frames=at + k) for k in (-1, 0, 1))
    noise = np.abs(now - 0.5 * (before + after))
    known = noise[np.isfinite(noise)]
    rounding = largest * 2.0**-24
    if not len(known) or not rounding <= BELOW_NOISE * float(np.median(known)):
        return tracks
    return replace(tracks, xyz=x.astype(np.float32))


def nominal_fps(tracks: TrackSet) -> float:
    """Frames per second as declared, else from the timestamps' median step."""
    assert tracks.fps is not None or tracks.n_frames == 1
    return tracks.fps or USUAL_FPS


def missing(times: Float[np.ndarray, " T"]) -> Bool[np.ndarray, " T-1"]:
    """The steps over which frames are missing, by the times themselves: longer than :data:`GAP` of those around them,
    and of the whole. A rate that changes (60 frames a second, then 20) leaves no gap, nor do frames that a clock put
    right shows twice, a hair apart.
    """
    steps = np.diff(times)
    if len(steps) < 2:
        return np.zeros(len(steps), bool)
    around = sliding_window_view(np.pad(steps, AROUND, constant_values=np.nan), 2 * AROUND + 1)
    return np.asarray(steps > GAP * np.maximum(np.nanmedian(around, 1), np.median(steps)))


def is_uniform(tracks: TrackSet) -> bool:
    """Whether the frames lie on an even grid of the nominal rate, to within :data:`EVEN` frames."""
    t = tracks.timestamps
    if t is None:
        return True
    grid = t[0] + np.arange(len(t)) / nominal_fps(tracks)
    return bool(np.abs(t - grid).max() * nominal_fps(tracks) < EVEN)


def on_clock(tracks: TrackSet, x: Float[np.ndarray, "N T D"], fps: float) -> Float[np.ndarray, "N T D"]:
    """What ``tracks`` have at every frame, positions or pixels (nan where unseen), on an even clock of ``fps``.

    Samples of a uniform clock of that rate are taken as they are; splines answer for others and never bridge a gap.
    """
    if is_uniform(tracks) and abs(nominal_fps(tracks) / fps - 1) <= SAME_FPS:
        return x
    times = tracks.times
    grid = times[0] + np.arange(frames_on_clock(tracks, fps)) / fps
    return TrackSplines(times, in_space(x)).sample(grid)[..., : x.shape[2]]


def frames_on_clock(tracks: TrackSet, fps: float) -> int:
    """How many frames a video has on an even clock of ``fps``: see :func:`on_clock`."""
    if is_uniform(tracks) and abs(nominal_fps(tracks) / fps - 1) <= SAME_FPS:
        return tracks.n_frames
    return int(np.floor((tracks.times[-1] - tracks.times[0]) * fps + WHOLE)) + 1


def in_space(x: Float[np.ndarray, "N T D"]) -> Float[np.ndarray, "N T 3"]:
    """Positions as they are; pixels with a third coordinate 0, for splines, which hold three."""
    if x.shape[2] == 3:
        return x
    return np.concatenate([x, np.where(np.isfinite(x[..., :1]), 0.0, np.nan)], 2)
