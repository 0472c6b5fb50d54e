"""Depth of tracked points without a depth sensor or learned weights: visual hull, then stereo behind its surface.

Needs a rig that is synchronised, or aligned already: the hull intersects masks of one moment.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from ..compute.threads import MapLike
from ..files.cache import Cache
from ..files.digest import content_key
from ..geometry import common_target
from ..types import Camera, Video
from ..types.checks import check_whole
from .working import WorkingFrames

WIDE = 1.0
"""Focal length in widths of the image up to which lengths are given; of a longer one they shrink, so that a voxel stays
as large in the image."""


class EmptyHull(ValueError):
    """No place in space is foreground in enough views."""


@dataclass(frozen=True, eq=False)
class Rig:
    """What stereo needs of all videos: pixels and masks at one working size, and which frames belong together.

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
    ) -> Rig:
        """Frames that show the same moment under ``offsets`` (seconds) and ``rates``, on the fastest video's beat."""
        frames = tuple(WorkingFrames(v.frames, (v.camera.width, v.camera.height), width) for v in videos)
        rates = np.ones(len(videos)) if rates is None else rates
        clocks = [r * v.times + o for v, o, r in zip(videos, offsets, rates, strict=True)]
        fps = max(v.fps or 30.0 for v in videos)
        start, stop = min(c[0] for c in clocks), max(c[-1] for c in clocks)
        # the grid runs through the first video's own frames: whole-frame offsets meet exactly
        first = clocks[0][0]
        moments = first + np.arange(np.ceil((start - first) * fps - 1e-6), (stop - first) * fps + 1e-6) / fps
        index = np.stack([_nearest(c, moments, 0.5 / fps) for c in clocks], 1)
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

    Measured with 27 views: cross-camera median difference .59 %, p90 3.5 %. Lengths are in metres for cameras
    about 3.3 m from the scene and scale with that distance, so that no unit is assumed, and with the part of the scene
    that a long lens shows; pixels at 640 of width.

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
        key = (*key, self, content_key(rig.index, *uv))

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
        self, space: Space, hull: np.ndarray, images: dict[int, np.ndarray], v: int, points: np.ndarray, k: int
    ) -> Float[np.ndarray, " N"]:
        around = self.spread * np.array(
            [(0, 0), (-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)], float
        )
        sub = (points[:, None] + around[None]).reshape(-1, 2)
        start, scores = self.scores(space, hull, images, self.partners(space, np.array(list(images)), v), v, k, sub)
        shape = (len(points), len(around))
        return self.choose(space, start.reshape(shape), scores.reshape(*shape, -1))

    def enough(self, present: Int[np.ndarray, " P"]) -> bool:
        """Whether the videos that show a moment suffice for a hull and a correlation."""
        return len(present) >= max(3, self.min_views - self.misses)

    def partners(self, space: Space, present: Int[np.ndarray, " P"], v: int) -> list[int]:
        """The views that v is compared with, nearest by angle."""
        here = set(present.tolist())
        return [u for u in space.order[v] if u in here][: self.neighbours]

    def scores(
        self,
        space: Space,
        hull: np.ndarray,
        images: dict[int, np.ndarray],
        near: Sequence[int],
        v: int,
        k: int,
        points: Float[np.ndarray, "N 2"],
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N D"]]:
        """Depth at which each point's ray enters the hull, 0 never, and the correlations over the sweep behind it."""
        from .kernels_stereo import first_hit, sweep

        R, center, inverse_K = space.pose(v, k)
        unit = space.unit
        rays = np.concatenate([points, np.ones((len(points), 1))], 1) @ inverse_K.T @ R.T
        start = first_hit(
            hull, space.low, self.voxel * unit, center, rays, 0.4 * self.voxel * unit, space.near, space.far
        )
        depths = unit * np.arange(self.sweep[0], self.sweep[1] + 1e-9, self.step)
        if len(near) < 2:
            return np.zeros(len(points)), np.full((len(points), len(depths)), -1.0)
        scores = sweep(
            points,
            start,
            depths,
            images[v],
            np.stack([images[u] for u in near]),
            space.P[near],
            R,
            center,
            inverse_K,
            self.patch,
            4.0,
        )
        return start, scores

    def choose(
        self, space: Space, start: Float[np.ndarray, "N S"], scores: Float[np.ndarray, "N S D"]
    ) -> Float[np.ndarray, " N"]:
        """Depth by the summed correlations of a point and those around it, 0 where they are not believed."""
        from .kernels_stereo import choose_depth

        unit = space.unit
        depth, quality = choose_depth(scores, start, self.sweep[0] * unit, self.step * unit, 0.05 * unit, 0.6 / unit)
        return np.where(quality > self.least, depth, 0.0).astype(np.float32)


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
class Space:
    """The box that the hull is carved from, and the cameras at working resolution."""

    P: Float[np.ndarray, "V 3 4"]
    K: Float[np.ndarray, "V 3 3"]
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
        box = cls(P, K, rig.cameras, order, unit, low, dims, near, far)
        # where anything is ever occupied, from a few moments
        full = np.flatnonzero((rig.index >= 0).sum(1) >= stereo.min_views)
        occupied = []
        for s in full[:: max(1, len(full) // 12)]:
            present = np.flatnonzero(rig.index[s] >= 0)
            masks = box.masks(rig, int(s), present, round(coarse / unit * 160))
            grid = carve(masks, masks, P[present], low, coarse, dims, 4, stereo.min_views, stereo.misses, near)
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
        return cls(P, K, rig.cameras, order, unit, start, fine, near, far)

    def masks(self, rig: Rig, s: int, present: np.ndarray, grow: int) -> np.ndarray:
        import cv2

        kernel = np.ones((grow | 1, grow | 1), np.uint8)
        out = []
        for v in present:
            mask = rig.masks[int(v)][int(rig.index[s, v])].astype(np.uint8)
            mask = _straight(mask, rig.cameras[int(v)], self.K[v], cv2.INTER_NEAREST)
            out.append(cv2.dilate(mask, kernel) if grow > 1 else mask)
        return np.stack(out)

    def hull(self, stereo: HullStereo, rig: Rig, s: int, present: np.ndarray) -> np.ndarray:
        from .kernels_stereo import carve

        block = 4
        masks = self.masks(rig, s, present, 1)
        coarse = self.masks(rig, s, present, round(block * stereo.voxel * 160))
        return carve(
            masks,
            coarse,
            self.P[present],
            self.low,
            stereo.voxel * self.unit,
            self.dims,
            block,
            stereo.min_views,
            stereo.misses,
            self.near,
        )

    def image(self, rig: Rig, v: int, k: int) -> np.ndarray:
        import cv2

        return _straight(rig.frames[v].gray(k).astype(np.float32), rig.cameras[v], self.K[v], cv2.INTER_LINEAR)

    def pose(self, v: int, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        R = self.cameras[v].w2c[:3, :3].T
        return np.ascontiguousarray(R), self.cameras[v].center, np.linalg.inv(self.K[v])


def _straight(image: np.ndarray, camera: Camera, K: np.ndarray, how: int) -> np.ndarray:
    """The image without lens distortion."""
    if camera.distortion is None or not np.any(camera.distortion):
        return image
    import cv2

    h, w = image.shape
    # cv2's pixel centres lie at whole numbers, K's at halves
    shifted = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    maps = cv2.initUndistortRectifyMap(shifted, camera.distortion, None, shifted, (w, h), cv2.CV_32FC1)
    return cv2.remap(image, *maps, how)


def _nearest(clock: np.ndarray, moments: np.ndarray, within: float) -> np.ndarray:
    at = np.clip(np.searchsorted(clock, moments), 1, len(clock) - 1) if len(clock) > 1 else np.zeros(len(moments), int)
    if len(clock) > 1:
        at = np.where(moments - clock[at - 1] <= clock[at] - moments, at - 1, at)
    return np.where(np.abs(clock[at] - moments) <= within * (1 + 1e-6), at, -1)
