"""The feature model: descriptors that nearly repeat left and right, differ a little between views, and are noisy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .body import Parts
from .observation import Surface, stream


@dataclass(frozen=True)
class FeatureModel:
    """Sum of parts of about unit scale per component; verbs normalise the sum.

    Args:
        dim: D. The first part, of scale 1, are random Fourier features of the left/right-mirrored body coordinate.
        length_scale: m over which these change.
        limb: a random vector for every kind of limb or thing, the same left and right.
        side: the left/right cue: a random vector, added on the right and subtracted on the left.
        view, view_scale: a bias that differs from video to video, and the m over which it changes on the body.
        shift: a constant of the video.
        person: a random vector for every figure but the first (0 when all look alike).
        noise: white, per component.
    """

    dim: int = 128
    length_scale: float = 0.35
    limb: float = 0.8
    side: float = 0.15
    view: float = 0.6
    view_scale: float = 0.7
    shift: float = 0.3
    person: float = 0.4
    noise: float = 0.35

    def __call__(
        self, surface: Surface, parts: Parts, seed: int, video: int, dtype: type = np.float64
    ) -> Float[np.ndarray, "N D"]:
        """Features of ``video``'s tracks; the world's random vectors come from ``seed`` alone."""
        world, own = stream(seed, "features"), stream(seed, video, "features")
        figure = parts.figure[surface.part]
        folded = surface.position.copy()
        folded[figure, 0] = np.abs(folded[figure, 0])
        features = self._fourier(folded, self.length_scale, world, dtype)
        kinds = self.limb * world.standard_normal((64, self.dim))
        cue = self.side * world.standard_normal(self.dim)
        people = self.person * world.standard_normal((16, self.dim))
        people[0] = 0.0
        features += kinds[parts.kind[surface.part] % 64].astype(dtype)
        if self.side:
            features += (np.sign(surface.position[:, :1]) * figure[:, None] * cue).astype(dtype)
        if self.person and len(surface) and surface.object.max() > 0:
            features += np.where(figure[:, None], people[surface.object % 16], 0.0).astype(dtype)
        if self.view:
            features += dtype(self.view) * self._fourier(surface.position, self.view_scale, own, dtype)
        if self.shift:
            features += (self.shift * own.standard_normal(self.dim)).astype(dtype)
        if self.noise:
            features += dtype(self.noise) * own.standard_normal((len(surface), self.dim), dtype=dtype)
        return features

    def _fourier(self, x: np.ndarray, length: float, rng: np.random.Generator, dtype: type) -> np.ndarray:
        """Random Fourier features of unit variance for the Gaussian kernel (Rahimi & Recht 2007)."""
        w: np.ndarray = (rng.standard_normal((3, self.dim)) / length).astype(dtype)
        phase: np.ndarray = rng.uniform(0, 2 * np.pi, self.dim).astype(dtype)
        angle = x.astype(dtype) @ w
        angle += phase
        np.cos(angle, out=angle)
        angle *= dtype(np.sqrt(2))
        return angle
