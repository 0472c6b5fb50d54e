"""The parameter groups of a fit: what a row of each belongs to, the unit of its rate, and the rate that it begins with.

The only place where groups are listed. An effect declares the groups that it learns itself
(:attr:`recon.observe.effects.Effect.groups`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Group:
    """One group of parameters.

    Args:
        rate: Adam's step at the start, in ``unit``; None: frozen unless a fit gives it one.
        unit: "footprints" (the world size of a working pixel), "frames" (of the reference, in seconds), or "own": as
            the parameters are.
        rows: what a row belongs to, if densification changes how many there are. axis: along which the rows lie.
    """

    name: str
    rate: float | None = None
    unit: Literal["footprints", "frames", "own"] = "own"
    rows: Literal["gaussians", "nodes"] | None = None
    axis: int = 0

    def scale(self, footprint: float, frame_step: float) -> float:
        """The group's unit: world units of a footprint, seconds of a frame, or 1."""
        return {"footprints": footprint, "frames": frame_step, "own": 1.0}[self.unit]


SCENE = (
    Group("means", 0.03, "footprints", "gaussians"),
    Group("quats", 2e-3, rows="gaussians"),
    Group("log_scales", 6e-3, rows="gaussians"),
    Group("opacity_logits", 0.03, rows="gaussians"),
    Group("sh", 0.02, rows="gaussians"),
    Group("sh_rest", 1e-3, rows="gaussians"),
    Group("knots", 0.075, "footprints", "nodes", axis=1),
    Group("own_knots", 0.075, "footprints", "gaussians", axis=1),
    Group("knot_quats", 2e-3, rows="nodes", axis=1),
    Group("own_quats", 2e-3, rows="gaussians", axis=1),
    Group("features", 5e-3, rows="gaussians"),
    Group("static.means", unit="footprints"),
)
"""Of a scene. Rates are the study's metres and colours, expressed so; other static groups are in their own units. Those
of a motion's knots are divided by its :attr:`recon.motion.Path.peak`: a B-spline's knots go half as far again."""

CLOCKS = (Group("offsets", 0.02, "frames"), Group("bends", 0.02, "frames"), Group("clock_rates"))
"""Of the videos' clocks; ``bends`` are there where the scene was made with bent ones (:mod:`recon.footage.bends`)."""


def by_name(groups: Iterable[Group]) -> dict[str, Group]:
    """The groups by name."""
    return {group.name: group for group in groups}


def initial_rates(groups: Iterable[Group]) -> dict[str, float]:
    """The rate of every group that has one."""
    return {group.name: group.rate for group in groups if group.rate is not None}
