"""Costs that matchers minimise: features, curves in space, positions at known times, labels."""

from .epipolar import EpipolarDistance
from .linear import Cosine, Cost, Labels, track_distance
from .positions import CurveDistance, MedianPosition, SynchronousDistance

__all__ = [
    "COSTS",
    "Cosine",
    "Cost",
    "CurveDistance",
    "EpipolarDistance",
    "Labels",
    "MedianPosition",
    "SynchronousDistance",
    "track_distance",
]

COSTS = (Cosine, CurveDistance, MedianPosition, Labels, EpipolarDistance)
"""Costs that the shell offers for the slot of a matcher; plugins come on top."""
