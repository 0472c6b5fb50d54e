"""The slots of a run on recordings, what stands in them, and how the shell spells what else can."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from ..align.likelihood import LikelihoodScan
from ..align.slot import Aligner
from ..costs.epipolar import EpipolarDistance
from ..costs.linear import Cosine, Labels
from ..costs.positions import CurveDistance
from ..epipolar.refine import EpipolarRefine
from ..epipolar.scan import EpipolarScan
from ..io.scene import Scene
from ..match.slot import Matcher
from ..match.unbalanced import UnbalancedOT
from ..plugins import available, made
from ..priors import DEPTHS, DESCRIBERS, FLOWS, MASKERS, TRACKERS
from ..priors.blobs import BySize
from ..priors.depth_scale import Limits
from ..priors.slots import DepthEstimator
from ..priors.stereo import HullStereo, TrackDepth
from ..refine.slot import Refiner
from ..refine.splines import SplineRefine
from ..sync.method import Method, with_costs
from ..types.checks import check_whole
from .lift import Lift
from .tracking import Selection, Tracking

COLOUR = 3.0
"""Weight of the colour histograms beside the curve distance: what separates limbs that run close together."""

LABELS = 3.0
"""Weight of given labels: a track of another thing costs as much as the largest distance in space."""


PIXELS = Method(
    "pixels",
    matcher=UnbalancedOT(partners=20, top=None, every=4000, costs=(Cosine(center=False), EpipolarDistance())),
    aligner=EpipolarScan(),
    refiner=EpipolarRefine(),
    rematch=0,
)
"""Tracks without depth: transport on features offers every track twenty partners, the epipolar scan weighs them. Of few
tracks, or of tracks without features, it weighs all pairs.

Transport once more at the synchronised times, on features and epipolar distances (``rematch=1``), is there and is not
the default: over 216 pairs of basketball the mean error was .098 frame without it and .101 with it, at 1.4 times the
time. Partners chosen at a time that is slightly off agree with that time.
"""

SPACE = Method(
    "space",
    matcher=UnbalancedOT(costs=(Cosine(weight=COLOUR, center=False), CurveDistance())),
    aligner=LikelihoodScan(),
    refiner=SplineRefine(),
    rematch=1,
)
"""Lifted tracks: transport with relaxed marginals on features and curves, and once more at the synchronised times."""


@dataclass(frozen=True)
class Stages:
    """The objects in the slots of every stage.

    Args:
        tracking: masks, point tracks and descriptors. selection: which tracks are kept.
        stereo: depth of tracks by a rig; dense maps ask for a :class:`otsync.priors.stereo.HullStereo`.
        lift: positions from depth.
        depth: estimates depth from images, tied to the poses (:mod:`otsync.recordings.learned_depth`); it goes before
            depth that came along. None: there is only that. depth_limits: when points tie a video.
        pixels: how tracks in pixels are synchronised. space: how lifted tracks are.
    """

    tracking: Tracking = field(default_factory=Tracking)
    selection: Selection = field(default_factory=Selection)
    stereo: TrackDepth = field(default_factory=HullStereo)
    lift: Lift = field(default_factory=Lift)
    pixels: Method = PIXELS
    space: Method = SPACE
    depth: DepthEstimator | None = None
    depth_limits: Limits = field(default_factory=Limits)


PRIORS: dict[str, tuple[str, str, Iterable[Any]]] = {
    "masks": ("masker", "maskers", MASKERS),
    "points": ("points", "trackers", TRACKERS),
    "flow": ("flow", "flows", FLOWS),
    "features": ("features", "describers", DESCRIBERS),
    "depth": ("depth", "depths", DEPTHS),
}
"""Option of the shell: field of :class:`Tracking` (flow: of its tracker; depth: of :class:`Stages`), group of plugins,
our own choices."""


LEAST_WIDTH = 64
"""Pixels of width below which nothing can be tracked."""


def stages_from(
    stages: Stages | None = None,
    *,
    masks: str | None = None,
    points: str | None = None,
    flow: str | None = None,
    features: str | None = None,
    depth: str | None = None,
    selection: str | None = None,
    width: int | None = None,
) -> Stages:
    """``stages`` with priors as the shell spells them: ``name``, or ``name:field=value,field=value``.

    Args:
        stages: what the other slots hold; default :class:`Stages`.
        masks: of otsync's own or of the plugins in the group "maskers"; points: "trackers"; flow: "flows";
            features: "describers"; depth: "depths". None leaves what is there. ValueError lists the choices, or names a
            field that does not fit.
        selection: ``field=value,field=value`` of :class:`otsync.recordings.tracking.Selection`: which tracks are kept.
        width: pixels of width that videos are tracked at.

    Example:
        >>> stages_from(points="chained-flow:every=5", features="daisy").tracking.points.every
        5
    """
    stages = stages or Stages()
    spelled = {"masks": masks, "points": points, "flow": flow, "features": features, "depth": depth}
    chosen = {}
    for option, text in spelled.items():
        if text is not None:
            slot, group, own = PRIORS[option]
            chosen[slot] = made(text, available(group, own), f"--{option}")
    if "depth" in chosen:
        stages = replace(stages, depth=chosen.pop("depth"))
    if width is not None:
        check_whole("--recording.width", width, LEAST_WIDTH)
        chosen["width"] = width
    if selection is not None:
        choices = {"selection": partial(replace, stages.selection)}
        kept = made(f"selection:{selection}", choices, "--recording.selection")
        if not isinstance(kept, Selection):
            raise ValueError("--recording.selection: expected field=value,field=value; found nothing.")
        stages = replace(stages, selection=kept)
    if "flow" in chosen:
        chosen["points"] = following(chosen.get("points", stages.tracking.points), chosen.pop("flow"))
    if points is not None:
        chosen["given"] = False  # a tracker that is named goes before tracks that came along
    return replace(stages, tracking=replace(stages.tracking, **chosen))


def following(tracker: Any, flow: Any) -> Any:
    """``tracker`` with another optical flow. ValueError where it follows none."""
    if isinstance(tracker, BySize):
        return replace(tracker, large=following(tracker.large, flow))
    if "flow" not in getattr(tracker, "__dataclass_fields__", {}):
        raise ValueError(
            f"--flow: expected a tracker that follows flow, such as chained-flow; found {type(tracker).__name__}. "
            "Leave one of both out."
        )
    return replace(tracker, flow=flow)


def with_method(stages: Stages, route: str, method: Method) -> Stages:
    """The stages with other things in the slots of the route's answer: of pixels (epipolar), or of lifted tracks.

    ValueError names a slot and the route when the one cannot be used on the other.
    """
    if route != "epipolar":
        return replace(stages, space=stages.space.but(**method.slots()))
    slots: dict[str, Any] = {"matcher": Matcher.of, "aligner": Aligner.of, "refiner": Refiner.of}
    for slot, of in slots.items():
        thing = getattr(method, slot)
        # a refiner that leaves the answer as it is reads nothing
        if thing is not None and of(thing).needs_xyz:
            raise ValueError(
                f"{slot}, route: expected one that reads pixels on the route epipolar; found {thing}, which reads "
                "positions in space. Choose a route with depth (tracks, stereo), or leave it out."
            )
    times = stages.pixels.rematch if method.rematch is None else method.rematch
    mute = [c for c in getattr(method.matcher, "costs", ()) if isinstance(c, EpipolarDistance) and c.clock is None]
    if mute and not times:
        raise ValueError(
            f"costs, rematch: expected --rematch 1 beside {type(mute[0]).__name__}, which tells nothing while no clock "
            "is known; found no matching again. Add it, or leave the cost out."
        )
    return replace(stages, pixels=stages.pixels.but(**method.slots()))


def with_labels(stages: Stages, scene: Scene) -> Stages:
    """The stages with the cost of labels in both matchers, when every video of the scene has labels.

    A matcher that takes no ``costs`` stays as it is: what it compares is its own affair. It finds the labels in the
    track sets that it is given.
    """
    if not scene.labels or any(labels is None for labels in scene.labels):
        return stages

    def labelled(method: Method) -> Method:
        costs = getattr(method.matcher, "costs", None)
        if not costs or any(isinstance(c, Labels) for c in costs):
            return method
        return method.but(matcher=with_costs(method.matcher, (*costs, Labels(weight=LABELS))))

    return replace(stages, pixels=labelled(stages.pixels), space=labelled(stages.space))
