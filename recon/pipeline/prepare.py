"""From a recording and its offsets to all that a fit begins with: who takes part, then every stage, kept on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from otsync.clocks.shutter import at_frame_times
from otsync.compute.threads import MapLike
from otsync.io import Scene
from otsync.io.mend import cut, on_mended_clocks
from otsync.progress import Deadline, Progress
from otsync.recordings.stages import Stages
from otsync.sync.mend.breaks import mended
from otsync.types import Clock, Offsets, TrackSet
from recon.backdrop.fit import StaticFit, with_backdrop
from recon.footage.bends import bent, bent_tracks, chosen_bends, motion_of, wave
from recon.footage.footage import Footage
from recon.observe.effects import Effect
from recon.observe.recorded import check_effects
from recon.observe.vignetting import Falloff, Vignetting, own_falloff
from recon.pipeline.feature_maps import maps_from
from recon.pipeline.intake import readable, split
from recon.pipeline.plan import Plan
from recon.pipeline.readings import read_by, with_readings
from recon.pipeline.stages import (
    NoDepth,
    backdrop_of_scene,
    featured,
    initial_scene,
    lifted_tracks,
    read_footage,
    with_estimated,
)
from recon.pipeline.starts import FromImages, Given, OnScaffold, Start
from recon.pipeline.track_sets import tracks_of
from recon.scene.gaussians4d import Gaussians4D


@dataclass(frozen=True, eq=False)
class Prepared:
    """A recording, ready to be fitted.

    Args:
        footage: of the training videos, in the order of ``offsets``. held_out: of the others.
        clocks: of the held-out videos, where the given offsets tell.
        offsets: of the training videos alone. tracks: that the scene was made of, with the bends of its footage.
        initial: scene before any refinement. gains: (V,3) factors from its colours to each video's. falloff: of the
            vignetting that the static part shows; None without one.
        frame: name of the world frame. left_out: videos that have no offset.
    """

    footage: tuple[Footage, ...]
    held_out: tuple[Footage, ...]
    clocks: dict[str, Clock]
    offsets: Offsets
    tracks: tuple[TrackSet, ...]
    initial: Gaussians4D
    gains: np.ndarray
    frame: str
    left_out: tuple[str, ...] = ()
    falloff: Falloff | None = None

    @property
    def layered(self) -> bool:
        """Whether the fit draws what moves over backgrounds, rather than together with what is static."""
        return all(f.background is not None for f in self.footage)


def check_vignetting(effects: Sequence[Effect], static: StaticFit | None, progress: Progress) -> None:
    """ValueError for a vignetting that nothing tells, or another one than the static part was fitted with."""
    if not any(isinstance(effect, Vignetting) for effect in effects):
        return
    given = own_falloff(effects)
    if given is None and static is None:
        raise ValueError(
            "effects: expected a static part that tells the vignetting; found none. Give vignetting second and fourth, "
            "or leave it out."
        )
    if given is None and static is not None and not any(static.falloff):
        progress.note("vignetting was asked for, but the static part shows none: nothing is darkened")
    if given is not None and static is not None and static.falloff != given:
        raise ValueError(
            f"backdrop: expected one fitted with the vignetting of the plan, {tuple(given)}; found "
            f"{tuple(static.falloff)}. Fit it with falloff={tuple(given)}, or leave vignetting out of the effects."
        )


def bends_of(plan: Plan, offsets: Offsets, progress: Progress) -> np.ndarray:
    """[V] seconds by which each video's clock is bent: see :mod:`recon.footage.bends`. None where clocks stay."""
    sigma = offsets.sigma if "offsets" in plan.fit.active_rates() else np.zeros(len(offsets.names))
    bends = chosen_bends(sigma, 1.0 / float(offsets.fps[offsets.reference]), plan.bend, plan.fit.seed)
    if plan.bend not in (0.0, Plan.bend) and not bends.any():
        progress.note(f"bend: of {plan.bend:g} frames is unused: clocks are frozen, or have no sigma to begin with")
    return bends


def prepare(
    scene: Scene,
    offsets: Offsets,
    tracks: Sequence[TrackSet] | None = None,
    *,
    plan: Plan | None = None,
    held_out: Sequence[str] = (),
    backdrop: StaticFit | None = None,
    start: Start | None = None,
    stages: Stages | None = None,
    cache: Any = None,
    map: MapLike = map,
    progress: Progress | None = None,
    deadline: Deadline | None = None,
) -> Prepared:
    """Everything that a fit begins with.

    Args:
        offsets: of the recording's videos.
        tracks: in space, one set a video; those of other than training videos are left out, with a note. Default:
            tracked and lifted here.
        held_out: names of videos that nothing here sees but their own footage.
        backdrop: the static part, its gains those of the training videos in their order; default: fitted here.
        start: how the moving part begins; default: on a scaffold, and on visual hulls of the masks where no track can
            be lifted. One that reads neither tracks nor depth is not given
            any, nor is the static part.
        stages: whose masks, point tracks and stereo are used; which tracks are kept is the scaffold's own affair.
        cache: an :class:`otsync.files.cache.Cache`. map: any map-like callable; two threads use two cores.
        deadline: of the whole job; the static part takes at most a share of what is left.

    ValueError names what is missing or does not fit: a backdrop with gains of other videos, nothing that moves.
    """
    from otsync.files.cache import Cache

    plan, progress, cache, start = plan or Plan(), progress or Progress(), cache or Cache(), start or OnScaffold()
    stages = stages or Stages()
    for video in scene.videos:
        check_effects(plan.effects, video.times)
    if plan.frames is not None:
        scene = cut(scene, *plan.frames)
    scene = on_mended_clocks(scene, offsets)
    with progress.stage("reading"):
        scene = readable(scene, cache, map, progress)
        train, others, offsets, clocks = split(scene, offsets, held_out, progress)
    if start.reads_geometry:
        train = with_estimated(train, stages, cache, map, progress)
    for v, video in enumerate(train.videos):
        check_effects(plan.effects, video.times, v)
    if backdrop is not None and backdrop.gains.shape != (len(train.videos), 3):
        raise ValueError(
            f"backdrop: expected gains of shape ({len(train.videos)},3), of the videos to fit in their order "
            f"({', '.join(train.names)}); found {backdrop.gains.shape}. Keep the gains of those videos alone."
        )
    with progress.stage("footage"):
        upright = read_footage(train, plan.width, cache, map, progress, stages)
        held = () if others is None else read_footage(others, plan.width, cache, map, progress, stages)
    filmed, bends = train, bends_of(plan, offsets, progress)
    waves = [wave(motion_of(f)) if bends.any() else np.zeros(len(f)) for f in upright]
    crooked = [bent(v, float(b), w) for v, b, w in zip(filmed.videos, bends, waves, strict=True)]
    train, bends = replace(train, videos=tuple(v for v, _ in crooked)), np.array([b for _, b in crooked])
    footage = tuple(replace(f, times=v.times) for f, (v, _) in zip(upright, crooked, strict=True))
    if not start.reads_geometry:
        train, tracks = replace(train, videos=tuple(replace(v, depth=None) for v in train.videos)), ()
    elif tracks is None:
        with progress.stage("tracks"):
            try:
                tracks = lifted_tracks(train, offsets, cache, map, progress, stages)
            except NoDepth as error:
                # images and calibration alone still tell where masks meet, also for few cameras and for moving ones
                progress.note(
                    f"{error} The scene begins on visual hulls of the masks: options of a scaffold are unused"
                )
                start, tracks = FromImages(), ()
                train = replace(train, videos=tuple(replace(v, depth=None) for v in train.videos))
    else:
        own = [at_frame_times(t) for t in tracks_of(train, tracks, held_out, progress.note)]
        of = [offsets.names.index(t.name) for t in own]
        tracks = tuple(
            bent_tracks(mended(t, offsets.breaks[v]), filmed.videos[v], float(bends[v]), waves[v])
            for v, t in zip(of, own, strict=True)
        )
    if not any((f.boxes[:, 2] > f.boxes[:, 0]).any() for f in footage):
        raise ValueError("scene: expected something that moves; the masks are empty in every frame of every video.")
    with progress.stage("backdrop"):
        static = backdrop
        if static is None:
            static = backdrop_of_scene(train, tracks, footage, plan, cache, progress, deadline, stages)
        check_vignetting(plan.effects, static, progress)
    with progress.stage("initial scene"):
        gains = np.ones((len(footage), 3)) if static is None else static.gains
        given = Given(train, offsets, tuple(tracks), footage, gains, plan, cache, map, progress, stages)
        initial = initial_scene(given, static, start)
    for one in (*footage, *held):
        one.release()
    if static is not None:
        footage = tuple(
            f if f.background is None else with_backdrop(static, f, gains[v]) for v, f in enumerate(footage)
        )
    maps = None if plan.features is None else maps_from(plan.features)
    if maps is not None:
        with progress.stage("features"):
            initial = featured(given, initial, footage, maps)
    wanted = read_by(plan.fit.losses, plan.features)
    if wanted:
        footage = with_readings(wanted, train, footage, tracks, initial, offsets, plan.width, maps)
    falloff = None if static is None else static.falloff
    footage = tuple(
        replace(f, times=u.times, bend=float(b), wave=w) if b else replace(f, times=u.times)
        for f, u, b, w in zip(footage, upright, bends, waves, strict=True)
    )
    left_out = tuple(n for n in scene.names if n not in train.names and n not in held_out)
    return Prepared(footage, held, clocks, offsets, tuple(tracks), initial, gains, scene.frame, left_out, falloff)
