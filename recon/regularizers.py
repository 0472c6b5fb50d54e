"""What is asked of a motion apart from the images: losses on nodes (ARAP, lengths) and on how they move.

All are means of unsquared norms, smooth at zero and exactly zero there. Lengths are in footprints (the world size of a
working pixel), steps of time are those of the study's frame, 1/30 s, whatever the videos' own: a weight means the same
in every scene. Each object draws its own moment from `draw.rng`; a motion to which a loss does not apply gives None.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from torch import Tensor

from recon.motion import PerGaussian, Scaffold
from recon.motion.motion import Motion
from recon.motion.rotations import conjugate, product, rotation_vectors
from recon.motion.solve import FRAME
from recon.raster.projection import rotation_matrices

SOFT = 0.0075  # footprints: below it a norm is quadratic (0.1 mm where a footprint is 1.33 cm)
SOFT_ANGLE = 1e-4  # radians


@dataclass(frozen=True, eq=False)
class Draw:
    """What motion losses draw from. span: first and last world second of the footage; footprint: world units;
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


class MotionLoss(Protocol):
    """A loss on a motion: `weight` applies in the steps in which it is evaluated, every `every`-th."""

    @property
    def weight(self) -> float: ...

    @property
    def every(self) -> int: ...

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        """The unweighted loss, a scalar; None where this motion has nothing of the kind."""
        ...


def soft_norm(x: Tensor, soft: float = SOFT) -> Tensor:
    """√(‖x‖² + soft²) - soft over the last axis: the norm, smooth at zero, and zero there."""
    return ((x * x).sum(-1) + soft * soft).sqrt() - soft


def _relative(motion: Scaffold, t: float, neighbours: int, draw: Draw) -> Tensor:
    """R_kᵀ(x_i - x_k) [M,K,3] in footprints: node i in the frame of its neighbour k."""
    positions, quats = motion.nodes(t, draw.clocks)
    k = motion.edges[:, :neighbours]
    apart = (positions[:, None] - positions[k]) / draw.footprint
    return (rotation_matrices(quats)[k].transpose(-1, -2) @ apart[..., None])[..., 0]


def _edge_shares(motion: Scaffold, neighbours: int) -> Tensor:
    """Weights of the edges to the first neighbours, of sum 1 over each node's; 0 for a node without any."""
    w = motion.edge_weights[:, :neighbours]
    return w / w.sum(1, keepdim=True).clamp_min(1e-12)


@dataclass(frozen=True)
class Arap:
    """As rigid as possible: a node keeps its place in the frames of its neighbours (MoSca's L_coord).

    L = mean_i Σ_k ŵ_ik ‖l_ik(t) - l_ik(t + s)‖ with l_ik = R_kᵀ(x_i - x_k), s drawn from `shifts` (seconds). Zero for
    rigid motions of all nodes together.
    """

    weight: float = 0.008
    every: int = 2
    shifts: tuple[float, ...] = (FRAME, 3 * FRAME, 8 * FRAME)
    neighbours: int = 6

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        if not isinstance(motion, Scaffold):
            return None
        shift = motion.path.step(float(draw.rng.choice(self.shifts)))
        t = draw.moment(0, shift)
        change = _relative(motion, t, self.neighbours, draw) - _relative(motion, t + shift, self.neighbours, draw)
        return (soft_norm(change) * _edge_shares(motion, self.neighbours)).sum(1).mean()


@dataclass(frozen=True)
class Length:
    """Distances to neighbours are kept (MoSca's L_len): mean_i Σ_k ŵ_ik |‖l_ik(t)‖ - ‖l_ik(t + s)‖|."""

    weight: float = 0.008
    every: int = 2
    shifts: tuple[float, ...] = (FRAME, 3 * FRAME, 8 * FRAME)
    neighbours: int = 6

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        if not isinstance(motion, Scaffold):
            return None
        shift = motion.path.step(float(draw.rng.choice(self.shifts)))
        t = draw.moment(0, shift)
        k = motion.edges[:, : self.neighbours]
        lengths = []
        for moment in (t, t + shift):
            positions, _ = motion.nodes(moment, draw.clocks)
            lengths.append(soft_norm((positions[:, None] - positions[k]) / draw.footprint))
        return ((lengths[0] - lengths[1]).abs() * _edge_shares(motion, self.neighbours)).sum(1).mean()


def _places(motion: Motion, times: list[float], draw: Draw) -> list[Tensor] | None:
    """Positions [M,3] of what moves by its own parameters, in footprints: nodes, or Gaussians without a scaffold."""
    if isinstance(motion, Scaffold):
        return [motion.nodes(t, draw.clocks)[0] / draw.footprint for t in times]
    if isinstance(motion, PerGaussian):
        return [motion.path.at(motion.own_knots, t) / draw.footprint for t in times]
    return None


def _frame(motion: Motion) -> float:
    return motion.path.step(FRAME) if isinstance(motion, Scaffold | PerGaussian) else FRAME


@dataclass(frozen=True)
class Velocity:
    """Mean distance travelled in 1/30 s, footprints: weak, it stills what no image holds."""

    weight: float = 0.00027
    every: int = 2

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        step = _frame(motion)
        t = draw.moment(0, step)
        at = _places(motion, [t, t + step], draw)
        return None if at is None else soft_norm(at[1] - at[0]).mean() * (FRAME / step)


@dataclass(frozen=True)
class Acceleration:
    """Mean second difference of positions over 1/30 s, footprints."""

    weight: float = 0.0133
    every: int = 2

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        step = _frame(motion)
        t = draw.moment(step, step)
        at = _places(motion, [t - step, t, t + step], draw)
        return None if at is None else soft_norm(at[2] - 2 * at[1] + at[0]).mean() * (FRAME / step) ** 2


def _turns(motion: Scaffold, times: list[float], draw: Draw) -> list[Tensor]:
    """Rotation vectors [M,3] from each time to the next."""
    quats = [motion.nodes(t, draw.clocks)[1] for t in times]
    return [rotation_vectors(product(b, conjugate(a))) for a, b in pairwise(quats)]


@dataclass(frozen=True)
class RotationVelocity:
    """Mean angle by which a node turns in 1/30 s, radians."""

    weight: float = 0.001
    every: int = 2

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        if not isinstance(motion, Scaffold):
            return None
        step = _frame(motion)
        t = draw.moment(0, step)
        (turn,) = _turns(motion, [t, t + step], draw)
        return soft_norm(turn, SOFT_ANGLE).mean() * (FRAME / step)


@dataclass(frozen=True)
class RotationAcceleration:
    """Mean change of the rotation vector from one 1/30 s to the next, radians."""

    weight: float = 0.001
    every: int = 2

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        if not isinstance(motion, Scaffold):
            return None
        step = _frame(motion)
        t = draw.moment(step, step)
        before, after = _turns(motion, [t - step, t, t + step], draw)
        return soft_norm(after - before, SOFT_ANGLE).mean() * (FRAME / step) ** 2


#: The study's: set once on one scene, not tuned.
MOTION_LOSSES: tuple[MotionLoss, ...] = (Arap(), Length(), Acceleration(), Velocity())
