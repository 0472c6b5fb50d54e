"""Estimated depth of the videos of a scene, in world units: it then serves as depth that came with the recording.

An estimator (:class:`otsync.priors.slots.DepthEstimator`) tells depth up to a scale, most also up to a shift. Both are
tied to the known poses by points of the background that cameras share (:mod:`otsync.recordings.static_points`). What
moves in front of it keeps the background's scale and shift.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ..compute.threads import MapLike
from ..files.cache import Cache
from ..files.digest import content_key
from ..geometry import distort
from ..io.frames import FrameRange, LazyFrames
from ..io.scene import Scene
from ..priors.depth_scale import Untied, depth_of, tie_moving, tie_static
from ..priors.slots import DepthEstimator, cache_key
from ..priors.working import WorkingFrames, bilinear
from ..progress import Tell
from ..types import Camera, Video
from .stages import Stages
from .static_points import Points, static_points

TOGETHER = 16
"""Frames whose maps are made and kept at once, of estimators that do not say how many they look at together."""

KEPT = 2
"""Such groups that stay in memory: 13 MB each at 518 x 392."""

FARTHEST = 4.0
"""Times the depth of the farthest point that agrees: beyond, inverse depth is all noise."""

GRID = 48
"""Pixels of the background along the longer side, by which a static camera's frames are brought to each other."""

MOST_POINTS = 3000
"""Of a video, those whose depth is surest."""


class RawMaps(Sequence[np.ndarray]):
    """What an estimator says of every frame, made when it is asked for and kept on disk, in 16-bit numbers.

    ``make(first, stop)`` gives the maps of these frames.
    """

    def __init__(
        self, frames: WorkingFrames, camera: Camera, prior: DepthEstimator, key: tuple[Any, ...], cache: Cache
    ):
        self.frames, self.camera, self.prior, self.cache = frames, camera, prior, cache
        self.together = int(getattr(prior, "together", TOGETHER))
        self.key = (*key, self.together)
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, k: int) -> Float[np.ndarray, "h w"]:  # type: ignore[override]
        group, within = divmod(k, self.together)
        if group not in self._kept:
            stored = self.cache.arrays("depth-maps", (*self.key, group), lambda: self._made(group))
            self._kept[group] = stored["maps"].astype(np.float32) * stored["unit"][:, None, None]
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        return self._kept[group][within]

    def _made(self, group: int) -> dict[str, np.ndarray]:
        which = range(group * self.together, min((group + 1) * self.together, len(self)))
        cameras = [pose_at(self.camera, k, self.frames.size) for k in which]
        maps = np.asarray(self.prior([self.frames[k] for k in which], cameras), np.float32)
        # halves tell .05 %, far less than an estimator errs; a unit a map keeps them in range
        unit = np.nanmax(np.where(np.isfinite(maps), np.abs(maps), 0), axis=(1, 2))
        unit = np.where(unit > 0, unit, 1).astype(np.float32)
        return {"maps": (maps / unit[:, None, None]).astype(np.float16), "unit": unit}


class TiedMaps(LazyFrames):
    """Depth along z of every frame, world units, 0 unknown, as a recording brings it.

    affine: (T,2) scale and shift of inverse depth a frame. told: how it was tied, in words.
    """

    def __init__(self, raw: RawMaps, affine: Float[np.ndarray, "T 2"], farthest: float, told: str, prior: Any):
        self.raw, self.affine, self.farthest, self.told, self.prior = raw, affine, farthest, told, prior

    def __len__(self) -> int:
        return len(self.raw)

    def frame(self, k: int) -> Float[np.ndarray, "h w"]:
        scale, shift = (float(x) for x in self.affine[k])
        return depth_of(self.raw[k], scale, shift, gives=self.raw.prior.gives, farthest=self.farthest)

    def digest(self) -> str:
        """What the maps are, without making them."""
        return content_key(self.raw.key, self.affine, self.farthest)


@dataclass(frozen=True, eq=False)
class Estimated:
    """A scene with estimated depth. untied: why a video has none, by name. notes: how each was tied, in words."""

    scene: Scene
    untied: dict[str, str]
    notes: tuple[str, ...]


def with_depth(
    scene: Scene,
    stages: Stages,
    *,
    cache: Cache | None = None,
    map: MapLike = map,
    tell: Tell = lambda text: None,
) -> Estimated:
    """The scene with depth by the estimator that ``stages.depth`` names; as it is where none is named.

    Estimated depth goes before depth that came along. A video that too few points tie keeps what it came with;
    ``untied`` says why. A scene whose depth is estimated so already comes back as it is.
    """
    prior, cache = stages.depth, cache or Cache()
    if prior is None or all(_is_from(video, prior) for video in scene.videos):
        return Estimated(scene, {}, ())
    weights = cache_key(prior)  # first: what is missing is said before anything is computed
    masks = list(map(lambda n: stages.tracking.masks(scene.videos[n], scene.masks[n], cache), range(len(scene.videos))))
    points = _points(scene, masks, stages, cache, map)
    videos, untied, notes = [], {}, []
    for n, video in enumerate(scene.videos):  # one after the other: an estimator uses all there is
        frames = WorkingFrames(video.frames, (video.camera.width, video.camera.height), stages.tracking.width)
        key = (stages.tracking.key(video, scene.masks[n]), stages.tracking.width, weights)
        raw = RawMaps(frames, video.camera, prior, key, cache)
        try:
            depth = tied(raw, video, masks[n], points[n], stages, cache)
        except Untied as error:
            kept = "depth that came along is used" if video.depth is not None else "it has no depth"
            untied[video.name] = f"{error}"
            notes.append(f"depth of {video.name} is not tied to the poses: {error}; {kept}")
            videos.append(video)
        else:
            notes.append(f"depth {n + 1}/{len(scene.videos)}: {video.name}, {depth.told}")
            videos.append(replace(video, depth=depth))
        tell(notes[-1])
    return Estimated(replace(scene, videos=tuple(videos)), untied, tuple(notes))


def remedy(untied: dict[str, str]) -> str:
    """What to do about videos that no points tie, in a sentence."""
    names = ", ".join(f"{name} ({why})" for name, why in untied.items())
    return (
        f"estimated depth of {names} is not tied to the poses: expected points of the background that two cameras "
        "with known poses see. Check the poses (otsync check), add a camera near it or a metric estimator, or leave "
        "--recording.depth out"
    )


def _is_from(video: Video, prior: DepthEstimator) -> bool:
    depth = video.depth
    while isinstance(depth, FrameRange):  # a part of it
        depth = depth.base
    return isinstance(depth, TiedMaps) and cache_key(depth.prior) == cache_key(prior)


def pose_at(camera: Camera, k: int, size: tuple[int, int]) -> Camera:
    """A camera with the pose of frame k, for images of a size (width, height)."""
    scale = np.array([size[0] / camera.width, size[1] / camera.height, 1.0])
    w2c = camera.w2c if camera.w2c.ndim == 2 else camera.w2c[k]
    return replace(camera, K=camera.K * scale[:, None], w2c=w2c, width=size[0], height=size[1])


def _points(
    scene: Scene, masks: Sequence[Sequence[np.ndarray]], stages: Stages, cache: Cache, map: MapLike
) -> list[Points]:
    """Points of the background of every video, kept on disk."""
    pixels = [stages.tracking.key(v, m) for v, m in zip(scene.videos, scene.masks, strict=True)]
    lenses = [(v.camera.K, v.camera.w2c, v.camera.distortion) for v in scene.videos]
    key = (pixels, content_key(lenses), cache_key(stages.tracking.masker), stages.tracking.width)

    def compute() -> dict[str, np.ndarray]:
        found = static_points(scene.videos, masks, stages.tracking.width, map)
        out: dict[str, np.ndarray] = {}
        for n, p in enumerate(found):
            best = np.sort(np.argsort(p.sigma, kind="stable")[:MOST_POINTS])
            out |= {f"{name}{n}": getattr(p, name)[best] for name in ("xyz", "uv", "frame", "sigma")}
        return out

    arrays = cache.arrays("static-points", key, compute)
    return [Points(*(arrays[f"{name}{n}"] for name in ("xyz", "uv", "frame", "sigma"))) for n in range(len(pixels))]


def tied(
    raw: RawMaps, video: Video, masks: Sequence[np.ndarray], points: Points, stages: Stages, cache: Cache
) -> TiedMaps:
    """The maps of one video with the scale and shift of its points. :class:`Untied` says why they do not tell it."""
    least = stages.depth_limits.least
    if len(points) < least:  # before a model looks at a single frame
        raise Untied(f"{len(points)} points of the background are shared with other views, fewer than {least}")
    solve = _static if video.camera.w2c.ndim == 2 else _moving
    key = (raw.key, content_key(points.xyz, points.uv, points.sigma), stages.depth_limits, video.camera.w2c)

    def compute() -> dict[str, np.ndarray]:
        try:
            return solve(raw, video.camera, masks, points, stages)
        except Untied as error:  # kept too: it takes as long to find out
            return {"why": np.array(str(error))}

    found = cache.arrays("depth-ties", key, compute)
    if "why" in found:
        raise Untied(str(found["why"]))
    agree, error, farthest = int(found["agree"]), float(found["error"]), float(found["farthest"])
    told = f"{agree} of {len(points)} points of the background agree to {error:.1%}"
    return TiedMaps(raw, found["affine"], FARTHEST * farthest, told, stages.depth)


def _static(
    raw: RawMaps, camera: Camera, masks: Sequence[np.ndarray], points: Points, stages: Stages
) -> dict[str, np.ndarray]:
    z = camera.to_camera(points.xyz[:, None])[:, 0, 2]
    places = np.concatenate([raw.frames.from_full(points.uv), _grid(raw.frames.size)])
    seen = _sampled(
        raw, masks, lambda k: places
    )  # in one pass: without a cache maps are made as often as they are read
    at, behind = np.split(seen, [len(points)], axis=1)
    affine, line = tie_static(at, behind, z, points.sigma, gives=raw.prior.gives, limits=stages.depth_limits)
    return _told(affine, line.agree, line.error, float(z[line.agree].max()))


def _moving(
    raw: RawMaps, camera: Camera, masks: Sequence[np.ndarray], points: Points, stages: Stages
) -> dict[str, np.ndarray]:
    xyz = np.repeat(points.xyz[:, None], len(raw), 1)
    z = camera.to_camera(xyz)[..., 2].T
    uv = raw.frames.from_full(distort(camera, camera.project(xyz))).transpose(1, 0, 2)
    at = _sampled(raw, masks, lambda k: uv[k])
    affine, line = tie_moving(at, z, points.sigma, gives=raw.prior.gives, limits=stages.depth_limits)
    return _told(affine, line.agree, line.error, float(np.where(np.isfinite(at), z, 0)[:, line.agree].max()))


def _told(
    affine: Float[np.ndarray, "T 2"], agree: Bool[np.ndarray, " M"], error: float, farthest: float
) -> dict[str, np.ndarray]:
    return {
        "affine": affine,
        "agree": np.array(agree.sum()),
        "error": np.array(error),
        "farthest": np.array(farthest),
    }


def _grid(size: tuple[int, int]) -> Float[np.ndarray, "G 2"]:
    """Working pixel indices, evenly over the image."""
    step = max(1.0, max(size) / GRID)
    x, y = (np.arange(step / 2, n, step) - 0.5 for n in size)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def _sampled(
    raw: RawMaps, masks: Sequence[np.ndarray], places: Callable[[int], Float[np.ndarray, "N 2"]]
) -> Float[np.ndarray, "T N"]:
    """The estimator's values at working pixels of every frame; nan where something moves, or outside the image."""
    width, height = raw.frames.size
    out = []
    for k in range(len(raw)):
        uv = places(k)
        inside = np.isfinite(uv).all(1)
        inside &= (np.where(inside[:, None], uv, -1) >= 0).all(1)
        inside &= (np.where(inside[:, None], uv, 0) <= [width - 1, height - 1]).all(1)
        at, mask, values = np.where(inside[:, None], uv, 0), np.asarray(masks[k]), raw[k]
        x, y = np.round(at).astype(int).T
        free = inside & ~mask[np.minimum(y, mask.shape[0] - 1), np.minimum(x, mask.shape[1] - 1)]
        shrink = np.array([values.shape[1] / width, values.shape[0] / height])
        d = bilinear(values, (at + 0.5) * shrink - 0.5).astype(float)
        out.append(np.where(free & np.isfinite(d), d, np.nan))
    return np.stack(out)
