"""Seeds of a backdrop: flat discs on the surfaces that the pictures show, and coarse ones behind their gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from recon.backdrop.stills import Still
from recon.backdrop.surroundings import Surroundings
from recon.observe.effects import ImageCircle
from recon.observe.vignetting import NO_FALLOFF, Falloff
from recon.raster import sh
from recon.scene.gaussians import Gaussians

RAYS, SPACING = 80, 2.6
"""Rays per image width along which seeds are cast; spacing of the seeds, in pixels of the nearest camera."""

WIDTH, THICKNESS, OPACITY = 0.45, 0.2, 0.82
"""Of a seed: standard deviation along the surface, in spacings; across it, relative to that; and its opacity."""

COARSE, BEHIND, BROAD = 5.0, 0.15, 0.6
"""The layer below seeds of known depth: its spacing, in theirs; how far behind them it lies and the standard deviation
of its discs, in its own spacings."""

SOLID = 0.98
"""Opacity of that layer and of fillers: nothing lies behind them."""

FILLERS = 1500
"""Discs that would cover all directions; only those are taken where no camera looked."""

BEYOND, ALONE, BLENDED = 1.05, 1.5, 8
"""Fillers: how far out they stand, in distances of floor and shell; widths to the nearest seed from which one is
needed; seeds whose colours it blends."""

SHARPEST = 0.4
"""Least standard deviation of a Gaussian, in pixels of the nearest camera: a held-out camera that comes closer would
see gaps between finer ones (the smoothing filter of Mip-Splatting, Yu et al. 2024)."""


@dataclass(frozen=True, eq=False)
class Discs:
    """N flat seeds.

    Args:
        at, normal, color: (N,3). width: (N,) standard deviation along the surface.
        pixel: (N,) world size of a pixel of the camera that shows it largest.
        opacity: (N,). measured: (N,) whether the depth was given rather than guessed.
    """

    at: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    color: Float[np.ndarray, "N 3"]
    width: Float[np.ndarray, " N"]
    pixel: Float[np.ndarray, " N"]
    opacity: Float[np.ndarray, " N"]
    measured: Bool[np.ndarray, " N"]

    @staticmethod
    def join(groups: Sequence[Discs]) -> Discs:
        return Discs(**{name: np.concatenate([vars(g)[name] for g in groups]) for name in vars(groups[0])})

    def gaussians(self, sh_degree: int) -> tuple[Gaussians, Tensor]:
        """(the Gaussians, their least standard deviation [N])."""
        scales = self.width[:, None] * np.array([1, 1, THICKNESS])
        coefficients = np.zeros((len(self.at), (sh_degree + 1) ** 2, 3))
        coefficients[:, 0] = (self.color - 0.5) / sh.C0
        logits = np.log(self.opacity / (1 - self.opacity))
        arrays = (self.at, facing(self.normal), np.log(scales), logits, coefficients)
        gaussians = Gaussians(*(torch.as_tensor(np.ascontiguousarray(a), dtype=torch.float32) for a in arrays))
        return gaussians, torch.as_tensor(SHARPEST * self.pixel, dtype=torch.float32)


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface in one picture, ray by ray: points, normals and colours [N,3]; [N] whether depth was given, and
    squared distances of the pixels from the principal point, in half diagonals."""

    at: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    color: Float[np.ndarray, "N 3"]
    measured: Bool[np.ndarray, " N"]
    radii: Float[np.ndarray, " N"]


def surface_of(still: Still, around: Surroundings, near: float) -> Surface:
    """Where the pixels of a picture lie: at their depth where it is known, else on the floor or the shell.

    Points nearer than ``near`` (along z) are left out.
    """
    u, v = still.pixels(max(1, round(still.size[0] / RAYS)))
    rays = still.rays(u, v)
    away, normal = around.cast(np.broadcast_to(still.center, rays.shape), rays)
    known = np.isfinite(away)
    at = still.center + np.where(known, away, 0)[:, None] * rays
    given = np.zeros(len(u), bool)
    if still.depth is not None:
        z = still.depth[v, u]
        given = z > 0
        at[given] = still.lift(u[given], v[given], z[given])
        normal = np.where(given[:, None], normals_of_depth(still, u, v), normal)
    keep = (known | given) & ((at - still.center) @ still.w2c[2, :3] > near)
    radii = ImageCircle.of(still.K, still.size).squared_radii((0, 0, *still.size))[v, u]
    return Surface(at[keep], normal[keep], still.image[v, u][keep] / 255, given[keep], radii[keep])


def seed_discs(
    stills: Sequence[Still],
    surfaces: Sequence[Surface],
    around: Surroundings,
    near: float,
    gains: Float[np.ndarray, "V 3"] | None = None,
    falloff: Falloff = NO_FALLOFF,
) -> Discs:
    """Discs on the surfaces of all pictures, one per voxel, and coarser ones behind them.

    gains: factors of the videos' colours, which are divided out. falloff: of the cameras' vignetting, too.
    """
    at, normal, given = (np.concatenate([getattr(s, n) for s in surfaces]) for n in ("at", "normal", "measured"))
    if not len(at):
        raise ValueError(
            f"footage: expected background beyond the near plane ({near:.3g}); found none. Check that depth and poses "
            "have one unit."
        )
    each = [s.color if gains is None else s.color / gains[t.video] for s, t in zip(surfaces, stills, strict=True)]
    color = (np.concatenate(each) / falloff.at(np.concatenate([s.radii for s in surfaces]))[:, None]).clip(0, 1)
    pixel = _nearest_pixel(stills, at, near)
    # sides of voxels are the smallest one times a power of two: far things are seeded no finer than they are seen
    base = np.percentile(pixel, 1)
    level = np.maximum(np.floor(np.log2(pixel / base) + 0.5), 0)
    side = SPACING * base * 2.0**level
    cell = np.concatenate([level[:, None], np.floor(at / side[:, None])], 1).astype(np.int64)
    first = np.sort(np.unique(cell, axis=0, return_index=True)[1])
    opacity = np.full(len(first), OPACITY)
    fine = Discs(at[first], normal[first], color[first], WIDTH * side[first], pixel[first], opacity, given[first])
    return Discs.join([fine, underlay(fine), fillers(fine, around)])


def underlay(fine: Discs) -> Discs:
    """Coarse opaque discs a little behind the fine ones whose depth was measured.

    New views look through gaps that the cameras did not see; without these discs they would look into black (+2 to 3 dB
    in the synthetic room). Behind seeds on a guessed surface they would stand where the seeds should move: -.2 to
    -.8 dB.
    """
    known = np.flatnonzero(fine.measured)
    side = COARSE * np.median(fine.width[known]) / WIDTH if len(known) else 1.0
    cell, first, inverse, count = np.unique(
        np.floor(fine.at[known] / side).astype(np.int64),
        axis=0,
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )

    def mean(values: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "n 3"]:
        sums = [np.bincount(inverse.ravel(), column, len(cell)) for column in values[known].T]
        return np.stack(sums, 1) / np.maximum(count, 1)[:, None]

    normal = mean(fine.normal)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0.3, normal / np.maximum(length, 1e-12), fine.normal[known][first])
    n = len(cell)
    return Discs(
        mean(fine.at) - BEHIND * side * normal,
        normal,
        mean(fine.color),
        np.full(n, BROAD * side),
        np.full(n, np.median(fine.pixel)),
        np.full(n, SOLID),
        np.ones(n, bool),
    )


def fillers(fine: Discs, around: Surroundings) -> Discs:
    """Large discs on floor and shell in the directions without seeds, in the colours of the nearest seeds."""
    k = np.arange(FILLERS) + 0.5
    polar, turn = np.arccos(1 - 2 * k / FILLERS), np.pi * (1 + 5**0.5) * k
    rays = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], 1)
    away, normal = around.cast(np.broadcast_to(around.focus, rays.shape), rays)
    hit = np.isfinite(away)
    at = around.focus + (BEYOND * away[hit])[:, None] * rays[hit]
    width = away[hit] * (4 * np.pi / FILLERS) ** 0.5
    far, which = cKDTree(fine.at).query(at, k=np.arange(1, min(BLENDED, len(fine.at)) + 1))
    empty = far[:, 0] > ALONE * width
    weight = 1 / (far[empty] + 1e-9)[..., None]
    color = (fine.color[which[empty]] * weight).sum(1) / weight.sum(1)
    n = int(empty.sum())
    return Discs(
        at[empty],
        normal[hit][empty],
        color,
        width[empty],
        np.full(n, np.median(fine.pixel)),
        np.full(n, SOLID),
        np.zeros(n, bool),
    )


def normals_of_depth(still: Still, u: np.ndarray, v: np.ndarray) -> Float[np.ndarray, "N 3"]:
    """Surface normals, towards the camera, from the depths around pixels; else along the pixel's own ray."""
    assert still.depth is not None
    depth, (width, height) = still.depth, still.size
    reach = max(2, width // 80)

    def at(du: int, dv: int) -> tuple[np.ndarray, np.ndarray]:
        x, y = (u + du).clip(0, width - 1), (v + dv).clip(0, height - 1)
        return still.lift(x, y, depth[y, x]), depth[y, x] > 0

    (left, a), (right, b), (up, c), (down, d) = at(-reach, 0), at(reach, 0), at(0, -reach), at(0, reach)
    normal = np.cross(down - up, right - left)  # image axes: x right, y down, so this looks back at the camera
    length = np.linalg.norm(normal, axis=1)
    normal = normal / np.maximum(length, 1e-12)[:, None]
    back = -still.rays(u, v)
    good = a & b & c & d & (length > 0) & ((normal * back).sum(1) > 0.1)
    return np.where(good[:, None], normal, back)


def facing(normals: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4"]:
    """Quaternions wxyz that turn z to unit normals."""
    x, y, z = normals.T
    quats = np.stack([1 + z, -y, x, np.zeros_like(z)], 1)
    quats[np.linalg.norm(quats, axis=1) < 1e-3] = 0, 1, 0, 0  # half a turn about x
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _nearest_pixel(stills: Sequence[Still], points: Float[np.ndarray, "N 3"], near: float) -> Float[np.ndarray, " N"]:
    """World size of a pixel at each point, in the picture that shows it largest."""
    size = np.full(len(points), np.inf)
    for still in stills:
        cam = points @ still.w2c[:3, :3].T + still.w2c[:3, 3]
        z = np.maximum(cam[:, 2], 1e-9)
        uv = cam[:, :2] / z[:, None] * still.K[[0, 1], [0, 1]] + still.K[:2, 2]
        seen = (cam[:, 2] > near) & (uv >= 0).all(1) & (uv <= still.size).all(1)
        size = np.where(seen, np.minimum(size, z / still.K[0, 0]), size)
    return np.where(np.isfinite(size), size, np.median(size[np.isfinite(size)]))
