"""Synchronise videos of one moving scene by optimal transport between 4D tracks.

Tracks in, offsets out::

    from otsync import synchronize
    from otsync.simulate import simulate

    tracks, truth = simulate("tennis", videos=4, seed=3)
    offsets = synchronize(tracks)
    offsets.save("offsets.json")

Nouns are frozen dataclasses of arrays, verbs validate and report a status, algorithms are objects in slots.
"""

from .align import DTW, ConstantShift, LikelihoodScan, align
from .anchored import AnchoredFGW
from .costs import Cosine, Labels, track_distance
from .graph import Graph
from .match import (
    EntropicFGW,
    FusedGromovWasserstein,
    GromovWasserstein,
    NearestNeighbor,
    OptimalTransport,
    PartialFGW,
    match,
    matcher_for,
)
from .refine import SplineRefine, Unrefined, refine
from .sync import synchronize
from .trust import Trust
from .types import Alignment, Camera, Matches, Offsets, Refused, Status, TrackSet, Video

__version__ = "0.1.0"

__all__ = [
    "DTW",
    "Alignment",
    "AnchoredFGW",
    "Camera",
    "ConstantShift",
    "Cosine",
    "EntropicFGW",
    "FusedGromovWasserstein",
    "Graph",
    "GromovWasserstein",
    "Labels",
    "LikelihoodScan",
    "Matches",
    "NearestNeighbor",
    "Offsets",
    "OptimalTransport",
    "PartialFGW",
    "Refused",
    "SplineRefine",
    "Status",
    "TrackSet",
    "Trust",
    "Unrefined",
    "Video",
    "align",
    "match",
    "matcher_for",
    "refine",
    "synchronize",
    "track_distance",
]
