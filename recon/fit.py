"""fit(): one scene, many videos, their clocks: everything that has a learning rate is refined from the images.

One step renders a few frames, each on a thread of its own, blends them over their backgrounds, and follows the losses'
gradients. The offsets are parameters like any other: a frame's time becomes world time by its video's offset, and the
motion can be differentiated in time. Only differences of offsets are seen. All of them move during the fit, because
holding the reference still leaves a slow common mode between all others and the motion; at the end the reference is
put back to where it was.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from os import PathLike
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from otsync.types import Offsets
from recon.checkpoint import Checkpoint, Snapshot, key_of
from recon.density import Densify
from recon.effects import Effect, Shot, compose, initial_parameters, prior
from recon.footage import Footage
from recon.gaussians4d import Gaussians4D, scene_arrays, scene_from_arrays
from recon.losses import ImageLoss, Mask, Photometric, ScaleHinge, Seen
from recon.optimize import RATES, Adam, Decay, check_rates
from recon.quiet import one_thread_each, uninterrupted
from recon.regularizers import Acceleration, Arap, Draw, Length, MotionLoss, Velocity
from recon.stage import Clip, compose_over, observer
from recon.uncertainty import newton_sigma

logger = logging.getLogger("recon")

Loss = ImageLoss | MotionLoss

LOSSES: tuple[Loss, ...] = (Photometric(), Mask(), ScaleHinge(7e-4), Arap(), Length(), Velocity(), Acceleration())
"""What the study of the paper's scene used; depth, tracks and features enter only at initialisation unless added."""

RECORDS = 200  # rows of history in a fit
CALIBRATION = (20, 60)  # steps between which the speed is taken when a budget in seconds is given


class Diverged(RuntimeError):
    """A loss or a gradient is no number any more; the text names the step, the group and the frame."""


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

    Args:
        footage: the videos; each is found by name in ``offsets``, whose reference keeps its place.
        losses, effects: what is in the tuple is computed, nothing else.
        rates: learning rate of each parameter group at the start; a group without one is frozen, "offsets" too.
        steps, budget: how long: a number of steps, or wall seconds, which are turned into a number of steps once the
            first ones have shown their speed. Default: 2000 steps.
        batch: images per step, each on its own thread. The result does not depend on the number of threads.
        checkpoint: file that the fit is kept in, every ``save_every`` seconds and on Ctrl-C; a fit that was killed
            continues from it and ends with the same numbers.

    Raises:
        ValueError: for footage, offsets or rates that do not fit together.
        Diverged: when a loss or a gradient is no number; the last checkpoint is kept.
    """
    problem = Problem.of(scene, footage, offsets, tuple(losses), tuple(effects), batch, seed)
    total = _steps(steps, budget)
    options = (losses, effects, sorted(rates.items()), steps, budget, batch, densify, seed)
    keep = Checkpoint(checkpoint, problem.key(*options) if checkpoint is not None else "", save_every)
    run = Run(problem, dict(rates), keep.load(), total)
    due = densify.steps(total) if densify is not None and total else frozenset()
    started, last = time.perf_counter(), time.perf_counter()
    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(batch + 1, thread_name_prefix="recon.fit"))
        stack.enter_context(one_thread_each(batch))
        bar = stack.enter_context(tqdm(total=total, initial=run.step, desc="fit", unit="step", disable=None))
        try:
            while run.total is None or run.step < run.total:
                run.one_step(pool, probe=densify is not None)
                bar.update()
                if run.total is None and run.step == CALIBRATION[0]:
                    last = time.perf_counter()
                if run.total is None and run.step == CALIBRATION[1]:
                    assert budget is not None
                    each = (time.perf_counter() - last) / (CALIBRATION[1] - CALIBRATION[0])
                    run.total = max(CALIBRATION[1], int(budget / each))
                    due = densify.steps(run.total) if densify is not None else due
                    bar.total = run.total
                if densify is not None and run.step in due:
                    run.densify(densify)
                if run.record_due():
                    row = run.record(time.perf_counter() - started)
                    bar.set_postfix_str(f"PSNR {row[3]:.1f}, offsets {_spread(problem, row[4:])}", refresh=False)
                if keep.due():
                    keep.save(run.snapshot())
        except KeyboardInterrupt:
            keep.save(run.snapshot())
            raise
        keep.save(run.snapshot())
        return run.finish(time.perf_counter() - started)


def _steps(steps: int | None, budget: float | None) -> int | None:
    if steps is not None and budget is not None:
        raise ValueError("steps, budget: expected one of them, got both")
    if budget is not None:
        if not budget > 0:
            raise ValueError(f"budget: expected seconds above 0, got {budget}")
        return None
    steps = 2000 if steps is None else steps
    if steps < 0:
        raise ValueError(f"steps: expected 0 or more, got {steps}")
    return steps


def _spread(problem: Problem, seconds: np.ndarray) -> str:
    """How far the offsets have moved from where they began, relative to the reference, in frames."""
    moved = (seconds - problem.start) / problem.scene.frame_step
    return f"moved {np.abs(moved - moved[problem.reference]).max():.3f} frames at most"


@dataclass(frozen=True, eq=False)
class Problem:
    """What a fit is about, and does not change while it runs."""

    scene: Gaussians4D
    clips: tuple[Clip, ...]
    times: tuple[Tensor, ...]
    offsets: Offsets
    index: np.ndarray
    losses: tuple[ImageLoss, ...]
    motion_losses: tuple[MotionLoss, ...]
    effects: tuple[Effect, ...]
    keys: np.ndarray
    batch: int
    seed: int

    @classmethod
    def of(
        cls, scene: Gaussians4D, footage: Sequence[Footage], offsets: Offsets, losses: tuple[Loss, ...],
        effects: tuple[Effect, ...], batch: int, seed: int,
    ) -> Problem:  # fmt: skip
        """Check that everything fits together; ValueError names what does not."""
        if not footage:
            raise ValueError("footage: expected at least one video, got none")
        if batch < 1:
            raise ValueError(f"batch: expected at least 1 image a step, got {batch}")
        names = [f.name for f in footage]
        missing = [n for n in names if n not in offsets.names]
        if missing or len(set(names)) < len(names):
            raise ValueError(
                f"footage: expected unique names among those of offsets ({', '.join(offsets.names)}); found "
                f"{', '.join(missing or names)}"
            )
        index = np.array([offsets.names.index(n) for n in names])
        apart = [offsets.names[v] for v in index if not np.isfinite(offsets.seconds[v])
                 or offsets.component[v] != offsets.component[index[0]]]  # fmt: skip
        if apart:
            raise ValueError(
                f"offsets: expected every video on one clock; {', '.join(apart)} have no offset on it. Leave them out."
            )
        if len(scene) == 0:
            raise ValueError("scene: expected moving Gaussians, got none: nothing was seeded where things move")
        unknown = [type(x).__name__ for x in losses if not hasattr(x, "needs") and not hasattr(x, "every")]
        if unknown:
            raise ValueError(f"losses: expected ImageLoss or MotionLoss objects, got {', '.join(unknown)}")
        keys = [(v, k) for v, f in enumerate(footage) for k in range(len(f.images))
                if not f.bad[k] and (f.boxes[k, 2:] > f.boxes[k, :2]).all()]  # fmt: skip
        if not keys:
            raise ValueError("footage: expected frames in which something moves; found none. Check the masks.")
        device = scene.dynamic.means.device
        return cls(
            scene, tuple(Clip.of(f, device) for f in footage),
            tuple(torch.as_tensor(f.times, dtype=torch.float64) for f in footage), offsets, index,
            tuple(x for x in losses if hasattr(x, "needs")), tuple(x for x in losses if hasattr(x, "every")), effects, np.array(keys), batch, seed,
        )  # fmt: skip

    @property
    def start(self) -> np.ndarray:
        """[V] seconds that the offsets begin at."""
        return self.offsets.seconds[self.index]

    @property
    def reference(self) -> int:
        """The video whose offset stays: the offsets' reference, or the first where that was left out."""
        at = np.nonzero(self.index == self.offsets.component[self.index[0]])[0]
        return int(at[0]) if len(at) else 0

    @property
    def needs_depth(self) -> bool:
        return any("depth" in loss.needs for loss in self.losses)

    def key(self, *options: Any) -> str:
        """What decides the result: see :func:`recon.checkpoint.key_of`."""
        arrays = [*scene_arrays(self.scene).values(), self.start, self.offsets.rates[self.index]]
        for clip in self.clips:
            f = clip.footage
            arrays += [f.images, f.times, f.K, f.w2c, f.boxes, f.bad]
            arrays += [a for a in (f.masks, f.background) if a is not None]
        return key_of(arrays, *options)

    def pick(self, step: int) -> list[tuple[int, int]]:
        """(video, frame) of the images of a step: every frame once before any comes again."""
        chosen = []
        for i in range(step * self.batch, (step + 1) * self.batch):
            epoch, at = divmod(i, len(self.keys))
            order = np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.keys))
            chosen.append((int(self.keys[order[at], 0]), int(self.keys[order[at], 1])))
        return chosen

    def groups(self) -> dict[str, Tensor]:
        """Every parameter group at its start, frozen or not."""
        out = scene_groups(self.scene)
        out |= initial_parameters(self.effects, len(self.clips))
        out["offsets"] = torch.as_tensor(self.start.copy())
        out["clock_rates"] = torch.as_tensor(self.offsets.rates[self.index].copy())
        return out


def scene_groups(scene: Gaussians4D) -> dict[str, Tensor]:
    """The parameter groups of a scene: the dynamic Gaussians' by their own names, the static ones' with a prefix."""
    out = {f.name: getattr(scene.dynamic, f.name) for f in fields(scene.dynamic)}
    out |= scene.motion.parameters()
    if scene.static is not None:
        out |= {f"static.{f.name}": getattr(scene.static, f.name) for f in fields(scene.static)}
    return out


def assemble(scene: Gaussians4D, groups: Mapping[str, Tensor]) -> Gaussians4D:
    """The scene with the groups' values."""
    dynamic = replace(scene.dynamic, **{f.name: groups[f.name] for f in fields(scene.dynamic)})
    motion = scene.motion.with_parameters({n: groups[n] for n in scene.motion.parameters()})
    static = scene.static
    if static is not None:
        static = replace(static, **{n[7:]: t for n, t in groups.items() if n.startswith("static.")})
    return replace(scene, dynamic=dynamic, motion=motion, static=static)


class Run:
    """A fit under way: its parameters, and what happens in a step."""

    def __init__(self, problem: Problem, rates: dict[str, float], snapshot: Snapshot | None, total: int | None):
        self.problem, self.rates = problem, rates
        self.scene, self.step, self.total = problem.scene, 0, total
        self.groups = problem.groups()
        self.rows = np.zeros((0, 4 + len(problem.clips)))
        if snapshot is not None:
            self.scene, self.step, self.total = (
                scene_from_arrays(snapshot.scene),
                snapshot.step,
                snapshot.steps or total,
            )
            self.groups |= {n: v.to(self.groups[n].device) for n, v in snapshot.groups.items()}
            self.rows = snapshot.history
        self.adam = self._adam({} if snapshot is None else snapshot.moments)
        self.decay = Decay()
        self._since: list[tuple[float, float]] = []
        self._pull = torch.zeros(2, len(self.scene))

    def _adam(self, moments: Mapping[str, Tensor]) -> Adam:
        active = check_rates(self.rates, self.groups)
        adam = Adam(self.groups, active, self.scene.footprint, self.scene.frame_step)
        adam.restore(moments)
        return adam

    def values(self) -> dict[str, Tensor]:
        """Every group's current value; those that are fitted require gradients."""
        return {**self.groups, **self.adam.groups}

    def world_time(self, values: Mapping[str, Tensor], video: int, frame: int) -> Tensor:
        """World seconds at which a frame was taken, differentiable in its video's clock."""
        return values["clock_rates"][video] * self.problem.times[video][frame] + values["offsets"][video]

    def one_step(self, pool: ThreadPoolExecutor, probe: bool = False) -> None:
        """Render a batch, gather gradients in a fixed order, and move."""
        p, values = self.problem, self.values()
        names = list(self.adam.groups)
        jobs = [pool.submit(self.image_gradient, values, names, key, probe) for key in p.pick(self.step)]
        if p.motion_losses:
            jobs.append(pool.submit(self.motion_gradient, values, names))
        done = [job.result() for job in jobs]
        total: dict[str, Tensor] = {}
        for n, result in enumerate(done):
            share = 1.0 / p.batch if n < p.batch else 1.0
            for name, gradient in zip(names, result.gradients, strict=True):
                if gradient is not None:
                    total[name] = gradient * share if name not in total else total[name].add_(gradient, alpha=share)
        self._guard(total, done, p.pick(self.step))
        fraction = self.step / self.total if self.total else 0.0
        with uninterrupted():
            self.adam.step(total, self.decay(fraction))
            self.step += 1
            self._since += [(r.loss, r.psnr) for r in done[: p.batch]]
            if probe:
                for r in done[: p.batch]:
                    self._pull += r.pull

    def look(self, values: dict[str, Tensor], video: int, frame: int, later: float = 0.0) -> Tensor:
        """The image [h,w,3] of a frame's box as the scene gives it, ``later`` seconds after the frame, without a graph."""
        p, clip = self.problem, self.problem.clips[video]
        box = clip.box(frame)
        observe = observer(assemble(self.scene, values), p.clips, values["offsets"])
        shot = Shot(video, self.world_time(values, video, frame) + later, box, clip.size[1], frame)
        with torch.no_grad():
            return compose_over(compose(observe, p.effects, values)(shot), clip.behind(box))

    def sigma(self, values: dict[str, Tensor]) -> np.ndarray:
        """See :func:`recon.uncertainty.newton_sigma`."""
        p = self.problem
        return newton_sigma(
            lambda v, k, later: self.look(values, v, k, later), lambda v, k: p.clips[v].image(k, p.clips[v].box(k)),
            p.keys, p.reference, len(p.clips), self.scene.frame_step,
        )  # fmt: skip

    def image_gradient(self, values: dict[str, Tensor], names: list[str], key: tuple[int, int], probe: bool) -> Result:
        """Loss of one frame and its gradients."""
        p, (v, k) = self.problem, key
        probes: list[tuple[Tensor, Tensor]] = []
        scene = assemble(self.scene, values)
        clip = p.clips[v]
        box = clip.box(k)
        observe = observer(scene, p.clips, values["offsets"], depth=p.needs_depth, probes=probes if probe else None)
        shot = Shot(v, self.world_time(values, v, k), box, clip.size[1], k)
        rendered = compose(observe, p.effects, values)(shot)
        image = clip.image(k, box)
        seen = Seen(
            rendered=compose_over(rendered, clip.behind(box)), alpha=rendered.alpha, depth=rendered.depth, image=image,
            mask=clip.mask(k, box), video=v, frame=k, t=shot.t, box=box, view=(clip.K, clip.pose(k)),
            scales=scene.dynamic.scales, footprint=scene.footprint,
        )  # fmt: skip
        parts = [loss.weight * value for loss in p.losses if (value := loss(seen)) is not None]
        held = prior(p.effects, values)
        loss = sum(parts if held is None else [*parts, held], torch.zeros(()))
        psnr = -10 * math.log10(float((seen.rendered.detach() - image).square().mean()) + 1e-12)
        wanted = [values[n] for n in names] + [means for means, _ in probes]
        gradients = torch.autograd.grad(loss, wanted, allow_unused=True) if loss.requires_grad else [None] * len(wanted)
        pull = torch.zeros(2, len(scene)) if probe else None
        for (_, radii), g in zip(probes, gradients[len(names) :], strict=True):
            if pull is not None and g is not None:
                seen_here = (radii > 0).any(-1).cpu()
                pull += torch.stack([g[0, : len(scene)].norm(dim=-1).cpu() * seen_here, seen_here.float()])
        return Result(float(loss.detach()), psnr, list(gradients[: len(names)]), pull)

    def motion_gradient(self, values: dict[str, Tensor], names: list[str]) -> Result:
        """Losses of the motion itself, at a time of its own."""
        p = self.problem
        scene = assemble(self.scene, values)
        rng = np.random.default_rng([p.seed, 2, self.step])
        draw = Draw(rng, scene.span, scene.frame_step, scene.footprint, values["offsets"])
        parts = [
            loss.weight * value for loss in p.motion_losses if self.step % loss.every == 0
            if (value := loss(scene.motion, scene.dynamic.means, scene.dynamic.quats, draw)) is not None
        ]  # fmt: skip
        total = sum(parts, torch.zeros(()))
        wanted = [values[n] for n in names]
        gradients = (
            torch.autograd.grad(total, wanted, allow_unused=True) if total.requires_grad else [None] * len(names)
        )
        return Result(float(total.detach()), math.nan, list(gradients), None)

    def _guard(self, total: Mapping[str, Tensor], done: Sequence[Result], keys: list[tuple[int, int]]) -> None:
        """Diverged, with step, group and frames, before a NaN reaches the parameters."""
        bad = [n for n, g in total.items() if not bool(g.sum().isfinite()) and not bool(g.isfinite().all())]
        lost = [n for n, r in enumerate(done) if not math.isfinite(r.loss)]
        if bad or lost:
            frames = ", ".join(f"{self.problem.clips[v].footage.name} frame {k}" for v, k in keys)
            what = f"the gradient of {', '.join(bad)}" if bad else "the loss"
            raise Diverged(
                f"step {self.step}: {what} is no number ({frames}). Lower its rate, and look at these frames; the "
                "parameters before this step are those of the last checkpoint."
            )

    def densify(self, densify: Densify) -> None:
        """Split, clone and prune; Adam forgets the new ones' past."""
        values, moments = {n: v.detach() for n, v in self.values().items()}, self.adam.moments()
        pull = self._pull[0] / self._pull[1].clamp_min(1)
        before = len(self.scene)
        self.scene, old, fresh = densify(assemble(self.scene, values), pull)
        self.groups = values | scene_groups(self.scene)
        carried = {}
        for name, moment in moments.items():
            group, _, kind = name.rpartition(".")
            axis = 1 if group == "own_knots" else 0
            if kind != "step" and moment.ndim > axis and moment.shape[axis] == before and group in PER_GAUSSIAN:
                moment = moment.index_select(axis, old)
                moment[(slice(None),) * axis + (fresh,)] = 0
            carried[name] = moment
        self.adam = self._adam(carried)
        self._pull = torch.zeros(2, len(self.scene))

    def record_due(self) -> bool:
        every = max(1, (self.total or 10**9) // RECORDS)
        return self.step % every == 0 or self.step == self.total

    def record(self, seconds: float) -> np.ndarray:
        """Append a row to the history."""
        loss, psnr = np.mean(self._since, axis=0) if self._since else (math.nan, math.nan)
        offsets = self.values()["offsets"].detach().cpu().numpy()
        row = np.array([self.step, seconds, loss, psnr, *offsets])
        self.rows = np.concatenate([self.rows, row[None]])
        self._since = []
        return row

    def snapshot(self) -> Snapshot:
        values = {n: v.detach().clone() for n, v in self.values().items()}
        return Snapshot(
            self.step,
            self.total or 0,
            scene_arrays(assemble(self.scene, values)),
            values,
            self.adam.moments(),
            self.rows,
        )

    def finish(self, seconds: float) -> Reconstruction:
        """Put the reference back, and say how sure each clock is."""
        p = self.problem
        values = {n: v.detach() for n, v in self.values().items()}
        scene = assemble(self.scene, values)
        found = values["offsets"].cpu().numpy()
        sigma = self.sigma(values) if "offsets" in self.adam.groups else p.offsets.sigma[p.index]
        drift = float(found[p.reference] - p.start[p.reference])
        scene = replace(scene, motion=scene.motion.shifted(-drift), span=scene.span)
        offsets = replace(
            p.offsets,
            seconds=_put(p.offsets.seconds, p.index, found - drift), sigma=_put(p.offsets.sigma, p.index, sigma),
            rates=_put(p.offsets.rates, p.index, values["clock_rates"].cpu().numpy()),
        )  # fmt: skip
        history = History.of(self.rows)
        stats = {
            "steps": float(self.step), "seconds": seconds, "images": float(self.step * p.batch),
            "gaussians": float(len(scene)), "loss": float(history.loss[-1]) if len(history.loss) else math.nan,
            "psnr": float(history.psnr[-1]) if len(history.psnr) else math.nan,
            "drift_frames": drift / scene.frame_step,
        }  # fmt: skip
        learned = {n: values[n] for n in initial_parameters(p.effects, len(p.clips))}
        return Reconstruction(scene, offsets, learned, history, stats)


PER_GAUSSIAN = ("means", "quats", "log_scales", "opacity_logits", "sh", "own_knots")


@dataclass(frozen=True)
class Result:
    """What one job of a step gives back; gradients in the order of the groups, None where there is none."""

    loss: float
    psnr: float
    gradients: list[Tensor | None]
    pull: Tensor | None


def _put(array: np.ndarray, index: np.ndarray, values: np.ndarray) -> np.ndarray:
    out = np.array(array, float)
    out[index] = values
    return out
