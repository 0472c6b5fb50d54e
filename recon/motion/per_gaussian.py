"""Motions without a scaffold: each Gaussian on a path of its own, and none at all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from recon.motion.arrays import indices, numbers
from recon.motion.paths import Path, path_arrays, path_from_arrays, resampled
from recon.motion.track_curves import TrackCurves
from recon.rotations import product, unit

NEIGHBOURS = 20  # of a Gaussian, for losses on rigidity: Luiten et al. 2024


@dataclass(frozen=True, eq=False, repr=False)
class PerGaussian:
    """N Gaussians, each on a path of its own.

    Args:
        own_knots [P,N,3]: displacements from the means, world units: learnable.
        own_quats [P,N,4]: turns wxyz, of any length, in front of the Gaussians' quats: learnable; None: none turns.
        near int64 [N,K]: the Gaussians that were nearest to each, nearest first, for losses on rigidity; None: unknown.
            One that has fewer than K stands in their place itself.
    """

    path: Path
    own_knots: Tensor
    own_quats: Tensor | None = None
    near: Tensor | None = None

    def __repr__(self) -> str:
        turning = "" if self.own_quats is None else ", turning"
        return f"PerGaussian({self.own_knots.shape[1]} Gaussians{turning}, {self.path}, {self.own_knots.device})"

    @property
    def peak(self) -> float:
        return self.path.peak

    @classmethod
    def at_rest(cls, path: Path, count: int) -> PerGaussian:
        """That many Gaussians that stand still; float32 on the CPU."""
        return cls(path, torch.zeros(path.count, count, 3))

    @classmethod
    def from_tracks(cls, curves: TrackCurves, points: Float[np.ndarray, "n 3"], t: float) -> PerGaussian:
        """Gaussians whose means are ``points``, where they are at world second ``t``; each moves as a track near it.

        float32 on the CPU; see :meth:`TrackCurves.displacements`.
        """
        return cls(curves.path, torch.from_numpy(curves.displacements(points, t)).float())

    def joined(self, other: PerGaussian) -> PerGaussian:
        """The Gaussians of this motion, then those of ``other``. Which are neighbours has to be asked anew.

        ValueError for another path, and where one motion turns and the other does not.
        """
        if other.path != self.path or (other.own_quats is None) != (self.own_quats is None):
            raise ValueError(f"other: expected a motion like {self}; found {other}.")
        quats = None
        if self.own_quats is not None and other.own_quats is not None:
            quats = torch.cat([self.own_quats, other.own_quats], 1)
        return PerGaussian(self.path, torch.cat([self.own_knots, other.own_knots], 1), quats)

    def on(self, path: Path) -> PerGaussian:
        """The same motion on another path, sampled at its knots."""
        quats = None if self.own_quats is None else resampled(self.own_quats, self.path, path)
        return replace(self, path=path, own_knots=resampled(self.own_knots, self.path, path), own_quats=quats)

    def turning(self) -> PerGaussian:
        """The same motion, which may learn to turn every Gaussian."""
        if self.own_quats is not None:
            return self
        upright = self.own_knots.new_tensor([1.0, 0, 0, 0])
        return replace(self, own_quats=upright.repeat(*self.own_knots.shape[:2], 1))

    def tied(self, means: Tensor, t: float, neighbours: int = NEIGHBOURS) -> PerGaussian:
        """The same motion, which knows the ``neighbours`` nearest others of every Gaussian at world second ``t``.

        means [N,3]: of the Gaussians.
        """
        count = len(means)
        at = (means + self.path.at(self.own_knots, t)).detach().cpu().numpy()
        found = cKDTree(at).query(at, k=range(2, min(neighbours, count - 1) + 2))[1] if count > 1 else None
        near = np.tile(np.arange(count)[:, None], (1, neighbours))
        if found is not None:
            near[:, : found.shape[1]] = found
        return replace(self, near=torch.as_tensor(near, device=self.own_knots.device))

    def parameters(self) -> dict[str, Tensor]:
        learnt = {"own_knots": self.own_knots}
        return learnt if self.own_quats is None else learnt | {"own_quats": self.own_quats}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> PerGaussian:
        return replace(self, own_knots=parameters["own_knots"], own_quats=parameters.get("own_quats"))

    def turns(self, t: Tensor | float) -> Tensor | None:
        """Unit quaternions [N,4] by which the Gaussians have turned at world second `t`; None: none turns."""
        return None if self.own_quats is None else unit(self.path.at(self.own_quats, t))

    def warp(
        self, means: Tensor, quats: Tensor, t: Tensor | float, clocks: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Means [N,3] and quats [N,4] at world second `t` ([T,N,3] and, where they turn, [T,N,4] at T of them). All
        paths are in world time: `clocks` do not matter."""
        turns = self.turns(t)
        return means + self.path.at(self.own_knots, t), quats if turns is None else product(turns, quats)

    def shifted(self, by: float, clocks: Tensor | None = None) -> PerGaussian:
        return replace(self, path=replace(self.path, start=self.path.start + by))

    def take(self, index: Tensor | np.ndarray) -> PerGaussian:
        """The motion of the Gaussians at `index`; one that loses a neighbour stands in its place itself."""
        device = self.own_knots.device
        every = torch.arange(self.own_knots.shape[1], device=device)
        index = every[torch.as_tensor(index, device=device)]  # of a mask: the integers
        near = None
        if self.near is not None:
            rows, lost = torch.arange(len(index), device=device), len(index)
            place = torch.full_like(every, lost).scatter_reduce(0, index, rows, "amin")  # of repeats the first
            near = place[self.near[index]]
            near = torch.where(near == lost, rows[:, None], near)
        quats = None if self.own_quats is None else self.own_quats[:, index]
        return replace(self, own_knots=self.own_knots[:, index], own_quats=quats, near=near)

    def to(self, device: torch.device | str) -> PerGaussian:
        moved = {n: x.to(device) for n in ("own_knots", "own_quats", "near") if (x := getattr(self, n)) is not None}
        return replace(self, **moved)

    def arrays(self) -> dict[str, np.ndarray]:
        parts = {n: getattr(self, n) for n in ("own_knots", "own_quats", "near")}
        kept = {n: x.detach().cpu().numpy() for n, x in parts.items() if x is not None}
        return {"kind": np.array("per-gaussian")} | kept | path_arrays(self.path)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> PerGaussian:
        """The motion whose :meth:`arrays` these are. ValueError where one is missing, unsound or does not fit."""
        try:
            path = path_from_arrays(arrays)
            knots = numbers(arrays, "own_knots", (path.count, None, 3), like="path_knots")
            n, kind = knots.shape[1], (np.asarray(arrays["own_knots"]).dtype.type,)
            quats = (
                numbers(arrays, "own_quats", (path.count, n, 4), kind, like="own_knots")
                if "own_quats" in arrays
                else None
            )
            near = indices(arrays, "near", (n, None), n, like="own_knots") if "near" in arrays else None
            return cls(path, knots, quats, near)
        except KeyError as error:
            raise ValueError(f"arrays: expected those of a motion per Gaussian; found no {error}.") from None


@dataclass(frozen=True)
class Static:
    """No motion: nothing is computed."""

    peak: ClassVar[float] = 1.0

    def parameters(self) -> dict[str, Tensor]:
        return {}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Static:
        return self

    def warp(
        self, means: Tensor, quats: Tensor, t: Tensor | float, clocks: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        return means, quats

    def shifted(self, by: float, clocks: Tensor | None = None) -> Static:
        return self

    def take(self, index: Tensor | np.ndarray) -> Static:
        return self

    def to(self, device: torch.device | str) -> Static:
        return self

    def arrays(self) -> dict[str, np.ndarray]:
        return {"kind": np.array("static")}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Static:
        return cls()
