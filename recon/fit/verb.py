"""fit(): one scene, many videos, their clocks: everything that has a learning rate is refined from the images.

One step renders a few frames (on a CPU each on a thread of its own, on a GPU all at once where it can), blends them
over their backgrounds, and follows the losses' gradients. The offsets are parameters like any other: a frame's time
becomes world time by its video's offset, and the motion can be differentiated in time. Only differences of offsets are
seen. All of them move during the fit, because holding the reference still leaves a slow common mode between all others
and the motion; at the end the reference is put back to where it was.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_right
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from os import PathLike
from typing import Any

import numpy as np
import torch
from torch import Tensor

from otsync.compute.interrupts import uninterrupted
from otsync.compute.threads import MapLike, pool_of
from otsync.progress import Deadline, bar
from otsync.types import Offsets, Status
from otsync.types.status import in_order
from recon.fit.checkpoint import Checkpoint
from recon.fit.lags import displaced
from recon.fit.leave_one_out import elsewhere, shown_without_each, steps_worth
from recon.fit.options import FitOptions
from recon.fit.parts import broken
from recon.fit.problem import Problem, assemble, check_groups
from recon.fit.run import Diverged, Run
from recon.fit.uncertainty import averaged, newton_sigma, unreached, unsettled
from recon.fit.undisturbed import one_thread_each
from recon.fit.witnesses import Told, reconciled, relative_sigma, repeated, scaled_start, share_kept, unseen
from recon.footage.footage import Footage
from recon.observe.effects import initial_parameters
from recon.scene.gaussians4d import Gaussians4D

__all__ = ["Diverged", "History", "Reconstruction", "fit"]

FIT_SHARE = 0.9
"""Of what is left of the whole job's time: views are compared and results written after the fit."""

GUESSED = (20, 60)
"""Steps of a session between which the speed is taken first, where a budget in seconds is given: a guess alone."""

CALIBRATED = (0.15, 0.3)
"""Shares of the time between which the speed is taken for good. The first steps are slow: by them alone a fit was a
fifth too short. No rate decays before (:class:`recon.fit.optimize.Decay`)."""

AGAIN, CHANGED = (0.5, 0.7, 0.85, 0.95), 0.03
"""Shares of the time at which the number of steps is set anew where the speed since the last one has changed it by more
than this share: a laptop grows hot, and other work ends."""

RELEASED = 100
"""Steps after which the memory of footage that lies in files is given back: what they read comes from the system's
cache again."""


@dataclass(frozen=True, eq=False)
class History:
    """How a fit went, one row per record.

    Args:
        step: [R] steps done. seconds: [R] wall seconds since the fit began (of the last session, when it was resumed).
        loss: [R] mean loss since the last row. psnr: [R] dB over the boxes that were rendered since the last row.
        offsets: [R,V] seconds, before the gauge is taken out.
    """

    step: np.ndarray
    seconds: np.ndarray
    loss: np.ndarray
    psnr: np.ndarray
    offsets: np.ndarray

    @classmethod
    def of(cls, rows: np.ndarray) -> History:
        return cls(rows[:, 0].astype(int), rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4:])


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A fitted scene and its clocks.

    Args:
        scene: asked for any world time by ``scene.at(t)``.
        offsets: the videos' clocks, refined where "offsets" had a rate; sigma from the frames' own votes, from what was
            not settled yet, and from the sigma of the clocks that the fit began with.
        parameters: of the effects, by group.
        history: convergence. stats: steps, seconds, images, loss, psnr, gaussians; where clocks were bent, the share of
            the start's error that the fit still has, by what it left of the bends, and its sigma.
    """

    scene: Gaussians4D
    offsets: Offsets
    parameters: dict[str, Tensor]
    history: History
    stats: dict[str, float] = field(default_factory=dict)


PHOTOMETRIC = "photometric"
"""In the stats of offsets: that these clocks are what a fit to pictures made of them."""

Watch = Callable[[Gaussians4D, str], None]
"""Is shown a fit as it goes on: the scene, and where it stands in words."""


def fit(
    scene: Gaussians4D,
    footage: Sequence[Footage],
    offsets: Offsets,
    options: FitOptions | None = None,
    *,
    checkpoint: str | PathLike[str] | None = None,
    deadline: Deadline | None = None,
    watch: Watch | None = None,
    **changes: Any,
) -> Reconstruction:
    """Refine a 4D scene, and the clocks of the videos, from their images.

    The fit runs where the scene is: ``fit(scene.to("cuda"), ...)`` runs on a GPU, through gsplat. The result is on the
    CPU either way, and does not depend on the number of threads.

    Args:
        footage: the videos; each is found by name in ``offsets``, whose reference keeps its place.
        options: how the scene is fitted; ``changes`` are fields of it: ``fit(scene, footage, offsets, steps=200)``.
            What is not among its losses and effects is not computed; not even a rolling shutter that a camera declares,
            which :func:`recon.observe.recorded.with_declared` adds.
        checkpoint: file that the fit is kept in, every ``save_every`` seconds and on Ctrl-C; a fit that was killed
            continues from it and ends with the same numbers (on a GPU, whose sums run in any order, nearly so).
        deadline: of the whole job, whose seconds ``options.budget`` are: the fit takes what is left of them.
        watch: called now and then with the scene so far, on the CPU, and in words where the fit stands; it changes
            nothing.

    Raises:
        ValueError: for footage, offsets or rates that do not fit together.
        TypeError: for a change that is no field of :class:`FitOptions`.
        Diverged: when a loss or a gradient is no number; the last checkpoint is kept.

    Example:
        >>> fit(scene, footage, offsets, steps=200, freeze=("offsets",))  # doctest: +SKIP
    """
    unknown = changes.keys() - (known := {f.name: None for f in fields(FitOptions)}).keys()
    if unknown:
        raise TypeError(f"fit: expected fields of FitOptions ({', '.join(known)}); found {', '.join(sorted(unknown))}.")
    options = replace(options or FitOptions(), **changes)
    problem, rates = Problem.of(scene, footage, offsets, options), options.active_rates()
    check_groups(problem, options)
    o = options
    told = (o.losses, o.effects, sorted(rates.items()), o.steps, o.budget, o.batch, o.densify, o.seed)
    keep = Checkpoint(checkpoint, problem.key(*told) if checkpoint is not None else "", options.save_every)
    run = Run(problem, rates, keep.load(problem.groups()), options.total)
    started = time.perf_counter()
    with ExitStack() as stack:
        each: MapLike = map
        if problem.device.type == "cpu":  # a GPU is fed by one thread: more would only wait for each other
            each = stack.enter_context(pool_of(options.batch + 1, "recon.fit")).map
        stack.enter_context(one_thread_each(options.batch))
        shown = stack.enter_context(bar("fit", "step", run.total, initial=run.step))
        calibrate = None
        if run.total is None:
            calibrate = Calibration(options.budget, deadline, lambda total: run.steps_after() + steps_worth(run, total))
        try:
            while run.total is None or run.step < run.total:
                with uninterrupted():
                    run.advance(each, options.densify)
                    row = run.record(time.perf_counter() - started) if run.record_due() else None
                shown.update()
                if calibrate is not None:
                    run.expected, run.total = calibrate(run.step)
                    shown.total = run.expected
                if row is not None:
                    shown.set_postfix_str(f"PSNR {row[3]:.1f}, offsets moved {_moved(problem, row[4:])} frames", False)
                if watch is not None and row is not None:
                    values = {n: v.detach().clone() for n, v in run.values().items()}
                    watch(assemble(run.scene, values).to("cpu"), f"step {run.step}, PSNR {row[3]:.1f} dB")
                if keep.due():
                    keep.save(run.snapshot())
                if run.step % RELEASED == 0:
                    for one in footage:
                        one.release()
        except KeyboardInterrupt:
            keep.save(run.snapshot())
            raise
        keep.save(run.snapshot())
        return _finish(run, time.perf_counter() - started, each)


class Calibration:
    """Turns a budget in seconds into a number of steps, as the steps show their speed.

    Args:
        budget: seconds of the fit; of none, a share of what is left of the ``deadline``. after: steps that the work
            after the last one is worth, by how many there are; more steps are worth no less.
    """

    def __init__(
        self, budget: float | None, deadline: Deadline | None = None, after: Callable[[int], int] = lambda total: 0
    ):
        assert budget is not None or deadline is not None  # only then is the number of steps open
        self.deadline, self.after, self.done = deadline, after, 0
        self.began = self.since = time.perf_counter()
        self.seconds = float(budget or 0.0) if deadline is None else FIT_SHARE * deadline.left
        self.first, self.again = 0, False
        self.guess: int | None = None
        self.known: int | None = None
        self.least, self.marks = 0, list(AGAIN)

    def __call__(self, step: int) -> tuple[int | None, int | None]:
        """After a step: the number of steps in all as it is guessed, and as it is known; None before."""
        self.done += 1
        now = time.perf_counter()
        gone = now - self.began
        if self.done == GUESSED[0] or (
            self.guess is not None and not self.again and gone >= CALIBRATED[0] * self.seconds
        ):
            self.since, self.first, self.again = now, self.done, self.guess is not None
        if self.guess is None and self.done >= GUESSED[1]:
            self.guess = self._total(step, now)
        if self.guess is not None and self.known is None and gone >= CALIBRATED[1] * self.seconds:
            self.guess = self.known = self._total(step, now)
            self.since, self.first, self.least = now, self.done, 2 * step
        elif self.known is not None and self.marks and gone >= self.marks[0] * self.seconds:
            if self.done - self.first >= GUESSED[0]:  # fewer, as after a pause of the machine, tell no speed
                total = max(self.least, self._total(step, now))
                if abs(total - self.known) > CHANGED * self.known:
                    self.guess = self.known = total
            self.since, self.first, self.marks = now, self.done, self.marks[1:]
        return self.guess, self.known

    def _total(self, step: int, now: float) -> int:
        steps = self.done - self.first
        if not steps:  # the time was over before it could be measured
            return 2 * step
        each = (now - self.since) / steps
        left = self.seconds - (now - self.began) if self.deadline is None else FIT_SHARE * self.deadline.left
        most = step + int(left / each)
        total = max(step + 1, bisect_right(range(most + 1), most, key=lambda n: n + self.after(n)) - 1)
        return total if self.least else max(2 * step, total)  # rates must have time to decay


def _moved(problem: Problem, seconds: np.ndarray) -> str:
    """The largest change of an offset from where it began, relative to the reference, in frames."""
    moved = (seconds - problem.start) / problem.scene.frame_step
    return f"{np.abs(moved - moved[problem.reference]).max():.3f}"


def _finish(run: Run, seconds: float, map: MapLike) -> Reconstruction:
    """Put the reference back where it was, and say how sure each clock is."""
    p = run.problem
    values = {n: v.detach() for n, v in run.values().items()}
    scene = assemble(run.scene, values)
    history = _offsets_by_step(run, values["offsets"].cpu().numpy())
    if "offsets" in run.adam.groups:
        values["offsets"] = torch.as_tensor(averaged(history)).to(values["offsets"])
    refined = values["offsets"].cpu().numpy()
    drift = float(refined[p.reference] - p.start[p.reference])
    refined, sigma = refined - drift, p.offsets.sigma[p.index]
    told: Told | None = None
    flags = list(p.offsets.flags)
    if "offsets" in run.adam.groups:
        at_start = values | {"offsets": values["offsets"] - drift}
        votes = run.votes(values, map)
        refined, sigma, raised, told = _witnessed(run, refined, sigma, newton_sigma(votes), history)
        parts = sorted(
            {
                *broken(votes, p.scene.frame_step),
                *displaced(run.lagged(values, votes, map)),
                *elsewhere(shown_without_each(run, at_start, map), sigma, p.reference),
            }
        )
        # where the reference's clock breaks all others are off by it
        apart = [v for v in range(len(p.clips)) if v != p.reference] if p.reference in parts else parts
        for v, flag in (*raised, *((v, Status.BROKEN_CLOCK) for v in apart)):
            flags[p.index[v]] = in_order((*flags[p.index[v]], flag))
    clocks = torch.as_tensor(refined).to(values["offsets"])
    scene = replace(scene, motion=scene.motion.shifted(-drift, clocks)).to("cpu")
    offsets = replace(
        p.offsets,
        seconds=_put(p.offsets.seconds, p.index, refined),
        sigma=_put(p.offsets.sigma, p.index, sigma),
        flags=tuple(flags),
        rates=_put(p.offsets.rates, p.index, values["clock_rates"].cpu().numpy()),
        stats=dict(p.offsets.stats) | ({PHOTOMETRIC: 1.0} if "offsets" in run.adam.groups else {}),
    ).judged_by_sigma()
    course = History.of(run.rows)
    stats = {
        "steps": float(run.step),
        "seconds": seconds,
        "images": float(run.step * p.batch),
        "gaussians": float(len(scene)),
        "loss": float(course.loss[-1]) if len(course.loss) else math.nan,
        "psnr": float(course.psnr[-1]) if len(course.psnr) else math.nan,
        "drift_frames": drift / scene.frame_step,
    }
    if told is not None:
        stats |= {"start_kept": told.share, "start_kept_sigma": told.share_sigma}
    learned = {n: values[n].cpu() for n in initial_parameters(p.effects, len(p.clips))}
    return Reconstruction(scene, offsets, learned, course, stats)


def _witnessed(
    run: Run, refined: np.ndarray, start_sigma: np.ndarray, votes: np.ndarray, history: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[tuple[int, Status]], Told | None]:
    """What start and pictures together say of the clocks: offsets and sigma [V], seconds, flags by video, and what
    bends told.

    Args:
        refined: offsets of the fit. start_sigma: of the clocks that it began with. votes: sigma of the frames' votes,
            of each clock by itself. history: as of :func:`recon.fit.uncertainty.averaged`.
    """
    p = run.problem
    before, gap = relative_sigma(start_sigma, p.reference), refined - p.start
    told = run.told(votes)
    seen = run.step * p.batch
    usual = share_kept(images=seen / len(p.clips), epochs=seen / len(p.keys))
    kept, scale = (usual, 1.0) if told is None else (told.kept, told.scale)
    votes = relative_sigma(scale * votes, p.reference)
    alone = np.hypot(votes, unsettled(history, p.reference))
    again = bool(p.offsets.stats.get(PHOTOMETRIC))
    if told is not None and not again:
        before = scaled_start(before, gap, alone, p.reference, kept)
    own = unseen(before, gap, p.reference, kept)
    if again:
        offsets, sigma, contradicted = repeated(p.start, before, refined, np.hypot(alone, own), p.reference)
    else:  # the other witness' share of a start is its own
        witness = np.isfinite(before) & (before > 0)
        alone = np.where(witness, alone, np.hypot(alone, own))
        offsets, sigma, contradicted = reconciled(p.start, before, refined, alone, p.reference, kept)
    sigma = np.hypot(sigma, unreached(before, run.reach("offsets")))
    # where nothing moves, in a video or in the reference, pictures tell nothing: the start stands
    blind = ~np.isfinite(votes)
    offsets, sigma = np.where(blind, p.start, offsets), np.where(blind, before, sigma)
    raised = [(int(v), Status.CONTRADICTED) for v in np.flatnonzero(contradicted & ~blind)]
    raised += [(int(v), Status.STATIC) for v in np.flatnonzero(blind & ~np.isfinite(before))]
    return offsets, sigma, raised, told


def _offsets_by_step(run: Run, reached: np.ndarray) -> np.ndarray:
    """[R,1+V] (step, offsets): where they began, the rows of the history, and what was reached."""
    recorded = np.delete(run.rows, [1, 2, 3], axis=1)
    return np.vstack([[0, *run.problem.start], recorded, [run.step, *reached]])


def _put(array: np.ndarray, index: np.ndarray, values: np.ndarray) -> np.ndarray:
    out = np.array(array, float)
    out[index] = values
    return out
