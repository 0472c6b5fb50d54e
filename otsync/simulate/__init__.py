"""Worlds with exact answers: moving scenes filmed by several unsynchronised videos, as a tracker would report them."""

from .observation import Observation, Similarity, Surface
from .presets import PRESETS, Preset
from .scenes import MOTIONS, Scene
from .truth import Truth
from .world import Rig, simulate

__all__ = ["MOTIONS", "PRESETS", "Observation", "Preset", "Rig", "Scene", "Similarity", "Surface", "Truth", "simulate"]
