"""The nouns: frozen dataclasses of arrays. Files freeze them, so they change only with a version."""

from .camera import Camera, Video
from .results import Alignment, Matches, Offsets, Stats
from .status import Refused, Status, gravest, in_order
from .tracks import TrackSet

__all__ = [
    "Alignment",
    "Camera",
    "Matches",
    "Offsets",
    "Refused",
    "Stats",
    "Status",
    "TrackSet",
    "Video",
    "gravest",
    "in_order",
]
