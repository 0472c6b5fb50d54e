"""Curves in time as weighted sums of a few values: cubic B-splines, the paper's cubic Hermite splines, and samples (the
"w/o spline" ablation).

A path is a uniform grid of knots in seconds. At any time it is a sum over four consecutive knots,

    x(t) = Σ_a w_a(t) knots[first + a],   a = 0..3,

whose weights are cubic polynomials in t. Everything else (nodes, Gaussians, fused kernels) uses only `first` and `w` of
a path, so that another kind of curve is another object in the same slot.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.linalg import solve_banded
from torch import Tensor

from recon.motion.arrays import numbers

WINDOW = 4  # knots under a path's weights at any time
MAX_KNOTS = 4096  # of one path: nine minutes at the default spacing; a longer span means a wrong offset


@dataclass(frozen=True, repr=False)
class Path(ABC):
    """A kind of curve on a uniform grid: `count` knots at start + i * spacing seconds (float64)."""

    peak: ClassVar[float] = 1.0
    """The largest weight of a knot that is not at an end: how far the curve goes where that knot alone goes by 1."""

    start: float
    spacing: float
    count: int

    def __post_init__(self) -> None:
        if not (math.isfinite(self.start) and math.isfinite(self.spacing) and self.spacing > 0):
            raise ValueError(
                f"start, spacing: expected finite seconds, spacing > 0; found {self.start}, {self.spacing}."
            )
        if not WINDOW <= self.count <= MAX_KNOTS:
            raise ValueError(
                f"count: expected {WINDOW}..{MAX_KNOTS} knots; found {self.count:g}. Check the offsets (in seconds) of "
                "the videos, or set a wider spacing."
            )

    def __repr__(self) -> str:
        first, last = self.times[[0, -1]]
        return f"{type(self).__name__}({self.count} knots, {first:.3f} to {last:.3f} s)"

    @classmethod
    def of(cls, first: float, last: float, spacing: float, margin: float = 0.0) -> Self:
        """A path over first..last seconds, and `margin` seconds before and after: the largest believable offset."""
        if not (math.isfinite(first) and math.isfinite(last) and last >= first and margin >= 0 and spacing > 0):
            raise ValueError(
                "first, last, margin, spacing: expected finite seconds, last >= first, margin >= 0, spacing > 0; "
                f"found {first}, {last}, {margin}, {spacing}."
            )
        span = (last - first + 2 * margin) / spacing
        if span > 2 * MAX_KNOTS:  # before it is rounded: an absurd span has no integer
            raise ValueError(
                f"last - first: expected at most {MAX_KNOTS * spacing:.0f} seconds of motion at this spacing; found "
                f"{last - first:.6g}. Check the offsets (in seconds) of the videos, or set a wider spacing."
            )
        # a whole number of intervals stays that number, despite rounding
        return cls(float(first - margin), float(spacing), max(WINDOW, math.ceil(span - 1e-6) + 1))

    @property
    def times(self) -> Float[np.ndarray, " P"]:
        """Seconds of the knots."""
        return self.start + self.spacing * np.arange(self.count)

    @abstractmethod
    def _windows(self, t: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For times [...]: first knot of the window, matrix [...,4,4] of cubics in u, and the knot where u = 0."""

    @abstractmethod
    def step(self, seconds: float) -> float:
        """The time difference nearest to `seconds` over which this path may be compared with itself."""

    def basis(self, t: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For times [...]: the first knot int64 [...], weights [...,4], and their derivatives per second [...,4]."""
        first, matrix, origin = self._windows(t)
        u = (np.asarray(t, float) - self.start) / self.spacing - origin
        one = np.ones_like(u)
        powers = np.stack([one, u, u * u, u * u * u], -1)
        slopes = np.stack([0 * one, one, 2 * u, 3 * u * u], -1) / self.spacing
        return first, (matrix @ powers[..., None])[..., 0], (matrix @ slopes[..., None])[..., 0]

    def weights(self, t: Tensor) -> tuple[int | Tensor, Tensor]:
        """First knot (an int for a single time) and weights [...,4] float64, differentiable in `t`."""
        t = torch.as_tensor(t, dtype=torch.float64)
        first, matrix, origin = self._windows(t.detach().cpu().numpy())
        u = (t - self.start) / self.spacing - torch.as_tensor(origin, dtype=torch.float64, device=t.device)
        u2 = u * u
        powers = torch.stack([torch.ones_like(u), u, u2, u2 * u], -1)
        w = (torch.as_tensor(matrix, device=t.device) @ powers[..., None])[..., 0]
        return (int(first) if t.ndim == 0 else torch.as_tensor(first, device=t.device)), w

    def at(self, knots: Tensor, t: Tensor | float) -> Tensor:
        """The curve of `knots` [P,...] at `t`: [...], or [S,...] for S times."""
        first, w = self.weights(torch.as_tensor(t, dtype=torch.float64, device=knots.device))
        w = w.to(knots.dtype)
        if isinstance(first, int):
            return (w @ knots[first : first + WINDOW].flatten(1)).reshape(knots.shape[1:])
        window = first[..., None] + torch.arange(WINDOW, device=knots.device)
        return torch.einsum("...a,...ax->...x", w, knots.flatten(1)[window]).reshape(*first.shape, *knots.shape[1:])

    def through(self, values: np.ndarray) -> np.ndarray:
        """Knots [P,...] of the curve that has these values at the seconds of the knots."""
        first, w, _ = self.basis(self.times)
        column = first[:, None] + np.arange(WINDOW)
        bands = np.zeros((2 * WINDOW - 1, self.count))  # of the weights at the knots; row WINDOW - 1 is the diagonal
        bands[WINDOW - 1 + np.arange(self.count)[:, None] - column, column] = w
        flat = np.asarray(values, float).reshape(self.count, -1)
        return solve_banded((WINDOW - 1, WINDOW - 1), bands, flat).reshape(np.shape(values))

    def at_knots(self, knots: Tensor) -> Tensor:
        """Values [P,...] of the curve of ``knots`` at the seconds of the knots: what :meth:`through` undoes."""
        return self.at(knots, torch.as_tensor(self.times, device=knots.device))

    def design(self, t: Float[np.ndarray, " S"]) -> sparse.csr_array:
        """The weights [S,P] of all knots at S times: four a row."""
        first, w, _ = self.basis(t)
        begins = WINDOW * np.arange(len(first) + 1)
        return sparse.csr_array(
            (w.ravel(), (first[:, None] + np.arange(WINDOW)).ravel(), begins), shape=(len(first), self.count)
        )


def _hermite_matrices() -> Float[np.ndarray, "5 4 4"]:
    """Weights of a window's four knots as cubics in u, for the five kinds of interval.

    Kinds: before the first knot, the first interval, an inner one, the last one, after the last knot. u runs from 0 to
    1 over the interval, whose knots are those numbered 0, 0, 1, 2, 3 in the window. Tangents are central differences of
    the knots, one-sided at the two ends. Rows: knots of the window; columns: powers of u.
    """
    value0, slope0 = np.array([1.0, 0, -3, 2]), np.array([0, 1.0, -2, 1])
    value1, slope1 = np.array([0, 0, 3.0, -2]), np.array([0, 0, -1.0, 1])
    knots = np.eye(4)
    central1, central2 = (knots[2] - knots[0]) / 2, (knots[3] - knots[1]) / 2

    def interval(k: int, leave: np.ndarray, arrive: np.ndarray) -> np.ndarray:
        parts = ((knots[k], value0), (leave, slope0), (knots[k + 1], value1), (arrive, slope1))
        return sum((np.outer(rows, cubic) for rows, cubic in parts), np.zeros((4, 4)))

    begin, end = knots[1] - knots[0], knots[3] - knots[2]
    straight = np.eye(4)[:2]  # the powers 1 and u
    before = np.outer(knots[0], straight[0]) + np.outer(begin, straight[1])
    after = np.outer(knots[3], straight[0]) + np.outer(end, straight[1])
    return np.stack(
        [before, interval(0, begin, central1), interval(1, central1, central2), interval(2, central2, end), after]
    )


def _bspline_matrices() -> Float[np.ndarray, "5 4 4"]:
    """As :func:`_hermite_matrices`, of the uniform cubic B-spline that goes on straight: the knot before the first lies
    on the line through the first two, and likewise beyond the last."""
    inner = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6
    begin, end = np.zeros((4, 4)), np.zeros((4, 4))
    begin[:3], end[1:] = inner[1:], inner[:3]
    begin[:2] += np.outer([2, -1], inner[0])
    end[2:] += np.outer([-1, 2], inner[3])
    return np.stack([_HERMITE[0], begin, inner, end, _HERMITE[4]])


_HERMITE = _hermite_matrices()
_BSPLINE = _bspline_matrices()
_FIRST_OF_KIND = np.array([0, 0, -1, -2, -3])  # the window's first knot, counted from the knot where u = 0
_ONE_HOT = np.zeros((4, 4, 4))
_ONE_HOT[np.arange(4), np.arange(4), 0] = 1  # knot k of the window, whatever u


@dataclass(frozen=True, repr=False)
class _Spline(Path):
    """Cubics on the intervals between knots, and straight lines beyond the ends, with the ends' slopes: so the
    derivative in time, by which offsets are refined, stays alive and bounded there."""

    matrices: ClassVar[np.ndarray]
    """[5,4,4], see :func:`_hermite_matrices`."""

    def _windows(self, t: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s = (np.asarray(t, float) - self.start) / self.spacing
        last = self.count - 1
        # the knot where u = 0; an infinite or absurd time is continued like the end
        i = np.clip(np.nan_to_num(np.floor(s)), -1, last).astype(np.int64)
        kind = np.where(i < 0, 0, np.where(i == 0, 1, np.where(i < last - 1, 2, np.where(i < last, 3, 4))))
        origin = np.maximum(i, 0)
        return origin + _FIRST_OF_KIND[kind], self.matrices[kind], origin

    def step(self, seconds: float) -> float:
        return seconds


@dataclass(frozen=True, repr=False)
class HermiteSpline(_Spline):
    """Cubic Hermite spline through its knots, C1, with tangents by finite differences (central; one-sided at the ends).

    Equals scipy.interpolate.CubicHermiteSpline with those tangents.

    The paper's. Its error falls with the third power of the spacing only: with knots every .133 s the nearest one (by
    least squares) is up to 1 % of its swing off a limb that swings at 1 Hz, and 9 % at 2 Hz.
    """

    matrices: ClassVar[np.ndarray] = _HERMITE


@dataclass(frozen=True, repr=False)
class BSpline(_Spline):
    """Uniform cubic B-spline, C2, which passes near its knots, with natural ends.

    Equals scipy.interpolate.BSpline on the knots and one more at either end, on the straight line through the last two.
    As smooth as four knots allow, its error falls with the fourth power of the spacing: of a swing of 1 Hz .1 %, of one
    of 2 Hz 2 %, where :class:`HermiteSpline` has 1 and 9.
    """

    peak: ClassVar[float] = 2 / 3
    matrices: ClassVar[np.ndarray] = _BSPLINE


@dataclass(frozen=True, repr=False)
class Sampled(Path):
    """The sample nearest in time, held beyond the ends: the "w/o spline" ablation, without a derivative in time."""

    def _windows(self, t: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s = (np.asarray(t, float) - self.start) / self.spacing
        nearest = np.clip(np.floor(np.nan_to_num(s) + 0.5), 0, self.count - 1).astype(np.int64)
        first = np.clip(nearest - 1, 0, self.count - WINDOW)
        return first, _ONE_HOT[nearest - first], nearest

    def step(self, seconds: float) -> float:
        return max(1, round(seconds / self.spacing)) * self.spacing


def resampled(knots: Tensor, path: Path, other: Path) -> Tensor:
    """Knots on another path of the curve that has the same values at that one's seconds."""
    values = path.at(knots.detach(), torch.as_tensor(other.times, device=knots.device))
    return torch.as_tensor(other.through(values.cpu().numpy())).to(values)


SPLINES: dict[str, type[Path]] = {"b-spline": BSpline, "hermite": HermiteSpline}
"""Splines that a motion may be built of, by their names in the shell."""


def path_arrays(path: Path) -> dict[str, np.ndarray]:
    """A path as plain arrays, for a checkpoint."""
    numbers = np.array([path.start, path.spacing, path.count], float)
    return {"path": np.array(type(path).__name__), "path_knots": numbers}


def path_from_arrays(arrays: Mapping[str, np.ndarray]) -> Path:
    """The path whose :func:`path_arrays` these are; KeyError where one is missing, ValueError where they make none."""
    every: tuple[type[Path], ...] = (*SPLINES.values(), Sampled)
    kinds = {kind.__name__: kind for kind in every}
    name, (start, spacing, count) = str(arrays["path"]), numbers(arrays, "path_knots", (3,)).double().tolist()
    if name not in kinds:
        raise ValueError(f"path: expected one of {sorted(kinds)}; found {name!r}.")
    if count != int(count):
        raise ValueError(f"path_knots: expected a whole number of knots; found {count}.")
    try:
        return kinds[name](start, spacing, int(count))
    except ValueError as error:
        raise ValueError(f"path_knots: {error}") from None
