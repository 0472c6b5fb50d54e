"""A fit under way: its parameters, and its steps."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from otsync.compute.threads import MapLike
from recon.fit.checkpoint import Snapshot
from recon.fit.densify import Densify
from recon.fit.lags import FIRST, LAGS, Lagged, OtherTimes, lagged
from recon.fit.optimize import Adam, Decay, check_rates
from recon.fit.problem import Problem, assemble, scene_groups
from recon.fit.uncertainty import FRAMES, Look, Target, Votes, cast
from recon.fit.witnesses import Told, told_by_bends
from recon.losses.image import Seen
from recon.losses.motion import Draw
from recon.observe.cameras import Clip, compose_over, feature_image, observer, observer_at_once
from recon.observe.effects import Rendered, Shot, compose, prior
from recon.scene.gaussians4d import Gaussians4D, scene_arrays, scene_from_arrays

RECORDS = 200  # rows of history in a fit
UNSEEN = -30.0  # logit of an opacity that nobody sees


class Diverged(RuntimeError):
    """A loss or a gradient is no number any more; the text names the step, the group and the frame."""


@dataclass(frozen=True)
class JobDone:
    """One job of a step, done.

    Args:
        losses, psnrs: by image. gradients: in the order of the groups, None where there is none.
        pull: [2,N] what densification is decided by; None where it was not asked for.
    """

    losses: list[float]
    psnrs: list[float]
    gradients: list[Tensor | None]
    pull: Tensor | None


class Run:
    """A fit under way: its parameters, and its steps.

    ``total`` is the number of steps in all, None until a budget has shown it; ``expected`` is guessed before that, for
    records alone.
    """

    def __init__(self, problem: Problem, rates: dict[str, float], snapshot: Snapshot | None, total: int | None):
        self.problem, self.rates = problem, rates
        self.scene, self.step, self.total = problem.scene, 0, total
        self.expected: int | None = None
        self.groups = problem.groups()
        self.rows = np.zeros((0, 4 + len(problem.clips)))
        if snapshot is not None:
            self.scene, self.step, self.total = (
                scene_from_arrays(snapshot.scene).to(problem.device),
                snapshot.step,
                snapshot.steps or total,
            )
            self.groups |= {n: v.to(problem.device) for n, v in snapshot.groups.items()}
            self.rows = snapshot.history
        self.densified = 0 if snapshot is None else snapshot.densified
        self.adam = self._adam({} if snapshot is None else snapshot.moments)
        self.decay = Decay()
        self._since = [] if snapshot is None else [(float(a), float(b)) for a, b in snapshot.since]
        self._pull = self._no_pull() if snapshot is None else snapshot.pull.to(problem.device)

    def _adam(self, moments: Mapping[str, Tensor]) -> Adam:
        motion, active = self.scene.motion, check_rates(self.rates, self.groups)
        active |= {name: active[name] / motion.peak for name in motion.parameters() if name in active}
        adam = Adam(self.groups, active, self.scene.footprint, self.scene.frame_step, self.problem.declared)
        adam.restore(moments)
        return adam

    def _no_pull(self) -> Tensor:
        return torch.zeros(2, len(self.scene), device=self.problem.device)

    def values(self) -> dict[str, Tensor]:
        """Every group's current value; those that are fitted require gradients."""
        return {**self.groups, **self.adam.groups}

    @property
    def done(self) -> float:
        """The share 0..1 of the steps that is done; 0 until a budget has shown their number."""
        return self.step / self.total if self.total else 0.0

    def world_time(self, values: Mapping[str, Tensor], video: int, frame: int) -> Tensor:
        """World seconds at which a frame was taken, differentiable in its video's clock."""
        t = values["clock_rates"][video] * self.problem.times[video][frame] + values["offsets"][video]
        return t + values["bends"][video] * self.problem.waves[video][frame] if len(values["bends"]) else t

    def shot(self, values: Mapping[str, Tensor], video: int, frame: int) -> Shot:
        """What is asked for of a frame: the box where something may move, at the world time that its clock gives."""
        clip, rate = self.problem.clips[video], values["clock_rates"][video]
        t = self.world_time(values, video, frame)
        return Shot(video, t, clip.box(frame), clip.size[1], frame, rate=rate, circle=clip.circle)

    def advance(self, map: MapLike, densify: Densify | None) -> None:
        """A step, and what is due after it: all of it, or none."""
        self.one_step(map, probe=densify is not None)
        if densify is not None and self.total:
            due = sorted(densify.steps(self.total))
            # a budget may learn its length only after a moment has passed
            if self.densified < len(due) and self.step >= due[self.densified]:
                self.densify(densify)
                self.densified += 1

    def one_step(self, map: MapLike, probe: bool = False) -> None:
        """Render a batch, gather gradients in a fixed order, and move; ``map`` calls the jobs of the step."""
        p, values = self.problem, self.values()
        names = list(self.adam.groups)
        keys = p.pick(self.step)
        groups = [keys] if p.at_once else [[key] for key in keys]
        jobs = [partial(self.image_gradient, values, names, group, probe) for group in groups]
        if p.motion_losses:
            jobs.append(partial(self.motion_gradient, values, names))
        done = list(map(lambda job: job(), jobs))
        total: dict[str, Tensor] = {}
        for n, result in enumerate(done):
            share = 1.0 / p.batch if n < len(groups) else 1.0
            for name, gradient in zip(names, result.gradients, strict=True):
                if gradient is not None:
                    total[name] = gradient * share if name not in total else total[name].add_(gradient, alpha=share)
        self._guard(total, done, keys)
        if "clock_rates" in total:  # the reference's clock is the world's
            total["clock_rates"][p.reference] = 0
        self.adam.step(total, self.decay(self.done))
        self.step += 1
        for r in done[: len(groups)]:
            self._since += zip(r.losses, r.psnrs, strict=True)
            if r.pull is not None:
                self._pull += r.pull

    def steps_after(self) -> int:
        """Steps that take as long as :meth:`votes`, three renderings each, and what :meth:`lagged` asks of all."""
        if "offsets" not in self.adam.groups:
            return 0
        frames = np.unique(self.problem.keys[:, 0], return_counts=True)[1]
        renderings = 3 * np.minimum(frames, FRAMES) + (2 * len(LAGS) + 2) * np.minimum(frames, FIRST)
        return int(renderings.sum() / self.problem.batch)

    def reach(self, group: str) -> float:
        """How far Adam's steps so far can have moved an entry of a group, in the group's own unit."""
        steps = range(self.step)
        return self.adam.rates.get(group, 0.0) * sum(self.decay(k / self.total if self.total else 0.0) for k in steps)

    def look(self, values: dict[str, Tensor], video: int, frame: int, later: float = 0.0) -> Tensor:
        """The image [h,w,3] of a frame's box as the scene gives it, ``later`` seconds after the frame, without a
        graph.
        """
        p, clip = self.problem, self.problem.clips[video]
        box = clip.box(frame)
        observe = observer(assemble(self.scene, values), p.clips, values["offsets"])
        shot = self.shot(values, video, frame)
        shot = replace(shot, t=shot.t + later)
        with torch.no_grad():
            return compose_over(compose(observe, p.effects, values)(shot), clip.behind(box))

    def votes(self, values: dict[str, Tensor], map: MapLike = map) -> list[Votes]:
        """What frames say of each video's own clock: see :func:`recon.fit.uncertainty.cast`."""
        look, target = self._shown(values)
        p = self.problem
        return cast(look, target, p.keys, len(p.clips), self.scene.frame_step, map=map)

    def lagged(self, values: dict[str, Tensor], votes: Sequence[Votes], map: MapLike = map) -> list[Lagged]:
        """How each video's frames are shown at other times: see :func:`recon.fit.lags.lagged`."""
        return lagged(self.other_times(values), votes, map)

    def other_times(self, values: dict[str, Tensor], ahead: tuple[float, ...] = LAGS) -> OtherTimes:
        """Frames beside what their cameras would see ``ahead`` and as many seconds before."""
        look, target = self._shown(values)
        still = values | {"opacity_logits": torch.full_like(values["opacity_logits"], UNSEEN)}
        empty, time = partial(self.look, still), partial(self.world_time, values)
        return OtherTimes(look, empty, target, time, self.scene.frame_step, ahead)

    def anew(
        self, keys: np.ndarray, steps: int, values: Mapping[str, Tensor], known: Collection[str], faster: float
    ) -> Run:
        """A fit of so many steps of one image to some of the images, from the scene that this one began with, that
        holds the ``known`` groups at their ``values``. The others have ``faster`` times the rates of this one.
        """
        rates = {name: faster * rate for name, rate in self.rates.items() if name not in known}
        fresh = Run(replace(self.problem, keys=keys, batch=1), rates, None, steps)
        fresh.groups |= {name: values[name].detach().clone() for name in known}
        return fresh

    def _shown(self, values: dict[str, Tensor]) -> tuple[Look, Target]:
        """Frames as the scene gives them, and as they are."""
        clips = self.problem.clips
        return partial(self.look, values), lambda v, k: clips[v].image(k, clips[v].box(k))

    def told(self, sigma: np.ndarray) -> Told | None:
        """What the bends of the clocks tell, None where none were bent; ``sigma``: seconds, of the votes."""
        left = self.values()["bends"].detach().cpu().numpy()
        return told_by_bends(np.array([c.footage.bend for c in self.problem.clips]), left, sigma) if len(left) else None

    def image_gradient(
        self, values: dict[str, Tensor], names: list[str], keys: list[tuple[int, int]], probe: bool
    ) -> JobDone:
        """Losses of some frames, and the gradients of their sum; several are rendered at once."""
        p = self.problem
        probes: list[tuple[Tensor, Tensor]] = []
        scene = assemble(self.scene, values)
        shots = [self.shot(values, v, k) for v, k in keys]
        clocks, depth, asked = values["offsets"], p.needs("depth"), probes if probe else None
        observe = (
            observer(scene, p.clips, clocks, depth=depth, probes=asked)
            if len(shots) == 1
            else observer_at_once(scene, p.clips, shots, clocks, depth=depth, probes=asked)
        )
        observe, losses, errors = compose(observe, p.effects, values), [], []
        held = prior(p.effects, values)  # of every image, so that it weighs as much in any batch
        for shot in shots:
            seen = self.seen(scene, values, observe(shot), p.clips[shot.video], shot)
            parts = [loss.weight * value for loss in p.losses if (value := loss(seen)) is not None]
            losses.append(sum(parts if held is None else [*parts, held], torch.zeros((), device=p.device)))
            errors.append((seen.rendered.detach() - seen.image).square().mean())
        loss = sum(losses[1:], losses[0])
        wanted = [values[n] for n in names] + [means for means, _ in probes]
        gradients = torch.autograd.grad(loss, wanted, allow_unused=True) if loss.requires_grad else [None] * len(wanted)
        pull = self._no_pull() if probe else None
        for (_, radii), g in zip(probes, gradients[len(names) :], strict=True):
            if pull is not None and g is not None:
                seen_here = (radii[:, : len(scene)] > 0).any(-1)
                length = g.reshape(len(radii), -1, 2)[:, : len(scene)].norm(dim=-1)
                pull += torch.stack([(length * seen_here).sum(0), seen_here.float().sum(0)])
        psnrs = [-10 * math.log10(float(e) + 1e-12) for e in errors]
        return JobDone([float(x.detach()) for x in losses], psnrs, list(gradients[: len(names)]), pull)

    def seen(
        self, scene: Gaussians4D, values: Mapping[str, Tensor], rendered: Rendered, clip: Clip, shot: Shot
    ) -> Seen:
        """A rendered frame beside everything that is given of it; what no loss reads is not computed."""
        p, k, box, given = self.problem, shot.frame, shot.box, clip.footage
        rows, columns = slice(box[1], box[3]), slice(box[0], box[2])

        def cut(maps: Mapping[int, np.ndarray] | None) -> Tensor | None:
            return None if maps is None or k not in maps else torch.as_tensor(maps[k][rows, columns], device=p.device)

        depth, features = cut(given.depth), cut(given.features) if p.needs("features") else None
        tracks = None if given.tracks is None else given.tracks.get(k)
        clocks = values["offsets"]
        return Seen(
            rendered=compose_over(rendered, clip.behind(box)),
            alpha=rendered.alpha,
            depth=rendered.depth,
            image=clip.image(k, box),
            mask=clip.mask(k, box),
            video=shot.video,
            frame=k,
            t=shot.t,
            box=box,
            view=(clip.K, clip.pose(k)),
            scales=scene.dynamic.scales,
            footprint=scene.footprint,
            given_depth=depth,
            given_features=features,
            features=None if features is None else feature_image(scene, clip, k, shot.t, box, clocks),
            tracks=tracks,
            means=None if tracks is None else scene.moving(shot.t, clocks).means,
        )

    def motion_gradient(self, values: dict[str, Tensor], names: list[str]) -> JobDone:
        """Losses of the motion itself, at a time of its own."""
        p = self.problem
        scene = assemble(self.scene, values)
        rng = np.random.default_rng([p.seed, 2, self.step])
        draw = Draw(rng, scene.span, scene.frame_step, scene.footprint, values["offsets"])
        parts = [
            loss.weight_at(self.done) * value
            for loss in p.motion_losses
            if self.step % loss.every == 0
            if (value := loss(scene.motion, scene.dynamic.means, scene.dynamic.quats, draw)) is not None
        ]
        total = sum(parts, torch.zeros((), device=p.device))
        wanted = [values[n] for n in names]
        gradients = (
            torch.autograd.grad(total, wanted, allow_unused=True) if total.requires_grad else [None] * len(names)
        )
        return JobDone([float(total.detach())], [], list(gradients), None)

    def _guard(self, total: Mapping[str, Tensor], done: Sequence[JobDone], keys: list[tuple[int, int]]) -> None:
        """Diverged, with step, group and frames, before a NaN reaches the parameters."""
        sums = [g.sum().isfinite() for g in total.values()]
        sound = not sums or bool(torch.stack(sums).all())  # one question: a GPU's answers are waited for
        bad = [] if sound else [n for n, g in total.items() if not bool(g.isfinite().all())]
        if bad or not all(math.isfinite(loss) for r in done for loss in r.losses):
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
        denser, old, fresh = densify(assemble(self.scene, values), pull)
        self.scene, source = densify.scaffold(denser, pull[old])
        self.groups = values | scene_groups(self.scene)
        carried = {}
        for name, moment in moments.items():
            group, _, kind = name.rpartition(".")
            told = self.problem.declared.get(group)
            if told is not None and kind != "step" and told.rows == "gaussians":
                moment = _carried(moment, told.axis, torch.where(fresh, -1, old))
            elif told is not None and kind != "step" and told.rows == "nodes" and source is not None:
                moment = _carried(moment, told.axis, source)
            carried[name] = moment
        self.adam = self._adam(carried)
        self._pull = self._no_pull()

    def record_due(self) -> bool:
        every = max(1, (self.total or self.expected or 10**9) // RECORDS)
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
            self.densified,
            self._pull,
            np.array(self._since).reshape(-1, 2),
        )


def _carried(moment: Tensor, axis: int, source: Tensor) -> Tensor:
    """Adam's averages of the rows that stay; zero for new ones (source -1)."""
    out = moment.index_select(axis, source.clamp_min(0))
    shape = [1] * out.ndim
    shape[axis] = -1
    return out * (source >= 0).reshape(shape)
