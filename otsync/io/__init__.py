"""Recordings in: scene documents, the readers that write them, and frames that are decoded lazily.

layout.py       scene.json: what it may hold, the source of its JSON Schema
schemas.py      JSON Schemas of scene.json and offsets.json, for docs/
document.py     scene.json: format, version, writing
scene.py        from a document to a scene, checked
readers.py      what a reader is; READERS, in the order in which they are asked
panoptic.py     the Panoptic layout
pose2sim.py     Pose2Sim's and Caliscope's .toml, Qualisys' .qca.txt
footage.py      video files and folders of images
frames.py       frames of a video without holding the video
images.py       single images, masks, labels and depth maps from files
masks/          masks as segmenters write them
keypoints/      detections and keypoints of other programs
mend.py         a scene without some of its frames
"""

from .frames import ImageFrames, VideoFrames
from .readers import READERS, Reader, describe_folder, find_reader, readers
from .scene import Scene, open_scene, scene_from_document

__all__ = [
    "READERS",
    "ImageFrames",
    "Reader",
    "Scene",
    "VideoFrames",
    "describe_folder",
    "find_reader",
    "open_scene",
    "readers",
    "scene_from_document",
]
