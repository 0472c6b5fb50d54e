"""Scale and shift of estimated depth, from points whose depth is known: pure functions on arrays.

An estimator tells a value d a pixel; the inverse depth there is ``1/z = scale d + shift``. What it ``gives`` says how
much of that is unknown::

    relative   d is inverse depth up to scale and shift (MiDaS, DPT, Depth Anything)
    inverse    d is inverse depth up to scale (Depth Pro)
    depth      1/d is inverse depth up to scale (metric estimators, in whatever unit; feed-forward models)

Fits are robust: RANSAC over pairs of points, then Huber weights on those that agree. They are the same in every run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from ..compute.medians import known_median

Gives = Literal["relative", "inverse", "depth"]

ROUGH = 0.05
"""One sigma of an estimator's inverse depth, as a share of it: of the good ones on unseen scenes."""

FLOOR = 0.02
"""The same as a share of the points' median inverse depth: of what is far away."""

AGREES = 3.0
"""Sigmas within which a point agrees with a fit."""

HUBER = 1.345
"""Sigmas from which on a point's pull no longer grows."""

TRIES, SEED = 2000, 0
"""Pairs of points that are tried, and the seed that draws them."""

LEAST_SPREAD = 0.15
"""Of inverse depth over its median: points on one wall that faces the camera tell no shift."""


class Untied(ValueError):
    """Points that tie an estimate to the world are too few, too flat, or disagree; the text says which."""


@dataclass(frozen=True, eq=False)
class Line:
    """``q = scale d + shift``. agree: (N,) which points do; error: their median share off."""

    scale: float
    shift: float
    agree: Bool[np.ndarray, " N"]
    error: float


@dataclass(frozen=True)
class Limits:
    """When points tie a video.

    Args:
        least: points that agree. share: of all points that must agree.
        frames: share of a moving camera's frames that must be tied; the others lie between them.
    """

    least: int = 12
    share: float = 0.3
    frames: float = 0.5

    def __post_init__(self) -> None:
        if self.least < 3 or not 0 < self.share <= 1 or not 0 < self.frames <= 1:
            raise ValueError(
                "least, share, frames: expected 3 and more, and shares above 0 up to 1; found "
                f"{self.least}, {self.share:g} and {self.frames:g}."
            )


def fit_line(
    d: Float[np.ndarray, " N"],
    q: Float[np.ndarray, " N"],
    sigma: Float[np.ndarray, " N"],
    *,
    shift: bool = True,
    limits: Limits | None = None,
) -> Line:
    """``q = scale d + shift`` with scale above 0, through most of the points.

    Args:
        d: what the estimator says. q: inverse depth, 1 / unit of the world. sigma: of ``d`` and ``q`` together, in q's
            unit.
        shift: False: it is 0.

    :class:`Untied` says why the points do not tell the line.
    """
    limits = limits or Limits()
    if len(d) < limits.least:
        raise Untied(f"{len(d)} points, fewer than {limits.least}")
    scale, offset = _tried(d, q, shift)
    left = np.abs(scale[:, None] * d + offset[:, None] - q) / sigma
    cost = np.where(scale > 0, (np.minimum(left / AGREES, 1.0) ** 2).sum(1), np.inf)
    best = int(cost.argmin())
    if not np.isfinite(cost[best]):
        raise Untied("what the estimator calls near is far in the world")
    a, b = float(scale[best]), float(offset[best])
    for _ in range(20):
        left = np.abs(a * d + b - q) / sigma
        weight = np.where(left <= AGREES, np.minimum(1.0, HUBER / np.maximum(left, 1e-9)), 0.0) / sigma**2
        a, b = _weighted(d, q, weight, shift, (a, b))
    agree = np.abs(a * d + b - q) <= AGREES * sigma
    if a <= 0:
        raise Untied("what the estimator calls near is far in the world")
    if agree.sum() < max(limits.least, limits.share * len(d)):
        raise Untied(f"{int(agree.sum())} of {len(d)} points agree, fewer than {limits.least} or {limits.share:.0%}")
    low, high = np.quantile(q[agree], (0.05, 0.95))
    if shift and high - low < LEAST_SPREAD * np.median(q[agree]):
        raise Untied(f"all {int(agree.sum())} points lie at about one depth, which tells no shift")
    return Line(a, b, agree, float(np.median(np.abs(a * d + b - q)[agree] / q[agree])))


def _tried(
    d: Float[np.ndarray, " N"], q: Float[np.ndarray, " N"], shift: bool
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Lines through pairs of points, or through the origin and one."""
    rng = np.random.default_rng(SEED)
    if not shift:
        one = np.arange(len(d)) if len(d) <= TRIES else rng.choice(len(d), TRIES, replace=False)
        one = one[d[one] > 0] if (d[one] > 0).any() else one
        scale = q[one] / np.where(d[one] > 0, d[one], np.inf)
        return scale, np.zeros_like(scale)
    i, j = np.triu_indices(len(d), 1) if len(d) * (len(d) - 1) // 2 <= TRIES else rng.integers(0, len(d), (2, TRIES))
    apart = d[i] - d[j]
    far = np.abs(apart) > 0.2 * np.ptp(d)  # near ones tell a slope of noise
    i, j, apart = (i[far], j[far], apart[far]) if far.any() else (i, j, np.where(apart == 0, np.inf, apart))
    scale = (q[i] - q[j]) / apart
    return scale, q[i] - scale * d[i]


def _weighted(
    d: np.ndarray, q: np.ndarray, weight: np.ndarray, shift: bool, before: tuple[float, float]
) -> tuple[float, float]:
    """Weighted least squares; what was there before where it is singular."""
    if not shift:
        square = float(weight @ d**2)
        return (float(weight @ (d * q)) / square, 0.0) if square > 0 else before
    total = float(weight.sum())
    if total <= 0:
        return before
    x, y = float(weight @ d) / total, float(weight @ q) / total
    square = float(weight @ (d - x) ** 2)
    if square <= 1e-18 * total * max(x * x, 1e-300):
        return before
    a = float(weight @ ((d - x) * (q - y))) / square
    return a, y - a * x


def as_inverse(d: Float[np.ndarray, "*N"], gives: Gives) -> Float[np.ndarray, "*N"]:
    """The estimator's values as inverse depth up to scale (and shift); nan where it tells none."""
    if gives != "depth":
        return np.where(np.isfinite(d), d, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.isfinite(d) & (d > 0), 1 / d, np.nan)


def noise(q: Float[np.ndarray, " N"], sigma: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """One sigma of ``q`` against an estimate of it; ``sigma``: of the point's own depth, as a share."""
    return np.hypot(ROUGH, sigma) * q + FLOOR * np.median(q)


def steadied(d: Float[np.ndarray, "T G"], *, shift: bool) -> Float[np.ndarray, "T 2"]:
    """Scale and shift that bring every frame of a static camera to what most frames say of the background.

    Args:
        d: inverse depth up to scale (and shift) at pixels of the background, nan where something moves.

    Estimators of single images flicker from frame to frame. The background does not: this takes the flicker out, with
    many more pixels than there are points of known depth. Frames with too few pixels keep what their neighbours have.
    """
    out = np.tile([1.0, 0.0], (len(d), 1))
    for _ in range(2):
        now = out[:, :1] * d + out[:, 1:]
        middle = known_median(now, 0)
        known = np.zeros(len(d), bool)
        for k in range(len(d)):
            both = np.isfinite(now[k]) & np.isfinite(middle)
            if both.sum() >= 20:
                a, b = brought(now[k][both], middle[both], shift=shift)
                if a > 0:
                    out[k], known[k] = (a * out[k, 0], a * out[k, 1] + b), True
        if known.any():
            out = between(out, known)
    return out


def brought(x: Float[np.ndarray, " N"], y: Float[np.ndarray, " N"], *, shift: bool) -> tuple[float, float]:
    """Scale and shift of x that bring it to y, two estimates of one thing; a scale of 0 and less: they contradict."""
    if shift:
        spread = np.subtract(*np.quantile(x, (0.8, 0.2)))
        a = float(np.subtract(*np.quantile(y, (0.8, 0.2))) / spread) if spread > 0 else 1.0
        b = float(np.median(y) - a * np.median(x))
    else:
        a, b = float(np.median(y) / np.median(x)) if np.median(x) > 0 else 1.0, 0.0
    least = 0.01 * float(np.std(y)) + 1e-300  # of a sky, which is 0 in both, nothing may depend on the last bits
    for _ in range(10):
        left = np.abs(a * x + b - y)
        sigma = 1.4826 * np.median(left) + least
        weight = np.minimum(1.0, HUBER * sigma / np.maximum(left, 1e-300))
        a, b = _weighted(x, y, weight, shift, (a, b))
    return a, b


def between(values: Float[np.ndarray, "T 2"], known: Bool[np.ndarray, " T"]) -> Float[np.ndarray, "T 2"]:
    """Rows that are not known, put between their neighbours in time; before the first and after the last the same."""
    k = np.arange(len(values))
    return np.stack([np.interp(k, k[known], values[known, c]) for c in range(values.shape[1])], 1)


def tie_static(
    points: Float[np.ndarray, "T M"],
    background: Float[np.ndarray, "T G"],
    z: Float[np.ndarray, " M"],
    sigma: Float[np.ndarray, " M"],
    *,
    gives: Gives,
    limits: Limits | None = None,
) -> tuple[Float[np.ndarray, "T 2"], Line]:
    """Scale and shift of every frame of a camera that does not move: one line a video, the flicker taken out before.

    Args:
        points: the estimator's values at M points of the background whose depth along z is known; nan where hidden.
        background: the same at other pixels of the background.
        z: depth of the points, world units. sigma: of it, as a share.

    :class:`Untied` says why they do not tell it. The line's ``agree`` is of the M points.
    """
    shift = gives == "relative"
    frames = steadied(as_inverse(background, gives), shift=shift)
    d = known_median(frames[:, :1] * as_inverse(points, gives) + frames[:, 1:], 0)
    known = np.flatnonzero(np.isfinite(d))
    if len(known) == 0:
        raise Untied("no point of known depth is ever in sight")
    q = 1 / z[known]
    line = fit_line(d[known], q, noise(q, sigma[known]), shift=shift, limits=limits)
    agree = np.zeros(len(z), bool)
    agree[known] = line.agree
    out = np.stack([line.scale * frames[:, 0], line.scale * frames[:, 1] + line.shift], 1)
    return out, Line(line.scale, line.shift, agree, line.error)


def tie_moving(
    points: Float[np.ndarray, "T M"],
    z: Float[np.ndarray, "T M"],
    sigma: Float[np.ndarray, " M"],
    *,
    gives: Gives,
    limits: Limits | None = None,
) -> tuple[Float[np.ndarray, "T 2"], Line]:
    """The same of a camera that moves: a line a frame; frames without enough points lie between their neighbours.

    Args:
        points: the estimator's values where the points appear in each frame; nan out of sight or hidden. z: their
            depth in each frame.
    """
    limits = limits or Limits()
    shift = gives == "relative"
    d = as_inverse(points, gives)
    out, known = np.zeros((len(d), 2)), np.zeros(len(d), bool)
    agree, seen, errors, why = np.zeros(d.shape[1], bool), np.zeros(d.shape[1], bool), [], ""
    for k in range(len(d)):
        here = np.flatnonzero(np.isfinite(d[k]) & (z[k] > 0))
        seen[here] = True
        q = 1 / z[k, here]
        try:
            line = fit_line(d[k, here], q, noise(q, sigma[here]) if len(here) else q, shift=shift, limits=limits)
        except Untied as error:
            why = str(error)
            continue
        out[k], known[k] = (line.scale, line.shift), True
        agree[here[line.agree]] = True
        errors.append(line.error)
    if known.sum() < max(1, limits.frames * len(d)):
        raise Untied(f"{int(known.sum())} of {len(d)} frames are tied, fewer than {limits.frames:.0%}; the last: {why}")
    middle = np.median(out[known], 0)
    return between(out, known), Line(float(middle[0]), float(middle[1]), agree, float(np.median(errors)))


def depth_of(
    d: Float[np.ndarray, "h w"], scale: float, shift: float, *, gives: Gives, farthest: float
) -> Float[np.ndarray, "h w"]:
    """Depth along z, world units, float32; 0 where it is unknown or beyond ``farthest``."""
    q = scale * as_inverse(d, gives) + shift
    known = q > 1 / farthest  # nan is not
    return np.where(known, 1 / np.where(known, q, 1.0), 0).astype(np.float32)
