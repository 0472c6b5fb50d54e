"""Motions without a scaffold: each Gaussian on its own path (the "w/o scaffold" ablation), and none at all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from recon.motion.arrays import numbers
from recon.motion.paths import Path, path_arrays, path_from_arrays
from recon.motion.scaffold import Scaffold


@dataclass(frozen=True, eq=False, repr=False)
class PerGaussian:
    """N Gaussians, each displaced from its mean along its own path: own_knots [P,N,3] world units. None turns."""

    path: Path
    own_knots: Tensor

    def __repr__(self) -> str:
        return f"PerGaussian({self.own_knots.shape[1]} Gaussians, {self.path}, {self.own_knots.device})"

    @classmethod
    def following(cls, scaffold: Scaffold, means: Tensor, path: Path | None = None) -> PerGaussian:
        """The paths on which `scaffold` carries its Gaussians of these `means` [N,3]."""
        path = path or scaffold.path
        upright = means.new_tensor([1.0, 0, 0, 0]).expand(len(means), 4)
        with torch.no_grad():
            carried = [scaffold.warp(means, upright, float(t))[0] - means for t in path.times]
        return cls(path, torch.stack(carried))

    def parameters(self) -> dict[str, Tensor]:
        return {"own_knots": self.own_knots}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> PerGaussian:
        return replace(self, own_knots=parameters["own_knots"])

    def warp(
        self, means: Tensor, quats: Tensor, t: Tensor | float, clocks: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Means [N,3] at world second `t` ([T,N,3] at T of them), and the quats as they are. All paths are in world
        time: `clocks` do not matter."""
        return means + self.path.at(self.own_knots, t), quats

    def shifted(self, by: float, clocks: Tensor | None = None) -> PerGaussian:
        return replace(self, path=replace(self.path, start=self.path.start + by))

    def take(self, index: Tensor | np.ndarray) -> PerGaussian:
        index = torch.as_tensor(index, device=self.own_knots.device)
        return replace(self, own_knots=self.own_knots[:, index])

    def to(self, device: torch.device | str) -> PerGaussian:
        return replace(self, own_knots=self.own_knots.to(device))

    def arrays(self) -> dict[str, np.ndarray]:
        own = self.own_knots.detach().cpu().numpy()
        return {"kind": np.array("per-gaussian"), "own_knots": own} | path_arrays(self.path)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> PerGaussian:
        """The motion whose :meth:`arrays` these are. ValueError where one is missing, unsound or does not fit."""
        try:
            path = path_from_arrays(arrays)
            return cls(path, numbers(arrays, "own_knots", (path.count, None, 3)))
        except KeyError as error:
            raise ValueError(f"arrays: expected those of a motion per Gaussian; found no {error}.") from None


@dataclass(frozen=True)
class Static:
    """No motion: nothing is computed."""

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
