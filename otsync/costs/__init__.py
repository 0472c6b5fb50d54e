"""Costs that matchers minimise: features, curves in space, positions at known times, labels."""

from .linear import Cosine, Cost, Labels, track_distance
from .positions import CurveDistance, MedianPosition, SynchronousDistance

__all__ = ["Cosine", "Cost", "CurveDistance", "Labels", "MedianPosition", "SynchronousDistance", "track_distance"]
