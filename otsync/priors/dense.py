"""Dense depth maps without a depth sensor or learned weights: the stereo of tracked points at every mask pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..compute.threads import MapLike
from ..files.cache import Cache
from ..files.digest import content_key
from ..geometry import undistort
from .stereo import MADE_BY, Hull, HullStereo, Rig, Space
from .working import WorkingFrames


@dataclass(frozen=True)
class DenseStereo:
    """Depth of every mask pixel of chosen frames, 0 where it is not believed.

    What :class:`HullStereo` does at a track's point, with the map's own pixels as the sub-points whose correlations
    are added. A track's depth is then held against its running median over time; a map's is held against the median
    of its surroundings instead.

    Args:
        stereo: hull, sweep and correlation. width: of the maps, pixels; at most the rig's working width counts.
        reach: pixels of the map around a pixel whose correlations are added, a square of 2 reach + 1.
        around: pixels of the map around a pixel whose median its depth must not leave by more than the share ``jump``,
            and of which a share of at least ``company`` must be known.
    """

    stereo: HullStereo = field(default_factory=HullStereo)
    width: int = 320
    reach: int = 1
    around: int = 2
    jump: float = 0.03
    company: float = 0.3

    def __call__(
        self,
        rig: Rig,
        frames: Sequence[Sequence[int]],
        cache: Cache | None = None,
        key: tuple[Any, ...] = (),
        map: MapLike = map,
    ) -> list[Float[np.ndarray, "F h w"]]:
        """Maps of the chosen ``frames`` of every video, float32, along z in world units.

        A map has its image's field of view, lens distortion included, as given depth maps have. Frames that fewer
        than the hull's views see at their moment have empty maps. ``key``: what the pixels and masks are; without it
        nothing is kept.
        """
        store = cache if cache is not None and key else Cache()
        space = Space.of(self.stereo, rig)
        # the box of the hull, and with it where voxels lie, depends on all moments
        key = (*key, MADE_BY, self, content_key(rig.index))
        wanted: dict[int, list[tuple[int, int]]] = {}
        for v, chosen in enumerate(frames):
            for k in sorted(set(chosen)):
                s = self._moment(rig, v, k)
                if s is not None:
                    wanted.setdefault(s, []).append((v, k))

        def moment(item: tuple[int, list[tuple[int, int]]]) -> dict[str, np.ndarray]:
            s, views = item
            return store.arrays("dense", (*key, s, tuple(views)), lambda: self._moment_maps(rig, space, s, views))

        out = [np.zeros((len(f), *self.size(rig.frames[v])[::-1]), np.float32) for v, f in enumerate(frames)]
        for (_, views), maps in zip(wanted.items(), map(moment, wanted.items()), strict=True):
            for v, k in views:
                made = maps[f"depth{v}_{k}"]
                known = made > 0
                for place in np.flatnonzero(np.asarray(frames[v]) == k):
                    # zeros are not written: pages of a map that nobody wrote to take no memory
                    np.copyto(out[v][place], made, where=known)
        return out

    def size(self, frames: WorkingFrames) -> tuple[int, int]:
        """Width and height of a video's maps."""
        w, h = frames.size
        scale = min(1.0, self.width / w)
        return max(1, round(w * scale)), max(1, round(h * scale))

    def _moment(self, rig: Rig, v: int, k: int) -> int | None:
        """The row of the rig in which video v shows its frame k; None for one between two moments.

        At fractional offsets the first and last frames may lie beyond the grid, and of two frames that are equally
        near to a moment only one is shown.
        """
        if not 0 <= k < len(rig.frames[v]):
            raise ValueError(f"frames[{v}]: expected indices below {len(rig.frames[v])}; found {k}.")
        rows = np.flatnonzero(rig.index[:, v] == k)
        return int(rows[0]) if len(rows) else None

    def _moment_maps(self, rig: Rig, space: Space, s: int, views: list[tuple[int, int]]) -> dict[str, np.ndarray]:
        present = np.flatnonzero(rig.index[s] >= 0)
        out = {f"depth{v}_{k}": np.zeros(self.size(rig.frames[v])[::-1], np.float32) for v, k in views}
        if not self.stereo.enough(present):
            return out
        hull = space.hull(self.stereo, rig, s, present)
        near = {v: self.stereo.partners(space, present, v) for v, _ in views}
        seen = {u for v in near for u in (v, *near[v])}
        images = {u: space.image(rig, u, int(rig.index[s, u])) for u in sorted(seen)}
        for v, k in views:
            out[f"depth{v}_{k}"] = self._map(rig, space, hull, images, near[v], v, k)
        return out

    def _map(
        self, rig: Rig, space: Space, hull: Hull, images: dict[int, np.ndarray], near: list[int], v: int, k: int
    ) -> Float[np.ndarray, "h w"]:
        w, h = self.size(rig.frames[v])
        inside, uv = mask_pixels(np.asarray(rig.masks[v][k]), w, h)
        points = undistort(rig.cameras[v], uv / rig.frames[v].scale) * rig.frames[v].scale
        depth = self.stereo.depths(space, hull, images, near, v, k, points, neighbourhood(inside, self.reach))
        out = np.zeros((h, w), np.float32)
        out[inside] = depth
        return consistent(out, self.around, self.jump, self.company)


def mask_pixels(
    mask: Bool[np.ndarray, "H W"], w: int, h: int
) -> tuple[Bool[np.ndarray, "h w"], Float[np.ndarray, "N 2"]]:
    """Which pixels of a (h,w) map lie in ``mask``, and their centres in the mask's pixels (+0.5 convention)."""
    H, W = mask.shape
    x, y = (np.arange(w) + 0.5) * W / w, (np.arange(h) + 0.5) * H / h
    inside = mask[y.astype(int)[:, None], x.astype(int)[None]]
    row, column = np.nonzero(inside)
    return inside, np.stack([x[column], y[row]], 1)


def neighbourhood(inside: Bool[np.ndarray, "h w"], reach: int) -> Int[np.ndarray, "N S"]:
    """Per pixel of ``inside``, in row order, the numbers of the pixels around it; N where there is none.

    The pixel itself comes first.
    """
    count = int(inside.sum())
    number = np.full(np.array(inside.shape) + 2 * reach, count)
    middle = (slice(reach, reach + inside.shape[0]), slice(reach, reach + inside.shape[1]))
    number[middle][inside] = np.arange(count)
    row, column = np.nonzero(inside)
    steps = [(i, j) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)]
    steps.sort(key=lambda step: step != (0, 0))
    return np.stack([number[row + reach + i, column + reach + j] for i, j in steps], 1)


def consistent(depth: Float[np.ndarray, "h w"], around: int, jump: float, company: float) -> Float[np.ndarray, "h w"]:
    """``depth`` without values that leave the median of their surroundings, or have too few known ones around them."""
    known = depth > 0
    group = neighbourhood(known, around)
    values = np.append(depth[known], np.nan)[group]
    near = np.isfinite(values)
    ordered = np.sort(values, axis=1)
    middle = np.take_along_axis(ordered, (near.sum(1) // 2)[:, None], 1)[:, 0] if len(values) else np.zeros(0)
    good = (near.mean(1) >= company) & (np.abs(depth[known] - middle) <= jump * middle)
    out = np.zeros_like(depth)
    out[known] = np.where(good, depth[known], 0)
    return out
