"""Seeding: the first Gaussians of a scene, on the surfaces that the depth maps show, moment by moment.

At the middle of the clip every surface voxel gets a Gaussian, which is bound to the motion. At each further moment the
Gaussians are carried there, and new ones are added where none is near: on what earlier moments hid. Their means hold at
that moment, so each moment is a rest of the scaffold.

A rolling shutter is not undone here: its rows are off by up to half a readout, which the fit corrects.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Float
from scipy.spatial import cKDTree

from otsync.types import Offsets
from otsync.types.checks import check_number, check_whole
from recon.footage.depth import Depths, depth_at
from recon.footage.footage import Footage
from recon.motion import Motion, Scaffold
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D

logger = logging.getLogger("recon.seed")

INSIDE = 230
"""Masks of 0..255 from which a pixel shows only what moves: at edges the background's colour and depth mix in."""

NEARBY, MOST_NEARBY = 2.5, 48
"""Voxels around one that it is compared with, and how many of them at most."""

APART = 8 * 1 / 30
"""Seconds between the moments at which seeds are taken."""


@dataclass(frozen=True)
class Seeding:
    """How densely Gaussians begin."""

    voxel: tyro.conf.OmitArgPrefixes[float] = 2.7
    """Working pixels between the Gaussians that what moves begins with: finer is slower and shows more."""
    support: int = 2
    """Pixels that must have seen a voxel, so that stray depths seed nothing."""
    share: float = 0.25
    """Share of the pixels of the fullest voxel nearby that a voxel must hold: noisy depth makes a thick shell around a
    surface, and the middle of the shell is the fullest. 0: the whole shell."""
    reach: float = 1.3
    """Voxels within which a Gaussian of an earlier moment counts as being there already."""
    scale: float = 0.55
    """Standard deviation of a Gaussian at the start, in voxels."""
    opacity: float = 0.8
    """Of a Gaussian at the start."""
    sh_degree: tyro.conf.OmitArgPrefixes[int] = 0
    """Harmonics of the colours of what moves, 1 to 4 where they depend on the view (sheen); 0: they do not."""

    def __post_init__(self) -> None:
        for name in ("voxel", "reach", "scale"):
            check_number(name, getattr(self, name))
        check_whole("support", self.support, 1)
        if self.share != 0:
            check_number("share", self.share, 0, 1)
        check_number("opacity", self.opacity, 0, 1)
        check_whole("sh_degree", self.sh_degree, 0, 4)


Bind = Callable[[Any, Float[np.ndarray, "n 3"], float, int | None], Motion]
"""A motion, points that hold at a world second, and the video that seeds them (None: all): the motion of n more."""


def to_scaffold(motion: Scaffold, points: Float[np.ndarray, "n 3"], t: float, video: int | None) -> Scaffold:
    """The scaffold with Gaussians bound to its nodes."""
    return motion.bind(points, t, video=video)


def moments(span: tuple[float, float], frame_step: float, apart: float = APART) -> np.ndarray:
    """World seconds to seed at: the middle first, then outwards in steps of ``apart`` seconds, then both ends.

    The middle is a whole number of the reference's frames after the first second, at which the earliest video begins.
    So moments lie between the frames of every other video, and of the reference where a video began between two of its.
    """
    first, last = span
    middle = first + frame_step * round((last - first) / 2 / frame_step)
    steps = int((last - first) / 2 // apart)
    times = [middle]
    for k in range(1, steps + 1):
        times += [middle - k * apart, middle + k * apart]
    inside = [t for t in times if first - 1e-9 <= t <= last + 1e-9]
    ends = [t for t in (first, last) if min(abs(t - x) for x in inside) > apart / 4]
    return np.array([*inside, *ends])


def shown_at(footage: Sequence[Footage], offsets: Offsets, t: float, frame_step: float) -> list[int | None]:
    """For every video the readable frame that is believed nearest to world second ``t``.

    None where that is further than one frame of the reference away. To make depth maps for seeding, ask this function
    which frames need one: half-way between two frames another rounding would choose the other.
    """
    frames: list[int | None] = []
    for f in footage:
        at = offsets.names.index(f.name)
        clock = offsets.clock(at)
        k = f.nearest(clock.own(t))
        far = k is None or abs(clock.world(f.times[k]) - t) > frame_step
        frames.append(None if far else k)
    return frames


def cloud_at(
    footage: Sequence[Footage],
    depth: Sequence[Depths | None],
    offsets: Offsets,
    t: float,
    frame_step: float,
    gains: Float[np.ndarray, "V 3"] | None = None,
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Positions and colours of all pixels of what moves, over all videos, in the frames of :func:`shown_at`.

    Colours are divided by the videos' gains.
    """
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for v, (f, k) in enumerate(zip(footage, shown_at(footage, offsets, t, frame_step), strict=True)):
        z = None if k is None else depth_at(depth[v], f, k)
        if k is None or z is None:
            continue
        known = z > 0
        if f.masks is not None:
            known &= f.masks[k] > INSIDE
        row, column = np.nonzero(known)
        rays = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], 1) @ np.linalg.inv(f.K).T
        w2c = f.pose(k)
        points.append((rays * z[row, column, None] - w2c[:3, 3]) @ w2c[:3, :3])
        gain = np.ones(3) if gains is None else gains[v]
        colors.append(f.images[k][row, column] / 255.0 / gain)
    return np.concatenate(points), np.concatenate(colors).clip(0, 1)


def thinned(
    points: Float[np.ndarray, "P 3"], colors: Float[np.ndarray, "P 3"], voxel: float, support: int, share: float = 0.0
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Mean position and colour of voxels that hold ``support`` points, and a ``share`` of the fullest one's nearby."""
    if not len(points):
        return points, colors
    _, inverse, count = np.unique(
        np.floor(points / voxel).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    inverse = inverse.reshape(-1)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(inverse, values[:, c], len(count)) for c in range(3)]
        return np.stack(sums, 1) / np.maximum(count, 1)[:, None]

    middles = mean(points)
    near = cKDTree(middles).query(middles, range(1, MOST_NEARBY + 1), distance_upper_bound=NEARBY * voxel)[1]
    fullest = np.append(count, 0)[near].max(1)
    keep = (count >= support) & (count >= share * fullest)
    return middles[keep], mean(colors)[keep]


def seed(
    motion: Motion,
    footage: Sequence[Footage],
    offsets: Offsets,
    depth: Sequence[Depths | None],
    *,
    footprint: float,
    frame_step: float,
    span: tuple[float, float],
    times: Float[np.ndarray, " R"] | None = None,
    gains: Float[np.ndarray, "V 3"] | None = None,
    options: Seeding | None = None,
    bind: Bind = to_scaffold,
) -> Gaussians4D:
    """Gaussians on the surfaces that the depth maps show, bound to a motion.

    Args:
        motion: a scaffold, or any motion of no Gaussians yet that ``bind`` gives some.
        depth: per video, in the order of ``footage``. offsets: believed clocks, by name.
        footprint: world units of a working pixel. span: (first, last) world seconds. times: see :func:`moments`.
        gains: factors of the videos' colours.

    In a scaffold per video (whose clocks are numbered as ``footage``) each video seeds what it sees into its own nodes,
    and only where those before it have seeded nothing.

    Raises ValueError when no depth falls on anything that moves, and for a video without any.
    """
    options = options or Seeding()
    times = moments(span, frame_step) if times is None else times
    voxel = options.voxel * footprint
    means, colors = torch.zeros(0, 3), np.zeros((0, 3))
    everyone = range(len(footage))
    clock = motion.clock if isinstance(motion, Scaffold) else None
    own = set() if clock is None else set(clock.tolist())
    groups = [list(everyone)] if clock is None else [[v] for v in everyone if v in own]
    for t in times:
        for group in groups:
            points, shades = thinned(
                *cloud_at(
                    [footage[v] for v in group],
                    [depth[v] for v in group],
                    offsets,
                    float(t),
                    frame_step,
                    None if gains is None else gains[group],
                ),
                voxel,
                options.support,
                options.share,
            )
            if len(means) and len(points):
                here = motion.warp(means, _upright(len(means)), float(t))[0].detach().numpy()
                new = cKDTree(here).query(points)[0] > options.reach * voxel
                points, shades = points[new], shades[new]
            if not len(points):
                continue
            motion = bind(motion, points, float(t), None if clock is None else group[0])
            means = torch.cat([means, torch.as_tensor(points, dtype=torch.float32)])
            colors = np.concatenate([colors, shades])
        logger.info("seeds until %.3f s: %d", t, len(means))
    if not len(means):
        raise ValueError(
            "depth: expected depth where something moves, at one moment at least; found none. Check masks and "
            "depth maps."
        )
    return Gaussians4D(balls(means, colors, voxel, options), motion, footprint, frame_step, span)


def balls(means: torch.Tensor, colors: Float[np.ndarray, "N 3"], voxel: float, options: Seeding) -> Gaussians:
    """Round Gaussians at means [N,3], of the size and opacity of a seed; voxel: world units."""
    n = len(means)
    return Gaussians.from_colors(
        means,
        _upright(n),
        torch.full((n, 3), options.scale * voxel),
        torch.full((n,), options.opacity),
        torch.as_tensor(colors, dtype=torch.float32),
        sh_degree=options.sh_degree,
    )


def _upright(n: int) -> torch.Tensor:
    return torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
