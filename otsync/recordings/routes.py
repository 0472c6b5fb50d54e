"""From a scene of recordings to offsets: the routes, in stages that are kept on disk so that a run continues.

Routes::

    tracks    depth is given          tracks -> lift -> match, scan, refine -> graph
    epipolar  cameras only            tracks -> epipolar scan -> graph
    stereo    a static rig            the epipolar route, then hull and stereo at its offsets, then the tracks route

Rolling shutters of declared readout are undone once on every route: pixels where pairs are compared
(:func:`otsync.synchronize`), positions after lifting (:class:`otsync.recordings.lift.Lift`), which needs the images'
own pixels. Hull and stereo compare rows of several cameras as if they were of one moment: what moves gets a depth that
mixes moments up to half the sum of both readouts apart.

Measured on basketball, 8 cameras of 120 frames of 640 x 360, two cores: the epipolar route 45 s cold, 3 s warm, 0.42 GB
at most; the stereo route 25 s more, 0.79 GB. Longer clips take about 30 kB a frame and video for masks, and as much as
the 4000 longest tracks of a video take (32 kB a frame) while it is tracked.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from ..clocks.shutter import check_within_a_frame
from ..compute.processes import Processes
from ..compute.threads import MapLike
from ..files.cache import Cache
from ..files.digest import content_key, sequence_key
from ..geometry import seen_pixels
from ..io.scene import Scene
from ..priors.slots import cache_key
from ..priors.stereo import EmptyHull, Rig
from ..priors.working import WIDTH
from ..progress import Deadline, Progress, Tell
from ..sync.hearing import on_own_clock
from ..sync.mend.breaks import mended
from ..sync.method import Method
from ..sync.verb import jump_sigma, synchronize
from ..types import Offsets, Status, TrackSet, Video
from ..types.checks import check_number, check_whole
from .given import names_of, tracks_of
from .kept_pairs import KeptPairs
from .learned_depth import remedy, with_depth
from .lift import depth_at
from .placement import misplaced, with_doubts
from .silent import NothingToFollow, followed, of_those_that_move, tried
from .stages import Stages, with_labels, with_method
from .synchronized import Synchronized
from .tracking import pixel_tracks, track_labels

Route = Literal["auto", "tracks", "epipolar", "stereo"]


def synchronize_scene(
    scene: Scene,
    *,
    route: Route = "auto",
    reference: int | Literal["auto"] = 0,
    method: Method | None = None,
    stages: Stages | None = None,
    cache: Cache | None = None,
    map: MapLike = map,
    processes: int = 1,
    tell: Tell = lambda text: None,
    deadline: Deadline | None = None,
    fine_enough: float | None = None,
) -> Synchronized:
    """Put the videos of a scene on one clock.

    Args:
        route: "auto" decides by what is there; naming one overrides it. ValueError says what a named route lacks.
        reference: index of the video whose clock is the world's; "auto" takes the one with the surest pairs.
        method: what stands in the slots of the stage that gives the answer (matcher, aligner, refiner, graph, rematch,
            rate); what it leaves out is the route's own. On the stereo route the epipolar stage before it keeps its
            own. ValueError names what does not go with the route.
        stages: the objects of every stage. Depth is estimated (``stages.depth``) on the routes auto and tracks, which
            read it.
        cache: where stages are kept; a run that was killed continues from what is there, with the same result.
        map: any map-like callable; two threads use two cores.
        processes: that many pairs are spread over (threads of it wait for each other); with 1 on the map's threads
            alone. Programs that use more need Python's usual ``if __name__ == "__main__"``.
        tell: receives one line per stage.
        deadline: of the job that this is a part of: stereo is left out where it would take more than its share.
        fine_enough: frames of the reference. Where pixels give every offset, unflagged and with a smaller sigma, route
            "auto" leaves stereo out, for a job that goes on to fit the offsets to pictures; None: it never does.

    A video in which nothing can be followed is ``static``, with a clock of its own, where two others are left and it is
    not the reference; NothingToFollow otherwise.
    """
    check_whole("processes", processes, 1)
    if fine_enough is not None:
        check_number("fine_enough", fine_enough)
    solve = partial(
        _synchronized,
        route=route,
        method=method,
        stages=stages,
        cache=cache,
        map=map,
        processes=processes,
        tell=tell,
        deadline=deadline,
        fine_enough=fine_enough,
    )
    return of_those_that_move(scene, reference, solve, tell)


def _synchronized(
    scene: Scene,
    *,
    route: Route,
    reference: int | Literal["auto"],
    method: Method | None,
    stages: Stages | None,
    cache: Cache | None,
    map: MapLike,
    processes: int,
    tell: Tell,
    deadline: Deadline | None,
    fine_enough: float | None,
) -> Synchronized:
    """:func:`synchronize_scene` of videos that all have something to follow; NothingToFollow names others."""
    for video in scene.videos:
        check_within_a_frame(video.camera.readout, video.times, f"camera.readout of {video.name!r}")
    stages, cache = with_labels(stages or Stages(), scene), cache or Cache()
    progress = Progress(tell)
    scene, doubts = estimated(scene, route, stages, cache, map, tell, progress)
    chosen, why = choose_route(scene, route, stages)
    why = (*why, *doubts)
    named = method is not None and bool(method.slots())
    if method is not None:
        stages = with_method(stages, chosen, method)
    if method is not None and named:
        why = (*why, method.told())
    for line in why:
        tell(line)
    if chosen == "tracks":
        with progress.stage("tracks"):
            raw = track_all(scene, stages, cache, map, tell)
        with progress.stage("lift"):
            lifted = lift_given(scene, raw, stages, cache, map)
        with progress.stage("synchronise"):
            offsets = pairs_in_space(lifted, reference, stages, cache, map, processes)
            offsets = with_doubts(offsets, scene.doubtful)
        return Synchronized(without_times(offsets), tuple(lifted), chosen, why, None, progress.seconds)
    with progress.stage("tracks"):
        chosen_tracks = track_all(
            scene, stages, cache, map, tell, lambda video, one: tried(select, video, one, stages, scene.frame)
        )
        flat = followed(chosen_tracks)
    with progress.stage("epipolar"):
        first = without_times(pairs_in_pixels(flat, reference, stages, cache, map, processes))
        astray = misplaced(first) | set(scene.doubtful)
        first = with_doubts(first, astray)
    epipolar = Synchronized(first, tuple(flat), "epipolar", why, None, progress.seconds)
    if chosen == "epipolar":
        return epipolar
    asked = named or route == "stereo"
    doubt = _too_doubtful(first, stages)
    if not (asked or doubt):
        late = "" if deadline is None else _too_late(progress.seconds["epipolar"], deadline)
        doubt = late or ("" if fine_enough is None else _fine(first, fine_enough))
    if doubt:
        _refuse_unused(method, doubt)
        tell(doubt)
        return replace(epipolar, why=(*why, doubt))
    with progress.stage("stereo"):
        try:
            depth = stereo_depth(scene, flat, first, stages, cache, map)
        except EmptyHull as error:
            if asked:
                raise
            doubt = f"no stereo: {error} The epipolar answer stands"
            tell(doubt)
            return replace(epipolar, why=(*why, doubt))
        lifted = [stages.lift(t, z) for t, z in zip(flat, depth, strict=True)]
    bare = [t.name for t in lifted if len(t) == 0]
    if bare:
        doubt = f"stereo found no depth for {', '.join(bare)}: the epipolar answer stands"
        _refuse_unused(method, doubt)
        tell(doubt)
        return replace(epipolar, why=(*why, doubt))
    with progress.stage("synchronise"):
        whole = [mended(t, breaks) for t, breaks in zip(lifted, first.breaks, strict=True)]
        offsets = breaking(pairs_in_space(whole, reference, stages, cache, map, processes), first, lifted)
        offsets = with_doubts(without_times(offsets), astray)
    if not named and (doubt := _less_sure(offsets, first)):
        tell(doubt)
        return replace(epipolar, why=(*why, doubt))
    return Synchronized(inheriting(offsets, first), tuple(lifted), chosen, why, first, progress.seconds)


def estimated(
    scene: Scene, route: Route, stages: Stages, cache: Cache, map: MapLike, tell: Tell, progress: Progress
) -> tuple[Scene, tuple[str, ...]]:
    """The scene with estimated depth where an estimator and no route without depth is named; what to say about it.

    ValueError where it is not tied to the poses and the route asks for depth.
    """
    if stages.depth is None or route in ("epipolar", "stereo"):
        return scene, ()
    with progress.stage("depth"):
        found = with_depth(scene, stages, cache=cache, map=map, tell=tell)
    lacking = {v.name: found.untied[v.name] for v in found.scene.videos if v.depth is None and v.name in found.untied}
    if lacking and route == "tracks":
        raise ValueError(f"route tracks: {remedy(lacking)}.")
    return found.scene, (remedy(lacking),) if lacking else ()


def choose_route(scene: Scene, route: Route, stages: Stages) -> tuple[str, tuple[str, ...]]:
    """The route and the reasons for it, in words. ValueError when the named one is not possible."""
    if len(scene.videos) < 2:
        raise ValueError(f"scene: expected at least two videos; found {len(scene.videos)}.")
    if route not in ("auto", "tracks", "epipolar", "stereo"):
        raise ValueError(f"route: expected auto, tracks, epipolar or stereo; found {route!r}.")
    flat = [v.name for v in scene.videos if v.depth is None]
    lacks = {
        "tracks": f"depth is missing for {', '.join(flat)}" if flat else "",
        "stereo": lacks_stereo(scene, stages),
        "epipolar": "",
    }
    if route != "auto":
        if lacks[route]:
            raise ValueError(f"route {route}: {lacks[route]}. Add what is missing, or choose another route.")
        return route, (f"route {route}: as asked",)
    for name, reason in (
        ("tracks", "every video has depth"),
        ("stereo", f"no depth, {len(scene.videos)} static cameras: epipolar scan, then visual hull and stereo"),
        ("epipolar", "no depth: offsets from pixels and calibration alone"),
    ):
        if not lacks[name]:
            others = tuple(f"not {n}: {text}" for n, text in lacks.items() if text)
            return name, (f"route {name}: {reason}", *others)
    raise AssertionError("the epipolar route needs nothing")


def lacks_stereo(scene: Scene, stages: Stages) -> str:
    """Why hull and stereo cannot be used on the scene; empty when they can."""
    moving = [v.name for v in scene.videos if v.camera.w2c.ndim == 3]
    if moving:
        return f"cameras move: {', '.join(moving)}"
    if len(scene.videos) < stages.stereo.min_views:
        return f"{len(scene.videos)} videos are fewer than the {stages.stereo.min_views} from which depth is measured"
    return ""


def track_all(
    scene: Scene,
    stages: Stages,
    cache: Cache,
    map: MapLike,
    tell: Tell = lambda text: None,
    keep: Callable[[Video, dict[str, np.ndarray]], Any] = lambda video, tracked: tracked,
) -> list[Any]:
    """Masks, point tracks, descriptors and, where given, labels of every video; points that were given instead.

    ``keep`` is asked what of a video's tracks is kept in memory, which of long clips they would fill. ValueError names
    the first frame that does not read.
    """
    started, done = time.perf_counter(), []

    points = scene.points or (None,) * len(scene.videos)
    parts = names_of(points)
    if any(points) and not all(points):
        lacking = [v.name for v, p in zip(scene.videos, points, strict=True) if p is None]
        raise ValueError(
            f"points: expected them of every video, since tracks of our own have other features; {', '.join(lacking)} "
            "have none. Add them, leave these videos out, or take all points out of scene.json."
        )

    def one(item: tuple[Video, Any, Any, Any, Any]) -> Any:
        video, masks, labels, found, given = item
        if found is not None and given is not None:
            raise ValueError(
                f"video {video.name}: points, tracks: expected one of them in scene.json; found both. Leave one out."
            )
        if found is None:
            tracked = stages.tracking(video, masks, cache, given)
        else:
            tracked = tracks_of(found, len(video.frames), video.fps or 30.0, video.camera.width / WIDTH, parts)
        if labels is not None:
            size, uv = (video.camera.width, video.camera.height), tracked["uv"]
            key = (sequence_key(labels), size, content_key(uv))
            tracked |= cache.arrays("labels", key, lambda: {"labels": track_labels(labels, uv, size)})
        done.append(video.name)
        spent = time.perf_counter() - started
        tell(f"tracks {len(done)}/{len(scene.videos)}: {video.name}, {len(tracked['uv'])} tracks, {spent:.1f} s")
        return keep(video, tracked)

    labels = scene.labels or (None,) * len(scene.videos)
    tracks = scene.tracks or (None,) * len(scene.videos)
    return list(map(one, list(zip(scene.videos, scene.masks, labels, points, tracks, strict=True))))


def select(video: Video, raw: dict[str, np.ndarray], stages: Stages, frame: str) -> TrackSet:
    """The tracks of one video that are worth keeping, in undistorted pixels; NothingToFollow where there is none."""
    chosen = stages.selection(raw["uv"], video.camera.width, video.fps or 30.0)
    if len(chosen) == 0:
        why = (
            f"video {video.name}: expected moving foreground to track; found no track that lives and moves enough: "
            f"{stages.selection.told(raw['uv'], video.camera.width, video.fps or 30.0)}. Check the masks, choose a "
            "part of the clip with motion, lower the limit (--recording.selection, --recording.masks), raise "
            "--recording.width where things are small, or leave this video out."
        )
        raise NothingToFollow({video.name: why})
    tracks = pixel_tracks(
        raw["uv"][chosen],
        raw["features"][chosen],
        video.camera,
        fps=video.fps,
        timestamps=video.timestamps,
        name=video.name,
        frame=frame,
    )
    return replace(tracks, labels=raw["labels"][chosen]) if "labels" in raw else tracks


def pairs_in_pixels(
    tracks: Sequence[TrackSet],
    reference: int | Literal["auto"],
    stages: Stages,
    cache: Cache,
    map: MapLike = map,
    processes: int = 1,
) -> Offsets:
    """The depth-free answer: transport on features, epipolar scan and fit of every pair, then the graph."""
    with Processes(processes) as call:
        return synchronize(tracks, reference=reference, method=stages.pixels, map=KeptPairs(cache, map, call))


def pairs_in_space(
    tracks: Sequence[TrackSet],
    reference: int | Literal["auto"],
    stages: Stages,
    cache: Cache,
    map: MapLike = map,
    processes: int = 1,
) -> Offsets:
    """The answer from lifted tracks: transport, likelihood scan, spline fit, matched again, then the graph."""
    with Processes(processes) as call:
        return synchronize(tracks, reference=reference, method=stages.space, map=KeptPairs(cache, map, call))


def lift_given(
    scene: Scene, raw: Sequence[dict[str, np.ndarray]], stages: Stages, cache: Cache, map: MapLike = map
) -> list[TrackSet]:
    """Tracks lifted by the depth maps that came with the recording, then chosen by their life in space."""

    def one(item: tuple[Video, dict[str, np.ndarray]]) -> TrackSet:
        video, tracked = item
        rich = replace(stages.selection, count=3 * stages.selection.count, apart=0.5 * stages.selection.apart)
        chosen = rich(tracked["uv"], video.camera.width, video.fps or 30.0)
        uv = tracked["uv"][chosen]
        flat = select(video, tracked, replace(stages, selection=rich), scene.frame)
        key = (stages.tracking.key(video, None), sequence_key(video.depth or []), content_key(uv))
        depth = cache.arrays("depth", key, lambda: {"z": depth_at(video.depth or [], flat, uv)})["z"]
        lifted = stages.lift(flat, depth)
        best = lifted.take(stages.selection(seen_pixels(lifted), video.camera.width, video.fps or 30.0))
        if len(best) == 0:
            why = (
                f"video {video.name}: expected depth where things move; no track could be lifted. Check the depth "
                "maps' scale and holes (otsync check), or use --recording.route epipolar."
            )
            raise NothingToFollow({video.name: why})
        return best

    return followed(list(map(partial(tried, one), list(zip(scene.videos, raw, strict=True)))))


def stereo_depth(
    scene: Scene, tracks: Sequence[TrackSet], offsets: Offsets, stages: Stages, cache: Cache, map: MapLike = map
) -> list[np.ndarray]:
    """Depth of every track sample by hull and stereo over the videos whose clocks ``offsets`` knows."""
    pairs = list(zip(scene.videos, scene.masks, strict=True))
    masks = list(map(lambda item: stages.tracking.masks(item[0], item[1], cache), pairs))
    rig, key = rig_at(scene, masks, offsets, range(len(scene.videos)), stages)
    return stages.stereo(rig, [seen_pixels(t) for t in tracks], cache, key, map)


def rig_at(
    scene: Scene, masks: Sequence[Sequence[np.ndarray]], offsets: Offsets, chosen: Sequence[int], stages: Stages
) -> tuple[Rig, tuple[Any, ...]]:
    """The chosen videos on one clock, for stereo; and a key of everything that it sees of them."""
    videos = [scene.videos[v] for v in chosen]
    # rounding keeps the key the same over the last bits of a solution
    seconds, rates = np.round(offsets.seconds[list(chosen)], 6), offsets.rates[list(chosen)]
    breaks = [offsets.breaks[v] for v in chosen]
    rig = Rig.at(videos, [masks[v] for v in chosen], seconds, stages.tracking.width, rates, breaks)
    pixels = [stages.tracking.key(scene.videos[v], scene.masks[v]) for v in chosen]
    poses = [
        (c.K.tobytes(), c.w2c.tobytes(), None if c.distortion is None else c.distortion.tobytes()) for c in rig.cameras
    ]
    return rig, (*pixels, cache_key(stages.tracking.masker), stages.tracking.width, content_key(*poses))


def without_times(offsets: Offsets) -> Offsets:
    """The same without wall times among the statistics: a run that was killed and continued writes the same file."""

    def clean(stats: dict[str, float]) -> dict[str, float]:
        return {k: v for k, v in stats.items() if not k.endswith("seconds")}

    alignments = {pair: replace(a, stats=clean(a.stats)) for pair, a in offsets.alignments.items()}
    return replace(offsets, alignments=alignments, stats=clean(offsets.stats))


def _flagged(offsets: Offsets) -> int:
    return sum(not s.ok for s in offsets.status)


INHERITED = 0.55
"""Share of the errors of the pixels' offsets that the answer of lifted tracks has, since depth was built at these: in
three recordings of ``recon simulate`` (seeds 30, 33, 36), whose depth was built at offsets that were wrong by .7 frame
(three draws each), .29 to .86, .55 on average."""


def inheriting(offsets: Offsets, first: Offsets) -> Offsets:
    """The answer of tracks whose depth was measured at the offsets ``first``, with its share of their errors."""
    return replace(offsets, sigma=np.hypot(offsets.sigma, INHERITED * first.sigma)).judged_by_sigma()


def breaking(offsets: Offsets, first: Offsets, tracks: Sequence[TrackSet]) -> Offsets:
    """The answer of ``tracks`` that were mended as ``first`` says: with these breaks, and with their errors."""
    breaks = [
        tuple(sorted((*known, *(on_own_clock(b, known) for b in new)), key=lambda b: b.at))
        for known, new in zip(first.breaks, offsets.breaks, strict=True)
    ]
    fps = np.array([t.fps for t in tracks], float)
    # the error of a jump is that of all behind it
    loose = np.array(
        [sum(jump_sigma(b, 1 / f) ** 2 for b in known) for known, f in zip(first.breaks, fps, strict=True)]
    )
    loose = np.where(np.arange(len(fps)) == offsets.reference, 0.0, loose + loose[offsets.reference])
    return replace(offsets, fps=fps, breaks=tuple(breaks), sigma=np.hypot(offsets.sigma, np.sqrt(loose)))


LESS_SURE = 2.0
"""Times the sigma of the pixels' answer from which on lifted tracks are no gain. Of a mouse in a glass cylinder, 5
cameras at 120 frames a second, the pixels' answer was off by .8 frame on average, that of lifted tracks by 2.7."""


def _less_sure(offsets: Offsets, first: Offsets) -> str:
    """Why the answer from lifted tracks is less sure than the pixels'; empty when it is not."""
    if _flagged(offsets) > _flagged(first):
        return "the lifted tracks leave more doubt than the pixels did: the epipolar answer stands"
    both = np.isfinite(offsets.sigma) & np.isfinite(first.sigma) & (first.sigma > 0)
    ratio = float(np.median(offsets.sigma[both] / first.sigma[both])) if both.any() else 0.0
    if ratio > LESS_SURE:
        return f"the lifted tracks are less sure than the pixels, by {ratio:.1f} times: the epipolar answer stands"
    return ""


def _refuse_unused(method: Method | None, why: str) -> None:
    """ValueError where slots were named for an answer from lifted tracks, and there is none."""
    if method is not None and method.slots():
        raise ValueError(
            f"{', '.join(method.slots())}: expected lifted tracks to use them on; {why}. Choose --recording.route "
            "epipolar, or leave them out. What was tracked is kept."
        )


STEREO_COST = 1.5
"""Time of the stages from stereo to its answer, as a multiple of the epipolar stage's: measured on 14 to 30 cameras."""

STEREO_SHARE = 0.4
"""Of the time that a budget leaves: more of it, and the pixels' answer stands, so that the rest of the job has some."""


def _too_late(epipolar: float, deadline: Deadline) -> str:
    """Why a budget has no time for stereo; empty when it has."""
    if STEREO_COST * epipolar <= STEREO_SHARE * deadline.left:
        return ""
    return (
        f"no stereo: it would take about {STEREO_COST * epipolar:.0f} s of the {deadline.left:.0f} s that the budget "
        "leaves; the epipolar answer stands"
    )


def _fine(first: Offsets, enough: float) -> str:
    """Why stereo has nothing to add to the pixels' answer: sigma is below so many frames; empty where it has."""
    most = float(np.max(first.sigma * first.fps[first.reference]))
    if _flagged(first) or not most < enough:
        return ""
    return (
        f"no stereo: pixels give every offset to {most:.2f} frame, and pictures refine it; the epipolar answer stands"
    )


def _too_doubtful(first: Offsets, stages: Stages) -> str:
    """Why depth cannot be built at these offsets; empty when it can."""
    apart = [
        n
        for n, s, c in zip(first.names, first.seconds, first.component, strict=True)
        if not np.isfinite(s) or c != first.reference
    ]
    if apart:
        return f"no stereo: {', '.join(apart)} could not be put on the common clock"
    doubtful = [n for n, s in zip(first.names, first.status, strict=True) if s not in (Status.OK, Status.COARSE)]
    if len(doubtful) > len(first) / 2:
        return f"no stereo: the epipolar offsets of {', '.join(doubtful)} are doubtful"
    return ""
