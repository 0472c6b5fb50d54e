"""Whether each video suits a scene that was fitted without it.

A scene follows its videos, those with a wrong clock as well: of few videos it takes the wrong one in and shows it well,
and two that are off alike vouch for each other. A scene that never saw a video's pictures does not follow it. So where
videos are few, the scene that the fit began with is fitted anew without each of them in turn, on two seconds in which
it and most others have frames, and frames of the one that was left out are held against what its camera would see
earlier and later. It is asked as a whole (all its frames by one lag): single frames suit other times by chance.

Clocks and what effects have learned are those of the fit, and stay as they are. A scene that was fitted to these videos
before, and is fitted once more, holds the wrong one from the start: it tells less.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from functools import partial

import numpy as np
from torch import Tensor

from otsync.compute.threads import MapLike
from otsync.progress import bar
from recon.fit.lags import Lagged
from recon.fit.problem import Problem
from recon.fit.run import Diverged, Run
from recon.fit.uncertainty import scattered
from recon.observe.effects import initial_parameters
from recon.scene.groups import CLOCKS

FEW = 6
"""Videos up to which each is left out once. Of more, most see anything, and one that is wrong is shown badly."""

STEPS = 100
"""Of each of these fits, of one image: after fewer the ghosts of the video that was left out, which the scene began
with, are still there, and it suits its own times."""

FASTER = 3.0
"""Times the rates of the fit, for so few steps: two of five videos that are twelve frames off alike suit the true lag
by .59 and .71 of their own times, by .88 and not at all with its own rates. With five times sound ones come near it."""

SHARE = 0.75
"""Of the images that the fit saw, which all of these together see at the most."""

SECONDS = 2.0
"""Of the scene that it is fitted on, so that every moment is seen often."""

FRAMES = 8
"""Of the video that was left out, each held against all lags where the first few promise anything."""

FIRST = 3
"""Of these, those that are asked first."""

PROMISING = 0.95
"""Of the sum of squares of these at their own times, below which the others are asked."""

AHEAD = tuple(n / 30 for n in (1, *range(2, 31, 2)))
"""Seconds, earlier and later: what suits a lag of twelve frames well may suit eleven badly."""

SURELY = 2.0
"""Sigmas of its clock beyond which a lag contradicts what the fit says."""

BETTER = 0.8
"""Of the sum of squares of all frames at their own times, below which another lag suits the video better."""

NOTHING = 0.95
"""Of the sum of squares of the scene without what moves, that this lag must be below as well."""

ALIKE = 0.5
"""Share of the frames that must suit a lag next to this one better than their own times."""

RENDERING = 1 / 3
"""Of the time that an image takes in a step, which renders it, and goes back for the gradient."""


def leaves_out(run: Run) -> bool:
    """Whether the fit is asked: of two to :data:`FEW` videos, whose offsets and whose scene are fitted."""
    fitted = set(run.adam.groups)
    return 1 < len(run.problem.clips) <= FEW and "offsets" in fitted and bool(fitted - _known(run.problem))


def steps_worth(run: Run, total: int) -> int:
    """Steps of a fit of ``total`` steps that take as long as :func:`shown_without_each` after it."""
    if not leaves_out(run):
        return 0
    rendered = RENDERING * (2 * len(AHEAD) + 2) * FIRST
    return math.ceil(len(run.problem.clips) * (_steps(run.problem, total) + rendered) / run.problem.batch)


def shown_without_each(run: Run, values: dict[str, Tensor], map: MapLike = map) -> list[Lagged]:
    """How frames of each video are shown, at their own times and others, by a scene that was fitted without it.

    Args:
        run: the fit that ended. values: its groups; their offsets are those that the scene of the start would have,
            which holds no drift. map: calls the jobs, one a video.

    Returns:
        One entry a video, with no frames where it shares none with the others, or where the fit without it diverged;
        no entries where videos are many or their clocks were not fitted.
    """
    p = run.problem
    if not leaves_out(run):
        return []
    seconds = np.array([float(run.world_time(values, int(v), int(k))) for v, k in p.keys])
    stop = threading.Event()
    shown = []
    with bar("leave one out", "video", len(p.clips)) as told:
        try:
            for one in map(partial(_shown_without, run, values, seconds, stop), range(len(p.clips))):
                shown.append(one)
                told.update()
        finally:  # on Ctrl-C nobody waits for the others
            stop.set()
    for clip in p.clips:
        clip.footage.release()
    return shown


def elsewhere(shown: Sequence[Lagged], sigma: np.ndarray, reference: int) -> list[int]:
    """Videos that suit another time of a scene without them better than their clocks say.

    Args:
        sigma: [V] seconds, of the offsets to the ``reference``. Its own place in the scene is as sure as that of the
            surest other one.
    """
    known = np.where(np.isfinite(sigma), sigma, np.inf)
    known[reference] = np.delete(known, reference).min(initial=np.inf)
    return [v for v, one in enumerate(shown) if len(one.frames) and _suits_another(one, SURELY * known[v])]


def busiest(own: np.ndarray, others: np.ndarray) -> float:
    """Where :data:`SECONDS` begin in which a video and the others have most frames: most pairs of one of each.

    Args:
        own, others: seconds of the scene of their frames, in any order.
    """
    own, others = np.sort(own), np.sort(others)
    begins = np.concatenate([own, others])

    def inside(times: np.ndarray) -> np.ndarray:
        return np.searchsorted(times, begins + SECONDS, "right") - np.searchsorted(times, begins, "left")

    return float(begins[np.argmax(inside(own) * inside(others))])


def _steps(problem: Problem, total: int) -> int:
    return min(STEPS, int(SHARE * total * problem.batch / len(problem.clips)))


def _known(problem: Problem) -> set[str]:
    """Groups that stay as the fit left them."""
    return {*(group.name for group in CLOCKS), *initial_parameters(problem.effects, len(problem.clips))}


def _shown_without(
    run: Run, values: dict[str, Tensor], seconds: np.ndarray, stop: threading.Event, video: int
) -> Lagged:
    p = run.problem
    mine = p.keys[:, 0] == video
    begin = busiest(seconds[mine], seconds[~mine])
    near = (seconds >= begin) & (seconds <= begin + SECONDS)
    others = near & ~mine
    within = seconds[others].min(initial=np.inf), seconds[others].max(initial=-np.inf)
    own = near & mine & (seconds >= within[0]) & (seconds <= within[1])
    nothing = Lagged(np.zeros(0, int), np.zeros(0), np.zeros((0, 0)), np.zeros(0))
    if not own.any():
        return nothing
    alone = run.anew(p.keys[others], _steps(p, run.step), values, _known(p), FASTER)
    try:
        while alone.step < (alone.total or 0):
            if stop.is_set():
                return nothing
            alone.one_step(map)
    except Diverged:
        return nothing
    times = alone.other_times({name: value.detach() for name, value in alone.values().items()}, AHEAD)
    frames = np.sort(p.keys[own, 1])
    chosen = frames[scattered(len(frames), FRAMES)]
    first = scattered(len(chosen), FIRST)
    rows = {k: times.errors((video, k), *within) for k in chosen[first].tolist()}
    share = _share(told := times.of(list(rows), list(rows.values())), told.lags != 0)
    if share.min() < PROMISING:
        rows |= {k: times.errors((video, k), *within) for k in chosen.tolist() if k not in rows}
    return times.of(sorted(rows), [rows[k] for k in sorted(rows)])


def _share(one: Lagged, lags: np.ndarray) -> np.ndarray:
    """[L] by lag: the sum of squares of the frames that have it, of theirs at their own times; inf of other ``lags``,
    where few frames have it, and where nothing that moves would do as well.
    """
    own = one.errors[:, one.lags == 0]
    seen = np.isfinite(one.errors)
    there, here = np.where(seen, one.errors, 0.0).sum(0), (seen * own).sum(0)
    nothing = (seen * one.nothing[:, None]).sum(0)
    common = seen.sum(0) >= max(2, math.ceil(len(own) / 2))
    asked = lags & common & (there < NOTHING * nothing) & (here > 0)
    return np.where(asked, there / np.maximum(here, 1e-300), np.inf)


def _suits_another(one: Lagged, beyond: float) -> bool:
    share = _share(one, np.abs(one.lags) > beyond)
    best = int(np.argmin(share))
    if share[best] >= BETTER:
        return False
    around = one.errors[:, max(0, best - 1) : best + 2]
    around = np.where(np.isfinite(around), around, np.inf).min(1)
    frames = np.isfinite(one.errors[:, best])
    return bool((around[frames] < one.errors[frames, one.lags == 0]).mean() > ALIKE)
