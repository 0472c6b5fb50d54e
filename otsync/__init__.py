"""Synchronise videos of one moving scene by optimal transport between 4D tracks.

Tracks in, offsets out::

    from otsync import synchronize
    from otsync.simulate import simulate

    tracks, truth = simulate("tennis", videos=4, seed=3)
    offsets = synchronize(tracks)
    offsets.save("offsets.json")

Nouns are frozen dataclasses of arrays, verbs validate and report a status, algorithms are objects in slots.
"""

from .align.likelihood import LikelihoodScan
from .align.verb import align
from .align.warping import DTW, ConstantShift
from .costs.linear import Cosine, Labels, track_distance
from .frames import OwnFrames
from .match.anchored import AnchoredFGW
from .match.candidates import Candidates
from .match.dense import (
    EntropicFGW,
    FusedGromovWasserstein,
    GromovWasserstein,
    NearestNeighbor,
    OptimalTransport,
    PartialFGW,
)
from .match.unbalanced import SemirelaxedFGW, UnbalancedFGW, UnbalancedOT
from .match.verb import match, matcher_for
from .refine.splines import SplineRefine
from .refine.unrefined import Unrefined
from .refine.verb import refine
from .sync.graph import Graph
from .sync.method import PAPER, Method
from .sync.verb import synchronize
from .types import Alignment, Camera, Matches, Offsets, Refused, Similarity, Status, TrackSet, Video
from .types.trust import Trust

__version__ = "0.1.0"

__all__ = [
    "DTW",
    "PAPER",
    "Alignment",
    "AnchoredFGW",
    "Camera",
    "Candidates",
    "ConstantShift",
    "Cosine",
    "EntropicFGW",
    "FusedGromovWasserstein",
    "Graph",
    "GromovWasserstein",
    "Labels",
    "LikelihoodScan",
    "Matches",
    "Method",
    "NearestNeighbor",
    "Offsets",
    "OptimalTransport",
    "OwnFrames",
    "PartialFGW",
    "Refused",
    "SemirelaxedFGW",
    "Similarity",
    "SplineRefine",
    "Status",
    "TrackSet",
    "Trust",
    "UnbalancedFGW",
    "UnbalancedOT",
    "Unrefined",
    "Video",
    "align",
    "match",
    "matcher_for",
    "refine",
    "synchronize",
    "track_distance",
]
