"""Refinement: ``refine(a, b, matches, alignment, refiner)`` and the refiners that go in its slot."""

from .slot import Refiner
from .splines import SplineRefine
from .unrefined import Unrefined
from .verb import refine

__all__ = ["REFINERS", "Refiner", "SplineRefine", "Unrefined", "refine"]

REFINERS = (SplineRefine, Unrefined)
"""Refiners that the shell, the benchmarks and the catalogue of hard cases offer; plugins come on top."""
