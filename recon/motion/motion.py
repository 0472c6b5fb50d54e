"""The slot of motions: a scaffold, a motion per Gaussian, or none at all."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from recon.motion.per_gaussian import PerGaussian, Static
from recon.motion.scaffold import Scaffold


class Motion(Protocol):
    """How Gaussians move. Immutable: changes return a new one."""

    @property
    def peak(self) -> float:
        """By how much its curves move where one of their knots moves by 1, see :attr:`recon.motion.Path.peak`; 1 where
        there are no curves."""
        ...

    def parameters(self) -> dict[str, Tensor]:
        """The learnable tensors by name."""
        ...

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Self:
        """The same motion with these learnable tensors."""
        ...

    def warp(
        self, means: Tensor, quats: Tensor, t: Tensor | float, clocks: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Means [N,3] and quats [N,4] at world second `t`; `clocks` [V] offsets, for a scaffold per video.

        At T seconds: [T,N,3] and [T,N,4]; one that does not change with time may lack the first axis.
        """
        ...

    def take(self, index: Tensor | np.ndarray) -> Self:
        """The motion of the Gaussians at `index`: integers, with repeats, or a mask."""
        ...

    def shifted(self, by: float, clocks: Tensor | None = None) -> Self:
        """The same motion, `by` seconds later in world time; `clocks` [V]: the videos' new offsets."""
        ...

    def to(self, device: torch.device | str) -> Self:
        """The same motion on another device."""
        ...

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything as plain arrays, from which :func:`motion_from_arrays` makes it again."""
        ...


def motion_from_arrays(arrays: Mapping[str, np.ndarray]) -> Motion:
    """The motion whose :meth:`Motion.arrays` these are. ValueError where they are not those of a motion."""
    kinds: dict[str, Any] = {"scaffold": Scaffold, "per-gaussian": PerGaussian, "static": Static}
    kind = str(arrays.get("kind"))
    if kind not in kinds:
        raise ValueError(f"kind: expected one of {sorted(kinds)}; found {kind!r}.")
    return kinds[kind].from_arrays(arrays)
