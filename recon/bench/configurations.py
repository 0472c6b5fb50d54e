"""The field's methods, and the ablations, as settings of one fit: nothing here is another code path.

ours                  motion-spline scaffold, offsets refined
fixed                 the same, offsets held: what refinement is worth
true time             the same from true offsets, held: the ceiling (Dynamic3DGaussians' setting, with our motion)
w/o spline            nodes sampled per frame: no derivative in time, so nothing to refine offsets by (MoSca)
w/o scaffold          every Gaussian on a spline of its own
scaffold per video    the paper's: every video's nodes on that video's clock
Sync-NeRF style       images alone: no priors on motion, and from offsets that no geometric stage has found
Dynamic3DGaussians    true offsets, every Gaussian free in every frame
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from recon.fit.optimize import RATES, without
from recon.fit.problem import Loss
from recon.fit.verb import LOSSES
from recon.losses.image import Mask, Photometric, ScaleHinge
from recon.motion import PerGaussian, Sampled, Scaffold, ScaffoldOptions
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
        scaffold: how the motion is built. motion: what becomes of it before the fit.
        rates, losses: of the fit.
    """

    start: Start = "given"
    scaffold: ScaffoldOptions = field(default_factory=ScaffoldOptions)
    motion: Callable[[Gaussians4D], Gaussians4D] = as_built
    rates: Mapping[str, float] = field(default_factory=lambda: RATES)
    losses: tuple[Loss, ...] = LOSSES


HELD = without(RATES, "offsets")

CONFIGURATIONS: Mapping[str, Configuration] = {
    "ours": Configuration(),
    "fixed": Configuration(rates=HELD),
    "true time": Configuration(start="true", rates=HELD),
    "w/o spline": Configuration(motion=sampled, rates=HELD),
    "w/o scaffold": Configuration(motion=per_gaussian),
    "scaffold per video": Configuration(scaffold=ScaffoldOptions(per_video=True)),
    "Sync-NeRF style": Configuration(losses=(Photometric(), Mask(), ScaleHinge())),
    "Dynamic3DGaussians": Configuration(start="true", motion=per_gaussian_sampled, rates=HELD),
}
