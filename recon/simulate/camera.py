"""A camera that films a world through its effects: images, masks and exact depth."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from otsync.simulate.observation import stream
from otsync.types import Camera
from recon.raster import render, sh
from recon.scene.gaussians import Gaussians
from recon.simulate.effects import Blur, DarkCorners, Effect, Exposure, Instant, MoreNoise, Rolling, See, Sheen
from recon.simulate.world import NOISE, STATIC_NEAR, World

MOVING_NEAR = 0.01
"""Near plane of what moves, m."""

HALF, SOLID, CLEAR = 0.5, 0.6, 0.05
"""Alpha above which a pixel is in the mask, above which its depth is that of what moves, and below which the wall's.
Between the last two it has none: silhouettes mix both."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of one camera: uint8 images, bool masks, and exact depth [T,h,w], 0 at silhouettes."""

    images: np.ndarray
    masks: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True, eq=False)
class FilmingCamera:
    """One camera in front of a world, with its effects, gain, falloff and sources of noise."""

    world: World
    camera: Camera
    effects: tuple[Effect, ...]
    gain: Float[np.ndarray, " 3"]
    shade: Float[np.ndarray, "h w 1"]
    noise: tuple[tuple[float, np.random.Generator], ...]

    @classmethod
    def of(cls, world: World, camera: Camera, c: int, effects: tuple[Effect, ...], seed: int) -> FilmingCamera:
        gain, shade, noise = np.ones(3), np.ones((1, 1, 1)), [(NOISE, stream(seed, c, "noise"))]
        seen: Counter[str] = Counter()
        for effect in effects:
            name = type(effect).__name__
            rng = stream(seed, c, "effect", name, seen[name])
            seen[name] += 1
            if isinstance(effect, Exposure):
                gain = gain * effect.draw(rng)
            elif isinstance(effect, DarkCorners):
                shade = shade * effect.shade(camera)
            elif isinstance(effect, MoreNoise):
                noise.append((effect.size, rng))
            elif isinstance(effect, Rolling):
                camera = replace(camera, readout=effect.readout)
        return cls(world, camera, effects, gain, shade, tuple(noise))

    def film(self, times: Float[np.ndarray, " T"]) -> Frames:
        """Frames at world ``times`` (s). Depth has no blur, but its rows are those of a rolling shutter."""
        with torch.no_grad():
            backdrop = self._render(self.world.static, STATIC_NEAR)
            wall = backdrop.z[..., 0].numpy()
            see = self._see()
            images, masks, depths = [], [], []
            for t in times:
                seen = see(float(t))
                image = (seen.rgb + (1 - seen.alpha) * backdrop.rgb).numpy() * self.gain * self.shade
                for size, rng in self.noise:
                    image = image + size * rng.standard_normal(image.shape)
                images.append(np.rint(255 * image.clip(0, 1)).astype(np.uint8))
                masks.append(seen.alpha[..., 0].numpy() > HALF)
                alpha, z = seen.solid[..., 0].numpy(), seen.z[..., 0].numpy()
                depths.append(np.where(alpha > SOLID, z, np.where(alpha < CLEAR, wall, 0)).astype(np.float32))
        return Frames(np.stack(images), np.stack(masks), np.stack(depths))

    def _see(self) -> See:
        """The camera through its effects."""
        see: See = lambda t: self._render(self._moving(t), MOVING_NEAR)  # noqa: E731
        for effect in self.effects:
            if isinstance(effect, Blur | Rolling):
                see = effect(see, self.camera)
        return see

    def _moving(self, t: float) -> Gaussians:
        """The moving Gaussians in the colours that this camera sees."""
        moving = self.world.moving(t)
        for lamp in (e for e in self.effects if isinstance(e, Sheen)):
            R, shift = self.camera.w2c[:3, :3], self.camera.w2c[:3, 3]
            light = lamp.light(moving.means.numpy(), self.world.facing(t), -R.T @ shift)
            moving = replace(moving, sh=moving.sh + torch.as_tensor(light / sh.C0, dtype=torch.float32)[:, None])
        return moving

    def _render(self, gaussians: Gaussians, near: float) -> Instant:
        """The Gaussians as the camera sees them; depth 0 where there are none."""
        colors = (sh.C0 * gaussians.sh[:, 0] + 0.5).clamp(0, 1)
        w2c = torch.as_tensor(self.camera.w2c, dtype=torch.float32)[None]
        K = torch.as_tensor(self.camera.K, dtype=torch.float32)[None]
        out = render(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            colors,
            w2c,
            K,
            self.camera.width,
            self.camera.height,
            near_plane=near,
        )
        assert out.depths is not None
        return Instant(out.colors[0], out.alphas[0], out.depths[0], out.alphas[0])
