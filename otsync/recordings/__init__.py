"""From recordings to offsets: tracking, lifting, routes, and what is checked before."""

from .check import check_scene
from .dense_depth import depth_maps
from .routes import Stages, Synchronized, synchronize_scene

__all__ = ["Stages", "Synchronized", "check_scene", "depth_maps", "synchronize_scene"]
