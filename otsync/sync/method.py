"""A whole method of synchronising: what stands in every slot of :func:`otsync.synchronize`, under one name."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

from ..align.slot import AlignerLike
from ..align.warping import DTW
from ..costs.linear import Cosine, Cost
from ..match.dense import FusedGromovWasserstein
from ..match.slot import MatcherLike
from ..refine.slot import Rate, RefinerLike
from ..refine.unrefined import Unrefined
from .graph import Graph


@dataclass(frozen=True)
class Method:
    """What stands in the slots; None: the default of :func:`otsync.synchronize`, or of a recording's route.

    Args:
        name: how tables and the shell call it.
        matcher, aligner, refiner, graph, rematch, rate: as for :func:`otsync.synchronize`.
    """

    name: str = ""
    matcher: MatcherLike | None = None
    aligner: AlignerLike | None = None
    refiner: RefinerLike | None = None
    graph: Graph | None = None
    rematch: int | None = None
    rate: Rate | None = None

    def but(self, **slots: Any) -> Method:
        """The same with other things in the slots that are named and not None."""
        named = {f.name for f in fields(self)} - {"name"}
        assert set(slots) <= named, slots
        return replace(self, **{slot: thing for slot, thing in slots.items() if thing is not None})

    def told(self) -> str:
        """Its name and what it puts into which slot, in a line."""
        things = ", ".join(f"{slot} {thing}" for slot, thing in self.slots().items())
        return f"method {self.name}: {things}" if self.name else f"in the slots: {things}"

    def slots(self) -> dict[str, Any]:
        """What it names, by slot."""
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "name"}
        return {slot: thing for slot, thing in own.items() if thing is not None}


PAPER = Method(
    "paper",
    matcher=FusedGromovWasserstein(costs=(Cosine(center=False),)),
    aligner=DTW(),
    refiner=Unrefined(),
    graph=Graph(extra=0),
    rematch=0,
)
"""SyncTrack4D's geometric stage as it is written: features as given, FGW by POT's conditional gradient, pairs by the
Hungarian method on the plan, tslearn's DTW over D_geo, the most frequent offset of its path, a star to the reference.

The paper leaves α and the unit of D_track open: C is divided by its common median, α is .222, where the optimum is
broad (docs/matching.md).
"""

METHODS = (PAPER,)
"""Methods that the shell, the report and the benchmarks know by name; plugins come on top."""


def with_costs(matcher: MatcherLike | None, costs: tuple[Cost, ...]) -> MatcherLike:
    """The matcher minimising other costs. ValueError where it has none to choose."""
    if not is_dataclass(matcher) or isinstance(matcher, type) or "costs" not in {f.name for f in fields(matcher)}:
        raise ValueError(
            f"costs: expected a matcher that minimises costs of choice; found {matcher or 'none'}. Name one that does, "
            "as matcher:unbalanced-ot, or leave --costs out."
        )
    return replace(matcher, costs=costs)
