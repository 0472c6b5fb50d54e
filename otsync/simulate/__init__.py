"""Worlds with exact answers: moving scenes filmed by several unsynchronised videos, as a tracker would report them.

A world is a :class:`Scene` (rigid parts that move, defined at every real time); :func:`simulate` films it and applies
the effects of a preset; :class:`Truth` knows the answers. :func:`matching_world` is the world of the matching study.
"""

from . import effects
from .adversaries import ADVERSARIES
from .features import FeatureModel
from .matching import matching_world
from .mocap import Mocap
from .observation import Observation, Similarity, Surface
from .presets import PRESETS, Preset
from .scenes import MOTIONS, Scene
from .truth import Truth
from .world import Rig, simulate

__all__ = [
    "ADVERSARIES",
    "MOTIONS",
    "PRESETS",
    "FeatureModel",
    "Mocap",
    "Observation",
    "Preset",
    "Rig",
    "Scene",
    "Similarity",
    "Surface",
    "Truth",
    "effects",
    "matching_world",
    "simulate",
]
