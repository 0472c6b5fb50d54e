"""The nouns: frozen dataclasses of arrays. Files freeze them, so they change only with a version."""

from .camera import Camera, Video
from .clock import Break, Clock, mended_frames, mended_times
from .results import Alignment, Matches, Offsets, Stats
from .similarity import Similarity
from .status import Refused, Status, gravest, in_order
from .tracks import TrackSet, check_same_world

__all__ = [
    "Alignment",
    "Break",
    "Camera",
    "Clock",
    "Matches",
    "Offsets",
    "Refused",
    "Similarity",
    "Stats",
    "Status",
    "TrackSet",
    "Video",
    "check_same_world",
    "gravest",
    "in_order",
    "mended_frames",
    "mended_times",
]
