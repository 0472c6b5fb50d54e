"""Alignment: ``align(a, b, matches, aligner)`` and the aligners that go in its slot (paper, Sec. 3.4)."""

from .likelihood import LikelihoodScan
from .slot import Aligner
from .verb import align
from .warping import DTW, ConstantShift

__all__ = ["ALIGNERS", "DTW", "Aligner", "ConstantShift", "LikelihoodScan", "align"]

ALIGNERS = (LikelihoodScan, DTW, ConstantShift)
"""Aligners that the shell, the benchmarks and the catalogue of hard cases offer; plugins come on top."""
