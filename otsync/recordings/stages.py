"""The slots of a run on recordings, what stands in them, and how the shell spells what else can."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from ..align.likelihood import LikelihoodScan
from ..align.slot import Aligner
from ..costs.linear import Cosine, Labels
from ..costs.positions import CurveDistance
from ..epipolar.refine import EpipolarRefine
from ..epipolar.scan import EpipolarScan
from ..io.scene import Scene
from ..match.candidates import Candidates
from ..match.slot import Matcher
from ..plugins import available, made
from ..priors import DESCRIBERS, MASKERS, TRACKERS
from ..priors.stereo import HullStereo, TrackDepth
from ..refine.slot import Refiner
from ..refine.splines import SplineRefine
from ..sync.graph import Graph
from .lift import Lift
from .tracking import Selection, Tracking

COLOUR = 3.0
"""Weight of the colour histograms beside the curve distance: what separates limbs that run close together."""

LABELS = 3.0
"""Weight of given labels: a track of another thing costs as much as the largest distance in space."""


@dataclass(frozen=True)
class Stages:
    """The objects in the slots of every stage.

    Args:
        tracking: masks, point tracks and descriptors. selection: which tracks are kept.
        stereo: depth of tracks by a rig; dense maps ask for a :class:`otsync.priors.stereo.HullStereo`.
        lift: positions from depth. graph: which pairs are compared.
        epipolar_matcher, epipolar_aligner, epipolar_refiner: of tracks in pixels.
        matcher, aligner, refiner: of lifted tracks.
    """

    tracking: Tracking = field(default_factory=Tracking)
    selection: Selection = field(default_factory=Selection)
    stereo: TrackDepth = field(default_factory=HullStereo)
    lift: Lift = field(default_factory=Lift)
    graph: Graph = field(default_factory=Graph)
    epipolar_matcher: Matcher = field(default_factory=lambda: Candidates(20, None))
    epipolar_aligner: Aligner = field(default_factory=EpipolarScan)
    epipolar_refiner: Refiner = field(default_factory=EpipolarRefine)
    matcher: Matcher = field(
        default_factory=lambda: Candidates(2, 200, (Cosine(weight=COLOUR, center=False), CurveDistance()))
    )
    aligner: Aligner = field(default_factory=LikelihoodScan)
    refiner: Refiner = field(default_factory=SplineRefine)


PRIORS: dict[str, tuple[str, str, Iterable[Any]]] = {
    "masks": ("masker", "maskers", MASKERS),
    "points": ("points", "trackers", TRACKERS),
    "features": ("features", "describers", DESCRIBERS),
}
"""Option of the shell: field of :class:`Tracking`, group of plugins, otsync's own choices."""


def stages_from(
    stages: Stages | None = None, *, masks: str | None = None, points: str | None = None, features: str | None = None
) -> Stages:
    """``stages`` with priors as the shell spells them: ``name``, or ``name:field=value,field=value``.

    Args:
        stages: what the other slots hold; default :class:`Stages`.
        masks: of otsync's own or of the plugins in the group "maskers"; points: "trackers"; features: "describers".
            None leaves what is there. ValueError lists the choices, or names a field that does not fit.

    Example:
        >>> stages_from(points="chained-flow:every=5", features="daisy").tracking.points.every
        5
    """
    stages = stages or Stages()
    spelled = {"masks": masks, "points": points, "features": features}
    chosen = {}
    for option, text in spelled.items():
        if text is not None:
            slot, group, own = PRIORS[option]
            chosen[slot] = made(text, available(group, own), f"--{option}")
    return replace(stages, tracking=replace(stages.tracking, **chosen))


def with_labels(stages: Stages, scene: Scene) -> Stages:
    """The stages with the cost of labels in both matchers, when every video of the scene has labels.

    A matcher that takes no ``costs`` stays as it is: what it compares is its own affair. It finds the labels in the
    track sets that it is given.
    """
    if not scene.labels or any(labels is None for labels in scene.labels):
        return stages

    def labelled(matcher: Matcher) -> Matcher:
        costs = getattr(matcher, "costs", None)
        if costs is None or any(isinstance(c, Labels) for c in costs):
            return matcher
        return replace(matcher, costs=(*costs, Labels(weight=LABELS)))  # type: ignore[type-var]

    return replace(stages, epipolar_matcher=labelled(stages.epipolar_matcher), matcher=labelled(stages.matcher))
