"""The paper's first stage in a run: dense 4D feature tracks of every video alone, matched in place of sparse ones.

Every video is fitted by itself on its own clock, with the depth that it came with, or that stereo measures at the
offsets found so far. Maps of features are lifted into its Gaussians, and their trajectories are tracks like any other
(:mod:`recon.features.tracks`): they are synchronised by the method of lifted tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from otsync.compute.threads import MapLike
from otsync.files.digest import content_key
from otsync.geometry import seen_pixels
from otsync.io import Scene
from otsync.progress import Progress
from otsync.recordings.dense_depth import depth_maps
from otsync.recordings.placement import misplaced, with_doubts
from otsync.recordings.routes import inheriting, pairs_in_space, without_times
from otsync.recordings.stages import Stages
from otsync.recordings.synchronized import Synchronized
from otsync.recordings.tracking import Selection
from otsync.types import Offsets, TrackSet, Video
from recon.features.tracks import Alone, FeatureMaps, feature_tracks, own_clock
from recon.footage.depth import working_depth
from recon.footage.footage import Footage
from recon.pipeline.feature_maps import key_of
from recon.pipeline.stages import lifted_tracks, read_footage, scene_key, with_estimated
from recon.scene.seed import moments, shown_at

APART = (16.0, 12.0, 8.0, 6.0, 4.0)
"""Pixels at 640 of width between tracks, in turn: the first that leaves as many as the selection asks for."""


class NoDenseTracks(ValueError):
    """A video has no dense tracks: nothing of it can be lifted, or nothing lives and moves enough."""


def dense_tracks(
    scene: Scene,
    offsets: Offsets,
    maps: FeatureMaps,
    *,
    width: int,
    options: Alone | None = None,
    stages: Stages | None = None,
    cache: Any = None,
    map: MapLike = map,
    progress: Progress | None = None,
) -> list[TrackSet]:
    """Dense 4D feature tracks of every video, each on its own clock; kept.

    Args:
        offsets: of the videos in their order. They only say where stereo looks for depth: videos that came with depth
            do not heed them.
        maps: the extractor. width: working pixels of an image's width.
        options: how each video is fitted; its steps, and which Gaussians count as seen.

    Raises:
        NoDepth: no video has depth. NoDenseTracks: names those that lack it.
    """
    from otsync.files.cache import Cache

    options, stages = options or Alone(), stages or Stages()
    cache, progress = cache or Cache(), progress or Progress()
    scene = with_estimated(scene, stages, cache, map, progress)
    with progress.stage("tracks of every video"):
        sparse = {t.name: t for t in lifted_tracks(scene, offsets, cache, map, progress, stages)}
    lacking = [n for n in scene.names if n not in sparse]
    if lacking:
        raise NoDenseTracks(
            f"--features: expected tracks in space of every video; {', '.join(lacking)} have none. Add depth maps, or "
            "leave these videos out (--recording.cameras)."
        )
    with progress.stage("footage of every video"):
        footage = read_footage(scene, width, cache, map, progress, stages)
    depth = _depth(scene, offsets, footage, width, stages, cache, map)

    def one(item: tuple[int, Video]) -> TrackSet:
        v, video = item
        flow = sparse[video.name]
        part = scene.take([video.name])
        # depth by stereo is made at the offsets, so they are part of what the tracks are
        at = () if video.depth is not None else (np.round(offsets.seconds, 6).tolist(), offsets.reference)
        key = (*scene_key(part, [flow], stages), at, width, key_of(maps), content_key(repr(options)))

        def build() -> dict[str, np.ndarray]:
            found = feature_tracks(footage[v], flow, depth[v], maps, options=options)
            assert found.features is not None
            return {"xyz": found.positions(), "seen": found.seen, "features": found.features}

        kept = cache.arrays("dense-tracks", key, build)
        camera = replace(footage[v].camera, readout=None)
        xyz = np.where(kept["seen"][..., None], kept["xyz"], np.nan)
        tracks = TrackSet(
            kept["xyz"],
            kept["seen"],
            kept["features"],
            flow.fps,
            flow.timestamps,
            flow.name,
            camera.project(xyz),
            camera=camera,
            frame=flow.frame,
        )
        progress.tell(f"dense tracks of {video.name}: {len(tracks)}")
        return tracks

    with progress.stage("dense tracks"):
        return list(map(one, list(enumerate(scene.videos))))


def synchronized_by_features(
    scene: Scene,
    coarse: Synchronized,
    maps: FeatureMaps,
    *,
    width: int,
    reference: int | Literal["auto"] = 0,
    options: Alone | None = None,
    stages: Stages | None = None,
    cache: Any = None,
    map: MapLike = map,
    progress: Progress | None = None,
) -> Synchronized:
    """The answer of dense feature tracks, by the method of lifted tracks (``stages.space``).

    Args:
        coarse: an answer of the same videos. Depth by stereo is measured at the offsets from pixels that it went on
            from, whatever the method made of them: so an ablation of methods compares answers to the same tracks. The
            rest is as of :func:`dense_tracks`.

    The doubts about cameras hold here, too, and errors of offsets that depth was measured at count in sigma.
    """
    from otsync.files.cache import Cache

    stages, cache, progress = stages or Stages(), cache or Cache(), progress or Progress()
    scene = with_estimated(scene, stages, cache, map, progress)
    flat = [v.name for v in scene.videos if v.depth is None]
    if flat and coarse.route == "epipolar":
        raise NoDenseTracks(
            f"--features: expected depth of every video; {', '.join(flat)} have none, and none can be measured at the "
            f"offsets from pixels ({coarse.why[-1]}). Add depth maps, or more cameras."
        )
    at = coarse.offsets if coarse.first is None else coarse.first
    doubtful = set(scene.doubtful) | (misplaced(at) if flat else set())
    dense = dense_tracks(
        scene,
        at,
        maps,
        width=width,
        options=options,
        stages=stages,
        cache=cache,
        map=map,
        progress=progress,
    )
    chosen = [thinned(t, stages.selection) for t in dense]
    with progress.stage("synchronise dense tracks"):
        offsets = with_doubts(without_times(pairs_in_space(chosen, reference, stages, cache, map)), doubtful)
    offsets = inheriting(offsets, at) if flat else offsets
    why = (
        *coarse.why,
        f"dense feature tracks of every video, {min(map(len, chosen))} and more, in place of sparse ones",
    )
    return Synchronized(
        offsets, tuple(chosen), f"{coarse.route}, dense features", why, coarse.offsets, progress.seconds
    )


def thinned(tracks: TrackSet, selection: Selection) -> TrackSet:
    """As many tracks as the selection asks for, long-lived ones first, spread over the image."""
    assert tracks.camera is not None
    # Gaussians come in the order of their places: which of equals is taken is left to chance
    mixed = tracks.take(np.random.default_rng(0).permutation(len(tracks)))
    chosen = mixed
    for apart in APART:
        kept = replace(selection, apart=apart, enough=0)(seen_pixels(mixed), tracks.camera.width, tracks.fps or 30.0)
        chosen = mixed.take(kept)
        if len(chosen) >= selection.count:
            break
    if len(chosen) == 0:
        raise NoDenseTracks(
            f"video {tracks.name}: expected dense tracks that live and move enough; found none of {len(tracks)}. Lower "
            "the limits (--recording.selection), or leave out --features."
        )
    return chosen


def _depth(
    scene: Scene,
    offsets: Offsets,
    footage: Sequence[Footage],
    width: int,
    stages: Stages,
    cache: Any,
    map: MapLike,
) -> list[Any]:
    """Depth of every video by frame: as it came, else by stereo at the moments that Gaussians are seeded at."""
    wanted = []
    for video, one in zip(scene.videos, footage, strict=True):
        own = own_clock(one)
        step = 1 / float(own.fps[0])
        times = moments((float(one.times[0]), float(one.times[-1])), step)
        shown = {shown_at([one], own, float(t), step)[0] for t in times}
        wanted.append([] if video.depth is not None else sorted(k for k in shown if k is not None))
    measured: list[Any] = [()] * len(wanted)
    if any(wanted):
        measured = depth_maps(scene, offsets, wanted, width=width, stages=stages, cache=cache, map=map)
    return [
        working_depth(video, None if video.depth is not None else dict(zip(k, z, strict=True)).get, width=width)
        for video, k, z in zip(scene.videos, wanted, measured, strict=True)
    ]
