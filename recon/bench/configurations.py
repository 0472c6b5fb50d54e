"""The field's methods, and the ablations, as settings of one fit: nothing here is another code path.

ours                  motion-spline scaffold, offsets refined
fixed                 the same, offsets held: what refinement is worth
true time             the same from true offsets, held: the ceiling (Dynamic3DGaussians' setting, with our motion)
w/o spline            nodes sampled per frame: no derivative in time, so nothing to refine offsets by (MoSca)
w/o scaffold          every Gaussian on a spline of its own
scaffold per video    the paper's: every video's nodes on that video's clock
Sync-NeRF style       images alone: no priors on motion, and from offsets that no geometric stage has found
Dynamic3DGaussians    true offsets, every Gaussian free in every frame
without LOSS          ours, without a loss of the default ones
with LOSS             ours, with another loss that there is, a plugin's too
with EFFECT           ours, with an effect that a plugin adds
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from otsync.plugins import available
from recon.fit.optimize import chosen_rates
from recon.fit.options import DEFAULT_LOSSES
from recon.losses import LOSSES, Loss, Mask, Photometric, ScaleHinge
from recon.motion import PerGaussian, Sampled, Scaffold
from recon.observe import EFFECTS, Effect
from recon.observe.recorded import all_effects
from recon.pipeline.plan import Plan
from recon.pipeline.readings import SUPPLIED
from recon.scene.gaussians4d import Gaussians4D

Start = Literal["given", "true"]


def as_built(scene: Gaussians4D) -> Gaussians4D:
    """The motion that the tracks gave."""
    return scene


def sampled(scene: Gaussians4D) -> Gaussians4D:
    """Nodes sampled once a frame, held in between."""
    assert isinstance(scene.motion, Scaffold)
    return replace(scene, motion=scene.motion.on(_per_frame(scene)))


def per_gaussian(scene: Gaussians4D) -> Gaussians4D:
    """Every Gaussian on a spline of its own, which begins as the scaffold's."""
    assert isinstance(scene.motion, Scaffold)
    return replace(scene, motion=PerGaussian.following(scene.motion, scene.dynamic.means))


def per_gaussian_sampled(scene: Gaussians4D) -> Gaussians4D:
    """Every Gaussian free in every frame, beginning as the scaffold carries it."""
    assert isinstance(scene.motion, Scaffold)
    path = _per_frame(scene)
    return replace(scene, motion=PerGaussian.following(scene.motion, scene.dynamic.means, path))


def _per_frame(scene: Gaussians4D) -> Sampled:
    assert isinstance(scene.motion, Scaffold)
    ends = scene.motion.path.times
    return Sampled.of(float(ends[0]), float(ends[-1]), scene.frame_step)


@dataclass(frozen=True)
class Configuration:
    """One row of a table.

    Args:
        start: offsets that everything is built from: those given, or the truth.
        change: what the row does otherwise than the plan of all rows.
        motion: what becomes of the motion before the fit. groups: the parameter groups of that motion.
    """

    start: Start = "given"
    change: Callable[[Plan], Plan] = lambda plan: plan
    motion: Callable[[Gaussians4D], Gaussians4D] = as_built
    groups: tuple[str, ...] = ("knots", "knot_quats")

    def plan(self, plan: Plan) -> Plan:
        """The plan of this row, without what the plan of all rows says of the groups of other motions."""
        changed = self.change(plan)
        others, fit = [g for g in OF_MOTIONS if g not in self.groups], changed.fit
        rates = None if fit.rates is None else {g: rate for g, rate in fit.rates.items() if g not in others}
        freeze = tuple(g for g in fit.freeze if g not in others)
        return replace(changed, fit=replace(fit, rates=rates, freeze=freeze))


OF_MOTIONS = ("knots", "knot_quats", "own_knots")
"""Parameter groups that one motion has and another has not."""


def check_heeded(rows: Sequence[Configuration], plan: Plan) -> None:
    """ValueError for rates and groups to freeze of motions that none of the rows has."""
    fitted = {g for row in rows for g in row.groups}
    chosen = (("rates", chosen_rates(plan.fit.rates, plan.fit.groups)), ("freeze", plan.fit.freeze))
    for option, names in chosen:
        unused = [g for g in names if g in OF_MOTIONS and g not in fitted]
        if unused:
            raise ValueError(
                f"{option}: expected groups that a row fits; found {', '.join(unused)}. Leave them out, or add a row "
                "of another motion."
            )


def held(plan: Plan) -> Plan:
    """The offsets stay as they are, whatever rate the plan gives them."""
    others = tuple(g for g in plan.fit.freeze if g != "offsets")
    if plan.fit.rates is None:
        return replace(plan, fit=replace(plan.fit, freeze=(*others, "offsets")))
    rates = {g: rate for g, rate in plan.fit.rates.items() if g != "offsets"}
    return replace(plan, fit=replace(plan.fit, rates=rates, freeze=others))


def per_video(plan: Plan) -> Plan:
    """A scaffold on every video's own clock."""
    return replace(plan, scaffold=replace(plan.scaffold, per_video=True))


def images_alone(plan: Plan) -> Plan:
    """No losses on the motion."""
    return replace(plan, fit=replace(plan.fit, losses=(Photometric(), Mask(), ScaleHinge())))


def without_loss(kind: type[Loss]) -> Callable[[Plan], Plan]:
    """The losses of the plan but for those of a class."""

    def change(plan: Plan) -> Plan:
        rest = tuple(loss for loss in plan.fit.losses if type(loss) is not kind)
        if len(rest) == len(plan.fit.losses):
            raise ValueError(f"rows: expected a loss of the plan to leave out; {kind.__name__} is none of them.")
        return replace(plan, fit=replace(plan.fit, losses=rest))

    return change


def with_loss(kind: type[Loss]) -> Callable[[Plan], Plan]:
    """The losses of the plan, and one more at its defaults."""

    def change(plan: Plan) -> Plan:
        if any(type(loss) is kind for loss in plan.fit.losses):
            raise ValueError(f"rows: expected a loss to add; {kind.__name__} is among those of the plan already.")
        return replace(plan, fit=replace(plan.fit, losses=(*plan.fit.losses, kind())))

    return change


def with_effect(kind: Callable[[], Effect]) -> Callable[[Plan], Plan]:
    """The effects of the plan, and one more at its defaults."""

    def change(plan: Plan) -> Plan:
        return replace(plan, fit=replace(plan.fit, effects=(*plan.fit.effects, kind())))

    return change


OWN: Mapping[str, Configuration] = {
    "ours": Configuration(),
    "fixed": Configuration(change=held),
    "true time": Configuration("true", held),
    "w/o spline": Configuration(change=held, motion=sampled),
    "w/o scaffold": Configuration(motion=per_gaussian, groups=("own_knots",)),
    "scaffold per video": Configuration(change=per_video),
    "Sync-NeRF style": Configuration(change=images_alone),
    "Dynamic3DGaussians": Configuration("true", held, per_gaussian_sampled, ("own_knots",)),
}


def configurations() -> dict[str, Configuration]:
    """Every row that can be measured: our own, and one for each loss and effect that there is, ours or a plugin's."""
    rows, usual = dict(OWN), {type(loss) for loss in DEFAULT_LOSSES}
    for name, kind in available("losses", LOSSES).items():
        if kind in usual:
            rows[f"without {name}"] = Configuration(change=without_loss(kind))
        elif getattr(kind, "reads", None) in (None, *SUPPLIED):
            rows[f"with {name}"] = Configuration(change=with_loss(kind))
    for name, effect in all_effects().items():
        if effect not in EFFECTS:
            rows[f"with {name}"] = Configuration(change=with_effect(effect))
    return rows
