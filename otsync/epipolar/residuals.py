"""Epipolar residuals of continuous tracks, and how they change with the offset."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from ..clocks.common import in_space
from ..clocks.splines import TrackSplines
from ..compute.medians import known_median
from ..geometry import seen_pixels
from ..refine.common_error import Sums
from ..refine.gauss_newton import CLUSTER, GROUPS, jackknife, neighbours
from ..types import TrackSet
from .poses import Lines, not_turned

MAD = 1.4826
"""Median absolute deviation to standard deviation."""

MATCHES = 200
"""Most candidate pairs that are fitted."""

LEAST_SHARE, LEAST_CANDIDATES = 0.05, 3
"""Share of its tracks' mixtures that a candidate must have to be fitted, and how many such candidates a fit needs."""

MIN_SEEN = 12 / 30
"""Seconds that a candidate must be seen in both videos to be fitted."""

BY_RESIDUAL = 2.0
"""Robust deviations at which a residual counts half (Cauchy's weight)."""

BY_CANDIDATE = 1.5
"""Median rms residuals at which a candidate counts a quarter: it does not move like its partner."""

LEAST_HALF = 3
"""Frames on either side that a mean needs to be removed, however few a second there are."""

APART_BY = 30.0
"""Pixels, of one of noise, that two points of one body are usually apart in b's picture: the prior of a distance that
only a moving camera shows."""

CONVERGED = 1e-4
"""Frames below which a step is the last."""

TINY = 1e-9
"""Pixels added to scales of residuals, which may all be 0."""

AT_ENDS, FORGOTTEN = 0.7, 1.2
"""Share of the blur by which errors that tracks have in common move a moment's offset, and seconds within which they
are forgotten. Of 36 pairs of six films of phones in hands (seeds 3202 to 3209) the ends of those that are sound are off
by .7 of it at the median; a rate of 4 % moves them by 4 to 8 times as much."""

FITTED = 2.5
"""Factor on errors that tracks have in common, as that of positions (:mod:`otsync.refine.common_error`), and larger:
of distances to lines, which leave one direction free, more is fitted away. Of 82 offsets of twenty films (seeds 76000
to 76019) 57 and 82 % lie within one and two sigmas, with 3.1 62 and 90; but textured balls, whose offsets are .05 frame
off at most and say .25 to .32, would be refused then, one of three."""

BROKEN, LEAST_WANDER = 0.3, 5e-3
"""Share of the blur, and seconds, by which the offsets of single seconds may differ. Of 98 pairs of basketball (seed
77) the largest has .22 of its blur; motion that comes back a twentieth of a second early or late .8."""


def broken(wander: float, blur: float) -> bool:
    """Whether the seconds of the overlap say different offsets."""
    return wander > BROKEN * blur + LEAST_WANDER


@dataclass(frozen=True, eq=False)
class Step:
    """Residuals in pixels, their slopes in pixels a second of offset, both detrended, and the weights of samples."""

    residual: Float[np.ndarray, "M T"]
    slope: Float[np.ndarray, "M T"]
    weight: Float[np.ndarray, "M T"]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Supported candidates over a's even clock."""

    xa: Float[np.ndarray, "M T 2"]
    splines: TrackSplines
    times: Float[np.ndarray, " T"]
    lines: Lines
    fps: float
    weight: Float[np.ndarray, " M"]

    @classmethod
    def of(
        cls,
        a: TrackSet,
        b: TrackSet,
        xa: Float[np.ndarray, "Na T 2"],
        lines: Lines,
        pairs: Int[np.ndarray, "M 2"],
        share: Float[np.ndarray, " M"],
        fps: float,
    ) -> Residuals | None:
        """Of the candidates that have most of their tracks' mixtures; None where there are too few.

        Args:
            xa: a's pixels on an even clock of ``fps``. share: of each pair in its tracks' mixtures, 0 to 1.
        """
        best = np.argsort(-share, kind="stable")[:MATCHES]
        best = best[share[best] > LEAST_SHARE]
        if len(best) < LEAST_CANDIDATES:
            return None
        i, j = pairs[best].T
        used, where = np.unique(j, return_inverse=True)
        splines = TrackSplines(b.times, in_space(seen_pixels(b)[used])).take(where)
        times = a.times[0] + np.arange(xa.shape[1]) / fps
        return cls(xa[i], splines, times, lines, fps, share[best])

    def residual(self, offset: float | Float[np.ndarray, " T"]) -> Float[np.ndarray, "M T"]:
        """Sampson distances in pixels, nan where either is unseen."""
        return self._distances(offset)[0]

    def _distances(
        self, offset: float | Float[np.ndarray, " T"]
    ) -> tuple[Float[np.ndarray, "M T"], Float[np.ndarray, "M T 2"], Float[np.ndarray, "M T 2"]]:
        """Sampson distances in pixels, nan where either is unseen; how they change with b's pixels; and these."""
        t = self.times - offset
        xb = self.splines.sample(t)[..., :2]
        hb = homogeneous(xb)
        F = self.lines.at(t)
        if self.lines.still:
            la, lb = self.of_a, hb @ F[0][:, :2]
        else:
            la, lb = np.einsum("tij,mtj->mti", F, homogeneous(self.xa)), np.einsum("tij,mti->mtj", F, hb)
        norm = np.sqrt(la[..., 0] ** 2 + la[..., 1] ** 2 + lb[..., 0] ** 2 + lb[..., 1] ** 2)
        norm = np.maximum(norm, 1e-300)
        return (hb * la).sum(2) / norm, la[..., :2] / norm[..., None], xb

    @cached_property
    def of_a(self) -> Float[np.ndarray, "M T 3"]:
        """a's points as lines of b's image; of static cameras."""
        return homogeneous(self.xa) @ self.lines.at(self.times)[0].T

    def solve(self, offset: float, window: float, iterations: int, reach: float) -> tuple[float, Step]:
        """Offset, s, and what its last step saw; nan when nothing overlaps."""
        start, step, half = offset, 0.5 / self.fps, max(LEAST_HALF, round(window * self.fps))
        found = nothing = Step(*np.zeros((3, *self.xa.shape[:2])))
        for _ in range(iterations):
            seen = self._step(offset, half)
            curvature = 0.0 if seen is None else float((seen.weight * seen.slope**2).sum())
            if seen is None or curvature <= 0:
                return float("nan"), nothing
            found = seen
            move = -float((found.weight * found.slope * found.residual).sum()) / curvature
            offset += float(np.clip(move, -step, step))
            if abs(move) < CONVERGED / self.fps or abs(offset - start) > reach:
                break
        return offset, found

    def _step(self, offset: float | Float[np.ndarray, " T"], half: int) -> Step | None:
        """Residuals at an offset, or one for each of a's frames; None where too little overlaps."""
        step = 0.5 / self.fps
        e, across, xb = self._distances(offset)
        J = (self.residual(offset + step) - self.residual(offset - step)) / (2 * step)
        known = np.isfinite(e) & np.isfinite(J)
        if self.lines.still:
            R, J = detrended(e, known, half), detrended(J, known, half)
        else:
            apart = not_turned(across, xb, self.lines.b.turns(self.times - offset))
            R, J = without(e, apart, known, half), without(J, apart, known, half)
        enough = known.sum(1) >= MIN_SEEN * self.fps
        known &= enough[:, None]
        if not known.any():
            return None
        scale = MAD * float(np.median(np.abs(R[known]))) + TINY
        rms = np.sqrt((R**2 * known).sum(1) / np.maximum(known.sum(1), 1))
        level = BY_CANDIDATE * float(np.median(rms[enough])) + TINY
        w = known / (1 + (R / (BY_RESIDUAL * scale)) ** 2) * (self.weight / (1 + (rms / level) ** 2) ** 2)[:, None]
        return Step(R, J, w)

    def rate(self, offset: float, window: float, iterations: int) -> tuple[float, float]:
        """(by how much a second of b is longer than one of a, one sigma of it), fitted together with the offset from
        ``offset`` on; nan where nothing tells.
        """
        half, nothing = max(LEAST_HALF, round(window * self.fps)), (float("nan"), float("nan"))
        x, p, found, normal = self.times, np.zeros(2), None, np.zeros((2, 2))
        for _ in range(iterations):
            found = self._step(offset + p[0] + p[1] * x, half)
            if found is None:
                return nothing
            told = found.weight * found.slope**2
            if not p.any():
                x = self.times - float(told.sum(0) @ self.times) / max(float(told.sum()), TINY)
            normal = np.array([[told.sum(), (told @ x).sum()], [(told @ x).sum(), (told @ x**2).sum()]])
            if not np.linalg.det(normal) > TINY * normal[0, 0] ** 2:
                return nothing
            score = (found.weight * found.slope * found.residual).sum(0)
            move = -np.linalg.solve(normal, [score.sum(), score @ x])
            at_ends = float(np.abs(move) @ [1.0, np.abs(x).max()])
            p += move * min(1.0, 1 / (self.fps * max(at_ends, TINY)))  # no moment by more than a frame
            if at_ends < CONVERGED / self.fps:
                break
        assert found is not None
        powers = np.stack([np.ones_like(x), x])
        H, g = np.zeros((GROUPS, 2, 2)), np.zeros((GROUPS, 2))
        J, w = found.slope, found.weight
        np.add.at(H, self.group, np.einsum("mt,pt,qt->mpq", w * J * J, powers, powers))
        np.add.at(g, self.group, np.einsum("mt,pt->mp", w * J * found.residual, powers))
        blur = math.sqrt(float((w * found.residual**2).sum() / normal[0, 0]))
        shared = self.times[(w > 0).any(0)]
        span = max(float(shared[-1] - shared[0]), 1 / self.fps)
        # the slope of a line through errors of that size, as of positions (SplineRefine)
        common = 12 * (AT_ENDS * blur) ** 2 * FORGOTTEN / span**3
        return float(p[1]), math.sqrt(max(float(jackknife(H, g)[1, 1]), 0.0) + common)

    def common_error(self, found: Step, window: float) -> float:
        """One sigma, s, of errors that tracks have in common: see :func:`otsync.refine.common_error.common_error`."""
        R, J = found.residual[..., None], found.slope[..., None]
        sums = Sums.of(R, J, found.weight, self.group, 2 * round(window * self.fps))
        return FITTED * math.sqrt(sums.variance())

    def scatter(self, found: Step) -> float:
        """One sigma, s: by neighbourhoods of tracks or by blocks of time, whichever is larger."""
        J = found.slope
        part = np.zeros((2, GROUPS)), np.zeros((2, -(-J.shape[1] // self.block)))
        block = np.arange(J.shape[1]) // self.block
        for k, x in enumerate((found.weight * J * J, found.weight * J * found.residual)):
            np.add.at(part[0][k], self.group, x.sum(1))
            np.add.at(part[1][k], block, x.sum(0))
        return max(float(np.sqrt(jackknife(H[:, None, None], g[:, None])[0, 0])) for H, g in part)

    def wander(self, found: Step) -> tuple[float, float]:
        """(rms over blocks of a second, by their information, of what each says the offset is off by, s; blur, s)."""
        J, w = found.slope, found.weight
        block = np.arange(J.shape[1]) // self.block
        H, g = np.zeros((2, block[-1] + 1))
        np.add.at(H, block, (w * J * J).sum(0))
        np.add.at(g, block, (w * J * found.residual).sum(0))
        total = float(H.sum())
        if not total > 0:
            return 0.0, 0.0
        told = 1e-9 * total < H
        wander = math.sqrt(float((g[told] ** 2 / H[told]).sum()) / total)
        return wander, math.sqrt(float((w * found.residual**2).sum()) / total)

    @property
    def block(self) -> int:
        """Frames within which errors are taken as dependent."""
        return max(1, round(CLUSTER * self.fps))

    @cached_property
    def group(self) -> Int[np.ndarray, " M"]:
        """Neighbourhoods of a's tracks: those of one limb err alike."""
        middle = np.nan_to_num(known_median(self.xa, 1))  # some tracks a's clock never sees
        return neighbours(in_space(middle[:, None])[:, 0], GROUPS)


def homogeneous(x: Float[np.ndarray, "M T 2"]) -> Float[np.ndarray, "M T 3"]:
    return np.concatenate([x, np.ones((*x.shape[:2], 1))], 2)


def without(
    x: Float[np.ndarray, "M T"], apart: Float[np.ndarray, "M T 2"], known: Bool[np.ndarray, "M T"], half: int
) -> Float[np.ndarray, "M T"]:
    """``x`` minus what a constant distance of two points makes of it over ±``half`` frames: least squares with a ridge
    (:data:`APART_BY`); 0 where not known.

    To cameras that stand still that is a constant. To one that shakes it turns with the camera, in all tracks at once:
    phones in hands were off by .2 frame at a sigma of .1 where only a mean was taken off.

    Args:
        apart: how x changes with that distance, across and along the picture.
    """
    u, v, y = (np.where(known, z, 0.0) for z in (apart[..., 0], apart[..., 1], x))
    uu, vv = (moving_sum(z, half) + APART_BY**-2 for z in (u * u, v * v))
    uv, uy, vy = (moving_sum(z, half) for z in (u * v, u * y, v * y))
    det = uu * vv - uv**2
    return y - u * (vv * uy - uv * vy) / det - v * (uu * vy - uv * uy) / det


def detrended(x: Float[np.ndarray, "M T"], known: Bool[np.ndarray, "M T"], half: int) -> Float[np.ndarray, "M T"]:
    """``x`` minus its masked moving mean over ±``half`` frames; 0 where not known."""
    mean = moving_sum(np.where(known, x, 0.0), half) / np.maximum(moving_sum(known.astype(float), half), 1)
    return np.where(known, x - mean, 0.0)


def moving_sum(x: Float[np.ndarray, "M T"], half: int) -> Float[np.ndarray, "M T"]:
    """Sums over ±``half`` frames, fewer at the ends."""
    T = x.shape[1]
    low, high = np.maximum(np.arange(T) - half, 0), np.minimum(np.arange(T) + half + 1, T)
    total = np.concatenate([np.zeros((len(x), 1)), np.cumsum(x, 1)], 1)
    return total[:, high] - total[:, low]
