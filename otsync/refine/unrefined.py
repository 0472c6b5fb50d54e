"""The answer of the aligner, unrefined: what refinement is measured against."""

from __future__ import annotations

from dataclasses import dataclass

from ..types import Alignment, Matches, TrackSet
from .slot import Refiner


@dataclass(frozen=True)
class Unrefined(Refiner):
    """Takes the aligner's answer as it is."""

    needs_xyz = False

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment) -> Alignment:
        return alignment
