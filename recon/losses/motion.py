"""Losses of a motion itself, apart from the images: on the shape that nodes keep, and on how they move.

All are means of unsquared norms, smooth at zero and exactly zero there. Lengths are in footprints (the world size of a
working pixel), steps of time are those of the study's frame, 1/30 s, whatever the videos' own: a weight means the same
in every scene. Each object draws its own moment from `draw.rng`; a motion to which a loss does not apply gives None.
Offsets get no gradient from here: a motion is as stiff as it is, whenever it was filmed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.motion import PerGaussian, Scaffold, fused, regularizer_kernels
from recon.motion.motion import Motion
from recon.motion.solve import FRAME
from recon.rotations import conjugate, product, rotation_matrices, rotation_vectors

SOFT = 0.0075  # footprints: below it a norm is quadratic (0.1 mm where a footprint is 1.33 cm)
SOFT_ANGLE = 1e-4  # radians
SHIFTS = (FRAME, 3 * FRAME, 8 * FRAME)  # seconds over which shapes are compared


@dataclass(frozen=True, eq=False)
class Draw:
    """Where motion losses draw their moments. span: first and last world second of the footage; footprint: world units;
    frame_step: seconds of a frame of the reference; clocks float64 [V]: offsets, for a scaffold per video."""

    rng: np.random.Generator
    span: tuple[float, float]
    frame_step: float
    footprint: float
    clocks: Tensor | None = None

    def moment(self, before: float, after: float) -> float:
        """A world second that leaves `before` and `after` seconds within the span, as far as it is long enough."""
        first, last = self.span[0] + before, self.span[1] - after
        return float(self.rng.uniform(first, last)) if last > first else (first + last) / 2


class MotionLoss(ABC):
    """A loss on a motion: a frozen dataclass with a ``weight`` that inherits from this."""

    weight: float
    """Its share in the sum of losses, in the steps in which it is evaluated, at the end of a fit."""

    begin: float = 1.0
    """Share of its weight that a fit begins with; from there it grows evenly."""

    every: int = 1
    """It is evaluated in every ``every``-th step."""

    def weight_at(self, done: float) -> float:
        """The weight when a share 0..1 of a fit's steps is done."""
        return self.weight * (self.begin + (1 - self.begin) * done)

    @abstractmethod
    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        """The unweighted loss, a scalar; None where this motion has nothing of the kind."""


def soft_norm(x: Tensor, soft: float = SOFT) -> Tensor:
    """√(‖x‖² + soft²) - soft over the last axis: the norm, smooth at zero, and zero there."""
    return ((x * x).sum(-1) + soft * soft).sqrt() - soft


def shape_change(motion: Scaffold, times: tuple[float, float], neighbours: int, draw: Draw) -> Tensor:
    """mean_i Σ_k ŵ_ik ‖l_ik(t_0) - l_ik(t_1)‖ with l_ik = R_kᵀ(x_i - x_k) in footprints, over the first neighbours."""

    def local(apart: Tensor, quats: Tensor, k: Tensor) -> Tensor:
        return (rotation_matrices(quats)[k].transpose(-1, -2) @ apart[..., None])[..., 0]

    return _edge_change(motion, times, neighbours, draw, local, regularizer_kernels.arap)


def length_change(motion: Scaffold, times: tuple[float, float], neighbours: int, draw: Draw) -> Tensor:
    """mean_i Σ_k ŵ_ik |‖x_i - x_k‖(t_0) - ‖x_i - x_k‖(t_1)| in footprints, over the first neighbours."""

    def length(apart: Tensor, quats: Tensor, k: Tensor) -> Tensor:
        return soft_norm(apart)[..., None]

    def kernel(*given: Any) -> float:
        return regularizer_kernels.length(*given[:-1])  # rotations get no gradient

    return _edge_change(motion, times, neighbours, draw, length, kernel)


def _edge_change(
    motion: Scaffold,
    times: tuple[float, float],
    neighbours: int,
    draw: Draw,
    described: Callable[[Tensor, Tensor, Tensor], Tensor],
    kernel: Callable[..., float],
) -> Tensor:
    """mean_i Σ_k ŵ_ik ‖d_ik(t_0) - d_ik(t_1)‖ with d = described(x_i - x_k [M,K,3], quats [M,4], k [M,K]); the kernel
    computes the same, with its gradients, where that can be done in one pass."""
    k, shares = motion.edges[:, :neighbours], _edge_shares(motion, neighbours)
    if fused.applies(motion.knots, motion.knot_quats):
        moments = motion.moments(times, draw.clocks)
        edges, w = k.numpy(), shares.numpy()

        def compute(knots, quats, g_knots, g_quats):
            curves = (knots, quats, motion.rig.clock)
            return kernel(curves, moments, edges, w, 1 / draw.footprint, SOFT, g_knots, g_quats)

        return fused.penalty(motion.knots, motion.knot_quats, compute)
    before, after = (
        described((positions[:, None] - positions[k]) / draw.footprint, quats, k)
        for positions, quats in (motion.nodes(t, draw.clocks) for t in times)
    )
    return (soft_norm(before - after) * shares).sum(1).mean()


def _edge_shares(motion: Scaffold, neighbours: int) -> Tensor:
    """Weights of the edges to the first neighbours, of sum 1 over each node's; 0 for a node without any."""
    w = motion.edge_weights[:, :neighbours]
    return w / w.sum(1, keepdim=True).clamp_min(1e-12)


def difference(motion: Motion, times: list[float], coefficients: list[float], draw: Draw) -> Tensor | None:
    """mean ‖Σ_s coefficients_s x(t_s)‖ in footprints over what moves by its own parameters: nodes, or Gaussians
    without a scaffold."""
    if not isinstance(motion, PerGaussian | Scaffold):
        return None
    knots = motion.knots if isinstance(motion, Scaffold) else motion.own_knots
    if fused.applies(knots):
        weights = np.array(coefficients)
        if isinstance(motion, Scaffold):
            moments, clock = motion.moments(times, draw.clocks), motion.rig.clock
        else:
            moments, clock = motion.path.basis(np.array(times)[:, None])[:2], np.zeros(knots.shape[1], np.int32)

        def compute(knots, quats, g_knots, g_quats):
            curves = (knots, quats, clock)
            return regularizer_kernels.stencil(curves, moments, weights, 1 / draw.footprint, SOFT, g_knots)

        return fused.penalty(knots, knots.new_empty(0, 0, 4), compute)
    if isinstance(motion, Scaffold):
        at = [motion.nodes(t, draw.clocks)[0] for t in times]
    else:
        at = [motion.path.at(knots, t) for t in times]
    together = torch.stack([c * x for c, x in zip(coefficients, at, strict=True)]).sum(0)
    return soft_norm(together / draw.footprint).mean()


def _step(motion: Motion) -> float:
    """Seconds over which velocities are taken."""
    return motion.path.step(FRAME) if isinstance(motion, Scaffold | PerGaussian) else FRAME


def _over_a_shift(loss: Arap | Length, change: Callable[..., Tensor], motion: Motion, draw: Draw) -> Tensor | None:
    """The change between two moments, apart by one of the loss's shifts; None without a scaffold."""
    if not isinstance(motion, Scaffold):
        return None
    shift = motion.path.step(float(draw.rng.choice(loss.shifts)))
    t = draw.moment(0, shift)
    return change(motion, (t, t + shift), loss.neighbours, _still(draw))


@dataclass(frozen=True)
class Arap(MotionLoss):
    """As rigid as possible: a node keeps its place in the frames of its neighbours (MoSca's L_coord).

    Compares two moments apart by one of `shifts` (seconds), drawn. Zero for rigid motions of all nodes together. The
    weight grows: the fit first finds where things are, and then what they have in common.
    """

    weight: float = 0.1
    begin: float = 0.1
    every: int = 2
    shifts: tuple[float, ...] = SHIFTS
    neighbours: int = 6

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        return _over_a_shift(self, shape_change, motion, draw)


@dataclass(frozen=True)
class Length(MotionLoss):
    """Distances to neighbours are kept (MoSca's L_len), between two moments as for :class:`Arap`."""

    weight: float = 0.1
    begin: float = 0.1
    every: int = 2
    shifts: tuple[float, ...] = SHIFTS
    neighbours: int = 6

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        return _over_a_shift(self, length_change, motion, draw)


@dataclass(frozen=True)
class Velocity(MotionLoss):
    """Mean distance travelled in 1/30 s, footprints: weak, it stills what no image holds."""

    weight: float = 0.00027
    every: int = 2

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        step = _step(motion)
        t, scale = draw.moment(0, step), FRAME / step
        return difference(motion, [t, t + step], [-scale, scale], _still(draw))


@dataclass(frozen=True)
class Acceleration(MotionLoss):
    """Mean second difference of positions over 1/30 s, footprints."""

    weight: float = 0.0133
    every: int = 2

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        step = _step(motion)
        t, scale = draw.moment(step, step), (FRAME / step) ** 2
        return difference(motion, [t - step, t, t + step], [scale, -2 * scale, scale], _still(draw))


def _still(draw: Draw) -> Draw:
    return draw if draw.clocks is None else replace(draw, clocks=draw.clocks.detach())


def _turns(motion: Scaffold, times: list[float], draw: Draw) -> list[Tensor]:
    """Rotation vectors [M,3] from each time to the next."""
    quats = [motion.nodes(t, _still(draw).clocks)[1] for t in times]
    return [rotation_vectors(product(b, conjugate(a))) for a, b in pairwise(quats)]


@dataclass(frozen=True)
class RotationVelocity(MotionLoss):
    """Mean angle by which a node turns in 1/30 s, radians."""

    weight: float = 0.001
    every: int = 2

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        if not isinstance(motion, Scaffold):
            return None
        step = _step(motion)
        t = draw.moment(0, step)
        (turn,) = _turns(motion, [t, t + step], draw)
        return soft_norm(turn * (FRAME / step), SOFT_ANGLE).mean()


@dataclass(frozen=True)
class RotationAcceleration(MotionLoss):
    """Mean change of the rotation vector from one 1/30 s to the next, radians."""

    weight: float = 0.001
    every: int = 2

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        if not isinstance(motion, Scaffold):
            return None
        step = _step(motion)
        t = draw.moment(step, step)
        before, after = _turns(motion, [t - step, t, t + step], draw)
        return soft_norm((after - before) * (FRAME / step) ** 2, SOFT_ANGLE).mean()
