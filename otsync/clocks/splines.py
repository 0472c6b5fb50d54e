"""Tracks in continuous time: penalised cubic B-splines, one per track, that answer only where the track was seen."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from ..compute.indices import blocks
from .jumps import find_jumps

DEGREE = 3

KNOT_SECONDS = 2 / 30
"""Distance of knots: two frames at 30 fps, about as fast as a limb turns."""

SMOOTHING = 1.0
"""λ at 30 fps: calms the jitter of a tracker; 10 and more bias the offset."""

RIDGE = 1e-6
"""Added to the penalty: it only decides where neither data nor third differences do."""

BRIDGE_FRAMES = 2.5
"""Longest step between two samples that a curve is believed across: one dropped frame, not two."""

BESIDE_JUMP = 1
"""Whole steps on either side of a jump's own in which the curve does not answer."""

ON_SAMPLE = 1e-6
"""Frames within which a time is that of a sample, for rounding."""

NEAR = 40
"""Frames on either side that tell a curve's value at a moment."""

THIRD = (-1.0, 3.0, -3.0, 1.0)
"""Weights of a third difference."""

WITHIN = 1e-9
"""Share of a knot's distance by which the last time is kept inside the last interval."""


class TrackSplines:
    """Smoothing splines of M tracks over one clock.

    Minimises Σ ‖x(t_k) - x_k‖² + λ Σ ‖Δ³c‖² over the coefficients c of a cubic B-spline with uniform knots. The
    penalty carries the curve through gaps, but :meth:`support` says where it means something: between two
    consecutive samples that were both seen. Linear interpolation instead would lock the offset to whole frames; so
    would a curve through a jump (:mod:`otsync.clocks.jumps`), which is therefore taken out before and put back
    after, and the curve does not answer beside it.

    Args:
        times: (T,) seconds, increasing. xyz: (M,T,3), nan where unobserved.
        knot_seconds: knot spacing, at least one frame. smoothing: λ at 30 fps.

    Reference: Eilers and Marx, Flexible smoothing with B-splines and penalties, 1996.
    """

    def __init__(
        self,
        times: Float[np.ndarray, " T"],
        xyz: Float[np.ndarray, "M T 3"],
        *,
        knot_seconds: float = KNOT_SECONDS,
        smoothing: float = SMOOTHING,
    ):
        self.times = times
        self.seen = np.isfinite(xyz[..., 0])
        span = max(float(times[-1] - times[0]), 1e-9)
        self.frame = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
        intervals = max(1, int(np.ceil(span / max(knot_seconds, self.frame))))
        self.step = span / intervals
        self.knots = times[0] + self.step * np.arange(-DEGREE, intervals + DEGREE + 1)
        self.n = intervals + DEGREE
        self.jumps = find_jumps(xyz)
        #: (M,n,3) coefficients around each track's own mean, which keeps them small; one block a track
        self.mean, self.by_track = self._fit(xyz, smoothing * max(1.0, 1 / (30 * self.frame)))

    def _fit(self, xyz: np.ndarray, penalty: float) -> tuple[np.ndarray, np.ndarray]:
        """(M,3) means, and (M,n,3) coefficients around them. Memory grows with T + n, not with its square."""
        count = len(xyz)
        inside = np.clip(self.times, self.knots[DEGREE], self.knots[-DEGREE - 1])
        basis = sparse.csr_array(BSpline.design_matrix(inside, self.knots, DEGREE))
        # by diagonal: what turns the weights of samples into a band of the normal equations
        products = [basis[:, : self.n - d].multiply(basis[:, d:]).T.tocsr() for d in range(DEGREE + 1)]
        transposed, regular = basis.T.tocsr(), _penalty_bands(self.n, penalty)
        mean, coefficients = np.zeros((count, 3)), np.zeros((count, self.n, 3))
        for part in blocks(count, len(self.times) + self.n):
            seen = self.seen[part]
            weight = seen.astype(float)
            joined = self._joined(xyz[part], part)
            values = np.where(seen[..., None], joined, 0.0)
            mean[part] = values.sum(1) / np.maximum(weight.sum(1), 1)[:, None]
            values = np.where(seen[..., None], joined - mean[part, None], 0.0)
            right = (transposed @ values.transpose(1, 0, 2).reshape(len(self.times), -1)).reshape(self.n, -1, 3)
            bands = np.tile(regular, (len(values), 1, 1))
            for d in range(DEGREE + 1):
                bands[:, DEGREE - d, d:] += (products[d] @ weight.T).T
            for m in range(len(values)):
                coefficients[part.start + m] = solveh_banded(bands[m], right[:, m], check_finite=False)
        return mean, coefficients

    def take(self, index: np.ndarray) -> TrackSplines:
        """The splines of the tracks at ``index`` (repeats allowed), without fitting anew."""
        part = object.__new__(TrackSplines)
        part.__dict__ |= self.__dict__
        part.seen, part.mean = self.seen[index], self.mean[index]
        part.jumps = self.jumps.take(index) if len(self.jumps) else self.jumps
        part.by_track = self.by_track[index]
        return part

    def within(self, begin: float, end: float) -> TrackSplines:
        """The same splines, taken as seen only from ``begin`` to ``end``, s."""
        part = object.__new__(TrackSplines)
        part.__dict__ |= self.__dict__
        part.seen = self.seen & ((self.times >= begin) & (self.times <= end))
        return part

    def value(self, t: Float[np.ndarray, " S"]) -> Float[np.ndarray, "M S 3"]:
        """Positions at seconds ``t``; outside the clip the end values."""
        return self._with_jumps(self.joined(t), t)

    def value_and_velocity(
        self, t: Float[np.ndarray, " S"]
    ) -> tuple[Float[np.ndarray, "M S 3"], Float[np.ndarray, "M S 3"]]:
        """:meth:`value` and :meth:`velocity`."""
        first, value, slope = self.basis(t)
        x = self._curves(first, value, np.repeat(self.mean[:, None], len(t), 1))
        return self._with_jumps(x, t), self._curves(first, slope, np.zeros_like(x))

    def _with_jumps(self, x: np.ndarray, t: np.ndarray) -> np.ndarray:
        jumps = self.jumps
        for track, those in jumps.each_track():
            when = 0.5 * (self.times[jumps.before[those]] + self.times[jumps.after[those]])
            x[track] += np.concatenate([np.zeros((1, 3)), np.cumsum(jumps.by[those], 0)])[np.searchsorted(when, t)]
        return x

    def joined(self, t: Float[np.ndarray, " S"]) -> Float[np.ndarray, "M S 3"]:
        """Positions at ``t`` as they would be had no track jumped: what the coefficients say."""
        first, value, _ = self.basis(t)
        return self._curves(first, value, np.repeat(self.mean[:, None], len(t), 1))

    def velocity(self, t: Float[np.ndarray, " S"]) -> Float[np.ndarray, "M S 3"]:
        """World units per second at ``t``."""
        first, _, slope = self.basis(t)
        return self._curves(first, slope, np.zeros((len(self.mean), len(t), 3)))

    def _curves(self, first: np.ndarray, weights: np.ndarray, onto: np.ndarray) -> np.ndarray:
        from .kernels import add_curves

        add_curves(self.by_track, first, weights, onto)
        return onto

    def basis(
        self, t: Float[np.ndarray, " S"]
    ) -> tuple[Int[np.ndarray, " S"], Float[np.ndarray, "S 4"], Float[np.ndarray, "S 4"]]:
        """Which four coefficients make up the curve at ``t``: the first one's index, weights of value and of slope."""
        u = (self._inside(t) - self.times[0]) / self.step
        first = np.clip(np.floor(u).astype(np.int64), 0, self.n - DEGREE - 1)
        x = u - first
        y = 1 - x
        value = np.stack([y**3, 3 * x**3 - 6 * x**2 + 4, 3 * y**3 - 6 * y**2 + 4, x**3], 1) / 6
        slope = np.stack([-(y**2), 3 * x**2 - 4 * x, -(3 * y**2 - 4 * y), x**2], 1) / (2 * self.step)
        return first, value, slope

    def support(self, t: Float[np.ndarray, " S"]) -> Bool[np.ndarray, "M S"]:
        """Where ``t`` lies between two consecutive samples that were seen and are at most 2.5 frames apart."""
        times = self.times
        # a time within rounding of a sample needs that sample alone
        left = np.clip(np.searchsorted(times, t + ON_SAMPLE * self.frame, side="right") - 1, 0, len(times) - 1)
        on_sample = np.abs(t - times[left]) <= ON_SAMPLE * self.frame
        right = np.where(on_sample, left, np.minimum(left + 1, len(times) - 1))
        inside = (t >= times[0] - ON_SAMPLE * self.frame) & (t <= times[-1] + ON_SAMPLE * self.frame)
        inside &= times[right] - times[left] <= BRIDGE_FRAMES * self.frame
        known = self.seen[:, left] & self.seen[:, right] & inside
        jumps = self.jumps
        for track, those in jumps.each_track():
            begin = times[np.maximum(jumps.before[those] - BESIDE_JUMP, 0)]
            end = times[np.minimum(jumps.after[those] + BESIDE_JUMP, len(times) - 1)]
            known[track] &= np.searchsorted(begin, t) <= np.searchsorted(end, t, side="right")
        return known

    def sample(self, t: Float[np.ndarray, " S"]) -> Float[np.ndarray, "M S 3"]:
        """Positions at ``t``, nan where not supported."""
        return np.where(self.support(t)[..., None], self.value(t), np.nan)

    def _joined(self, xyz: np.ndarray, part: slice) -> np.ndarray:
        """Samples of some tracks with the jumps taken out."""
        jumps = self.jumps
        own = (jumps.track >= part.start) & (jumps.track < part.stop)
        if own.any():
            level = np.zeros_like(xyz)
            level[jumps.track[own] - part.start, jumps.after[own]] = jumps.by[own]
            xyz = xyz - np.cumsum(level, 1)
        return xyz

    def _inside(self, t: np.ndarray) -> np.ndarray:
        return np.clip(t, self.times[0], self.times[-1] - WITHIN * self.step)


def sampled(
    times: Float[np.ndarray, " T"],
    xyz: Float[np.ndarray, "M T 3"],
    seen: Bool[np.ndarray, "M T"],
    t: Float[np.ndarray, " S"],
) -> Float[np.ndarray, "M S 3"]:
    """What ``TrackSplines(times, xyz).sample(t)`` has, ``xyz`` counting where ``seen``; for few moments of a long clip
    from the frames near each alone, which needs no curve of an hour, and no copy of it. Its knots lie elsewhere: it
    differs by a tenth of the tracks' noise at most.
    """

    def curves(part: slice) -> TrackSplines:
        return TrackSplines(times[part], np.where(seen[:, part, None], xyz[:, part], np.nan).astype(float, copy=False))

    if len(times) <= 4 * NEAR * len(t):
        return curves(slice(None)).sample(t)
    out = np.full((len(xyz), len(t), 3), np.nan)
    order = np.argsort(t, kind="stable")
    near = np.searchsorted(times, t[order])
    # moments that are near each other have one curve: their frames are mostly the same
    for some in np.split(np.arange(len(t)), np.flatnonzero(np.diff(near) > NEAR) + 1):
        frames = slice(max(0, near[some[0]] - NEAR), near[some[-1]] + NEAR)
        out[:, order[some]] = curves(frames).sample(t[order[some]])
    return out


def _penalty_bands(n: int, penalty: float) -> Float[np.ndarray, "4 n"]:
    """Upper bands of λ D'D + ridge, D third differences of n >= 4 coefficients; row 3 - d is the d-th diagonal."""
    bands = np.zeros((DEGREE + 1, n))
    for d in range(DEGREE + 1):
        for k in range(DEGREE + 1 - d):
            # coefficient k of each difference beside coefficient k + d of the same one
            bands[DEGREE - d, k + d : k + d + n - DEGREE] += penalty * THIRD[k] * THIRD[k + d]
    bands[DEGREE] += RIDGE
    return bands
