"""Errors of position: along the viewing ray, across it, and drifting over the surface.

Standard deviations throughout; depth errors are relative to depth, everything else is in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ..observation import Observation


def smooth_noise(
    shape: tuple[int, ...], times: Float[np.ndarray, " T"], correlation: float, rng: np.random.Generator, dtype: type
) -> Float[np.ndarray, "*shape T"]:
    """Unit-variance Gaussian noise, smooth in time: correlation ``exp(-(dt / correlation)^2 / 2)``.

    White noise on knots, spread by Gaussians and normalised at every instant; defined at any times.
    """
    width = correlation / np.sqrt(2)
    knots = np.arange(times[0] - 4 * width, times[-1] + 4 * width, width)
    basis = np.exp(-0.5 * ((times - knots[:, None]) / width) ** 2)
    basis /= np.sqrt((basis**2).sum(0))
    return rng.standard_normal((*shape, len(knots)), dtype=dtype) @ basis.astype(dtype)


def along_ray(obs: Observation, relative: np.ndarray) -> Observation:
    return replace(obs, xyz=obs.xyz + obs.rays() * relative.astype(obs.xyz.dtype)[..., None])


def dtype_of(obs: Observation) -> type:
    return obs.xyz.dtype.type


@dataclass(frozen=True)
class DepthBias:
    """A wrong depth of the whole track, relative standard deviation ``size``."""

    size: float = 0.02

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        return along_ray(obs, self.size * rng.standard_normal((len(obs.xyz), 1)))


@dataclass(frozen=True)
class DepthDrift:
    """A slowly changing wrong depth of every track of its own."""

    size: float = 0.008
    correlation: float = 1.0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        drift = smooth_noise((len(obs.xyz),), obs.times, self.correlation, rng, dtype_of(obs))
        return along_ray(obs, self.size * drift)


@dataclass(frozen=True)
class CameraDepthDrift:
    """A slowly changing wrong depth that all tracks of the video share."""

    size: float = 0.004
    correlation: float = 1.2

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        drift = smooth_noise((1,), obs.times, self.correlation, rng, dtype_of(obs))
        return along_ray(obs, self.size * drift)


@dataclass(frozen=True)
class DepthJitter:
    """White noise of depth, a new value in every sample."""

    size: float = 0.005

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        return along_ray(obs, self.size * rng.standard_normal(obs.xyz.shape[:2], dtype=dtype_of(obs)))


@dataclass(frozen=True)
class LateralJitter:
    """White noise across the viewing ray: ``size`` m in each of the two directions."""

    size: float = 0.003

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        noise = dtype_of(obs)(self.size) * rng.standard_normal(obs.xyz.shape, dtype=dtype_of(obs))
        ray = obs.rays()
        along = np.einsum("nti,nti->nt", noise, ray) / np.einsum("nti,nti->nt", ray, ray)
        return replace(obs, xyz=obs.xyz + (noise - along[..., None] * ray))


@dataclass(frozen=True)
class PositionNoise:
    """White noise in all three directions, relative to the size of the scene."""

    size: float = 0.01

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        noise = rng.standard_normal(obs.xyz.shape, dtype=dtype_of(obs))
        noise *= dtype_of(obs)(self.size * obs.size)
        noise += obs.xyz
        return replace(obs, xyz=noise)


@dataclass(frozen=True)
class SlowDrift:
    """Every track slides over the surface: smooth noise of ``size`` m in each direction."""

    size: float = 0.008
    correlation: float = 1.2

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        drift = smooth_noise((len(obs.xyz), 3), obs.times, self.correlation, rng, dtype_of(obs))
        return replace(obs, xyz=obs.xyz + dtype_of(obs)(self.size) * drift.swapaxes(1, 2))


@dataclass(frozen=True)
class LimbDrift:
    """All tracks of a limb drift together: smooth noise of ``size`` m in each direction."""

    size: float = 0.05
    correlation: float = 0.8

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        parts = int(obs.surface.part.max(initial=-1)) + 2  # the last row is for outliers, part -1: none
        drift = smooth_noise((parts, 3), obs.times, self.correlation, rng, dtype_of(obs)) * dtype_of(obs)(self.size)
        drift[-1] = 0
        return replace(obs, xyz=obs.xyz + drift.swapaxes(1, 2)[obs.surface.part])


@dataclass(frozen=True)
class SharedDrift:
    """All tracks drift together, as a calibration does that slowly loses its hold: smooth noise of ``size`` m in each
    direction, from 0 at the first frame on.

    Args:
        seed: of the drift, for videos that all drift alike, each in its own clock; None: every video its own.
    """

    size: float = 0.2
    correlation: float = 1.5
    seed: int | None = None

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        rng = rng if self.seed is None else np.random.default_rng(self.seed)
        drift = smooth_noise((3,), obs.times, self.correlation, rng, np.float64).T
        return replace(obs, xyz=obs.xyz + (self.size * (drift - drift[0])).astype(obs.xyz.dtype))


@dataclass(frozen=True)
class Transient:
    """Trackers settle: all tracks begin ``size`` m beside their place and come there within a few ``settle`` s.

    The direction is the same in all videos, as of one tracker with one bias.
    """

    size: float = 0.2
    settle: float = 0.3
    seed: int = 0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        aside = np.random.default_rng(self.seed).standard_normal(3)
        fade = np.exp(-(obs.times - obs.times[0]) / self.settle)
        moved = self.size * fade[:, None] * aside / np.linalg.norm(aside)
        return replace(obs, xyz=obs.xyz + moved.astype(obs.xyz.dtype))
