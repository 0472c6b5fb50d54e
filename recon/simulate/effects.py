"""Effects of simulated cameras: gain, vignetting, noise, blur, rolling shutter, and a lamp on what they film."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from otsync.types import Camera
from recon.observe.effects import ImageCircle


@dataclass(frozen=True, eq=False)
class Instant:
    """The view of one instant: rgb [h,w,3] and alpha [h,w,1] of what moves.

    z [h,w,1]: its depth; solid [h,w,1]: its alpha. Neither has blur, which depth estimators look through.
    """

    rgb: Tensor
    alpha: Tensor
    z: Tensor
    solid: Tensor


See = Callable[[float], Instant]


@dataclass(frozen=True)
class Exposure:
    """Every camera has its own gain per channel, log-normal with this standard deviation."""

    size: float = 0.08

    def draw(self, rng: np.random.Generator) -> Float[np.ndarray, " 3"]:
        """Factors of R, G and B."""
        return np.exp(self.size * rng.standard_normal(3))


@dataclass(frozen=True)
class DarkCorners:
    """Vignetting: colours times ``(1 - size) ** r^2``, r from the principal point in half diagonals.

    The corners lose the share ``size`` of their light.
    """

    size: float = 0.2

    def __post_init__(self) -> None:
        if not 0 <= self.size < 1:
            raise ValueError(f"size: expected a share of 0 or more, below 1; found {self.size}.")

    def shade(self, camera: Camera) -> Float[np.ndarray, "h w 1"]:
        """The factor of every pixel."""
        circle = ImageCircle.of(camera.K, (camera.width, camera.height))
        return ((1 - self.size) ** circle.squared_radii((0, 0, camera.width, camera.height)))[..., None]


@dataclass(frozen=True)
class MoreNoise:
    """White noise beyond the usual, of this standard deviation in 0..1."""

    size: float = 0.03


@dataclass(frozen=True)
class Blur:
    """The shutter is open for ``exposure`` s around a frame's time: mean over ``samples`` instants."""

    exposure: float = 0.02
    samples: int = 7

    def __call__(self, see: See, camera: Camera) -> See:
        def blurred(t: float) -> Instant:
            steps = ((np.arange(self.samples) + 0.5) / self.samples - 0.5) * self.exposure
            seen = [see(t + step) for step in steps]
            middle, rgb, alpha = see(t), [s.rgb for s in seen], [s.alpha for s in seen]
            return Instant(torch.stack(rgb).mean(0), torch.stack(alpha).mean(0), middle.z, middle.solid)

        return blurred


@dataclass(frozen=True)
class Rolling:
    """Rows are read over ``readout`` s, the middle one at the frame's time; rendered in ``bands`` bands of rows."""

    readout: float = 0.02
    bands: int = 16

    def __call__(self, see: See, camera: Camera) -> See:
        rows = (np.arange(camera.height) + 0.5) / camera.height
        band = np.minimum((rows * self.bands).astype(int), self.bands - 1)

        def rolled(t: float) -> Instant:
            parts = []
            for b in np.unique(band):
                own = torch.as_tensor(np.flatnonzero(band == b))
                seen = see(t + self.readout * float(rows[band == b].mean() - 0.5))
                parts.append([x[own] for x in (seen.rgb, seen.alpha, seen.z, seen.solid)])
            return Instant(*(torch.cat(column) for column in zip(*parts, strict=True)))

        return rolled


@dataclass(frozen=True)
class Sheen:
    """A lamp reflected by what moves: ``size * max(0, n . h) ** sharpness`` on every channel (Blinn 1977).

    h: half-way between the directions to the lamp, which is far away, and to the camera.
    """

    size: float = 0.3
    sharpness: float = 6.0
    lamp: tuple[float, float, float] = (0.3, -0.4, 0.87)

    def light(self, means: np.ndarray, normals: np.ndarray, eye: np.ndarray) -> Float[np.ndarray, "N 1"]:
        """Light added to the colours [N,3] that the camera at ``eye`` sees."""
        to_eye = eye - means
        half = to_eye / np.linalg.norm(to_eye, axis=1, keepdims=True) + np.asarray(self.lamp) / np.linalg.norm(
            self.lamp
        )
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        return self.size * np.maximum((normals * half).sum(1, keepdims=True), 0) ** self.sharpness


Effect = Exposure | DarkCorners | MoreNoise | Blur | Rolling | Sheen
