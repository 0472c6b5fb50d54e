"""Effects between a surface and its tracks: each is an object ``(observation, rng) -> observation``.

Effects stand in a tuple and are applied in order; what is not in the tuple is not computed. Every effect draws from a
stream of its own, so that adding, removing or reordering others leaves its draws bit for bit as they are. An effect of
strength zero changes no bit of the positions. Depth errors act along the viewing ray and are relative to depth;
lengths are metres, times seconds, so nothing depends on the frame rate.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from ..observation import Observation
from .camera import (
    CameraFrame,
    ClockDrift,
    ClockRamp,
    ClockSway,
    DroppedFrames,
    LatePoses,
    OwnFrame,
    RigidFrame,
    RollingShutter,
)
from .noise import (
    CameraDepthDrift,
    DepthBias,
    DepthDrift,
    DepthJitter,
    LateralJitter,
    LimbDrift,
    PositionNoise,
    SharedDrift,
    SlowDrift,
    Transient,
)
from .timing import Cut, Drop, Freeze, In, Loop, Repeats, Replay, Reverse, SlowMotion
from .tracker import Gaps, Hallucination, IdentitySwitch, Lag, Occlusion, Outliers, PartLate, RayCompression, Smoothing

__all__ = [
    "CameraDepthDrift",
    "CameraFrame",
    "ClockDrift",
    "ClockRamp",
    "ClockSway",
    "Cut",
    "DepthBias",
    "DepthDrift",
    "DepthJitter",
    "Drop",
    "DroppedFrames",
    "Effect",
    "Freeze",
    "Gaps",
    "Hallucination",
    "IdentitySwitch",
    "In",
    "Lag",
    "LatePoses",
    "LateralJitter",
    "LimbDrift",
    "Loop",
    "Occlusion",
    "Outliers",
    "OwnFrame",
    "PartLate",
    "PositionNoise",
    "RayCompression",
    "Repeats",
    "Replay",
    "Reverse",
    "RigidFrame",
    "RollingShutter",
    "SharedDrift",
    "SlowDrift",
    "SlowMotion",
    "Smoothing",
    "Transient",
]


@runtime_checkable
class Effect(Protocol):
    """Anything that turns an observation into another. A user's own goes into the tuple like these."""

    def __call__(self, observation: Observation, rng: np.random.Generator, /) -> Observation: ...
