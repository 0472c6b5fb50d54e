"""How a scene is fitted to its videos: one dataclass for Python and for the shell."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from otsync.plugins import named
from otsync.types.checks import check_number, check_whole, positive
from recon.fit.densify import Densify
from recon.fit.optimize import DECLARED, chosen_rates, rates_on, without
from recon.losses import (
    LOSSES,
    Acceleration,
    Arap,
    ImageLoss,
    Length,
    Loss,
    Mask,
    MotionLoss,
    Photometric,
    ScaleHinge,
    Velocity,
)
from recon.observe import EFFECTS, Effect
from recon.scene.groups import Group, by_name, initial_rates

DEFAULT_LOSSES: tuple[Loss, ...] = (
    Photometric(),
    Mask(),
    ScaleHinge(),
    Arap(),
    Length(),
    Velocity(),
    Acceleration(),
)
"""The losses of the study of the paper's scene; depth, tracks and features enter only at initialisation, unless they
are added."""

DEFAULT_STEPS = 2000


@dataclass(frozen=True)
class FitOptions:
    """How a scene is fitted to its videos. ValueError names an option that makes no sense."""

    losses: Annotated[tuple[Loss, ...], named("losses", LOSSES, "--losses")] = DEFAULT_LOSSES
    """What the fit minimises; what is not listed is not computed."""
    effects: Annotated[tuple[Effect, ...], named("effects", EFFECTS, "--effects")] = ()
    """Effects of the cameras on the light, nearest to the scene first; a recording adds declared shutters and gains."""
    rates: Annotated[Mapping[str, float] | None, rates_on("--rates")] = None
    """Learning rates at the start. Python: of all groups that are fitted. Command line: of those that shall differ.
    Those of a motion's knots are divided by the largest weight of a knot in its curve: 2/3 for B-splines."""
    freeze: tuple[str, ...] = ()
    """Parameter groups that stay as they are: offsets, gain, knots, ..."""
    steps: int | None = None
    """Length of the fit in steps: the result is then the same on any machine of a kind."""
    budget: float | None = None
    """Wall seconds instead of steps: of the whole command (Python's ``fit`` and ``recon bench``: of the fit alone).
    Stages before the fit leave out what would take too much of them; the fit takes what is left, 120 steps at the
    least.
    """
    batch: int = 2
    """Images a step: on a CPU each on a thread of its own, on a GPU in one rendering where effects allow it."""
    densify: Densify | None = None
    """Split the Gaussians that are pulled hardest, drop those that are faint; off unless asked for."""
    seed: int = 0
    """Of every draw: the order of the images, the moments of the motion losses."""
    save_every: float = 60.0
    """Seconds between two savings of the fit, from the last of which a killed run continues."""

    def __post_init__(self) -> None:
        for name in ("losses", "effects", "freeze"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        _check_kinds("losses", self.losses, (ImageLoss, MotionLoss), "recon.losses.ImageLoss or MotionLoss")
        _check_kinds("effects", self.effects, (Effect,), "recon.observe.Effect")
        for loss in self.losses:
            check_number(f"losses: weight of {type(loss).__name__}", loss.weight, above=-math.inf)
            if isinstance(loss, MotionLoss):
                positive(f"losses: begin of {type(loss).__name__}", loss.begin, zero=True)
        check_length(self.steps, self.budget)
        check_whole("batch", self.batch, 1)
        positive("save_every", self.save_every, zero=True)
        if self.densify is not None and any(isinstance(x, ImageLoss) and x.reads == "tracks" for x in self.losses):
            raise ValueError(
                "losses, densify: expected one of Track and densification; found both. Tracks are tied to Gaussians, "
                "which densification replaces."
            )
        both = [name for name in self.freeze if name in chosen_rates(self.rates, self.groups)]
        if both:
            raise ValueError(f"rates, freeze: expected each group in one of them; found {', '.join(both)} in both.")
        self.active_rates()

    @property
    def total(self) -> int | None:
        """Steps in all; None when the budget decides."""
        return None if self.budget is not None else DEFAULT_STEPS if self.steps is None else self.steps

    @property
    def groups(self) -> dict[str, Group]:
        """What is declared of every parameter group: our own, and those of the effects."""
        return DECLARED | by_name(group for effect in self.effects for group in effect.groups)

    def active_rates(self) -> dict[str, float]:
        """The rate of every group that is fitted. ValueError for a group to freeze that has none."""
        rates = initial_rates(self.groups.values()) if self.rates is None else dict(self.rates)
        return without(rates, *self.freeze)


def check_length(steps: int | None, budget: float | None) -> None:
    """ValueError unless a length is a number of steps, or wall seconds, or left open."""
    if steps is not None and budget is not None:
        raise ValueError("steps, budget: expected one of them; found both.")
    if steps is not None:
        check_whole("steps", steps, 0)
    if budget is not None:
        check_number("budget", budget)


def _check_kinds(name: str, items: tuple[Any, ...], kinds: tuple[type, ...], expected: str) -> None:
    unknown = [x.__name__ if isinstance(x, type) else type(x).__name__ for x in items if not isinstance(x, kinds)]
    if unknown:
        raise ValueError(f"{name}: expected objects that inherit from {expected}; found {', '.join(unknown)}.")
