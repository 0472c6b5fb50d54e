"""Offsets without depth: epipolar residuals of pixel tracks, for the slots of aligners and refiners."""

from .refine import EpipolarRefine
from .scan import EpipolarScan

__all__ = ["EpipolarRefine", "EpipolarScan"]
