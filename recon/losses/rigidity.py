"""Local rigidity, likeness of rotations, and isometry, after Luiten et al., Dynamic 3D Gaussians (3DV 2024).

What moves by its own parameters (Gaussians without a scaffold, else the nodes of one) is compared with the neighbours
that it had in the first frame. Published are 20 neighbours and weights w = exp(-2000 d²) of their distance d in metres,
for images of 640 pixels, of which one covers 6.7 mm of the basketball scene. So d is taken in footprints here, and
2000/m² becomes .089: a weight means the same in every scene, whatever its unit and its images' size. The three weights
of the losses, 4 per metre, 4 and 2 per metre, are expressed so too.

Published, frames are fitted one after another, each from the one before, and the first frame is not touched again. Here
all are fitted at once: so distances in the first frame are those of the fit as it stands.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from recon.losses.motion import SOFT_ANGLE, Draw, MotionLoss, soft_norm
from recon.motion import PerGaussian, Scaffold
from recon.motion.motion import Motion
from recon.motion.per_gaussian import NEIGHBOURS
from recon.motion.solve import FRAME
from recon.rotations import conjugate, product, rotation_matrices

FALLOFF = 0.089
"""Of the weights, per squared footprint: 2000 per square metre where a footprint is 6.7 mm."""


@dataclass(frozen=True, eq=False)
class _Neighbours:
    """N things that move, with K neighbours each: near int64 [N,K], weights [N,K], and the motion at any moment."""

    motion: PerGaussian | Scaffold
    means: Tensor
    clocks: Tensor | None
    near: Tensor
    weights: Tensor
    unit: float

    @classmethod
    def of(cls, motion: Motion, means: Tensor, draw: Draw, count: int, falloff: float) -> _Neighbours | None:
        """None where nothing has neighbours."""
        if isinstance(motion, Scaffold):
            near, tied = motion.edges[:, :count], motion.edge_weights[:, :count] > 0
        elif isinstance(motion, PerGaussian) and motion.near is not None:
            near, tied = motion.near[:, :count], None
        else:
            return None
        clocks = None if draw.clocks is None else draw.clocks.detach()
        bare = cls(motion, means, clocks, near, torch.empty(0), draw.footprint)
        first = bare.apart(bare.pose(draw.span[0])[0]).detach()
        weights = torch.exp(-falloff * (first * first).sum(-1))
        return cls(motion, means, clocks, near, weights if tied is None else weights * tied, draw.footprint)

    def pose(self, t: float) -> tuple[Tensor, Tensor | None]:
        """Positions [N,3] and turns [N,4], None where none turns, at world second t."""
        if isinstance(self.motion, Scaffold):
            return self.motion.nodes(t, self.clocks)
        return self.means + self.motion.path.at(self.motion.own_knots, t), self.motion.turns(t)

    def apart(self, positions: Tensor) -> Tensor:
        """From each to its neighbours, footprints [N,K,3]."""
        return (positions[self.near] - positions[:, None]) / self.unit

    def mean(self, cost: Tensor) -> Tensor:
        """Mean over all pairs of their weighted cost [N,K]."""
        return (self.weights * cost).mean()


def _step(motion: PerGaussian | Scaffold) -> float:
    return motion.path.step(FRAME)


@dataclass(frozen=True)
class _AmongNeighbours(MotionLoss):
    """A loss over every Gaussian and its neighbours.

    Args:
        neighbours: at most, of those that the motion knows. falloff: of w = exp(-falloff d²), per squared footprint.
    """

    weight: float = 1.0
    every: int = 2
    neighbours: int = NEIGHBOURS
    falloff: float = FALLOFF

    def __call__(self, motion: Motion, means: Tensor, quats: Tensor, draw: Draw) -> Tensor | None:
        among = _Neighbours.of(motion, means, draw, self.neighbours, self.falloff)
        return None if among is None else self.change(among, draw)

    @abstractmethod
    def change(self, among: _Neighbours, draw: Draw) -> Tensor | None:
        """What is to be small; None where the motion has nothing to compare."""


@dataclass(frozen=True)
class Rigidity(_AmongNeighbours):
    """A neighbour goes as if it were fixed to the Gaussian, from 1/30 s to the next: mean distance, footprints.

    w ‖(x_j - x_i)(t - 1) - R_i(t - 1) R_i(t)⁻¹ (x_j - x_i)(t)‖. Where nothing turns, R is no turn.
    """

    weight: float = 0.027

    def change(self, among: _Neighbours, draw: Draw) -> Tensor | None:
        step = _step(among.motion)
        t = draw.moment(0, step)
        (before, turned_before), (after, turned_after) = among.pose(t), among.pose(t + step)
        then = among.apart(after)
        if turned_before is not None and turned_after is not None:
            back = rotation_matrices(product(turned_before, conjugate(turned_after)))
            then = then @ back.transpose(-1, -2)
        return among.mean(soft_norm(among.apart(before) - then)) * (FRAME / step)


@dataclass(frozen=True)
class RotationSimilarity(_AmongNeighbours):
    """Neighbours turn alike, from 1/30 s to the next: mean difference of quaternions. None where nothing turns.

    w ‖q_j(t) q_j(t - 1)⁻¹ - q_i(t) q_i(t - 1)⁻¹‖.
    """

    weight: float = 4.0

    def change(self, among: _Neighbours, draw: Draw) -> Tensor | None:
        step = _step(among.motion)
        t = draw.moment(0, step)
        before, after = among.pose(t)[1], among.pose(t + step)[1]
        if before is None or after is None:
            return None
        turn = product(after, conjugate(before))
        turn = torch.where(turn[:, :1] < 0, -turn, turn)  # q and -q are one rotation
        return among.mean(soft_norm(turn[among.near] - turn[:, None], SOFT_ANGLE)) * (FRAME / step)


@dataclass(frozen=True)
class Isometry(_AmongNeighbours):
    """Neighbours stay as far apart as they were in the first frame: mean change of the distance, footprints.

    w |‖x_j - x_i‖(t) - ‖x_j - x_i‖(first)|.
    """

    weight: float = 0.013

    def change(self, among: _Neighbours, draw: Draw) -> Tensor | None:
        lengths = [soft_norm(among.apart(among.pose(t)[0])) for t in (draw.span[0], draw.moment(0, 0))]
        return among.mean(soft_norm((lengths[0] - lengths[1])[..., None]))
