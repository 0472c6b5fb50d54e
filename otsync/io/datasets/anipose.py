"""anipose's ``calibration.toml``: a table a camera, with OpenCV's numbers.

``name``, ``size`` [width, height], ``matrix``, ``distortions``, ``rotation`` (Rodrigues) and ``translation`` of
world-to-camera. OpenCV's pixels begin half a pixel later than ours.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from ...files.arrays import existing
from .common import (
    HALF,
    camera,
    clip,
    clip_of,
    distortion,
    every_clip_taken,
    intrinsics,
    named_clips,
    numbers,
    pixels,
    scene,
    told,
    world_to_camera,
)

PLACES = ("calibration.toml", "calibration/calibration.toml")
CLIPS = ("videos-raw", "videos", "")
LARGEST = 2**20
"""Bytes of a calibration file: real ones have some kilobytes."""


class Anipose:
    """anipose (Karashchuk et al., Cell Reports 2021): static calibrated cameras."""

    name = "anipose"
    looks_for = f"{PLACES[0]}, and videos that are named as its cameras"
    brings = "cameras, distortion; the clock of videos"

    def claims(self, folder: Path) -> bool:
        return any((folder / place).is_file() for place in PLACES)

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        """``fps``: of folders of images, which carry no clock. ValueError names file and field."""
        path = existing(next((folder / p for p in PLACES if (folder / p).is_file()), folder / PLACES[0]))
        if path.stat().st_size > LARGEST:
            raise ValueError(f"{path}: expected at most {LARGEST} bytes; found {path.stat().st_size}. Another file?")
        try:
            tables = tomllib.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: expected TOML; {error}. Calibrate again, or mend it.") from None
        return told(path, "a table [cam_0], [cam_1], ... a camera", lambda: _document(folder, path, tables, fps))


def _document(folder: Path, path: Path, tables: dict[str, Any], fps: float | None) -> dict[str, Any]:
    import cv2

    cameras = {k: t for k, t in tables.items() if k != "metadata" and isinstance(t, dict)}
    if not cameras:
        raise ValueError(f"{path}: expected a table [cam_0], [cam_1], ... a camera; found none. Calibrate again.")
    clips = named_clips(folder, CLIPS)
    videos, taken = [], []
    for key, table in cameras.items():
        where = f"{path}: {key}"
        name = str(table["name"])
        if table.get("fisheye"):
            raise ValueError(
                f"{where}.fisheye: expected false; fisheye lenses are not supported. Undistort the videos."
            )
        width, height = (pixels(x, f"{where}.size") for x in numbers(table["size"], (2,), f"{where}.size"))
        R = cv2.Rodrigues(numbers(table["rotation"], (3,), f"{where}.rotation"))[0]
        w2c = world_to_camera(R, numbers(table["translation"], (3,), f"{where}.translation"), where)
        chosen = clip_of(name, clips, where)
        taken.append(chosen)
        own, size = clip(chosen, folder, fps if chosen.is_dir() else None)
        if size != (width, height):
            raise ValueError(
                f"{where}.size: expected the size of {chosen.name}, {size[0]} x {size[1]}; found {width} x {height}. "
                "Calibrate with videos of this size, or scale matrix and size."
            )
        K = intrinsics(table["matrix"], f"{where}.matrix", HALF)
        lens = distortion(table["distortions"], f"{where}.distortions")
        videos.append({"name": name, **own, "camera": camera(K, w2c, size, lens)})
    every_clip_taken(taken, clips, str(path))
    return scene(videos, "anipose", ["lengths are in the unit of the calibration board"])
