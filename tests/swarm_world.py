"""Many small warm things before a cold, noisy background, as a thermal camera sees bats or insects; the truth is known.

No thing differs from another, none has parts: one point a thing is all that there is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from otsync.io.scene import Scene
from otsync.types import Camera, Video
from tests.recording_world import ring


@dataclass(frozen=True, eq=False)
class Warm(Sequence):
    """Frames of blobs that are drawn when they are asked for.

    ``uv`` (N,T,2): their middles in the camera's pixels. sigma: of a blob, pixels. heat: its grey levels. noise: grey
    levels.
    """

    uv: np.ndarray
    size: tuple[int, int]
    sigma: float
    heat: float
    noise: float
    seed: int

    def __len__(self) -> int:
        return self.uv.shape[1]

    def __getitem__(self, k: int) -> np.ndarray:
        w, h = self.size
        image = 60 + np.random.default_rng((self.seed, k)).normal(0, self.noise, (h, w))
        reach = int(np.ceil(4 * self.sigma))
        for x, y in self.uv[:, k] - 0.5:
            if not (np.isfinite(x) and reach < x < w - reach - 1 and reach < y < h - reach - 1):
                continue
            i, j = round(float(x)), round(float(y))
            u, v = np.arange(i - reach, i + reach + 1), np.arange(j - reach, j + reach + 1)
            square = (u[None] - x) ** 2 + (v[:, None] - y) ** 2
            image[v[0] : v[-1] + 1, u[0] : u[-1] + 1] += self.heat * np.exp(-square / (2 * self.sigma**2))
        return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, 2)


def paths(t: np.ndarray, count: int, rng: np.random.Generator, pace: float = 1.0) -> np.ndarray:
    """(count, T, 3) units: smooth ways that do not repeat, each its own, about ``pace`` units a second."""
    out = 0.7 * rng.uniform(-1, 1, (count, 1, 3))
    for hertz in (0.23, 0.41, 0.87):
        phase, size = rng.uniform(0, 2 * np.pi, (count, 1, 3)), rng.normal(size=(count, 1, 3))
        out = out + 0.13 * pace / hertz * size * np.sin(2 * np.pi * hertz * t[None, :, None] + phase)
    return out


def swarm(
    shifts: Sequence[float],
    *,
    count: int = 40,
    frames: int = 120,
    fps: Sequence[float] | float = 30.0,
    width: int = 640,
    across: float = 10.0,
    noise: float = 2.0,
    pace: float = 1.0,
    seed: int = 0,
) -> Scene:
    """A scene of one camera a shift (seconds; the first is the reference).

    Args:
        frames: of the first video; the others last as long. fps: of all, or of each.
        across: pixels across a thing at 640 of width.
    """
    height = width * 3 // 4
    rates = [fps] * len(shifts) if isinstance(fps, int | float) else list(fps)
    ways, videos = np.random.default_rng((seed, 1)), []
    draw = ways.bit_generator.state
    for v, (camera, shift, rate) in enumerate(
        zip(ring(len(shifts), width=width, height=height), shifts, rates, strict=True)
    ):
        ways.bit_generator.state = draw
        t = shift + np.arange(round(frames * rate / rates[0])) / rate
        uv = camera.project(paths(t, count, ways, pace))
        images = Warm(uv, (width, height), across * width / 640 / 4, 90.0, noise, seed * 100 + v)
        videos.append(Video(images, Camera(camera.K, camera.w2c, width, height), rate, None, f"cam{v}"))
    return Scene(tuple(videos), (None,) * len(videos))
