"""From a recording and its offsets to a 4D scene and better offsets: prepare, fit, compare, write.

A run that was killed continues from its stages and its checkpoint, and ends with the same result.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from otsync.compute.indices import evenly
from otsync.compute.threads import MapLike
from otsync.files.arrays import write_json
from otsync.files.claim import clear_parts
from otsync.io import Scene
from otsync.io.mend import cut, on_mended_clocks
from otsync.metrics import offset_error
from otsync.progress import Deadline, Progress
from otsync.recordings.stages import stages_from
from otsync.types import Clock, Offsets, TrackSet, Video
from recon.evaluate.lpips import Lpips
from recon.evaluate.views import ViewScore, view
from recon.fit.optimize import chosen_rates
from recon.fit.options import FitOptions
from recon.fit.verb import Reconstruction, fit
from recon.observe.effects import Effect
from recon.observe.recorded import kept, optics, with_declared
from recon.pipeline.intake import given_clocks, readable, trained
from recon.pipeline.plan import Plan
from recon.pipeline.prepare import Prepared, prepare
from recon.pipeline.stages import read_footage
from recon.result.folder import FilmedBy, SavedReconstruction, load_result, metrics_of, save_run
from recon.result.page import SCENE_PAGE, write_page
from recon.result.report import write_reconstruction_report
from recon.result.strips import Strip, strips_of, write_strips
from recon.scene.gaussians4d import Gaussians4D


@dataclass(frozen=True, eq=False)
class Outcome:
    """A reconstructed recording.

    Args:
        fitted: scene and clocks. coarse: the offsets it began with, of the same videos. truth: (V,) seconds, where
            known.
        views: how well every camera that was compared is shown. left_out: videos without an offset.
    """

    fitted: Reconstruction
    coarse: Offsets
    views: tuple[ViewScore, ...]
    left_out: tuple[str, ...] = ()
    truth: np.ndarray | None = None
    lpips_reason: str = ""


LOOSE_POSE = 0.3
"""Degrees: one sigma of a camera's rotation from which on a fit keeps the clocks. It holds cameras still, so what is
left of their error goes where it can: poses found from the motion of basketball, .7 degrees off, moved clocks by half a
frame, and no residual tells. ``otsync calibrate`` finds cameras to .1 degrees where a walk ties them."""


def clocks_kept(options: FitOptions, scene: Scene, train: Sequence[str]) -> tuple[FitOptions, str]:
    """The options with the clocks frozen where the cameras of ``train`` are not known well enough, and a note on it.

    Who names a rate for the offsets gets it.
    """
    sigma = {name: scene.pose_sigma[name] for name in train if scene.pose_sigma.get(name, 0.0) > LOOSE_POSE}
    asked = "offsets" in options.freeze or "offsets" in chosen_rates(options.rates, options.groups)
    if not sigma or asked:
        return options, ""
    worst = max(sigma, key=lambda name: sigma[name])
    return replace(options, freeze=(*options.freeze, "offsets")), (
        f"clocks stay as they are: cameras were found, that of {worst} to {sigma[worst]:.1f} degrees, and a fit would "
        "hide that in the clocks. Another rate (--rates offsets=0.01) lets it move them all the same"
    )


LEAST_SHARE = 0.2
"""Of the budget, for the fit: with less it is said that more time would help."""


def reconstruct(
    scene: Scene,
    offsets: Offsets,
    out: Path,
    *,
    plan: Plan | None = None,
    tracks: Sequence[TrackSet] | None = None,
    held_out: Sequence[str] = (),
    truth: Offsets | None = None,
    priors: Mapping[str, Any] | None = None,
    cache: Any = None,
    map: MapLike = map,
    progress: Progress | None = None,
    deadline: Deadline | None = None,
    watch: Callable[[Gaussians4D, str], None] | None = None,
) -> Outcome:
    """Prepare, fit, evaluate and write the result folder (see :mod:`recon.result.folder`).

    A run that was killed continues from its stages and from ``fit.npz``; unless it has a budget in seconds, it ends
    with the same files.

    Args:
        plan: how; ``plan.fit`` is how the scene is fitted.
        tracks: in space, of training videos; default: tracked and lifted here.
        held_out: names of videos that only the evaluation sees.
        truth: true offsets of at least the training videos.
        priors: of masks, tracks and depth, as the shell spells them
            (:func:`otsync.recordings.stages.stages_from`); run.json keeps them.
        cache: an :class:`otsync.files.cache.Cache`; default: ``stages`` in ``out``. map: any map-like callable.
        deadline: of the whole job, whose seconds ``plan.fit.budget`` then are. The static part gets a share of what is
            left, the fit the rest. What that leaves out is noted.
        watch: is shown the fit as it goes on; see :func:`recon.fit.verb.fit`.
    """
    from otsync.files.cache import Cache

    plan, progress, cache = plan or Plan(), progress or Progress(), cache or Cache(out / "stages")
    stages = stages_from(**(priors or {}))
    # what is lacking is said before the work, not after it
    train = trained(scene, offsets, held_out)
    careful, why = clocks_kept(plan.fit, scene, train)
    plan = replace(plan, fit=careful)
    if why:
        progress.note(why)
    check_effects_of(plan, [v.camera.readout for v in scene.videos if v.name not in held_out])
    if truth is not None:
        _check_truth(truth, train)
    out.mkdir(parents=True, exist_ok=True)
    clear_parts(out, out / "stages")
    ready = prepare(
        scene,
        offsets,
        tracks,
        plan=plan,
        held_out=held_out,
        stages=stages,
        cache=cache,
        map=map,
        progress=progress,
        deadline=deadline,
    )
    true = None if truth is None else true_seconds(truth, ready.offsets)
    effects = with_declared(plan.effects, [f.readout for f in ready.footage], ready.gains, ready.falloff)
    options = replace(plan.fit, effects=effects)
    if deadline is not None:
        progress.note(f"budget: {deadline.left:.0f} of {deadline.seconds:.0f} s are left for the fit")
        if deadline.left < LEAST_SHARE * deadline.seconds:
            progress.note("what comes before the fit took nearly all of the budget: a longer one gives a better scene")
    with progress.stage("fit"):
        initial = ready.initial.to(plan.device)
        if watch is not None:
            watch(ready.initial, "before the first step")
        kept_in = out / "fit.npz"
        fitted = fit(initial, ready.footage, ready.offsets, options, checkpoint=kept_in, deadline=deadline, watch=watch)
    _write_fit(out, fitted)
    with progress.stage("views"):
        videos, scores = compared(fitted, effects, ready, plan, progress)
    outcome = Outcome(fitted, ready.offsets, scores, ready.left_out, true, Lpips().reason)
    _write(out, outcome, videos, effects, ready, plan, priors or {}, progress)
    return outcome


def compared(
    fitted: Reconstruction, effects: Sequence[Effect], ready: Prepared, plan: Plan, progress: Progress
) -> tuple[tuple[FilmedBy, ...], tuple[ViewScore, ...]]:
    """Every camera on the fitted scene, and how well the held-out ones and some of the others are shown.

    A camera that cannot be placed or scored is noted and left out; the fit is kept.
    """
    learned = fitted.parameters
    gains = learned["gain"].detach().cpu().numpy().astype(float)
    gains = np.broadcast_to(gains, (len(gains), 3)).copy()
    clocks = [
        Clock(float(s), float(r), "fitted") for s, r in zip(fitted.offsets.seconds, fitted.offsets.rates, strict=True)
    ]
    through = [optics(effects, f.readout, n, learned) for n, f in enumerate(ready.footage)]
    videos = [FilmedBy.of(f, clocks[n], gains[n], through[n]) for n, f in enumerate(ready.footage)]
    scores = []
    for footage in ready.held_out:
        own = optics(effects, footage.readout, None, learned)
        try:
            looking = view(fitted.scene, footage, ready.clocks.get(footage.name), layered=ready.layered, optics=own)
            scores.append(looking.score(most=plan.views))
        except ValueError as error:
            progress.note(f"held-out video {footage.name} is not compared: {error}")
        else:
            videos.append(FilmedBy.of(footage, looking.clock, looking.gain, own, held_out=True))
        footage.release()
    for n in evenly(len(ready.footage), SHOWN_TRAINING).tolist():
        footage = ready.footage[n]
        try:
            looking = view(fitted.scene, footage, clocks[n], gain=gains[n], layered=ready.layered, optics=through[n])
            scores.append(looking.score(most=max(1, plan.views // 4), held_out=False))
        except ValueError as error:
            progress.note(f"video {footage.name} is not compared: {error}")
        footage.release()
    return tuple(videos), tuple(scores)


SHOWN_TRAINING = 2
"""Training cameras that are compared as well, to show what the held-out ones lack."""


def _write_fit(out: Path, fitted: Reconstruction) -> None:
    """Scene and clocks, before anything is done with them that may fail.

    ``run.json`` of an earlier run goes first: from here until the new one is written the folder is not finished, so
    that a kill cannot leave the old cameras beside the new scene.
    """
    (out / "run.json").unlink(missing_ok=True)
    fitted.scene.save(out / "scene.npz")
    fitted.offsets.save(out / "offsets.json")


def _write(
    out: Path,
    outcome: Outcome,
    videos: Sequence[FilmedBy],
    effects: Sequence[Effect],
    ready: Prepared,
    plan: Plan,
    priors: Mapping[str, Any],
    progress: Progress,
) -> None:
    """The rest of the result folder; run.json last but for the report, since with it the folder counts as finished."""
    fitted = outcome.fitted
    metrics = metrics_of(outcome.views, fitted.stats, outcome.lpips_reason)
    if outcome.truth is not None:
        metrics["offset_error"] = offset_figures(fitted.offsets, outcome.truth)
    write_json(out / "metrics.json", metrics)
    options = {
        "width": plan.width,
        "frames": plan.frames,
        "seed": plan.fit.seed,
        "freeze": list(plan.fit.freeze),
        "layered": ready.layered,
        "priors": dict(priors),
        "optics": kept([own for effect in effects if (own := effect.alone(None, fitted.parameters)) is not None]),
    }
    strips = _strips(ready, progress)
    write_strips(out, strips)
    save_run(
        out,
        videos,
        options=options,
        frame=ready.frame,
        notes=progress.notes,
        seconds=progress.seconds,
    )
    write_reconstruction_report(
        out / "report.html",
        fitted,
        outcome.coarse,
        [f.name for f in ready.footage],
        outcome.views,
        seconds=progress.seconds,
        notes=progress.notes,
        truth=outcome.truth,
        lpips_reason=outcome.lpips_reason,
        scene_page=SCENE_PAGE,
        sync_page=SYNC_PAGE if (out / SYNC_PAGE).is_file() else None,
        filmed=[Video(list(f.images), f.camera, timestamps=f.times, name=f.name) for f in ready.footage],
    )
    write_page(out / SCENE_PAGE, load_result(out), strips, report="report.html")


SYNC_PAGE = "sync.html"
"""Of the clocks, where ``otsync run`` found them."""


def _strips(ready: Prepared, progress: Progress) -> tuple[Strip, ...]:
    """Small pictures of all videos, for the scene page."""
    try:
        return strips_of((*ready.footage, *ready.held_out))
    except ModuleNotFoundError:  # a page without pictures is better than none
        progress.note("the scene page has no pictures of the videos: they need pillow; pip install 'otsync[video]'")
        return ()


def offset_figures(offsets: Offsets, true: np.ndarray) -> dict[str, Any]:
    """Mean and largest absolute error in frames, relative to the reference; None where there is no other video.

    The reference's own error is in all of these. ``mean_apart_frames`` is without what all videos have in common, their
    median error, and of all videos, the reference too: of two it is half of their difference.
    """
    fps = float(offsets.fps[offsets.reference])
    error = offset_error(offsets.seconds, true, fps, reference=offsets.reference)
    alone = len(error.errors) < 2
    return {
        "mean_frames": None if alone else error.mean,
        "max_frames": None if alone else error.max,
        "mean_apart_frames": None if alone else offset_error(offsets.seconds, true, fps, "median").mean,
        "frames": [float(e) for e in error.errors],
    }


def true_seconds(truth: Offsets, offsets: Offsets) -> np.ndarray:
    """True offsets of the videos relative to their reference. ValueError names those that the truth lacks."""
    _check_truth(truth, offsets.names)
    seconds = np.array([truth.seconds[truth.names.index(n)] for n in offsets.names])
    return seconds - seconds[offsets.reference]


def _check_truth(truth: Offsets, names: Sequence[str]) -> None:
    missing = [n for n in names if n not in truth.names]
    if missing:
        raise ValueError(f"truth: expected offsets of {', '.join(names)}; {', '.join(missing)} are not in it.")


def check_effects_of(plan: Plan, readouts: Sequence[float | None]) -> None:
    """ValueError for effects of the plan that lack something, or that run.json cannot name.

    Args:
        readouts: that the cameras of the videos to fit declare.
    """
    effects = with_declared(plan.effects, readouts)
    kept([effect for effect in effects if not effect.groups])


def evaluate(
    result: SavedReconstruction,
    scene: Scene,
    names: Sequence[str],
    offsets: Offsets | None = None,
    *,
    most: int = 50,
    lpips_weights: Path | None = None,
    cache: Any = None,
    map: MapLike = map,
    progress: Progress | None = None,
) -> tuple[tuple[ViewScore, ...], str]:
    """Scores of the named cameras against a finished result, and why LPIPS is missing ("" when it is not).

    Clocks: as ``offsets`` say, else those of the result, else found on the frozen scene. A camera of the result is
    looked through the effects that the fit gave it, any other through those that held for all, and the shutter that it
    declares. ValueError for ``offsets`` that do not tell the clock of each of the named cameras.
    """
    from otsync.files.cache import Cache

    told = {} if offsets is None else given_clocks(offsets)
    untold = [] if offsets is None else [n for n in names if n not in told]
    if untold:
        raise ValueError(
            f"offsets: expected offsets of all that are compared; found none of {', '.join(untold)}. Compare the "
            "others alone, or give no offsets."
        )

    progress, cache = progress or Progress(), cache or Cache()
    lpips = Lpips.load(lpips_weights)
    part = scene.take(names)
    frames = result.options.get("frames")
    if frames is not None:
        part = cut(part, int(frames[0]), int(frames[1]))
    part = on_mended_clocks(part, result.offsets if offsets is None else offsets)
    part = readable(part, cache, map, progress)
    known = {v.name: v for v in result.videos}
    scores = []
    priors = result.options.get("priors", {})
    stages = stages_from(masks=priors.get("masks"), width=priors.get("width"))  # all that footage asks for
    for footage in read_footage(part, int(result.options["width"]), cache, map, progress, stages):
        own = known.get(footage.name)
        clock, gain = (None, None) if own is None else (own.clock, own.gain)
        clock = told.get(footage.name, clock)
        through = optics(result.optics, footage.readout) if own is None else own.optics
        looking = view(result.scene, footage, clock, gain=gain, layered=result.layered, optics=through)
        scores.append(looking.score(most=most, lpips=lpips, held_out=own is None or own.held_out))
    return tuple(scores), lpips.reason
