"""Seeding from images and calibration alone: Gaussians on the visual hull of the masks at one moment, at rest.

Neither tracks nor depth are asked for. Where the believed clocks are wrong, the masks of one moment do not agree: then
more of them may lack a voxel, until there is something to begin with.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.ndimage import binary_erosion, maximum_filter

from otsync.geometry import common_target
from otsync.types import Camera, Offsets
from recon.footage.footage import FOREGROUND, Footage
from recon.motion import HermiteSpline, PerGaussian
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.seed import Seeding, balls, moments, shown_at

logger = logging.getLogger("recon.seed")

LEAST = 500
"""Voxels of a hull's surface with which a scene may begin."""

STRICT, SHARED = 8, 0.75
"""Views from which one mask may lack a voxel at once, since masks have holes; share of the views that must contain it:
what few see lies in the cones of too few masks."""

BLOCK = 4
"""Voxels on a side of the blocks that are tested as a whole."""

ROOM, NEAR = 1.1, 0.1
"""Half of the box that is searched, and depth from which a camera sees, in distances of the cameras."""

BEHIND = 2.0
"""Voxels behind the first one on a pixel's ray within which a voxel shows its colour in that pixel."""


def hull_scene(
    footage: Sequence[Footage],
    offsets: Offsets,
    *,
    frame_step: float,
    span: tuple[float, float],
    spacing: float,
    margin: float,
    gains: Float[np.ndarray, "V 3"] | None = None,
    options: Seeding | None = None,
) -> Gaussians4D:
    """Gaussians on the visual hull at the middle of the clip, each at rest on a spline of its own.

    Args:
        offsets: believed clocks, by name. span: (first, last) world seconds.
        spacing, margin: seconds between the knots of the splines, and of knots beyond both ends.
        gains: factors of the videos' colours.

    Footprints are those at the point that the cameras look at. ValueError where fewer than two videos show the middle,
    and where no voxel lies in any mask.
    """
    options = options or Seeding()
    t = float(moments(span, frame_step)[0])
    shown = [(v, k) for v, k in enumerate(shown_at(footage, offsets, t, frame_step)) if k is not None]
    shown = [(v, k) for v, k in shown if footage[v].masks is not None]
    if len(shown) < 2:
        raise ValueError(
            f"footage: expected two videos with masks that show world second {t:.3f}; found {len(shown)}. A visual "
            "hull needs several views at one time: check the offsets."
        )
    cameras = [Camera(footage[v].K, footage[v].pose(k), *footage[v].size) for v, k in shown]
    middle = common_target(cameras)
    distance = float(np.median([np.linalg.norm(c.center - middle) for c in cameras]))
    footprint = float(np.median([np.linalg.norm(c.center - middle) / c.K[0, 0] for c in cameras]))
    voxel = options.voxel * footprint
    points = _surface(cameras, [_mask(footage[v], k) for v, k in shown], middle, distance, voxel)
    images = [footage[v].images[k] / 255 / (1.0 if gains is None else gains[v]) for v, k in shown]
    means = torch.as_tensor(points, dtype=torch.float32)
    path = HermiteSpline.of(*span, spacing, margin)
    logger.info("hull of %d videos at %.3f s: %d seeds", len(shown), t, len(means))
    dynamic = balls(means, _colors(points, cameras, images, voxel), voxel, options)
    return Gaussians4D(dynamic, PerGaussian.at_rest(path, len(means)), footprint, frame_step, span)


def _mask(footage: Footage, frame: int) -> UInt8[np.ndarray, "h w"]:
    assert footage.masks is not None
    return (footage.masks[frame] > 255 * FOREGROUND).astype(np.uint8)


def _surface(
    cameras: Sequence[Camera],
    masks: Sequence[UInt8[np.ndarray, "h w"]],
    middle: Float[np.ndarray, " 3"],
    distance: float,
    voxel: float,
) -> Float[np.ndarray, "N 3"]:
    """Middles of the voxels on the hull's surface, for as few masks that lack them as leave enough of them.

    A voxel is in the images of three quarters of the cameras at least.
    """
    from otsync.priors.kernels_stereo import carve

    size = (max(c.height for c in cameras), max(c.width for c in cameras))
    wide = np.zeros((2, len(cameras), *size), np.uint8)  # masks, and masks that a block's middle must lie in
    for v, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        grown = 2 * round(BLOCK * voxel * camera.K[0, 0] / distance) + 1
        wide[0, v, : camera.height, : camera.width] = mask
        wide[1, v, : camera.height, : camera.width] = maximum_filter(mask, grown)
    P = np.stack([c.K @ c.w2c[:3] for c in cameras])
    low, dims = middle - ROOM * distance, np.full(3, int(2 * ROOM * distance / voxel) // BLOCK * BLOCK)
    views = max(2, math.ceil(SHARED * len(cameras)))
    surface = np.zeros((0, 3), int)
    for misses in range(int(len(cameras) >= STRICT), views):
        grid = carve(wide[0], wide[1], P, low, voxel, dims, BLOCK, views, misses, NEAR * distance).astype(bool)
        surface = np.argwhere(grid & ~binary_erosion(grid))
        if len(surface) >= LEAST:
            break
    if not len(surface):
        raise ValueError("masks: expected something that two views agree on; found nothing. Check masks and offsets.")
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
