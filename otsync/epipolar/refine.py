"""The depth-free offset below the frame: Gauss-Newton on epipolar residuals of continuous tracks."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from ..clocks.common import in_space, nominal_fps, on_clock
from ..clocks.splines import TrackSplines
from ..geometry import fundamentals, seen_pixels
from ..refine.common_error import FITTED, Sums
from ..refine.gauss_newton import CLUSTER, GROUPS, jackknife, neighbours
from ..refine.slot import JUDGED_BY, Refiner
from ..types import Alignment, Matches, Status, TrackSet, in_order
from ..types.trust import Trust
from .scan import MAD, EpipolarScan, unit_of

MATCHES = 200
"""Most candidate pairs that are fitted."""

LEAST_SHARE, LEAST_CANDIDATES = 0.05, 3
"""Share of its tracks' mixtures that a candidate must have to be fitted, and how many such candidates a fit needs."""

MIN_SEEN = 12 / 30
"""Seconds that a candidate must be seen in both videos to be fitted."""

SPREAD_ITERATIONS = 4
"""Steps of the fits with other windows: they start from the answer."""

BY_RESIDUAL = 2.0
"""Robust deviations at which a residual counts half (Cauchy's weight)."""

BY_CANDIDATE = 1.5
"""Median rms residuals at which a candidate counts a quarter: it does not move like its partner."""

LEAST_HALF = 3
"""Frames on either side that a mean needs to be removed, however few a second there are."""

CONVERGED = 1e-4
"""Frames below which a step is the last."""

UNKNOWN_SIGMA = 0.5
"""Sigma in frames where the fit left its start, so that the scan's whole-frame answer stands."""

LEAST_SIGMA = 0.03
"""Frames added to sigma in squares: what is left on clean tracks, from splines and calibration."""

UNREAD = ("min_overlap", "max_lag", "weak", "ambiguous")
"""Parameters of the scan that its likelihoods do not depend on."""

TINY = 1e-9
"""Pixels added to scales of residuals, which may all be 0."""


@dataclass(frozen=True)
class EpipolarRefine(Refiner):
    """Continuous offset that flattens the epipolar residuals of the candidates which the scan's offset supports.

    Candidates are weighed at the start (their share of their track's mixture), then
    ``R = H [e(x_a(t), x_b(t - δ))]`` is minimised over δ by robust Gauss-Newton, H removing the mean over
    ±``windows[0]`` seconds: a candidate need not be the same physical point, it must only move like it. b's tracks are
    splines, never bridged over gaps.

    Args:
        windows: half windows of detrending, s: the answer's, and those whose answers tell its spread.
        scan: whose likelihoods weigh the candidates.
        reach: largest step from the start, s; beyond it the start stays, MOVED.
    """

    windows: tuple[float, ...] = (20 / 30, 10 / 30, 40 / 30)
    reach: float = 2 / 30
    iterations: int = 12
    scan: EpipolarScan = field(default_factory=EpipolarScan)
    trust: Trust = field(default_factory=lambda: Trust(evidence=1.0))

    needs_xyz = False

    def __post_init__(self) -> None:
        self.trust.check("EpipolarRefine.trust", JUDGED_BY)
        for name in UNREAD:
            if getattr(self.scan, name) != getattr(EpipolarScan, name):
                raise ValueError(
                    f"EpipolarRefine.scan.{name}: expected without it, since the fit reads only the scan's "
                    f"likelihoods; found {getattr(self.scan, name)}. Set it on the aligner."
                )

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment) -> Alignment:
        if not np.isfinite(alignment.offset) or len(matches) == 0:
            return alignment
        fps = min(nominal_fps(a), nominal_fps(b))
        problem = _Problem.of(self, a, b, matches, alignment.offset, fps)
        if problem is None:
            flags = in_order((*alignment.flags, Status.NO_OVERLAP))
            return replace(alignment, flags=flags)
        offset, found = problem.solve(alignment.offset, self.windows[0], self.iterations, self.reach)
        common = problem.common_error(found, self.windows[0])
        others = [
            problem.solve(offset, w, SPREAD_ITERATIONS, self.reach)[0] for w in self.windows[1:] if np.isfinite(offset)
        ]
        spread = max((abs(o - offset) for o in others if np.isfinite(o)), default=0.0)
        sigma = float(np.hypot(max(problem.scatter(found), common), spread))
        raised = list(alignment.flags)
        if not np.isfinite(offset) or abs(offset - alignment.offset) > self.reach:
            offset, sigma = alignment.offset, UNKNOWN_SIGMA / fps
            raised.append(Status.MOVED)
        stats = alignment.stats | {
            "moved": abs(offset - alignment.offset),
            "spread": spread,
            "common_error": common,
            "fitted_matches": float(len(problem.weight)),
        }
        ordered = in_order(raised)
        return replace(
            alignment,
            offset=float(offset),
            sigma=float(np.hypot(sigma, LEAST_SIGMA / fps)),
            flags=ordered,
            stats=stats,
        )


@dataclass(frozen=True, eq=False)
class _Step:
    """Residuals in pixels, their slopes in pixels a second of offset, both detrended, and the weights of samples."""

    residual: Float[np.ndarray, "M T"]
    slope: Float[np.ndarray, "M T"]
    weight: Float[np.ndarray, "M T"]


@dataclass(frozen=True, eq=False)
class _Problem:
    """Supported candidates over a's even clock."""

    xa: Float[np.ndarray, "M T 2"]
    splines: TrackSplines
    times: Float[np.ndarray, " T"]
    F: Float[np.ndarray, "Fa Fb 3 3"]
    b_start: float
    fps: float
    weight: Float[np.ndarray, " M"]

    @classmethod
    def of(
        cls, refine: EpipolarRefine, a: TrackSet, b: TrackSet, matches: Matches, offset: float, fps: float
    ) -> _Problem | None:
        assert a.camera is not None and b.camera is not None
        xa, xb = (on_clock(tracks, seen_pixels(tracks), fps) for tracks in (a, b))
        F = fundamentals(a.camera, b.camera)
        lag = round((offset - float(a.times[0] - b.times[0])) * fps)
        share = refine.scan.support(xa, xb, F, matches.pairs, lag, fps, unit_of(a, b))
        best = np.argsort(-share, kind="stable")[:MATCHES]
        best = best[share[best] > LEAST_SHARE]
        if len(best) < LEAST_CANDIDATES:
            return None
        i, j = matches.pairs[best].T
        used, where = np.unique(j, return_inverse=True)
        splines = TrackSplines(b.times, in_space(seen_pixels(b)[used])).take(where)
        times = a.times[0] + np.arange(xa.shape[1]) / fps
        return cls(xa[i], splines, times, F, float(b.times[0]), fps, share[best])

    def residual(self, offset: float) -> Float[np.ndarray, "M T"]:
        """Sampson distances in pixels, nan where either is unseen."""
        t = self.times - offset
        xb = self.splines.sample(t)[..., :2]
        frames_a = np.arange(len(self.times)) if self.F.shape[0] > 1 else np.zeros(len(t), int)
        index = np.clip(np.round((t - self.b_start) * self.fps).astype(int), 0, self.F.shape[1] - 1)
        F = self.F[np.minimum(frames_a, self.F.shape[0] - 1), index]
        one = np.ones((*xb.shape[:2], 1))
        ha, hb = np.concatenate([self.xa, one], 2), np.concatenate([xb, one], 2)
        la, lb = np.einsum("tij,mtj->mti", F, ha), np.einsum("tij,mti->mtj", F, hb)
        norm = np.sqrt(la[..., 0] ** 2 + la[..., 1] ** 2 + lb[..., 0] ** 2 + lb[..., 1] ** 2)
        return (hb * la).sum(2) / np.maximum(norm, 1e-300)

    def solve(self, offset: float, window: float, iterations: int, reach: float) -> tuple[float, _Step]:
        """Offset, s, and what its last step saw; nan when nothing overlaps."""
        start, step, half = offset, 0.5 / self.fps, max(LEAST_HALF, round(window * self.fps))
        found = nothing = _Step(*np.zeros((3, *self.xa.shape[:2])))
        for _ in range(iterations):
            e = self.residual(offset)
            J = (self.residual(offset + step) - self.residual(offset - step)) / (2 * step)
            known = np.isfinite(e) & np.isfinite(J)
            R, J = detrended(e, known, half), detrended(J, known, half)
            enough = known.sum(1) >= MIN_SEEN * self.fps
            known &= enough[:, None]
            if not known.any():
                return float("nan"), nothing
            scale = MAD * float(np.median(np.abs(R[known]))) + TINY
            rms = np.sqrt((R**2 * known).sum(1) / np.maximum(known.sum(1), 1))
            level = BY_CANDIDATE * float(np.median(rms[enough])) + TINY
            w = known / (1 + (R / (BY_RESIDUAL * scale)) ** 2) * (self.weight / (1 + (rms / level) ** 2) ** 2)[:, None]
            curvature = float((w * J * J).sum())
            if curvature <= 0:
                return float("nan"), nothing
            move = -float((w * J * R).sum()) / curvature
            found = _Step(R, J, w)
            offset += float(np.clip(move, -step, step))
            if abs(move) < CONVERGED / self.fps or abs(offset - start) > reach:
                break
        return offset, found

    def common_error(self, found: _Step, window: float) -> float:
        """One sigma, s, of errors that tracks have in common: see :func:`otsync.refine.common_error.common_error`."""
        R, J = found.residual[..., None], found.slope[..., None]
        sums = Sums.of(R, J, found.weight, self.group, 2 * round(window * self.fps))
        return FITTED * math.sqrt(sums.variance())

    def scatter(self, found: _Step) -> float:
        """One sigma, s: by neighbourhoods of tracks or by blocks of time, whichever is larger."""
        J = found.slope
        part = np.zeros((2, GROUPS)), np.zeros((2, -(-J.shape[1] // self.block)))
        block = np.arange(J.shape[1]) // self.block
        for k, x in enumerate((found.weight * J * J, found.weight * J * found.residual)):
            np.add.at(part[0][k], self.group, x.sum(1))
            np.add.at(part[1][k], block, x.sum(0))
        return max(float(np.sqrt(jackknife(H[:, None, None], g[:, None])[0, 0])) for H, g in part)

    @property
    def block(self) -> int:
        """Frames within which errors are taken as dependent."""
        return max(1, round(CLUSTER * self.fps))

    @cached_property
    def group(self) -> Int[np.ndarray, " M"]:
        """Neighbourhoods of a's tracks: those of one limb err alike."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of tracks that a's clock never sees
            middle = np.nan_to_num(np.nanmedian(self.xa, 1))
        return neighbours(in_space(middle[:, None])[:, 0], GROUPS)


def detrended(x: Float[np.ndarray, "M T"], known: Bool[np.ndarray, "M T"], half: int) -> Float[np.ndarray, "M T"]:
    """``x`` minus its masked moving mean over ±``half`` frames; 0 where not known."""
    filled = np.where(known, x, 0.0)
    T = x.shape[1]
    low, high = np.maximum(np.arange(T) - half, 0), np.minimum(np.arange(T) + half + 1, T)

    def windowed(values: np.ndarray) -> np.ndarray:
        total = np.concatenate([np.zeros((len(values), 1)), np.cumsum(values, 1)], 1)
        return total[:, high] - total[:, low]

    mean = windowed(filled) / np.maximum(windowed(known.astype(float)), 1)
    return np.where(known, x - mean, 0.0)
