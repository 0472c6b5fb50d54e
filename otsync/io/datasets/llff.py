"""``poses_bounds.npy`` (LLFF): Neural 3D Video, and Sync-NeRF's Plenoptic layout of the same scenes.

One row of 17 numbers a camera: a 3x5 matrix of axes (down, right, backwards), centre, and (height, width, focal), then
near and far. Rows and videos are paired by order: counts must agree. Sizes are those of the full images; frames that
were reduced (``frames_2``) scale the intrinsics.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...files.arrays import existing
from ..images import read_npy
from .common import (
    camera,
    clip,
    image_folders,
    numbers,
    pinhole,
    positive,
    rigid,
    same_count,
    scene,
    sorted_alike,
    told,
    videos_in,
)

FILE = "poses_bounds.npy"
COLUMNS = 17
SAME_SHAPE = 0.01
"""Relative difference between width and height scales: a reduction rounds to whole pixels."""


class NeuralVideo:
    """Neural 3D Video (Li et al., CVPR 2022): one video file a camera."""

    name = "neural-3d-video"
    looks_for = f"{FILE} beside *.mp4"
    brings = "cameras; the clock of videos"

    def claims(self, folder: Path) -> bool:
        return (folder / FILE).is_file() and bool(videos_in(folder))

    def describe(self, folder: Path) -> dict[str, Any]:
        """ValueError names file and field."""
        return _described(folder, videos_in(folder), "neural-3d-video", None, "*.mp4")


class SyncNerfPlenoptic:
    """Sync-NeRF's Plenoptic scenes: the same with folders of frames, as a rule at half resolution."""

    name = "sync-nerf-plenoptic"
    looks_for = f"{FILE} beside frames_N/cam*/"
    brings = "cameras"

    def claims(self, folder: Path) -> bool:
        return (folder / FILE).is_file() and bool(self._frames(folder))

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        """``fps``: the capture rate, which no file tells. ValueError names file and field."""
        return _described(folder, self._frames(folder), "sync-nerf-plenoptic", fps, "frames_N/cam*/")

    def _frames(self, folder: Path) -> list[Path]:
        """Of the least reduced ones that there are."""
        homes = [folder / "frames", *sorted(folder.glob("frames_[0-9]*"), key=lambda p: (len(p.name), p.name))]
        return next((found for home in homes if (found := image_folders(home))), [])


def _described(folder: Path, clips: list[Path], frame: str, fps: float | None, wanted: str) -> dict[str, Any]:
    path = existing(folder / FILE)
    if not clips:
        raise ValueError(f"{folder}: expected {wanted} beside {FILE}; found none. Put the recordings there.")

    def read() -> dict[str, Any]:
        rows = numbers(read_npy(path), (None, COLUMNS), f"{path}: poses and bounds")
        same_count(
            len(clips),
            len(rows),
            f"{folder}: videos for the rows of {FILE}",
            "They are paired by order: a video that was taken out (as often one that is not in sync) must leave its "
            "row too. Bring it back, or delete its row.",
        )
        sorted_alike([c.name for c in clips], str(folder))
        videos = []
        for n, (video, row) in enumerate(zip(clips, rows, strict=True)):
            where = f"{path}: row {n}"
            pose = row[:15].reshape(3, 5)
            down, right, back, centre = pose[:, :4].T
            c2w = rigid(np.stack([right, down, -back, centre], 1), where)
            height, width, focal = (positive(x, f"{where}: {w}") for x, w in zip(pose[:, 4], HWF, strict=True))
            own, size = clip(video, folder, fps if video.is_dir() else None)
            across, up = size[0] / width, size[1] / height
            if abs(across / up - 1) > SAME_SHAPE:
                raise ValueError(
                    f"{where}: expected the shape of {video.name}, {size[0]} x {size[1]} pixels; found {width:g} x "
                    f"{height:g}. Another layout's file, or videos that were cut or turned."
                )
            K = pinhole(focal * across, focal * up, size[0] / 2, size[1] / 2)
            name = video.stem if video.is_file() else video.name
            videos.append({"name": name, **own, "camera": camera(K, np.linalg.inv(c2w), size)})
        return scene(videos, frame, [f"videos and rows of {FILE} are paired by order"])

    return told(path, f"{COLUMNS} numbers a camera", read)


HWF = ("height", "width", "focal length")
