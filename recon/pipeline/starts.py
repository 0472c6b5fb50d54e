"""The scene that a fit begins with, in one slot: on a scaffold, on splines of its tracks, or from images alone.

A fit for its own sake begins on a scaffold; ``recon bench`` measures the others beside it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from otsync.compute.threads import MapLike
from otsync.io import Scene
from otsync.progress import Progress
from otsync.recordings.stages import Stages
from otsync.types import Offsets, TrackSet
from recon.footage.depth import working_depth
from recon.footage.footage import Footage
from recon.motion import Motion, PerGaussian, TrackCurves, build_scaffold
from recon.pipeline.plan import Plan
from recon.pipeline.track_sets import of_every_video
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.hull import hull_scene
from recon.scene.seed import Bind, moments, seed, shown_at, to_scaffold


@dataclass(frozen=True, eq=False)
class Given:
    """What a scene is begun from: videos in one order, and how they are to be used.

    Args:
        scene, footage: of the training videos. offsets: of those, believed. gains: (V,3) factors of their colours.
        tracks: in space; none where a start reads none. cache, map, progress, stages: as of
            :func:`recon.pipeline.prepare`.
    """

    scene: Scene
    offsets: Offsets
    tracks: tuple[TrackSet, ...]
    footage: tuple[Footage, ...]
    gains: np.ndarray
    plan: Plan
    cache: Any
    map: MapLike
    progress: Progress
    stages: Stages = field(default_factory=Stages)

    @property
    def frame_step(self) -> float:
        """Seconds of one frame of the reference."""
        return 1.0 / float(self.offsets.fps[self.offsets.reference])

    @property
    def span(self) -> tuple[float, float]:
        """First and last world second of the videos."""
        worlds = [self.offsets.clock(v).world(f.times) for v, f in enumerate(self.footage)]
        return float(min(t[0] for t in worlds)), float(max(t[-1] for t in worlds))


class Start(ABC):
    """How the scene that a fit begins with is made: a frozen dataclass, which with its fields is a key of the cache."""

    reads_geometry: ClassVar[bool] = True
    """Whether it is given tracks and depth. Where it is not, the static part is made without them, too."""

    ignores: ClassVar[tuple[str, ...]] = ()
    """Options of a plan that it does not heed, as the shell spells them."""

    @abstractmethod
    def __call__(self, given: Given) -> Gaussians4D:
        """The moving part of the scene."""


@dataclass(frozen=True)
class OnScaffold(Start):
    """A scaffold through the tracks, and Gaussians seeded from depth that are bound to it."""

    def __call__(self, given: Given) -> Gaussians4D:
        footprint, tracks = world_footprint(given.tracks, given.footage), given.tracks
        motion = build_scaffold(
            of_every_video(tracks, given.offsets.names),
            given.offsets.seconds,
            footprint=footprint,
            frame_step=given.frame_step,
            options=given.plan.scaffold,
            rates=given.offsets.rates,
            seed=given.plan.fit.seed,
        )
        count = sum(len(t) for t in tracks)
        given.progress.tell(
            f"scaffold: {len(motion)} nodes of {count} tracks, a knot every {motion.path.spacing:.3f} s, "
            f"footprint {footprint:.4g}"
        )
        return _seeded(given, motion, footprint, to_scaffold)


@dataclass(frozen=True)
class OnTracks(Start):
    """Gaussians seeded from depth, each on a spline of its own that begins as that of a track near it; no scaffold.

    Of the options of a scaffold, those of a single curve hold: spline, spacing, margin, robust and smooth.acceleration.
    """

    ignores: ClassVar[tuple[str, ...]] = tuple(
        f"scaffold.{name}"
        for name in (
            *("unit", "second_pick", "fewest", "most", "per_video", "neighbours", "reach", "shortest", "blend"),
            *("smooth.velocity", "smooth.still"),
        )
    )

    def __call__(self, given: Given) -> Gaussians4D:
        footprint, offsets = world_footprint(given.tracks, given.footage), given.offsets
        tracks = of_every_video(given.tracks, offsets.names)
        options = given.plan.scaffold.spaced(tracks, footprint, offsets.rates)
        curves = TrackCurves.of(
            tracks,
            offsets.seconds,
            options.path(*given.span),
            robust=options.robust * footprint,
            acceleration=options.smooth.acceleration,
            rates=offsets.rates,
        )

        def joined(motion: PerGaussian, points: np.ndarray, t: float, video: int | None) -> PerGaussian:
            return motion.joined(PerGaussian.from_tracks(curves, points, t))

        given.progress.tell(f"splines of {len(curves)} tracks, footprint {footprint:.4g}")
        scene = _seeded(given, PerGaussian.at_rest(curves.path, 0), footprint, joined)
        assert isinstance(scene.motion, PerGaussian)
        return replace(scene, motion=scene.motion.tied(scene.dynamic.means, given.span[0]))


@dataclass(frozen=True)
class FromImages(Start):
    """Gaussians on the visual hull of the masks, each on a spline of its own that follows it; no tracks, no depth."""

    reads_geometry: ClassVar[bool] = False
    ignores: ClassVar[tuple[str, ...]] = (
        *OnTracks.ignores,
        *("scaffold.robust", "scaffold.smooth.acceleration", "seeding.support", "seeding.share", "seeding.reach"),
    )

    def __call__(self, given: Given) -> Gaussians4D:
        options = given.plan.scaffold
        return hull_scene(
            given.footage,
            given.offsets,
            frame_step=given.frame_step,
            span=given.span,
            path=options.path(*given.span),
            gains=given.gains,
            options=given.plan.seeding,
        )


def world_footprint(tracks: Sequence[TrackSet], footage: Sequence[Footage]) -> float:
    """World units that a working pixel covers at the median depth of what moves."""
    focal = {f.name: float(f.K[0, 0]) for f in footage}
    samples = []
    for t in tracks:
        if t.camera is None or t.name not in focal:
            continue
        z = t.camera.to_camera(t.positions())[..., 2]
        samples.append(z[np.isfinite(z) & (z > 0)] / focal[t.name])
    values = np.concatenate(samples) if samples else np.zeros(0)
    if not len(values):
        raise ValueError("tracks: expected tracks in space of the fitted videos, with their cameras; found none.")
    return float(np.median(values))


def without_depth(scene: Scene, stages: Stages) -> set[str]:
    """Names of videos that came without depth and for which none can be measured."""
    static = [v.name for v in scene.videos if v.camera.w2c.ndim == 2]
    measured = set(static) if len(static) >= stages.stereo.min_views else set()
    return {v.name for v in scene.videos if v.depth is None} - measured


def _seeded(given: Given, motion: Motion, footprint: float, bind: Bind) -> Gaussians4D:
    """The motion with Gaussians on what the depth maps show at some moments."""
    from otsync.recordings.dense_depth import depth_maps

    scene, offsets, footage, width = given.scene, given.offsets, given.footage, given.plan.width
    times = moments(given.span, given.frame_step)
    blind = without_depth(scene, given.stages)
    shown = zip(*(shown_at(footage, offsets, float(t), given.frame_step) for t in times), strict=True)
    wanted = [
        [] if v.name in blind else sorted({k for k in frames if k is not None})
        for v, frames in zip(scene.videos, shown, strict=True)
    ]
    maps = depth_maps(scene, offsets, wanted, width=width, stages=given.stages, cache=given.cache, map=given.map)
    depth = [
        working_depth(v, dict(zip(k, m, strict=True)).get, width=width)
        for v, k, m in zip(scene.videos, wanted, maps, strict=True)
    ]
    return seed(
        motion,
        footage,
        offsets,
        depth,
        footprint=footprint,
        frame_step=given.frame_step,
        span=given.span,
        times=times,
        gains=given.gains,
        options=given.plan.seeding,
        bind=bind,
    )
