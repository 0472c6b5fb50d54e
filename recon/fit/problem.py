"""The problem of a fit: a scene, videos with their clocks, losses and effects, checked against each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from otsync.files.digest import content_key
from otsync.types import Offsets
from recon.fit.optimize import check_there, chosen_rates
from recon.fit.options import FitOptions
from recon.footage.footage import Footage
from recon.losses import ImageLoss, MotionLoss
from recon.observe.cameras import Clip
from recon.observe.effects import Effect, initial_parameters
from recon.scene.gaussians4d import Gaussians4D, scene_arrays
from recon.scene.groups import Group


@dataclass(frozen=True, eq=False)
class Problem:
    """All that a fit is given and does not change while it runs.

    Args:
        times: [V] of (F,) seconds of every video's frames. waves: of a bend of one second there
            (:mod:`recon.footage.bends`). index: [V] place of every video in ``offsets``.
        losses, motion_losses, effects, batch, seed: of the options.
        keys: [K,2] (video, frame) of the images that take part. declared: what is declared of every parameter group.
    """

    scene: Gaussians4D
    clips: tuple[Clip, ...]
    times: tuple[Tensor, ...]
    waves: tuple[Tensor, ...]
    offsets: Offsets
    index: np.ndarray
    losses: tuple[ImageLoss, ...]
    motion_losses: tuple[MotionLoss, ...]
    effects: tuple[Effect, ...]
    keys: np.ndarray
    batch: int
    seed: int
    declared: Mapping[str, Group]

    @classmethod
    def of(
        cls, scene: Gaussians4D, footage: Sequence[Footage], offsets: Offsets, options: FitOptions | None = None
    ) -> Problem:
        """Check that everything fits together; ValueError names what does not."""
        options = options or FitOptions()
        if not footage:
            raise ValueError("footage: expected at least one video; found none.")
        names = [f.name for f in footage]
        missing = [n for n in names if n not in offsets.names]
        if missing or len(set(names)) < len(names):
            raise ValueError(
                f"footage: expected unique names among those of offsets ({', '.join(offsets.names)}); found "
                f"{', '.join(missing or names)}"
            )
        index = np.array([offsets.names.index(n) for n in names])
        apart = [
            offsets.names[v]
            for v in index
            if not np.isfinite(offsets.seconds[v]) or offsets.component[v] != offsets.component[index[0]]
        ]
        if apart:
            raise ValueError(
                f"offsets: expected every video on one clock; {', '.join(apart)} have no offset on it. Leave them out."
            )
        if len(scene) == 0:
            raise ValueError("scene: expected moving Gaussians; found none: nothing was seeded where things move.")
        on_images = tuple(loss for loss in options.losses if isinstance(loss, ImageLoss))
        for loss in on_images:
            if loss.reads is not None and not any(getattr(f, loss.reads) for f in footage):
                raise ValueError(
                    f"losses: {type(loss).__name__} compares with the {loss.reads} of footage; found none in any "
                    f"video. Give Footage.{loss.reads}, or leave the loss out."
                )
            if "features" in loss.needs and scene.features is None:
                raise ValueError(
                    f"losses: {type(loss).__name__} compares the scene's features; found none. Lift them first."
                )
        keys = [
            (v, k)
            for v, f in enumerate(footage)
            for k in range(len(f.images))
            if not f.bad[k] and (f.boxes[k, 2:] > f.boxes[k, :2]).all()
        ]
        if not keys:
            raise ValueError("footage: expected frames in which something moves; found none. Check the masks.")
        device = scene.dynamic.means.device
        return cls(
            scene,
            tuple(Clip.of(f, device) for f in footage),
            tuple(torch.as_tensor(f.times, dtype=torch.float64, device=device) for f in footage),
            tuple(
                torch.as_tensor(np.zeros(len(f)) if f.wave is None else f.wave, dtype=torch.float64, device=device)
                for f in footage
            ),
            offsets,
            index,
            on_images,
            tuple(loss for loss in options.losses if isinstance(loss, MotionLoss)),
            options.effects,
            np.array(keys),
            options.batch,
            options.seed,
            options.groups,
        )

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
    def device(self) -> torch.device:
        """Where the fit runs: where the scene is."""
        return self.scene.dynamic.means.device

    @property
    def layered(self) -> bool:
        """Whether what is static is not drawn: there is none, or every video has a background instead."""
        return self.scene.static is None or all(clip.background is not None for clip in self.clips)

    @property
    def at_once(self) -> bool:
        """Whether the images of a step are one rendering: on a GPU, where no effect asks for other moments than the
        frames' own and what is static is not drawn."""
        return self.device.type != "cpu" and self.layered and all(effect.instant for effect in self.effects)

    def needs(self, what: str) -> bool:
        """Whether a loss asks for "depth" or "features" to be rendered."""
        return any(what in loss.needs for loss in self.losses)

    def key(self, *options: Any) -> str:
        """A hash of all that decides the result, the same in every process."""
        footage = []
        for clip in self.clips:  # one after the other, or all pixels are in memory at once
            footage.append(content_key(clip.footage))
            clip.footage.release()
        rates = self.offsets.rates[self.index]
        return content_key(scene_arrays(self.scene), self.start, rates, footage, *options)

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
        out = initial_parameters(self.effects, len(self.clips))
        out["offsets"] = torch.as_tensor(self.start.copy())
        bends = np.array([clip.footage.bend for clip in self.clips])
        out["bends"] = torch.as_tensor(bends if bends.any() else bends[:0])
        out["clock_rates"] = torch.as_tensor(self.offsets.rates[self.index].copy())
        return scene_groups(self.scene) | {name: t.to(self.device) for name, t in out.items()}


def check_groups(problem: Problem, options: FitOptions) -> None:
    """ValueError for chosen rates, and groups to freeze, that no image or loss of this problem depends on."""
    drawn = {n: v for n, v in problem.groups().items() if not (problem.layered and n.startswith("static."))}
    check_there("rates", chosen_rates(options.rates, problem.declared), drawn)
    check_there("freeze", options.freeze, drawn)


def scene_groups(scene: Gaussians4D) -> dict[str, Tensor]:
    """The parameter groups of a scene: the dynamic Gaussians' by their own names, the static ones' with a prefix.

    What depends on the view is a group of its own, as in 3DGS: few cameras are soon fitted by it instead of by shape.
    """
    out = {f.name: getattr(scene.dynamic, f.name) for f in fields(scene.dynamic)}
    if scene.dynamic.sh_degree:
        out["sh"], out["sh_rest"] = scene.dynamic.sh[:, :1], scene.dynamic.sh[:, 1:]
    out |= scene.motion.parameters()
    if scene.features is not None:
        out["features"] = scene.features
    if scene.static is not None:
        out |= {f"static.{f.name}": getattr(scene.static, f.name) for f in fields(scene.static)}
    return out


def assemble(scene: Gaussians4D, groups: Mapping[str, Tensor]) -> Gaussians4D:
    """The scene with the groups' values."""
    own = {f.name: groups[f.name] for f in fields(scene.dynamic)}
    if "sh_rest" in groups:
        own["sh"] = torch.cat([groups["sh"], groups["sh_rest"]], 1)
    dynamic = replace(scene.dynamic, **own)
    motion = scene.motion.with_parameters({n: groups[n] for n in scene.motion.parameters()})
    static = scene.static
    if static is not None:
        static = replace(static, **{n[7:]: t for n, t in groups.items() if n.startswith("static.")})
    return replace(scene, dynamic=dynamic, motion=motion, static=static, features=groups.get("features"))
