"""fit(): one scene, many videos, their clocks: everything that has a learning rate is refined from the images.

One step renders a few frames (on a CPU each on a thread of its own, on a GPU all at once where it can), blends them over
their backgrounds, and follows the losses' gradients. The offsets are parameters like any other: a frame's time becomes
world time by its video's offset, and the motion can be differentiated in time. Only differences of offsets are seen. All
of them move during the fit, because holding the reference still leaves a slow common mode between all others and the
motion; at the end the reference is put back to where it was.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from os import PathLike

import numpy as np
from torch import Tensor
from tqdm import tqdm

from otsync.compute.threads import MapLike
from otsync.types import Offsets
from recon.fit.checkpoint import Checkpoint
from recon.fit.densify import Densify
from recon.fit.optimize import RATES
from recon.fit.problem import Loss, Problem, assemble
from recon.fit.run import Diverged, Run
from recon.fit.undisturbed import one_thread_each, uninterrupted
from recon.footage.footage import Footage
from recon.losses.image import Mask, Photometric, ScaleHinge
from recon.losses.motion import Acceleration, Arap, Length, Velocity
from recon.observe.effects import Effect, initial_parameters
from recon.scene.gaussians4d import Gaussians4D

__all__ = ["LOSSES", "RATES", "Diverged", "History", "Reconstruction", "fit"]

LOSSES: tuple[Loss, ...] = (Photometric(), Mask(), ScaleHinge(), Arap(), Length(), Velocity(), Acceleration())
"""What the study of the paper's scene used; depth, tracks and features enter only at initialisation unless added."""

CALIBRATION = (20, 60)  # steps of a session between which the speed is taken when a budget in seconds is given


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
    """What a fit came to.

    Args:
        scene: asked for any world time by ``scene.at(t)``.
        offsets: the videos' clocks, refined where "offsets" had a rate; sigma from the frames' own votes.
        parameters: what the effects learned, by group.
        history: convergence. stats: steps, seconds, images, loss, psnr, gaussians.
    """

    scene: Gaussians4D
    offsets: Offsets
    parameters: dict[str, Tensor]
    history: History
    stats: dict[str, float] = field(default_factory=dict)


def fit(
    scene: Gaussians4D,
    footage: Sequence[Footage],
    offsets: Offsets,
    *,
    losses: Sequence[Loss] = LOSSES,
    effects: Sequence[Effect] = (),
    rates: Mapping[str, float] = RATES,
    steps: int | None = None,
    budget: float | None = None,
    batch: int = 2,
    densify: Densify | None = None,
    seed: int = 0,
    checkpoint: str | PathLike[str] | None = None,
    save_every: float = 60.0,
) -> Reconstruction:
    """Refine a 4D scene, and the clocks of the videos, from their images.

    The fit runs where the scene is: ``fit(scene.to("cuda"), ...)`` runs on a GPU, through gsplat. What it gives back is
    on the CPU either way.

    Args:
        footage: the videos; each is found by name in ``offsets``, whose reference keeps its place.
        losses, effects: what is in the tuple is computed, nothing else; not even a rolling shutter that a camera declares,
            which :func:`recon.effects.with_declared` adds.
        rates: learning rate of each parameter group at the start; a group without one is frozen, "offsets" too.
        steps, budget: how long: a number of steps, or wall seconds, which are turned into a number of steps once the
            first ones have shown their speed (120 at the least). Default: 2000 steps.
        batch: images per step, on a CPU each on its own thread. The result does not depend on the number of threads.
        checkpoint: file that the fit is kept in, every ``save_every`` seconds and on Ctrl-C; a fit that was killed
            continues from it and ends with the same numbers (on a GPU, whose sums run in any order, nearly so).

    Raises:
        ValueError: for footage, offsets or rates that do not fit together.
        Diverged: when a loss or a gradient is no number; the last checkpoint is kept.
    """
    problem = Problem.of(scene, footage, offsets, tuple(losses), tuple(effects), batch, seed)
    options = (losses, effects, sorted(rates.items()), steps, budget, batch, densify, seed)
    keep = Checkpoint(checkpoint, problem.key(*options) if checkpoint is not None else "", save_every)
    run = Run(problem, dict(rates), keep.load(problem.groups()), _steps(steps, budget))
    started = time.perf_counter()
    with ExitStack() as stack:
        each: MapLike = map
        if problem.device.type == "cpu":  # a GPU is fed by one thread: more would only wait for each other
            each = stack.enter_context(ThreadPoolExecutor(batch + 1, thread_name_prefix="recon.fit")).map
        stack.enter_context(one_thread_each(batch))
        bar = stack.enter_context(tqdm(total=run.total, initial=run.step, desc="fit", unit="step", disable=None))
        calibrate = Calibration(budget)
        try:
            while run.total is None or run.step < run.total:
                with uninterrupted():
                    run.advance(each, densify)
                    row = run.record(time.perf_counter() - started) if run.record_due() else None
                bar.update()
                if run.total is None:
                    bar.total = run.total = calibrate(run.step)
                if row is not None:
                    bar.set_postfix_str(f"PSNR {row[3]:.1f}, offsets moved {_moved(problem, row[4:])} frames", False)
                if keep.due():
                    keep.save(run.snapshot())
        except KeyboardInterrupt:
            keep.save(run.snapshot())
            raise
        keep.save(run.snapshot())
        return _finish(run, time.perf_counter() - started)


def _steps(steps: int | None, budget: float | None) -> int | None:
    """How many steps; None when the speed must be known first."""
    if steps is not None and budget is not None:
        raise ValueError("steps, budget: expected one of them, got both")
    if budget is not None:
        if not 0 < budget < math.inf:
            raise ValueError(f"budget: expected seconds above 0, got {budget}")
        return None
    steps = 2000 if steps is None else steps
    if steps < 0:
        raise ValueError(f"steps: expected 0 or more, got {steps}")
    return steps


class Calibration:
    """Turns a budget in seconds into a number of steps, once the first ones of a session have shown their speed."""

    def __init__(self, budget: float | None):
        self.budget, self.done, self.since = budget, 0, time.perf_counter()

    def __call__(self, step: int) -> int | None:
        """The number of steps in all; None until it is known."""
        self.done += 1
        if self.done == CALIBRATION[0]:
            self.since = time.perf_counter()
        if self.done < CALIBRATION[1]:
            return None
        assert self.budget is not None  # only then is the number of steps open
        each = (time.perf_counter() - self.since) / (CALIBRATION[1] - CALIBRATION[0])
        return max(2 * step, int(self.budget / each))  # rates must have time to decay


def _moved(problem: Problem, seconds: np.ndarray) -> str:
    """The largest change of an offset from where it began, relative to the reference, in frames."""
    moved = (seconds - problem.start) / problem.scene.frame_step
    return f"{np.abs(moved - moved[problem.reference]).max():.3f}"


def _finish(run: Run, seconds: float) -> Reconstruction:
    """Put the reference back where it was, and say how sure each clock is."""
    p = run.problem
    values = {n: v.detach() for n, v in run.values().items()}
    scene = assemble(run.scene, values)
    found = values["offsets"].cpu().numpy()
    sigma = run.sigma(values) if "offsets" in run.adam.groups else p.offsets.sigma[p.index]
    drift = float(found[p.reference] - p.start[p.reference])
    scene = replace(scene, motion=scene.motion.shifted(-drift, values["offsets"] - drift)).to("cpu")
    offsets = replace(
        p.offsets,
        seconds=_put(p.offsets.seconds, p.index, found - drift),
        sigma=_put(p.offsets.sigma, p.index, sigma),
        rates=_put(p.offsets.rates, p.index, values["clock_rates"].cpu().numpy()),
    )
    history = History.of(run.rows)
    stats = {
        "steps": float(run.step),
        "seconds": seconds,
        "images": float(run.step * p.batch),
        "gaussians": float(len(scene)),
        "loss": float(history.loss[-1]) if len(history.loss) else math.nan,
        "psnr": float(history.psnr[-1]) if len(history.psnr) else math.nan,
        "drift_frames": drift / scene.frame_step,
    }
    learned = {n: values[n].cpu() for n in initial_parameters(p.effects, len(p.clips))}
    return Reconstruction(scene, offsets, learned, history, stats)


def _put(array: np.ndarray, index: np.ndarray, values: np.ndarray) -> np.ndarray:
    out = np.array(array, float)
    out[index] = values
    return out
