"""Detections and keypoints that other programs found: read as they wrote them, one file or list of files a video.

detections.py   what a file of detections says; the slot of its readers
table.py        tables with a column each for frame, x and y
deeplabcut.py   DeepLabCut's CSV
sleap.py        SLEAP's analysis CSV
people.py       OpenPose's JSON, a file a frame
coco.py         COCO's JSON: annotations, or a list of results
"""

from .coco import Coco
from .deeplabcut import DeepLabCut
from .detections import Detections, KeypointReader, read_detections
from .people import OpenPose
from .sleap import Sleap
from .table import Table

KEYPOINTS: tuple[KeypointReader, ...] = (DeepLabCut(), Sleap(), OpenPose(), Coco(), Table())
"""Readers of keypoints, in the order in which they are asked."""

__all__ = ["KEYPOINTS", "Detections", "KeypointReader", "read_detections"]
