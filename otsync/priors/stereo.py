"""Depth of tracked points without a depth sensor or learned weights: visual hull, then stereo behind its surface.

Needs a rig that is synchronised, or aligned already: the hull intersects masks of one moment.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ..compute.threads import MapLike
from ..files.cache import Cache
from ..files.digest import content_key
from ..geometry import common_target
from ..types import Break, Camera, Video, mended_frames
from ..types.checks import check_number, check_whole
from .working import WorkingFrames

WIDE = 1.0
"""Focal length in widths of the image up to which lengths are given; of a longer one they shrink, so that a voxel stays
as large in the image."""


MADE_BY = 2
"""Counted up where what is measured changes, so that a folder made by an older version does not mix both."""

SURFACE = 0.05
"""Metres by which the hull's depths of two pixels of one surface differ at most."""

BEHIND = 0.6
"""Correlation that a depth loses per metre behind the hull: of two that are as good, the nearer one is more likely."""

NOISE = 4.0
"""Variance of the grey levels, which keeps flat patches from correlating."""


class EmptyHull(ValueError):
    """No place in space is foreground in enough views."""


@dataclass(frozen=True, eq=False)
class Rig:
    """What stereo needs of all videos: pixels and masks at working size, and which frames belong together.

    Args:
        index: (S,V) frame of every video at each moment, -1 where the video has none within half a frame.
    """

    frames: tuple[WorkingFrames, ...]
    masks: tuple[Sequence[np.ndarray], ...]
    cameras: tuple[Camera, ...]
    index: Int[np.ndarray, "S V"]

    @classmethod
    def at(
        cls,
        videos: Sequence[Video],
        masks: Sequence[Sequence[np.ndarray]],
        offsets: Float[np.ndarray, " V"],
        width: int = 640,
        rates: Float[np.ndarray, " V"] | None = None,
        breaks: Sequence[Sequence[Break]] | None = None,
    ) -> Rig:
        """Frames that show the same moment under ``offsets`` (seconds) and ``rates``, on the fastest video's beat.

        ``breaks``: of every video's clock. What stands still shows nothing.
        """
        frames = tuple(WorkingFrames(v.frames, (v.camera.width, v.camera.height), width) for v in videos)
        rates = np.ones(len(videos)) if rates is None else rates
        told = [mended_frames(v.times, b) for v, b in zip(videos, breaks or [()] * len(videos), strict=True)]
        clocks = [r * shown + o for (_, shown), o, r in zip(told, offsets, rates, strict=True)]
        fps = max(v.fps or 30.0 for v in videos)
        start, stop = min(c[0] for c in clocks), max(c[-1] for c in clocks)
        # the grid runs through the first video's own frames: whole-frame offsets meet exactly
        first = clocks[0][0]
        moments = first + np.arange(np.ceil((start - first) * fps - 1e-6), (stop - first) * fps + 1e-6) / fps
        index = np.stack([_nearest(c, moments, 0.5 / fps, keep) for c, (keep, _) in zip(clocks, told, strict=True)], 1)
        return cls(frames, tuple(masks), tuple(v.camera for v in videos), index)


class TrackDepth(Protocol):
    """The ``stereo`` slot: depth of point tracks, from a rig whose videos are on one clock."""

    @property
    def min_views(self) -> int:
        """Static videos that it needs at least."""
        ...

    def __call__(
        self,
        rig: Rig,
        uv: Sequence[Float[np.ndarray, "N T 2"]],
        cache: Cache | None = None,
        key: tuple[Any, ...] = (),
        map: MapLike = map,
    ) -> list[Float[np.ndarray, "N T"]]:
        """Depth along z of every track point (undistorted camera pixels, nan unseen), in world units, 0 unknown.

        Args:
            cache: where parts of the work are kept, so that a run that was killed continues. It looks them up by
                ``key``, by itself, and by ``rig.index`` and ``uv``.
            key: what the rig's pixels, masks and cameras are; empty: unknown, so nothing may be kept.
            map: any map-like callable, over parts that do not depend on each other.
        """
        ...


@dataclass(frozen=True)
class HullStereo:
    """Depth at given pixels: where the ray enters the visual hull, then the best correlation up to a limb behind it.

    Measured with 14 views of basketball: dense maps of neighbouring cameras differ by .76 % (median; 90 %: 7 %).
    Lengths are in metres for cameras about 3.3 m from the scene and scale with that distance, so that no unit is
    assumed, and with the part of the scene that a long lens shows; pixels at 640 of width.

    Args:
        voxel, sweep (from, to), step: metres. patch: half width of the correlation window. neighbours: views that
            are compared, nearest by angle. misses: masks that may lack a voxel which their image contains.
        spread: distance of the eight sub-points around a point whose correlations are added. least: correlation
            below which a depth is not believed.
        every: of so many moments one is measured; tracks between two that are have the mean of these, where both know
            it. Dense maps are always measured.
        chunk: moments whose depth is kept together, those in between included.
    """

    voxel: float = 0.02
    sweep: tuple[float, float] = (-0.02, 0.16)
    step: float = 0.012
    patch: int = 4
    neighbours: int = 5
    min_views: int = 5
    misses: int = 1
    spread: int = 3
    least: float = 0.2
    every: int = 1
    chunk: int = 25

    def __post_init__(self) -> None:
        check_whole("HullStereo.every", self.every, 1)
        check_whole("HullStereo.chunk", self.chunk, 1)
        check_number("HullStereo.voxel", self.voxel)
        check_number("HullStereo.step", self.step)
        if not self.sweep[1] - self.sweep[0] >= self.step:
            raise ValueError(
                f"HullStereo.sweep: expected from and to, at least a step of {self.step:g} apart; found {self.sweep}."
            )

    def __call__(
        self,
        rig: Rig,
        uv: Sequence[Float[np.ndarray, "N T 2"]],
        cache: Cache | None = None,
        key: tuple[Any, ...] = (),
        map: MapLike = map,
    ) -> list[Float[np.ndarray, "N T"]]:
        """Depth along z of every track point (undistorted camera pixels, nan unseen), in world units, 0 unknown."""
        cache = cache or Cache()
        space = Space.of(self, rig)
        wanted = np.arange(0, len(rig.index), self.every)
        size = max(1, self.chunk // self.every)
        chunks = [wanted[k : k + size] for k in range(0, len(wanted), size)]
        # without a key of the pixels nothing may be kept: the tracks alone do not say which images they came from
        store = cache if key else Cache()
        key = (*key, MADE_BY, self, content_key(rig.index, *uv))

        def part(moments: Int[np.ndarray, " C"]) -> dict[str, np.ndarray]:
            return store.arrays("stereo", (*key, int(moments[0])), lambda: self._chunk(rig, space, uv, moments))

        depth = [np.zeros(x.shape[:2], np.float32) for x in uv]
        known = [np.zeros(x.shape[1], bool) for x in uv]
        for arrays in map(part, chunks):
            for v, out in enumerate(depth):
                frames = arrays[f"frames{v}"]
                out[:, frames] = arrays[f"depth{v}"]
                known[v][frames] = True
        if self.every > 1:
            for x, z, k in zip(uv, depth, known, strict=True):
                fill_between(z, np.isfinite(x[..., 0]), k, self.every)
        return depth

    def _chunk(
        self, rig: Rig, space: Space, uv: Sequence[np.ndarray], moments: Int[np.ndarray, " C"]
    ) -> dict[str, np.ndarray]:
        used = [[int(k) for s in moments if (k := rig.index[s, v]) >= 0] for v in range(len(uv))]
        out = {f"frames{v}": np.array(used[v], int) for v in range(len(uv))}
        out |= {f"depth{v}": np.zeros((len(uv[v]), len(used[v])), np.float32) for v in range(len(uv))}
        for s in moments:
            present = np.flatnonzero(rig.index[s] >= 0)
            if not self.enough(present):
                continue
            images = {v: space.image(rig, v, int(rig.index[s, v])) for v in present.tolist()}
            hull = space.hull(self, rig, s, present)
            for v in present.tolist():
                k = int(rig.index[s, v])
                at = np.flatnonzero(np.isfinite(uv[v][:, k, 0]))
                if len(at):
                    points = uv[v][at, k].astype(float) * rig.frames[v].scale
                    out[f"depth{v}"][at, used[v].index(k)] = self._depths(space, hull, images, v, points, k)
        return out

    def _depths(
        self, space: Space, hull: Hull, images: dict[int, np.ndarray], v: int, points: np.ndarray, k: int
    ) -> Float[np.ndarray, " N"]:
        around = self.spread * np.array(
            [(0, 0), (-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)], float
        )
        sub = (points[:, None] + around[None]).reshape(-1, 2)
        group = np.arange(len(sub)).reshape(len(points), len(around))
        return self.depths(space, hull, images, self.partners(space, np.array(list(images)), v), v, k, sub, group)

    def enough(self, present: Int[np.ndarray, " P"]) -> bool:
        """Whether the videos that show a moment suffice for a hull and a correlation."""
        return len(present) >= max(3, self.min_views - self.misses)

    def partners(self, space: Space, present: Int[np.ndarray, " P"], v: int) -> list[int]:
        """The views that v is compared with, nearest by angle."""
        here = set(present.tolist())
        return [u for u in space.order[v] if u in here][: self.neighbours]

    def depths(
        self,
        space: Space,
        hull: Hull,
        images: dict[int, np.ndarray],
        near: Sequence[int],
        v: int,
        k: int,
        points: Float[np.ndarray, "M 2"],
        group: Int[np.ndarray, "N S"],
    ) -> Float[np.ndarray, " N"]:
        """Depth of the first point of each group, by the summed correlations of all; 0 where it is not believed.

        Args:
            near: views to compare with. points: working pixels. group: numbers of points, M for none.
        """
        from .kernels_stereo import at_points, choose_depth, correlate, first_hit, planes_of

        if len(near) < 2 or not len(group):
            return np.zeros(len(group), np.float32)
        R, center, inverse_K = space.pose(v, k)
        unit, image = space.unit, images[v]
        rays = np.concatenate([points, np.ones((len(points), 1))], 1) @ inverse_K.T @ R.T
        voxel = self.voxel * unit
        start = first_hit(hull.grid, hull.blocks, space.low, voxel, center, rays, 0.4 * voxel, space.near, space.far)
        start = np.append(start, 0.0)  # of the point that is none: no group adds it
        h, w = image.shape
        first, last, close, step = unit * self.sweep[0], unit * self.sweep[1], unit * SURFACE, unit * self.step
        low, high, owner, asked = planes_of(start, group, first, last, close, step)
        boxes, own, squares = boxes_to_compare(points, low, high, owner, len(group), self.patch, h, w)
        at = np.concatenate([[0], np.cumsum(_pixels(boxes[:, 1:]))])
        others, P, sizes = together([images[u] for u in near]), space.P[near], space.sizes[near]
        A, b = P[:, :, :3] @ (R @ inverse_K), P[:, :, :3] @ center + P[:, :, 3]
        volume = correlate(image, others, sizes, A, b, boxes, at, step, self.patch, np.float32(NOISE))
        scores, begins = at_points(points, low, high, volume, boxes, at, own, squares, self.patch, h, w)
        depth, quality = choose_depth(start, group, asked, scores, begins, low, close, step, BEHIND / unit)
        return np.where(quality > self.least, depth, 0.0).astype(np.float32)


def boxes_to_compare(
    points: Float[np.ndarray, "M 2"],
    low: Int[np.ndarray, " M"],
    high: Int[np.ndarray, " M"],
    owner: Int[np.ndarray, " M"],
    groups: int,
    half: int,
    h: int,
    w: int,
) -> tuple[Int[np.ndarray, "B 5"], Int[np.ndarray, " M"], Int[np.ndarray, "P Y X"]]:
    """The boxes of pixels that are compared, plane by plane: one a group, or squares that groups share.

    Whichever samples fewer pixels: few points lie alone, the pixels of a map side by side.

    Args:
        points, low, high, owner: see :mod:`otsync.priors.kernels_stereo`. half: of a patch. h, w: of the image.

    Returns:
        plane, first and last column, first and last row of each box; the box of each point's first plane, -1 where
        squares tell; and the box of every square of every plane, -1 for none.
    """
    from .kernels_stereo import TILE, boxes_of_groups, boxes_of_squares

    squares, number = boxes_of_squares(points, low, high, half, h, w)
    inside = owner >= 0
    if not (owner == -1).any() and inside.any():
        alone = boxes_of_groups(points, owner, groups, half, h, w)
        planes = np.zeros((groups, 2), int)
        planes[owner[inside]] = np.stack([low[inside], high[inside] + 1], 1)
        planes[_pixels(alone) == 0] = 0
        counts = planes[:, 1] - planes[:, 0]
        fits = (alone[:, 1::2] - alone[:, ::2] < TILE).all()
        if fits and (counts * _pixels(alone, 2 * half)).sum() < _pixels(squares[:, 1:], 2 * half).sum():
            which = np.repeat(np.arange(groups), counts)
            begins = np.cumsum(counts) - counts
            plane = np.arange(len(which)) - begins[which] + planes[which, 0]
            own = np.full(len(points), -1)
            own[inside] = begins[owner[inside]]
            return np.column_stack([plane, alone[which]]).astype(np.int32), own, np.full((0, 0, 0), -1)
    return squares, np.full(len(points), -1), number


def _pixels(boxes: Int[np.ndarray, "*B 4"], more: int = 0) -> Int[np.ndarray, "*B"]:
    """Pixels of boxes (first and last column, first and last row), ``more`` along each side; 0 for empty ones."""
    x0, x1, y0, y1 = np.moveaxis(boxes.astype(np.int64), -1, 0)
    return np.where((x1 >= x0) & (y1 >= y0), (x1 - x0 + 1 + more) * (y1 - y0 + 1 + more), 0)


def fill_between(
    depth: Float[np.ndarray, "N T"], seen: Bool[np.ndarray, "N T"], measured: Bool[np.ndarray, " T"], reach: int
) -> None:
    """Give the frames that were not measured the depth between those that were, in place; 0 where one is unknown.

    Args:
        seen: where tracks are: depth is given nowhere else. reach: frames from one measured frame to the next, at most.
    """
    at = np.flatnonzero(measured)
    for before, behind in itertools.pairwise(at):
        if not 1 < behind - before <= reach:
            continue
        first, last = depth[:, before], depth[:, behind]
        both = (first > 0) & (last > 0)
        for k in range(before + 1, behind):
            share = (k - before) / (behind - before)
            depth[:, k] = np.where(both & seen[:, k], (1 - share) * first + share * last, 0.0)


@dataclass(frozen=True, eq=False)
class Hull:
    """The visual hull of a moment: its occupied voxels, and the blocks of them that hold one."""

    grid: UInt8[np.ndarray, "X Y Z"]
    blocks: UInt8[np.ndarray, "x y z"]


@dataclass(frozen=True, eq=False)
class Space:
    """The box that the hull is carved from, and the cameras at working resolution, images of ``sizes`` (width, height).

    Views may be of different sizes.
    """

    P: Float[np.ndarray, "V 3 4"]
    K: Float[np.ndarray, "V 3 3"]
    sizes: Int[np.ndarray, "V 2"]
    cameras: tuple[Camera, ...]
    order: list[list[int]]
    unit: float
    low: Float[np.ndarray, " 3"]
    dims: Int[np.ndarray, " 3"]
    near: float
    far: float

    @classmethod
    def of(cls, stereo: HullStereo, rig: Rig) -> Space:
        from .kernels_stereo import carve

        if any(c.w2c.ndim == 3 for c in rig.cameras):
            raise ValueError("rig: expected static cameras for the visual hull; some move. Bring depth maps instead.")
        scale = np.array([f.scale for f in rig.frames])
        K = np.stack([np.diag([s, s, 1.0]) @ c.K for s, c in zip(scale, rig.cameras, strict=True)])
        P = np.stack([k @ c.w2c[:3] for k, c in zip(K, rig.cameras, strict=True)])
        target = common_target(list(rig.cameras))
        away = np.stack([c.center - target for c in rig.cameras])
        distance = np.linalg.norm(away, axis=1)
        # lengths are what they are at that distance for a wide lens; a long one sees smaller things from there
        longer = float(np.median([k[0, 0] / f.size[0] for k, f in zip(K, rig.frames, strict=True)]))
        unit = float(np.median(distance)) / 3.3 * min(1.0, WIDE / longer)
        direction = away / distance[:, None]
        order = [[int(u) for u in np.argsort(-(direction @ direction[v])) if u != v] for v in range(len(P))]
        near, far = 0.1 * unit, float(distance.max()) * 2.5
        coarse, radius = 0.08 * unit, float(np.median(distance)) * 1.1
        low, dims = target - radius, np.full(3, int(2 * radius / coarse) // 4 * 4)
        sizes = np.array([f.size for f in rig.frames])
        box = cls(P, K, sizes, rig.cameras, order, unit, low, dims, near, far)
        # where anything is ever occupied, from a few moments
        full = np.flatnonzero((rig.index >= 0).sum(1) >= stereo.min_views)
        occupied = []
        for s in full[:: max(1, len(full) // 12)]:
            present = np.flatnonzero(rig.index[s] >= 0)
            masks = grown(box.masks(rig, int(s), present), round(coarse / unit * 160))
            seen = (masks, masks, sizes[present], P[present])
            grid = carve(*seen, low, coarse, dims, 4, stereo.min_views, stereo.misses, near)
            occupied.append(np.argwhere(grid))
        corners = np.concatenate(occupied) if occupied else np.zeros((0, 3), int)
        if len(corners) == 0:
            raise EmptyHull(
                "masks: expected foreground that the views agree on; their visual hull is empty. Check masks, camera "
                "poses and offsets."
            )
        margin = 3
        start = low + (corners.min(0) - margin) * coarse
        size = (np.ptp(corners, axis=0) + 1 + 2 * margin) * coarse
        fine = np.ceil(size / (stereo.voxel * unit) / 4).astype(int) * 4
        return cls(P, K, sizes, rig.cameras, order, unit, start, fine, near, far)

    def masks(self, rig: Rig, s: int, present: np.ndarray) -> UInt8[np.ndarray, "P h w"]:
        """Masks at moment s of the videos that show it, without lens distortion."""
        import cv2

        out = []
        for v in present.tolist():
            mask = rig.frames[v].mask(rig.masks[v][int(rig.index[s, v])]).astype(np.uint8)
            out.append(_straight(mask, rig.cameras[v], self.K[v], cv2.INTER_NEAREST))
        return together(out)

    def hull(self, stereo: HullStereo, rig: Rig, s: int, present: np.ndarray) -> Hull:
        from .kernels_stereo import blocks_of, carve

        block = 4
        masks = self.masks(rig, s, present)
        grid = carve(
            masks,
            grown(masks, round(block * stereo.voxel * 160)),
            self.sizes[present],
            self.P[present],
            self.low,
            stereo.voxel * self.unit,
            self.dims,
            block,
            stereo.min_views,
            stereo.misses,
            self.near,
        )
        return Hull(grid, blocks_of(grid))

    def image(self, rig: Rig, v: int, k: int) -> np.ndarray:
        import cv2

        return _straight(rig.frames[v].gray(k).astype(np.float32), rig.cameras[v], self.K[v], cv2.INTER_LINEAR)

    def pose(self, v: int, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        R = self.cameras[v].w2c[:3, :3].T
        return np.ascontiguousarray(R), self.cameras[v].center, np.linalg.inv(self.K[v])


def grown(masks: UInt8[np.ndarray, "V h w"], by: int) -> UInt8[np.ndarray, "V h w"]:
    """Masks widened by half of ``by`` pixels on every side."""
    import cv2

    kernel = np.ones((by | 1, by | 1), np.uint8)
    return np.stack([cv2.dilate(mask, kernel) for mask in masks])


def together(images: Sequence[np.ndarray]) -> np.ndarray:
    """Images in one array; zeros beside and below those that are smaller than others."""
    sizes = [image.shape for image in images]
    if len(set(sizes)) == 1:
        return np.stack(images)
    out = np.zeros((len(images), *np.max(sizes, 0)), images[0].dtype)
    for one, image in zip(out, images, strict=True):
        one[: image.shape[0], : image.shape[1]] = image
    return out


def _straight(image: np.ndarray, camera: Camera, K: np.ndarray, how: int) -> np.ndarray:
    """The image without lens distortion."""
    if camera.distortion is None or not np.any(camera.distortion):
        return image
    import cv2

    size = (image.shape[1], image.shape[0])
    maps = _maps(camera.distortion.tobytes(), K.tobytes(), size)
    return cv2.remap(image, *maps, how)


@functools.lru_cache(64)
def _maps(distortion: bytes, K: bytes, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Where the pixels of an image without lens distortion lie in the distorted one."""
    import cv2

    lens, matrix = np.frombuffer(distortion), np.frombuffer(K).reshape(3, 3)
    # cv2's pixel centres lie at whole numbers, K's at halves
    shifted = matrix - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    return cv2.initUndistortRectifyMap(shifted, lens, None, shifted, size, cv2.CV_32FC1)


def _nearest(clock: np.ndarray, moments: np.ndarray, within: float, frames: np.ndarray) -> np.ndarray:
    """Of ``frames``, shown at the times of a clock, the nearest to each moment; -1 where none is near."""
    at = np.clip(np.searchsorted(clock, moments), 1, len(clock) - 1) if len(clock) > 1 else np.zeros(len(moments), int)
    if len(clock) > 1:
        at = np.where(moments - clock[at - 1] <= clock[at] - moments, at - 1, at)
    return np.where(np.abs(clock[at] - moments) <= within * (1 + 1e-6), frames[at], -1)
