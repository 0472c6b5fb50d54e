"""The slots of a method on the command line: what ``otsync sync`` and ``otsync run`` share."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from ..align import ALIGNERS
from ..costs import COSTS
from ..costs.linear import Cost
from ..epipolar import EpipolarRefine, EpipolarScan
from ..match import MATCHERS
from ..plugins import available, named
from ..refine import REFINERS
from ..refine.slot import Rate
from ..sync.graph import Graph
from ..sync.method import METHODS, Method, with_costs
from .slots import one_of, partial, slot


@dataclass(frozen=True)
class MethodOptions:
    """What stands in the slots; left out: the default for track sets, or of a recording's route."""

    method: one_of("methods", METHODS) | None = None
    """A whole method by name, whose slots the options below replace. paper: SyncTrack4D as it is written."""
    rate: Rate | None = None
    """Frame rates as declared, or fitted on long clips and kept where significant; default: as the refiner says."""
    rematch: int | None = None
    """How often trusted pairs are matched again at the synchronised times; default: once, on pixels never."""
    costs: Annotated[tuple[Cost, ...], named("costs", COSTS, "--costs")] = ()
    """What the named matcher minimises, for example: --costs cosine:weight=3,center=False curve-distance."""
    graph: partial(Graph) = field(default_factory=partial(Graph))
    """Which pairs are compared, and how their answers become one."""
    matcher: slot("matchers", MATCHERS, optional=True) = None
    """From tracks to pairs of tracks."""
    aligner: slot("aligners", (*ALIGNERS, EpipolarScan), optional=True) = None
    """From pairs of tracks to the offset of two videos, to the frame."""
    refiner: slot("refiners", (*REFINERS, EpipolarRefine), optional=True) = None
    """From the frame to a fraction of it."""

    def chosen(self, graph: Graph | None = None) -> Method:
        """The method that the options name. ValueError where costs have no matcher to minimise them.

        graph: what options of the graph change, where no method brings one; default :class:`Graph`.
        """
        method = Method()
        if self.method is not None:
            method = available("methods", METHODS)[self.method]
        named_graph: dict[str, Any] = {k: v for k, v in vars(self.graph).items() if v is not None}
        base = method.graph or graph or Graph()
        if named_graph.get("extra") == 0:  # a star has no use for the number up to which all pairs are compared
            base = replace(base, complete=Graph.complete)
        method = method.but(
            matcher=self.matcher,
            aligner=self.aligner,
            refiner=self.refiner,
            rate=self.rate,
            rematch=self.rematch,
            graph=replace(base, **named_graph) if named_graph else None,
        )
        return method.but(matcher=with_costs(method.matcher, self.costs)) if self.costs else method
