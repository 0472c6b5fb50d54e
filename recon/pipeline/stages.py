"""Tracks in space, footage, backdrop and initial scene of a recording: each kept on disk, so that a run continues.

tracks, depth    otsync's own stages, shared with the synchronisation that came before
footage          frames at working size, masks, backgrounds
backdrop         static Gaussians behind what moves
initial scene    what moves as a fit begins with it: :mod:`.starts`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch

from otsync.compute.threads import MapLike
from otsync.files.digest import content_key
from otsync.io import Scene
from otsync.priors.masks import MedianBackground
from otsync.priors.slots import cache_key
from otsync.priors.stereo import EmptyHull, HullStereo, TrackDepth
from otsync.progress import Deadline, Progress
from otsync.recordings.stages import Stages
from otsync.types import Offsets, TrackSet, Video
from recon.backdrop.fit import StaticFit, fit_backdrop
from recon.features.tracks import FeatureMaps
from recon.footage.depth import working_depth
from recon.footage.footage import Footage, footage_of
from recon.observe.vignetting import Falloff, own_falloff
from recon.pipeline.feature_maps import key_of, with_features
from recon.pipeline.intake import only
from recon.pipeline.plan import Plan
from recon.pipeline.starts import Given, Start
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D, scene_arrays, scene_from_arrays

MANY: dict[str, Any] = {"count": 700, "min_life": 10, "apart": 4.0, "enough": 0}
"""Tracks for a scaffold: more and shorter ones than synchronisation asks for, since every limb must have some."""


EVERY = 2
"""Of so many moments stereo measures one for them: positions are smoothed over about three frames anyway. Half of what
depth of all moments takes."""

STAGES = Stages()
"""What tracks and masks are made by, where nothing else is asked for."""


class NoDepth(ValueError):
    """No track can be lifted into space: no depth is given, and none can be measured."""


def with_estimated(scene: Scene, stages: Stages, cache: Any, map: MapLike, progress: Progress) -> Scene:
    """The scene with estimated depth where an estimator is named (``stages.depth``), and a note on who has none."""
    if stages.depth is None:
        return scene
    from otsync.recordings.learned_depth import remedy, with_depth

    with progress.stage("depth"):
        found = with_depth(scene, stages, cache=cache, map=map, tell=progress.tell)
    lacking = {v.name: found.untied[v.name] for v in found.scene.videos if v.depth is None and v.name in found.untied}
    if lacking:
        progress.note(remedy(lacking))
    return found.scene


def sparse(stereo: TrackDepth) -> TrackDepth:
    """The slot's stereo at one moment of :data:`EVERY`, where it knows how and was not told another number."""
    return replace(stereo, every=EVERY) if isinstance(stereo, HullStereo) and stereo.every == 1 else stereo


def lifted_tracks(
    scene: Scene, offsets: Offsets, cache: Any, map: MapLike, progress: Progress, stages: Stages = STAGES
) -> tuple[TrackSet, ...]:
    """Tracks in space of every video that has some: by given depth, else by hull and stereo at the offsets.

    :class:`NoDepth` where no video has some.
    """
    from otsync.recordings import routes as recordings
    from otsync.recordings.tracking import Selection

    stages = replace(stages, selection=Selection(**MANY), stereo=sparse(stages.stereo))

    def keep(video: Video, tracked: dict[str, np.ndarray]) -> tuple[TrackSet | None, dict[str, np.ndarray] | None]:
        try:
            chosen = recordings.select(video, tracked, stages, scene.frame)
        except ValueError:
            return None, None
        return chosen, None if video.depth is None else tracked

    kept = recordings.track_all(scene, stages, cache, map, progress.tell, keep)
    flat, raw = [one for one, _ in kept], [one for _, one in kept]
    for video, tracks in zip(scene.videos, flat, strict=True):
        if tracks is None:
            progress.note(f"video {video.name}: nothing moves enough to be tracked; it only adds images")
    if not any(flat):
        raise ValueError(
            "scene: expected something that moves; found no track that lives and moves enough in any video. Check the "
            "masks, or choose a part of the recording with motion (--frames)."
        )
    out: list[TrackSet] = []
    for video, tracked in zip(scene.videos, raw, strict=True):
        if tracked is not None:
            part = scene.take([video.name])
            try:
                out += recordings.lift_given(part, [tracked], stages, cache)
            except ValueError as error:
                progress.note(str(error))
    bare = [v for v, video in enumerate(scene.videos) if video.depth is None and flat[v] is not None]
    if bare:
        lacking = recordings.lacks_stereo(scene, stages)
        if lacking and not out:
            raise NoDepth(
                f"depth: none was given for {', '.join(scene.videos[v].name for v in bare)}, and none can be measured: "
                f"{lacking}. Add depth maps to the scene, or more static cameras."
            )
        if lacking:
            progress.note(f"no tracks in space from {', '.join(scene.videos[v].name for v in bare)}: {lacking}")
        else:
            there = [v for v, t in enumerate(flat) if t is not None]
            part, sets = scene.take([scene.names[v] for v in there]), [t for t in flat if t is not None]
            try:
                depth = recordings.stereo_depth(part, sets, only(offsets, part.names), stages, cache, map)
            except EmptyHull as error:
                if not out:
                    raise NoDepth(str(error)) from None
                progress.note(f"no tracks in space from {', '.join(part.names)}: {error}")
            else:
                lifted = [stages.lift(t, z) for t, z in zip(sets, depth, strict=True)]
                out += [t for v, t in zip(there, lifted, strict=True) if v in bare and len(t)]
    if not out:
        raise NoDepth("depth: expected depth where things move; no track could be lifted. Check the depth or masks.")
    return tuple(out)


def read_footage(
    scene: Scene, width: int, cache: Any, map: MapLike, progress: Progress, stages: Stages = STAGES
) -> tuple[Footage, ...]:
    """Frames, masks and backgrounds of every video at working size."""
    tracking = stages.tracking
    measured = [v.name for v, m in zip(scene.videos, scene.masks, strict=True) if m is None]
    if measured and isinstance(tracking.masker, MedianBackground):
        progress.note(
            f"no masks given for {', '.join(measured)}: what differs from the median over time counts as moving, "
            "so shadows do, and what stands still for half of the clip does not. Masks of your own mend that"
        )

    def one(item: tuple[Video, Any]) -> Footage:
        video, given = item
        return footage_of(video, tracking.masks(video, given, cache), width=width, folder=cache.root)

    return tuple(map(one, list(zip(scene.videos, scene.masks, strict=True))))


def scene_key(scene: Scene, tracks: Sequence[TrackSet], stages: Stages = STAGES) -> tuple[Any, ...]:
    """What the pixels, masks, poses, depth maps and tracks are, for the cache."""
    tracking = stages.tracking
    rows: list[Any] = [(cache_key(tracking.masker), tracking.width)]
    for video, masks in zip(scene.videos, scene.masks, strict=True):
        c, depth = video.camera, "none"
        if video.depth is not None:
            own = getattr(video.depth, "digest", None)
            depth = (
                own() if own is not None else content_key(*[None if z is None else np.asarray(z) for z in video.depth])
            )
        lens = None if c.distortion is None else c.distortion
        rows.append(content_key(tracking.key(video, masks), depth, video.times, c.K, c.w2c, lens, c.width, c.height))
    return (*rows, *(replace(t, name="") for t in tracks))


def backdrop_of_scene(
    scene: Scene,
    tracks: Sequence[TrackSet],
    footage: Sequence[Footage],
    plan: Plan,
    cache: Any,
    progress: Progress,
    deadline: Deadline | None = None,
    stages: Stages = STAGES,
) -> StaticFit | None:
    """Static Gaussians fitted to what the cameras see behind the things that move, kept; None where nothing shows."""
    at_most = None if deadline is None else BACKDROP_SHARE * deadline.left
    given = own_falloff(plan.effects)

    def build() -> dict[str, np.ndarray]:
        lifted = [t.positions()[t.seen] for t in tracks]
        points = np.concatenate([p[:: max(1, len(p) // POINTS)] for p in lifted]) if lifted else None
        depth = [None if v.depth is None else working_depth(v, width=plan.width) for v in scene.videos]
        static = fit_backdrop(
            footage,
            depth=None if all(d is None for d in depth) else depth,
            points=points,
            falloff=given,
            steps=plan.backdrop_steps,
            at_most=at_most,
            seed=plan.fit.seed,
            device=plan.device,
        )
        if static.stats["steps"] < plan.backdrop_steps:
            progress.note(
                f"budget: the static part takes {static.stats['steps']:.0f} steps in place of {plan.backdrop_steps}"
            )
        parts = {n: getattr(static.gaussians, n).numpy() for n in GAUSSIAN}
        return {
            **parts,
            "gains": static.gains,
            "falloff": np.array(static.falloff),
            "near": np.array(static.near),
            "psnr": static.psnr,
        }

    key = (*scene_key(scene, tracks, stages), plan.width, plan.backdrop_steps, plan.fit.seed)
    if plan.device != "cpu":  # rounds otherwise
        key = (*key, plan.device)
    if deadline is not None:
        key = (*key, "budget", deadline.seconds)
    try:
        kept = cache.arrays("backdrop", (*key, "falloff", given), build)
    except ValueError as error:
        progress.note(f"no static part: {error}")
        return None
    gaussians = Gaussians(*(torch.from_numpy(np.array(kept[n])) for n in GAUSSIAN))
    progress.tell(f"backdrop: {len(gaussians)} Gaussians, {np.nanmean(kept['psnr']):.2f} dB")
    falloff = Falloff(*kept["falloff"].tolist())
    if any(falloff):
        progress.tell(f"backdrop: corners of images are {100 * (1 - falloff.corner):.0f} % darker than their middle")
    return StaticFit(gaussians, kept["gains"], float(kept["near"]), kept["psnr"], falloff=falloff)


BACKDROP_SHARE = 0.25
"""Of the time that a budget leaves, for the static part at most."""

POINTS = 2000
"""Positions of what moves, per video, that the backdrop takes its scale from."""

GAUSSIAN = tuple(f.name for f in fields(Gaussians))


def featured(given: Given, initial: Gaussians4D, footage: Sequence[Footage], maps: FeatureMaps) -> Gaussians4D:
    """The scene with features lifted from all videos; kept."""
    offsets = given.offsets
    clocks = (np.round(offsets.seconds, 6).tolist(), np.round(offsets.rates, 9).tolist(), offsets.reference)
    moving = replace(initial, static=None)
    key = (*scene_key(given.scene, (), given.stages), clocks, given.plan.width, key_of(maps))
    key = (*key, content_key(*scene_arrays(moving).values()))

    def build() -> dict[str, np.ndarray]:
        features = with_features(moving, footage, offsets, maps).features
        assert features is not None
        return {"features": np.array(features.numpy(), order="C")}

    kept = torch.from_numpy(np.array(given.cache.arrays("features", key, build)["features"]))
    given.progress.tell(f"features: {kept.shape[1]} channels of {int((kept != 0).any(1).sum())} Gaussians")
    return replace(initial, features=kept)


def initial_scene(given: Given, static: StaticFit | None, start: Start) -> Gaussians4D:
    """The scene before any refinement, as ``start`` begins it; kept."""
    offsets, plan = given.offsets, given.plan
    clocks = (np.round(offsets.seconds, 6).tolist(), np.round(offsets.rates, 9).tolist(), offsets.reference)
    key = (*scene_key(given.scene, given.tracks, given.stages), clocks, given.gains.tolist())
    key = (*key, plan.width, plan.scaffold, plan.seeding, plan.fit.seed, start)

    def build() -> dict[str, np.ndarray]:
        # in the layout that a file gives back: sums over another one differ in their last bits
        return {k: np.array(v, order="C") for k, v in scene_arrays(start(given)).items()}

    initial = scene_from_arrays(given.cache.arrays("initial", key, build))
    given.progress.tell(f"initial scene: {len(initial)} moving Gaussians")
    if static is None:
        return initial
    return replace(initial, static=static.gaussians, near=static.near)
