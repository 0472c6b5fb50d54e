"""Seeding from images and calibration alone: Gaussians on the visual hull of the masks, which they follow.

Neither tracks nor depth are asked for. Where the believed clocks are wrong, the masks of one moment do not agree: then
more of them may lack a voxel, until there is something to begin with.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.ndimage import binary_erosion, maximum_filter
from scipy.spatial import cKDTree

from otsync.geometry import common_target
from otsync.types import Camera, Offsets
from recon.footage.footage import FOREGROUND, Footage
from recon.motion import Path, PerGaussian
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.seed import Seeding, balls, shown_at

logger = logging.getLogger("recon.seed")

LEAST = 500
"""Voxels of a hull's surface with which a scene may begin."""

VIEWS, SHARED, STRICT = 5, 1 / 3, 8
"""Views that must contain a voxel in their images, or all if there are fewer, and their least share; views from which
one mask may lack it at once, since masks have holes. On basketball (14 views, 5 of which must contain a voxel) the hull
projects onto 98 % of the masks; if 11 had to, onto 60 %."""

BLOCK = 4
"""Voxels on a side of the blocks that are tested as a whole."""

ROOM, NEAR = 1.1, 0.1
"""Half of the box that is searched, and depth from which a camera sees, in distances of the cameras."""

TOGETHER, ROUNDS = 12, 3
"""Seeds that go the mean of their ways from one hull to the next, and how often each looks for the hull anew."""

BEHIND = 2.0
"""Voxels behind the first one on a pixel's ray within which a voxel shows its colour in that pixel."""


def hull_scene(
    footage: Sequence[Footage],
    offsets: Offsets,
    *,
    frame_step: float,
    span: tuple[float, float],
    path: Path,
    gains: Float[np.ndarray, "V 3"] | None = None,
    options: Seeding | None = None,
) -> Gaussians4D:
    """Gaussians on the visual hull at the middle of the clip, each on a spline of its own that follows the hull.

    Args:
        offsets: believed clocks, by name. span: (first, last) world seconds. path: of each Gaussian, over the span.
        gains: factors of the videos' colours.

    Footprints are those at the point that the cameras look at. ValueError where fewer than two videos show the middle,
    and where no voxel lies in the masks of two then.
    """
    options = options or Seeding()
    middle = int(np.abs(path.times - np.mean(span)).argmin())
    view = _View.of(footage, offsets, float(path.times[middle]), frame_step)
    if view is None:
        raise ValueError(
            f"footage: expected two videos with masks that show world second {path.times[middle]:.3f}; found fewer. A "
            "visual hull needs several views at one time: check the offsets."
        )
    focus = common_target(view.cameras)
    away = np.array([np.linalg.norm(c.center - focus) for c in view.cameras])
    distance = float(np.median(away))
    footprint = float(np.median(away / [c.K[0, 0] for c in view.cameras]))
    voxel = options.voxel * footprint
    points = view.surface(focus, distance, voxel)
    if not len(points):
        raise ValueError("masks: expected something that two views agree on; found nothing. Check masks and offsets.")
    hulls = []
    for t in path.times:
        now = _View.of(footage, offsets, float(t), frame_step) if span[0] <= t <= span[1] else None
        hulls.append(np.zeros((0, 3)) if now is None else now.surface(focus, distance, voxel))
    means = torch.as_tensor(points, dtype=torch.float32)
    moved = torch.as_tensor(path.through(followed(points, hulls, middle)), dtype=torch.float32)
    logger.info("hull of %d videos at %.3f s: %d seeds", len(view.cameras), path.times[middle], len(means))
    images = [footage[v].images[k] / 255 / (1.0 if gains is None else gains[v]) for v, k in view.frames]
    dynamic = balls(means, _colors(points, view.cameras, images, voxel), voxel, options)
    return Gaussians4D(dynamic, PerGaussian(path, moved), footprint, frame_step, span)


def followed(
    points: Float[np.ndarray, "N 3"], hulls: Sequence[Float[np.ndarray, "m 3"]], middle: int
) -> Float[np.ndarray, "P N 3"]:
    """Displacements of points on the hull of the ``middle`` moment that stay on the hulls of P moments.

    From each moment to the next a point goes on as before, and from there to what is nearest of the hull; all of its
    neighbours go the mean of their ways, so that they stay together. Where there is no hull, it goes half as far as
    before.
    """
    out = np.zeros((len(hulls), *points.shape))
    near = cKDTree(points).query(points, k=range(1, min(TOGETHER, len(points)) + 1))[1]
    for order in (range(middle + 1, len(hulls)), range(middle - 1, -1, -1)):
        at, step = points, np.zeros_like(points)
        for p in order:
            if not len(hulls[p]):
                step = step / 2
            else:
                tree = cKDTree(hulls[p])
                for _ in range(ROUNDS):
                    nearest = hulls[p][tree.query(at + step)[1]]
                    step = (nearest - at)[near].mean(1)
            at = at + step
            out[p] = at - points
    return out


@dataclass(frozen=True, eq=False)
class _View:
    """What the videos show at one believed moment: frames (video, frame), and the cameras and masks of these."""

    frames: list[tuple[int, int]]
    cameras: list[Camera]
    masks: list[UInt8[np.ndarray, "h w"]]

    @classmethod
    def of(cls, footage: Sequence[Footage], offsets: Offsets, t: float, frame_step: float) -> _View | None:
        """None where fewer than two videos show it."""
        shown = enumerate(shown_at(footage, offsets, t, frame_step))
        frames = [(v, k) for v, k in shown if k is not None and footage[v].masks is not None]
        if len(frames) < 2:
            return None
        cameras = [Camera(footage[v].K, footage[v].pose(k), *footage[v].size) for v, k in frames]
        return cls(frames, cameras, [_mask(footage[v], k) for v, k in frames])

    def surface(self, focus: Float[np.ndarray, " 3"], distance: float, voxel: float) -> Float[np.ndarray, "N 3"]:
        """See :func:`_surface`."""
        return _surface(self.cameras, self.masks, focus, distance, voxel)


def _mask(footage: Footage, frame: int) -> UInt8[np.ndarray, "h w"]:
    assert footage.masks is not None
    return (footage.masks[frame] > 255 * FOREGROUND).astype(np.uint8)


def _surface(
    cameras: Sequence[Camera],
    masks: Sequence[UInt8[np.ndarray, "h w"]],
    focus: Float[np.ndarray, " 3"],
    distance: float,
    voxel: float,
) -> Float[np.ndarray, "N 3"]:
    """Middles of the voxels on the hull's surface, for as few masks that lack them as leave enough of them; maybe none.

    A voxel is in the images of five cameras at least, and of a third of them.
    """
    from otsync.priors.kernels_stereo import carve

    size = (max(c.height for c in cameras), max(c.width for c in cameras))
    wide = np.zeros((2, len(cameras), *size), np.uint8)  # masks, and masks that a block's middle must lie in
    for v, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        grown = 2 * round(BLOCK * voxel * camera.K[0, 0] / distance) + 1
        wide[0, v, : camera.height, : camera.width] = mask
        wide[1, v, : camera.height, : camera.width] = maximum_filter(mask, grown)
    P = np.stack([c.K @ c.w2c[:3] for c in cameras])
    sizes = np.array([(c.width, c.height) for c in cameras])
    low, dims = focus - ROOM * distance, np.full(3, int(2 * ROOM * distance / voxel) // BLOCK * BLOCK)
    views = min(len(cameras), max(VIEWS, math.ceil(SHARED * len(cameras))))
    surface = np.zeros((0, 3), int)
    for misses in range(int(len(cameras) >= STRICT), views):
        grid = carve(wide[0], wide[1], sizes, P, low, voxel, dims, BLOCK, views, misses, NEAR * distance) > 0
        surface = np.argwhere(grid & ~binary_erosion(grid))
        if len(surface) >= LEAST:
            break
    return low + (surface + 0.5) * voxel


def _colors(
    points: Float[np.ndarray, "N 3"],
    cameras: Sequence[Camera],
    images: Sequence[Float[np.ndarray, "h w 3"]],
    voxel: float,
) -> Float[np.ndarray, "N 3"]:
    """The median colour of every point in the images in which no other point stands before it; grey where in none."""
    seen = np.full((len(cameras), len(points), 3), np.nan)
    for v, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        x = points @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
        z = np.maximum(x[:, 2], 1e-9)
        u, w = (np.floor(x[:, i] / z * camera.K[i, i] + camera.K[i, 2]).astype(int) for i in (0, 1))
        inside = np.flatnonzero((x[:, 2] > 0) & (u >= 0) & (w >= 0) & (u < camera.width) & (w < camera.height))
        # cells of a voxel's size: so no gap between two points shows what is behind
        cell = max(1, round(voxel * float(np.median(camera.K[0, 0] / z[inside])))) if len(inside) else 1
        at = w[inside] // cell * camera.width + u[inside] // cell
        nearest = np.full(camera.height * camera.width, np.inf)
        np.minimum.at(nearest, at, z[inside])
        front = inside[z[inside] <= nearest[at] + BEHIND * voxel]
        seen[v, front] = image[w[front], u[front]]
    known = np.isfinite(seen[..., 0]).any(0)
    colors = np.full((len(points), 3), 0.5)
    colors[known] = np.nanmedian(seen[:, known], 0)
    return colors.clip(0, 1)
