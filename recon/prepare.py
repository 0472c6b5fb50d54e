"""What a fit begins with, made from a recording and its offsets: every stage kept on disk, so that a run continues.

    reading          frames that cannot be read are left out, and named
    tracks, depth    otsync's own stages, shared with the synchronisation that came before
    footage          frames at working size, masks, backgrounds
    backdrop         static Gaussians behind what moves
    initial scene    a scaffold through the lifted tracks, Gaussians seeded from depth

With :mod:`recon.pipeline` this is the only part of ``recon`` that calls otsync's algorithms, and imports them when it
runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from otsync.io import Scene
from otsync.io.mend import cut, keep_frames, unreadable
from otsync.types import Offsets, TrackSet, Video
from recon.backdrop import StaticFit, fit_backdrop, with_backdrop
from recon.density import Densify
from recon.depth import working_depth
from recon.device import device_of
from recon.effects import Effect
from recon.fit import LOSSES, Loss
from recon.footage import Footage, footage_of
from recon.gaussians import Gaussians
from recon.gaussians4d import Gaussians4D, scene_arrays, scene_from_arrays
from recon.held_out import Clock
from recon.motion import ScaffoldOptions, build_scaffold
from recon.seed import Seeding, moments, seed, shown_at
from recon.track_sets import of_every_video, tracks_of

Tell = Callable[[str], None]
MapLike = Callable[..., Any]


@dataclass(frozen=True)
class Plan:
    """What is done with a recording.

    Args:
        width: working pixels. frames: first and last (exclusive) frame of every video; None: all.
        scaffold: how the motion is built. seeding: how densely Gaussians begin.
        losses, effects, densify: of the fit; effects get the gains of the backdrop by themselves.
        freeze: parameter groups that the fit holds, "offsets" for instance.
        batch: images a step, each on a thread of its own.
        views: frames of every camera that are compared at the end. backdrop_steps: of the fit of the static part.
        save_every: seconds between savings of the fit.
        device: where static part and motion are fitted: "cpu", or "cuda" for a GPU; the rest is done on the CPU.
    """

    width: int = 320
    frames: tuple[int, int] | None = None
    scaffold: ScaffoldOptions = field(default_factory=ScaffoldOptions)
    seeding: Seeding = field(default_factory=Seeding)
    losses: tuple[Loss, ...] = LOSSES
    effects: tuple[Effect, ...] = ()
    densify: Densify | None = None
    freeze: tuple[str, ...] = ()
    batch: int = 2
    seed: int = 0
    views: int = 50
    backdrop_steps: int = 1500
    save_every: float = 60.0
    device: str = "cpu"

    def __post_init__(self) -> None:
        device_of(self.device)


@dataclass(frozen=True, eq=False)
class Prepared:
    """What a fit of a recording begins with.

    Args:
        footage: of the training videos, in the order of ``offsets``. held_out: of the others.
        clocks: of the held-out videos, where the given offsets tell.
        offsets: of the training videos alone.
        initial: scene before any refinement. gains: (V,3) factors from its colours to each video's.
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

    @property
    def layered(self) -> bool:
        """Whether the fit draws what moves over backgrounds, rather than together with what is static."""
        return all(f.background is not None for f in self.footage)


class Progress:
    """Says what happens, remembers what was lacking, and times the stages."""

    def __init__(self, tell: Tell = lambda text: None):
        self.tell, self.notes, self.seconds = tell, [], {}  # type: Tell, list[str], dict[str, float]

    def note(self, text: str) -> None:
        """Something that the user should know when reading the result."""
        self.notes.append(text)
        self.tell(f"note: {text}")

    @contextmanager
    def stage(self, name: str):
        """Time what happens inside."""
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started
        self.tell(f"{name}: {self.seconds[name]:.1f} s")


def readable(scene: Scene, cache: Any, map: MapLike, progress: Progress) -> Scene:
    """The scene without frames that cannot be read, each of which is noted. ValueError when one video has none left."""

    def look(item: tuple[Video, Any]) -> dict[str, np.ndarray]:
        video, masks = item
        parts = [getattr(x, "digest", None) for x in (video.frames, masks, video.depth) if x is not None]

        def compute() -> dict[str, np.ndarray]:
            bad = {f"{k:08d}": np.array(why) for k, why in unreadable(video, masks).items()}
            return {**bad, "looked": np.array(1)}

        if not all(parts):  # frames that are in memory have no digest, and are quickly looked at
            return compute()
        try:
            key = (*[digest() for digest in parts], video.camera.width, video.camera.height)  # type: ignore[misc]
        except OSError:
            return compute()
        return cache.arrays("readable", key, compute)

    index = []
    for video, found in zip(scene.videos, map(look, list(zip(scene.videos, scene.masks, strict=True))), strict=True):
        bad = {int(k): str(why) for k, why in found.items() if k != "looked"}
        for k, why in sorted(bad.items())[:3]:
            progress.note(f"video {video.name}, frame {k} is left out: {why}")
        if len(bad) > 3:
            progress.note(f"video {video.name}: {len(bad) - 3} further frames are left out")
        if len(bad) == len(video.frames):
            raise ValueError(f"video {video.name}: expected frames that can be read; found none. {bad[0]}")
        index.append([k for k in range(len(video.frames)) if k not in bad])
    return keep_frames(scene, index)


def split(
    scene: Scene, offsets: Offsets, held_out: Sequence[str], progress: Progress
) -> tuple[Scene, Scene | None, Offsets, dict[str, Clock]]:
    """Training videos, held-out ones, the offsets of the former alone, and the clocks of the latter that are known.

    Videos without an offset on the reference's clock are left out, with a note.
    """
    missing = [n for n in held_out if n not in scene.names]
    if missing:
        raise ValueError(f"held_out: expected some of {', '.join(scene.names)}; found {', '.join(missing)}.")
    reference, known = offsets.names[offsets.reference], given_clocks(offsets)
    train = [n for n in scene.names if n in known and n not in held_out]
    if reference not in train:
        raise ValueError(
            f"offsets: expected the reference ({reference}) among the videos to fit; found {', '.join(train) or 'none'}. "
            "Hold out another video, or synchronise with another reference."
        )
    for name in scene.names:
        if name not in train and name not in held_out:
            why = "has no offset on the common clock" if name in offsets.names else "is not in the offsets"
            progress.note(f"video {name} is left out: it {why}")
    clocks = {n: clock for n, clock in known.items() if n in held_out}
    return scene.take(train), scene.take(held_out) if held_out else None, only(offsets, train), clocks


def given_clocks(offsets: Offsets) -> dict[str, Clock]:
    """The clocks of the videos that have an offset on the reference's."""
    return {
        name: Clock(float(offsets.seconds[v]), float(offsets.rates[v]))
        for v, name in enumerate(offsets.names)
        if np.isfinite(offsets.seconds[v]) and offsets.component[v] == offsets.reference
    }


def only(offsets: Offsets, names: Sequence[str]) -> Offsets:
    """The offsets of some videos on the reference's clock, in that order.

    Where the reference is none of them, the first is named in its place; seconds stay those of world time.
    """
    at = [offsets.names.index(n) for n in names]
    new = {v: i for i, v in enumerate(at)}
    reference = new.get(offsets.reference, 0)
    pairs = {k: v for k, v in offsets.alignments.items() if k[0] in new and k[1] in new}
    return replace(
        offsets, names=tuple(names), fps=offsets.fps[at], seconds=offsets.seconds[at], rates=offsets.rates[at],
        sigma=offsets.sigma[at], reference=reference, component=np.full(len(at), reference),
        status=tuple(offsets.status[v] for v in at), flags=tuple(offsets.flags[v] for v in at),
        alignments={(new[i], new[j]): a for (i, j), a in pairs.items()}, matches={},
    )  # fmt: skip


MANY: dict[str, Any] = {"count": 700, "min_life": 10, "apart": 4.0}
"""Tracks for a scaffold: more and shorter ones than synchronisation asks for, since every limb must have some."""


def lifted_tracks(scene: Scene, offsets: Offsets, cache: Any, map: MapLike, progress: Progress) -> tuple[TrackSet, ...]:
    """Tracks in space of every video that has some: by given depth, else by hull and stereo at the offsets."""
    from otsync import recordings

    stages = replace(recordings.Stages(), selection=recordings.Selection(**MANY))
    raw = recordings.track_all(scene, stages, cache, map, progress.tell)
    flat: list[TrackSet | None] = []
    for video, found in zip(scene.videos, raw, strict=True):
        try:
            flat.append(recordings.select(video, found, stages, scene.frame))
        except ValueError:
            flat.append(None)
            progress.note(f"video {video.name}: nothing moves enough to be tracked; it only adds images")
    if not any(flat):
        raise ValueError(
            "scene: expected something that moves; found no track that lives and moves enough in any video. Check the "
            "masks, or choose a part of the recording with motion (--frames)."
        )
    out: list[TrackSet] = []
    for v, (video, tracks) in enumerate(zip(scene.videos, flat, strict=True)):
        if tracks is not None and video.depth is not None:
            part = scene.take([video.name])
            try:
                out += recordings.lift_given(part, [raw[v]], stages, cache)
            except ValueError as error:
                progress.note(str(error))
    bare = [v for v, video in enumerate(scene.videos) if video.depth is None and flat[v] is not None]
    if bare:
        lacking = recordings.lacks_stereo(scene, stages)
        if lacking and not out:
            raise ValueError(
                f"depth: none was given for {', '.join(scene.videos[v].name for v in bare)}, and none can be measured: "
                f"{lacking}. Add depth maps to the scene, or more static cameras."
            )
        if lacking:
            progress.note(f"no tracks in space from {', '.join(scene.videos[v].name for v in bare)}: {lacking}")
        else:
            kept = [v for v, t in enumerate(flat) if t is not None]
            part, sets = scene.take([scene.names[v] for v in kept]), [t for t in flat if t is not None]
            depth = recordings.stereo_depth(part, sets, only(offsets, part.names), stages, cache, map)
            lifted = [stages.lift(t, z) for t, z in zip(sets, depth, strict=True)]
            out += [t for v, t in zip(kept, lifted, strict=True) if v in bare and len(t)]
    if not out:
        raise ValueError("depth: expected depth where things move; no track could be lifted. Check the depth or masks.")
    return tuple(out)


def without_depth(scene: Scene) -> set[str]:
    """Names of videos that came without depth and for which none can be measured."""
    from otsync.recordings import Stages

    static = [v.name for v in scene.videos if v.camera.w2c.ndim == 2]
    measured = set(static) if len(static) >= Stages().stereo.min_views else set()
    return {v.name for v in scene.videos if v.depth is None} - measured


def read_footage(scene: Scene, width: int, cache: Any, map: MapLike, progress: Progress) -> tuple[Footage, ...]:
    """Frames, masks and backgrounds of every video at working size."""
    from otsync.recordings import Stages

    tracking = Stages().tracking
    measured = [v.name for v, m in zip(scene.videos, scene.masks, strict=True) if m is None]
    if measured:
        progress.note(
            f"no masks given for {', '.join(measured)}: what differs from the median over time counts as moving"
        )

    def one(item: tuple[Video, Any]) -> Footage:
        video, given = item
        return footage_of(video, tracking.masks(video, given, cache), width=width)

    return tuple(map(one, list(zip(scene.videos, scene.masks, strict=True))))


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


def prepare(
    scene: Scene,
    offsets: Offsets,
    tracks: Sequence[TrackSet] | None = None,
    *,
    plan: Plan | None = None,
    held_out: Sequence[str] = (),
    cache: Any = None,
    map: MapLike = map,
    progress: Progress | None = None,
) -> Prepared:
    """Everything that a fit begins with.

    Args:
        offsets: of the recording's videos.
        tracks: in space, one set a video; those of other than training videos are left out, with a note. Default:
            tracked and lifted here.
        held_out: names of videos that nothing here sees but their own footage.
        cache: an :class:`otsync.priors.cache.Cache`. map: any map-like callable; two threads use two cores.
    """
    from otsync.priors.cache import Cache

    plan, progress, cache = plan or Plan(), progress or Progress(), cache or Cache()
    if plan.frames is not None:
        scene = cut(scene, *plan.frames)
    with progress.stage("reading"):
        scene = readable(scene, cache, map, progress)
        train, others, offsets, clocks = split(scene, offsets, held_out, progress)
    if tracks is None:
        with progress.stage("tracks"):
            tracks = lifted_tracks(train, offsets, cache, map, progress)
    else:
        tracks = tracks_of(train, tracks, held_out, progress.note)
    with progress.stage("footage"):
        footage = read_footage(train, plan.width, cache, map, progress)
        held = () if others is None else read_footage(others, plan.width, cache, map, progress)
    if not any((f.boxes[:, 2] > f.boxes[:, 0]).any() for f in footage):
        raise ValueError("scene: expected something that moves; the masks are empty in every frame of every video.")
    with progress.stage("backdrop"):
        static = backdrop_of_scene(train, tracks, footage, plan, cache, progress)
    with progress.stage("initial scene"):
        initial = initial_scene(train, offsets, tuple(tracks), footage, static, plan, cache, map, progress)
    gains = np.ones((len(footage), 3)) if static is None else static.gains
    if static is not None:
        footage = tuple(
            f if f.background is None else with_backdrop(static, f, gains[v]) for v, f in enumerate(footage)
        )
    left_out = tuple(n for n in scene.names if n not in train.names and n not in held_out)
    return Prepared(
        footage, held, clocks, offsets, tuple(tracks), initial, gains, scene.frame, left_out
    )  # fmt: skip


def content_key(scene: Scene, tracks: Sequence[TrackSet]) -> tuple[Any, ...]:
    """What the pixels, masks, poses, depth maps and tracks are, for the cache."""
    from otsync import keep
    from otsync.priors.cache import digest_of
    from otsync.recordings import Stages

    tracking = Stages().tracking
    rows = []
    for video, masks in zip(scene.videos, scene.masks, strict=True):
        c, depth = video.camera, "none"
        if video.depth is not None:
            own = getattr(video.depth, "digest", None)
            depth = (
                own() if own is not None else digest_of(*[None if z is None else np.asarray(z) for z in video.depth])
            )
        lens = None if c.distortion is None else c.distortion
        rows.append(digest_of(tracking.key(video, masks), depth, video.times, c.K, c.w2c, lens, c.width, c.height))
    return (*rows, *(keep.digest(t) for t in tracks))


def backdrop_of_scene(
    scene: Scene, tracks: Sequence[TrackSet], footage: Sequence[Footage], plan: Plan, cache: Any, progress: Progress
) -> StaticFit | None:
    """Static Gaussians fitted to what the cameras see behind the things that move, kept; None where nothing shows."""

    def build() -> dict[str, np.ndarray]:
        lifted = [t.positions()[t.seen] for t in tracks]
        points = np.concatenate([p[:: max(1, len(p) // POINTS)] for p in lifted])
        depth = [None if v.depth is None else working_depth(v, width=plan.width) for v in scene.videos]
        found = fit_backdrop(
            footage, depth=None if all(d is None for d in depth) else depth, points=points, steps=plan.backdrop_steps,
            seed=plan.seed, device=plan.device,
        )  # fmt: skip
        parts = {n: getattr(found.gaussians, n).numpy() for n in GAUSSIAN}
        return {**parts, "gains": found.gains, "near": np.array(found.near), "psnr": found.psnr}

    key = (*content_key(scene, tracks), plan.width, plan.backdrop_steps, plan.seed)
    if plan.device != "cpu":  # rounds otherwise
        key = (*key, plan.device)
    try:
        kept = cache.arrays("backdrop", key, build)
    except ValueError as error:
        progress.note(f"no static part: {error}")
        return None
    gaussians = Gaussians(*(torch.from_numpy(np.array(kept[n])) for n in GAUSSIAN))
    progress.tell(f"backdrop: {len(gaussians)} Gaussians, {np.nanmean(kept['psnr']):.2f} dB")
    return StaticFit(gaussians, kept["gains"], float(kept["near"]), kept["psnr"])


POINTS = 2000
"""Positions of what moves, per video, that the backdrop takes its scale from."""

GAUSSIAN = ("means", "quats", "log_scales", "opacity_logits", "sh")


def initial_scene(
    scene: Scene, offsets: Offsets, tracks: tuple[TrackSet, ...], footage: tuple[Footage, ...],
    static: StaticFit | None, plan: Plan, cache: Any, map: MapLike, progress: Progress,
) -> Gaussians4D:  # fmt: skip
    """The scene before any refinement: a scaffold through the tracks, and what the depth maps show of it; kept."""
    clocks = (np.round(offsets.seconds, 6).tolist(), np.round(offsets.rates, 9).tolist(), offsets.reference)
    gains = np.ones((len(footage), 3)) if static is None else static.gains
    key = (*content_key(scene, tracks), clocks, gains.tolist(), plan.width, plan.scaffold, plan.seeding, plan.seed)

    def build() -> dict[str, np.ndarray]:
        built = seeded(scene, offsets, tracks, footage, gains, plan, cache, map, progress)
        # in the layout that a file gives back: sums over another one differ in their last bits
        return {k: np.array(v, order="C") for k, v in scene_arrays(built).items()}

    found = scene_from_arrays(cache.arrays("initial", key, build))
    progress.tell(f"initial scene: {len(found)} moving Gaussians")
    if static is None:
        return found
    return replace(found, static=static.gaussians, near=static.near)


def seeded(
    scene: Scene, offsets: Offsets, tracks: tuple[TrackSet, ...], footage: tuple[Footage, ...], gains: np.ndarray,
    plan: Plan, cache: Any, map: MapLike, progress: Progress,
) -> Gaussians4D:  # fmt: skip
    """Build what :func:`initial_scene` keeps."""
    from otsync.depth_maps import depth_maps

    footprint = world_footprint(tracks, footage)
    frame_step = 1.0 / float(offsets.fps[offsets.reference])
    motion = build_scaffold(
        of_every_video(tracks, offsets.names), offsets.seconds, footprint=footprint, frame_step=frame_step,
        options=plan.scaffold, rates=offsets.rates, seed=plan.seed,
    )  # fmt: skip
    progress.tell(f"scaffold: {len(motion)} nodes of {sum(len(t) for t in tracks)} tracks, footprint {footprint:.4g}")
    worlds = [offsets.rates[v] * f.times + offsets.seconds[v] for v, f in enumerate(footage)]
    span = (float(min(t[0] for t in worlds)), float(max(t[-1] for t in worlds)))
    times = moments(span, frame_step)
    blind = without_depth(scene)
    shown = zip(*(shown_at(footage, offsets, float(t), frame_step) for t in times), strict=True)
    wanted = [
        [] if v.name in blind else sorted({k for k in frames if k is not None})
        for v, frames in zip(scene.videos, shown, strict=True)
    ]
    maps = depth_maps(scene, offsets, wanted, width=plan.width, cache=cache, map=map)
    depth = [
        working_depth(v, dict(zip(k, m, strict=True)).get, width=plan.width)
        for v, k, m in zip(scene.videos, wanted, maps, strict=True)
    ]
    return seed(
        motion, footage, offsets, depth, footprint=footprint, frame_step=frame_step, span=span, times=times, gains=gains,
        options=plan.seeding,
    )  # fmt: skip
