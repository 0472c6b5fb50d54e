"""The field's methods, and the ablations, as settings of one fit: nothing here is another code path.

ours                     motion-spline scaffold, offsets refined
fixed                    the same, offsets held: what refinement is worth
true time                the same from true offsets, held: the ceiling
Hermite spline           the paper's splines, through their knots, in place of B-splines
w/o spline               nodes sampled per frame: no derivative in time, so nothing to refine offsets by (MoSca)
w/o spline, true time    the same from true offsets: what a spline costs or gains in quality (the paper's ablation)
w/o scaffold             every Gaussian on a spline of its own, begun from the tracks near it; no scaffold anywhere
w/o scaffold, true time  the same from true offsets, held
scaffold per video       every video's nodes on that video's clock, as in the paper
Sync-NeRF style          images and calibration alone: no tracks, no depth, no scaffold, no priors on motion
Dynamic3DGaussians       true offsets; every Gaussian free to move and turn in every frame, held together by rigidity
without LOSS             ours, without a loss of the default ones
with LOSS                ours, with another loss that there is, a plugin's too
with EFFECT              ours, with an effect that a plugin adds

Rows of which one is to be compared with another learn offsets at one rate, or hold them both: "ours" beside "Hermite
spline", "w/o scaffold" and "scaffold per video"; "true time" beside the other rows at true time; "fixed" beside "w/o
spline".

Sync-NeRF (Kim et al. 2024) has no geometric stage: its offsets begin at zero. With ``--amplitudes 30`` clocks begin
wrong by up to 30 frames, as those of clips that begin up to 30 frames apart and are taken for simultaneous. Ours never
begins there: ``otsync run`` has its tracks to begin with. The rival is a 4D Gaussian scene, not a radiance field: what
is compared is the information that a method begins with, on one renderer. It begins on visual hulls of the masks, which
are made from images, and may densify. A radiance field has no motion to find, a Gaussian that begins at rest does: so
here it begins by following the hulls (after 600 steps on basketball 20.6 dB where things move instead of 16.6). The
static part is made from images alone, too.

Dynamic3DGaussians fits frame after frame from a cloud of points that is given; here it begins from tracks and depth as
the others do, and all frames are fitted at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from otsync.plugins import available
from recon.fit.densify import Densify
from recon.fit.optimize import chosen_rates
from recon.fit.options import DEFAULT_LOSSES
from recon.losses import LOSSES, Isometry, Loss, Mask, Photometric, Rigidity, RotationSimilarity, ScaleHinge
from recon.motion import PerGaussian, Sampled, Scaffold
from recon.observe import EFFECTS, Effect
from recon.observe.recorded import all_effects
from recon.pipeline.plan import Plan
from recon.pipeline.readings import OF_ITSELF
from recon.pipeline.starts import FromImages, OnScaffold, OnTracks, Start
from recon.scene.gaussians4d import Gaussians4D

Clocks = Literal["given", "true"]


def as_built(scene: Gaussians4D) -> Gaussians4D:
    """The motion that the scene began with."""
    return scene


def sampled(scene: Gaussians4D) -> Gaussians4D:
    """Nodes sampled once a frame, held in between."""
    assert isinstance(scene.motion, Scaffold)
    return replace(scene, motion=scene.motion.on(per_frame(scene)))


def free_in_every_frame(scene: Gaussians4D) -> Gaussians4D:
    """Every Gaussian moves and turns by itself from frame to frame."""
    assert isinstance(scene.motion, PerGaussian)
    return replace(scene, motion=scene.motion.on(per_frame(scene)).turning())


def per_frame(scene: Gaussians4D) -> Sampled:
    """A sample for every frame of the reference, and for those before and after that the motion reaches."""
    assert isinstance(scene.motion, Scaffold | PerGaussian)
    ends, first, step = scene.motion.path.times, scene.span[0], scene.frame_step
    before = max(0, math.ceil((first - float(ends[0])) / step - 1e-6))
    return Sampled.of(first - before * step, float(ends[-1]), step)


@dataclass(frozen=True)
class Configuration:
    """One row of a table.

    Args:
        clocks: offsets that everything is built from: those given, or the truth.
        change: what the row does otherwise than the plan of all rows.
        start: how the moving part begins. motion: what becomes of its motion before the fit.
        groups: the parameter groups of that motion.
        own: options of the plan in whose place the row has its own, as the shell spells them.
    """

    clocks: Clocks = "given"
    change: Callable[[Plan], Plan] = lambda plan: plan
    start: Start = field(default_factory=OnScaffold)
    motion: Callable[[Gaussians4D], Gaussians4D] = as_built
    groups: tuple[str, ...] = ("knots", "knot_quats")
    own: tuple[str, ...] = ()

    @property
    def ignores(self) -> tuple[str, ...]:
        """Options of the plan that the row does not heed."""
        return (*self.start.ignores, *self.own)

    def plan(self, plan: Plan) -> Plan:
        """The plan of this row, without what the plan of all rows says of the groups of other motions."""
        changed = self.change(plan)
        others, fit = [g for g in OF_MOTIONS if g not in self.groups], changed.fit
        rates = None if fit.rates is None else {g: rate for g, rate in fit.rates.items() if g not in others}
        freeze = tuple(g for g in fit.freeze if g not in others)
        return replace(changed, fit=replace(fit, rates=rates, freeze=freeze))


OF_MOTIONS = ("knots", "knot_quats", "own_knots", "own_quats")
"""Parameter groups that one motion has and another has not."""


def check_heeded(rows: Sequence[Configuration], plan: Plan) -> None:
    """ValueError for rates and groups to freeze of motions that no row has, and for options that no row heeds."""
    fitted = {g for row in rows for g in row.groups}
    chosen = (("rates", chosen_rates(plan.fit.rates, plan.fit.groups)), ("freeze", plan.fit.freeze))
    for option, names in chosen:
        unused = [g for g in names if g in OF_MOTIONS and g not in fitted]
        if unused:
            raise ValueError(
                f"{option}: expected groups that a row fits; found {', '.join(unused)}. Leave them out, or add a row "
                "of another motion."
            )
    usual = Plan(views=plan.views)
    for option in dict.fromkeys(o for row in rows for o in row.ignores):
        if _of(plan, option) != _of(usual, option) and all(option in row.ignores for row in rows):
            raise ValueError(
                f"{option}: expected an option that a row heeds; found {_of(plan, option)!r}, and no row does. Leave "
                "it out, or add a row such as ours."
            )


def _of(plan: Plan, option: str) -> Any:
    """The value of an option, as the shell spells it."""
    value: Any = plan if "." in option else plan.fit
    for name in option.split("."):
        value = getattr(value, name)
    return value


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


def hermite(plan: Plan) -> Plan:
    """Nodes on the paper's splines."""
    return replace(plan, scaffold=replace(plan.scaffold, spline="hermite"))


def images_alone(plan: Plan) -> Plan:
    """No losses on the motion, and more Gaussians where the images ask for them."""
    fit = replace(plan.fit, losses=ON_IMAGES, densify=plan.fit.densify or Densify())
    return replace(plan, fit=fit)


def rigid(plan: Plan) -> Plan:
    """Offsets held, and on the motion the losses of Dynamic3DGaussians alone."""
    plan = held(plan)
    losses = (*ON_IMAGES, Rigidity(), RotationSimilarity(), Isometry())
    return replace(plan, fit=replace(plan.fit, losses=losses))


ON_IMAGES: tuple[Loss, ...] = (Photometric(), Mask(), ScaleHinge())
"""What is minimised where a row has no losses on the motion, or its own."""


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


APART: dict[str, Any] = {"start": OnTracks(), "groups": ("own_knots",)}
"""What a row has whose Gaussians move by themselves."""

OWN: Mapping[str, Configuration] = {
    "ours": Configuration(),
    "fixed": Configuration(change=held),
    "true time": Configuration("true", held),
    "Hermite spline": Configuration(change=hermite, own=("scaffold.spline",)),
    "w/o spline": Configuration(change=held, motion=sampled),
    "w/o spline, true time": Configuration("true", held, motion=sampled),
    "w/o scaffold": Configuration(**APART),
    "w/o scaffold, true time": Configuration("true", held, **APART),
    "scaffold per video": Configuration(change=per_video, own=("scaffold.per_video",)),
    "Sync-NeRF style": Configuration(change=images_alone, start=FromImages(), groups=("own_knots",), own=("losses",)),
    "Dynamic3DGaussians": Configuration(
        "true", rigid, OnTracks(), free_in_every_frame, ("own_knots", "own_quats"), own=("losses",)
    ),
}


def configurations() -> dict[str, Configuration]:
    """Every row that can be measured: our own, and one for each loss and effect that there is, ours or a plugin's."""
    rows, usual = dict(OWN), {type(loss) for loss in DEFAULT_LOSSES}
    for name, kind in available("losses", LOSSES).items():
        if kind in usual:
            rows[f"without {name}"] = Configuration(change=without_loss(kind))
        elif getattr(kind, "reads", None) in (None, *OF_ITSELF):
            rows[f"with {name}"] = Configuration(change=with_loss(kind))
    for name, effect in all_effects().items():
        if effect not in EFFECTS:
            rows[f"with {name}"] = Configuration(change=with_effect(effect))
    return rows
