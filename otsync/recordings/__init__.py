"""From recordings to offsets: tracking, lifting, routes, and what is checked before.

tracking.py     masks, point tracks and descriptors of one video
lift.py         positions in space from pixels and depth
stages.py       the slots of a run, and what stands in them
routes.py       which way from a scene to offsets, in which stages
kept_pairs.py   pairs of videos kept on disk
static_points.py  points of the background, whose depth is known from poses alone
learned_depth.py  estimated depth, tied to the poses by these points
dense_depth.py  depth maps of synchronised recordings
placement.py    which cameras may stand elsewhere than the scene says
audit.py        otsync audit: which camera of a rig is not in sync
check.py        otsync check: what commonly goes wrong in a recording
"""

from .audit import audit_scene
from .check import check_scene
from .dense_depth import depth_maps
from .learned_depth import with_depth
from .routes import synchronize_scene
from .stages import Stages, stages_from
from .synchronized import Synchronized

__all__ = [
    "Stages",
    "Synchronized",
    "audit_scene",
    "check_scene",
    "depth_maps",
    "stages_from",
    "synchronize_scene",
    "with_depth",
]
