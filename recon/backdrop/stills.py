"""Stills: pictures of the background, which are a fixed camera's median image or masked frames of a moving one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import maximum_filter

from otsync.compute.indices import evenly
from recon.footage.depth import Depths, background_depth, depth_at
from recon.footage.footage import FOREGROUND, GROWTH, Footage


@dataclass(frozen=True, eq=False)
class Still:
    """One picture of the background.

    Args:
        video: index of the video it is from.
        image: RGB. where: the pixels that show what stands still.
        K, w2c: of the working image.
        depth: z in world units, 0 where unknown; None: unknown everywhere.
    """

    video: int
    image: UInt8[np.ndarray, "h w 3"]
    where: Bool[np.ndarray, "h w"]
    K: Float[np.ndarray, "3 3"]
    w2c: Float[np.ndarray, "4 4"]
    depth: Float[np.ndarray, "h w"] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return int(self.image.shape[1]), int(self.image.shape[0])

    @property
    def center(self) -> Float[np.ndarray, " 3"]:
        """Of the camera, in the world."""
        return -self.w2c[:3, :3].T @ self.w2c[:3, 3]

    def pixels(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """(columns, rows) of every ``step``-th pixel that shows the background."""
        width, height = self.size
        v, u = np.mgrid[step // 2 : height : step, step // 2 : width : step].reshape(2, -1)
        keep = self.where[v, u]
        return u[keep], v[keep]

    def rays(self, u: np.ndarray, v: np.ndarray) -> Float[np.ndarray, "N 3"]:
        """Unit directions in the world of pixels in columns ``u`` and rows ``v``."""
        world = self._directions(u, v)
        return world / np.linalg.norm(world, axis=1, keepdims=True)

    def lift(self, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> Float[np.ndarray, "N 3"]:
        """World points at depth ``z`` along the rays of pixels."""
        return self.center + self._directions(u, v) * z[:, None]

    def _directions(self, u: np.ndarray, v: np.ndarray) -> Float[np.ndarray, "N 3"]:
        local = np.stack([u + 0.5, v + 0.5, np.ones(len(u))], 1) @ np.linalg.inv(self.K).T
        return local @ self.w2c[:3, :3]


def stills_of(
    footage: Sequence[Footage], depth: Sequence[Depths | None] | None = None, *, frames: int = 16
) -> list[Still]:
    """Every picture of the background that the videos have.

    Args:
        depth: per video, of some of its frames; None where there is none.
        frames: of a moving camera, spread over the clip.

    A camera without masks, fixed or moving, has none: nothing tells its background from what moves.
    """
    out = []
    for v, f in enumerate(footage):
        maps = None if depth is None else depth[v]
        if f.background is not None and f.background_seen is not None:
            z = None if maps is None else background_depth(maps, f)[0]
            out.append(Still(v, f.background, f.background_seen, f.K, f.pose(0), z))
        elif f.masks is not None:
            good = np.flatnonzero(~f.bad)
            grow = 2 * max(1, round(GROWTH * f.size[0] / 320)) + 1
            for k in good[evenly(len(good), frames)]:
                where = maximum_filter(f.masks[k], size=grow) <= 255 * FOREGROUND
                z = None if maps is None else depth_at(maps, f, int(k))
                out.append(Still(v, f.images[k], where, f.K, f.pose(int(k)), z))
    return out
