"""Sync-NeRF's Blender layout: ``transforms.json`` with one pose a camera, and one video (or folder of frames) each.

``camera_angle_x`` (radians) gives the focal length; ``transform_matrix`` is camera-to-world with OpenGL axes. Poses and
videos are paired by order, as the authors do it (Kim et al., Sync-NeRF, AAAI 2024): counts must agree.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...files.arrays import read_json
from .common import (
    camera,
    clip,
    from_opengl,
    image_folders,
    numbers,
    pinhole,
    pixels,
    positive,
    same_count,
    scene,
    sorted_alike,
    told,
    videos_in,
)

FILE = "transforms.json"
FRAMES = ("frames_1", "frames")


class SyncNerfBlender:
    """Sync-NeRF's Blender scenes: static calibrated cameras, without a world clock."""

    name = "sync-nerf-blender"
    looks_for = f"{FILE} beside *.mp4 or {FRAMES[0]}/, without images/"
    brings = "cameras; the clock of videos"
    insists = True

    def claims(self, folder: Path) -> bool:
        return (folder / FILE).is_file() and bool(self._clips(folder)) and not any(folder.glob("images*/"))

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        """``fps``: of folders of frames, which carry no clock. ValueError names file and field."""
        path = folder / FILE
        meta = read_json(path)
        return told(path, "width, height, camera_angle_x and frames", lambda: self._document(folder, meta, fps))

    def _document(self, folder: Path, meta: dict[str, Any], fps: float | None) -> dict[str, Any]:
        path, clips = folder / FILE, self._clips(folder)
        frames = meta["frames"]
        same_count(
            len(clips),
            len(frames),
            f"{folder}: videos for the poses of {FILE}",
            "They are paired by order: bring the videos that are missing, or take out the poses of those that are.",
        )
        sorted_alike([c.name for c in clips], str(folder))
        angle = positive(meta["camera_angle_x"], f"{path}: camera_angle_x")
        if angle >= np.pi:
            raise ValueError(f"{path}: camera_angle_x: expected radians below pi; found {angle:g}. Degrees?")
        videos = []
        for n, (video, frame) in enumerate(zip(clips, frames, strict=True)):
            own, size = clip(video, folder, fps if video.is_dir() else None)
            width, height = (
                (pixels(meta[field], f"{path}: {field}") if field in meta else size[k])
                for k, field in enumerate(("width", "height"))
            )
            if (width, height) != size:
                raise ValueError(
                    f"{video}: expected {width} x {height} pixels as {FILE} says; found {size[0]} x {size[1]}. Bring "
                    "the videos at full resolution, or scale width, height, cx and cy to theirs."
                )
            focal = width / (2 * np.tan(angle / 2))
            cx, cy = (
                (float(numbers(meta[field], (), f"{path}: {field}")) if field in meta else half)
                for field, half in (("cx", width / 2), ("cy", height / 2))
            )
            w2c = from_opengl(frame["transform_matrix"], f"{path}: frames[{n}].transform_matrix")
            name = video.stem if video.is_file() else video.name
            videos.append({"name": name, **own, "camera": camera(pinhole(focal, focal, cx, cy), w2c, size)})
        return scene(videos, "sync-nerf", [f"videos and poses of {FILE} are paired by order"])

    def _clips(self, folder: Path) -> list[Path]:
        return videos_in(folder) or next((f for place in FRAMES if (f := image_folders(folder / place))), [])
