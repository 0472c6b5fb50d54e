"""Scene documents (``scene.json``): format, version, what every reader fills in, and writing one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from ..files.arrays import write_json

FORMAT, VERSION = "otsync.scene", 1


def document(videos: Sequence[dict[str, Any]], frame: str = "world", **more: Any) -> dict[str, Any]:
    """A scene document. ``frame``: name of the cameras' world frame. ``more``: ``notes``, ``missing``."""
    return {"format": FORMAT, "version": VERSION, "frame": frame, "videos": list(videos), **more}


def write_document(path: str | os.PathLike[str], videos: Sequence[dict[str, Any]], frame: str = "world") -> None:
    """Write a scene document, atomically."""
    write_json(path, document(videos, frame))


def unknown_camera(width: int, height: int) -> dict[str, Any]:
    """The camera of a video whose calibration no file tells."""
    return {"K": None, "w2c": None, "width": width, "height": height}


def missing_fields(videos: Sequence[dict[str, Any]]) -> list[str]:
    """In words, what entries of videos lack before they can be read."""
    missing = []
    for video in videos:
        unknown = {"K": "camera.K", "w2c": "camera.w2c (world to camera, OpenCV axes)"}
        lacking = [words for field, words in unknown.items() if video["camera"][field] is None]
        if lacking:
            missing.append(f"{video['name']}: {' and '.join(lacking)}")
        if "file" not in video and video.get("fps") is None and video.get("timestamps") is None:
            missing.append(f"{video['name']}: fps or timestamps")
    return missing
