"""Recordings in: ``scene.json``, the Panoptic layout, video files and image folders; frames are decoded lazily."""

from .discover import describe_folder
from .frames import ImageFrames, VideoFrames
from .scene import Scene, open_scene, scene_from_document

__all__ = ["ImageFrames", "Scene", "VideoFrames", "describe_folder", "open_scene", "scene_from_document"]
