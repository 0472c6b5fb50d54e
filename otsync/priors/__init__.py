"""From pixels, before any synchronisation: masks, flow, point tracks, features, depth.

slots.py        what goes into the slots of tracking
working.py      frames at the resolution that priors work at
masks.py        which pixels move
flow.py         optical flow between neighbouring frames
patch_flow.py   the same where something moves
points.py       point tracks by optical flow
blobs.py        tracks of things too small for flow, and the choice by their size
linking.py      detections of single frames joined to tracks
features.py     descriptors of tracks
depth_scale.py  scale and shift of estimated depth, from points of known depth
stereo.py       depth of tracked points of a rig by visual hull and correlation
learned/        features, flow, depth of learned models
dense.py        the same at every pixel of a mask
"""

from ..files.cache import Cache
from .blobs import Blobs, BySize
from .features import Daisy, LabHistogram
from .flow import DISFlow
from .learned import (
    CoTracker,
    DepthAnything2,
    DepthAnything3,
    Dinov2,
    Dinov3,
    Onnx,
    Raft,
    Transformers,
    TransformersDepth,
)
from .masks import FlowResidual, GivenMasks, MedianBackground
from .patch_flow import PatchFlow
from .points import ChainedFlow
from .slots import DepthEstimator, Describer, Flow, Masker, Tracker
from .working import WorkingFrames

__all__ = [
    "DEPTHS",
    "DESCRIBERS",
    "FLOWS",
    "MASKERS",
    "TRACKERS",
    "Blobs",
    "BySize",
    "Cache",
    "ChainedFlow",
    "DISFlow",
    "Daisy",
    "DepthEstimator",
    "Describer",
    "Flow",
    "FlowResidual",
    "GivenMasks",
    "LabHistogram",
    "Masker",
    "MedianBackground",
    "PatchFlow",
    "Tracker",
    "WorkingFrames",
]

MASKERS = (MedianBackground, FlowResidual)
"""Maskers that the shell offers; plugins come on top."""

TRACKERS = (BySize, ChainedFlow, Blobs, CoTracker)
"""Trackers of points that the shell offers; plugins come on top."""

FLOWS = (DISFlow, PatchFlow, Raft)
"""Optical flows that the shell offers; plugins come on top."""

DESCRIBERS = (LabHistogram, Daisy, Dinov3, Dinov2, Transformers, Onnx)
"""Describers of tracks that the shell offers; plugins come on top."""

DEPTHS = (DepthAnything2, DepthAnything3, TransformersDepth)
"""Estimators of depth that the shell offers; plugins come on top."""
