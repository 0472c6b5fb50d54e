"""EasyMocap's ``intri.yml`` and ``extri.yml``: OpenCV's file storage, with the numbers of each camera by its name.

``names``; ``K_x``, ``dist_x`` and perhaps ``H_x``, ``W_x``; ``Rot_x`` (or ``R_x``, Rodrigues) and ``T_x`` of
world-to-camera. OpenCV's pixels begin half a pixel later than ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

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
    scene,
    told,
    world_to_camera,
)

INTRI, EXTRI = "intri.yml", "extri.yml"
CLIPS = ("videos", "images", "")
LARGEST = 2**22
"""Bytes of a calibration file: real ones have some kilobytes."""


class EasyMocap:
    """EasyMocap: static calibrated cameras, videos or folders of images."""

    name = "easymocap"
    looks_for = f"{INTRI} and {EXTRI}, and videos/ or images/ that are named as their cameras"
    brings = "cameras, distortion; the clock of videos"

    def claims(self, folder: Path) -> bool:
        return (folder / INTRI).is_file() and (folder / EXTRI).is_file()

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        """``fps``: of folders of images, which carry no clock. ValueError names file and field."""
        intri, extri = Storage(folder / INTRI), Storage(folder / EXTRI)
        return told(folder / EXTRI, "names, Rot_x and T_x", lambda: _document(folder, intri, extri, fps))


class Storage:
    """A file of OpenCV's storage: matrices and texts by name."""

    def __init__(self, path: Path):
        import cv2

        self.path = existing(path)
        if path.stat().st_size > LARGEST:
            raise ValueError(f"{path}: expected at most {LARGEST} bytes; found {path.stat().st_size}. Another file?")
        try:
            # read from memory: a name of a file may hold parameters for OpenCV
            text = path.read_text(encoding="utf-8")
            self.root = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            if not self.root.isOpened():
                raise ValueError("it holds nothing")
        except (cv2.error, SystemError, ValueError) as error:
            said = " ".join(str(error.__cause__ or error.__context__ or error).split())[:200]
            raise ValueError(f"{path}: expected OpenCV's YAML; {said}. Calibrate again, or mend the file.") from None

    def matrix(self, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """A matrix. ValueError names it where it is missing or of another shape."""
        import cv2

        where = f"{self.path}: {name}"
        try:
            value = self.root.getNode(name).mat()
        except (cv2.error, SystemError) as error:
            raise ValueError(f"{where}: expected a matrix; {' '.join(str(error).split())[:120]}. Mend it.") from None
        if value is None:
            raise ValueError(f"{where}: expected a matrix; found none. Add it.")
        return numbers(value, shape, where)

    def names(self) -> list[str]:
        node = self.root.getNode("names")
        found = [node.at(i).string() or str(int(node.at(i).real())) for i in range(node.size())]
        if not found:
            raise ValueError(f"{self.path}: names: expected the names of the cameras; found none. Add them.")
        if len(set(found)) < len(found):
            raise ValueError(f"{self.path}: names: expected every camera once; found {', '.join(found)}. Correct it.")
        return found


def _document(folder: Path, intri: Storage, extri: Storage, fps: float | None) -> dict[str, Any]:
    import cv2

    names = intri.names()
    if set(names) != set(extri.names()):
        raise ValueError(
            f"{extri.path}: names: expected those of {INTRI}, {', '.join(names)}; found {', '.join(extri.names())}. "
            "Bring both files of one calibration."
        )
    clips = named_clips(folder, CLIPS)
    videos, taken = [], []
    for name in names:
        where = f"{extri.path}: {name}"
        if extri.root.getNode(f"Rot_{name}").empty():
            R = cv2.Rodrigues(extri.matrix(f"R_{name}", (3, 1)))[0]
        else:
            R = extri.matrix(f"Rot_{name}", (3, 3))
        w2c = world_to_camera(R, extri.matrix(f"T_{name}", (3, 1)), where)
        chosen = clip_of(name, clips, where)
        taken.append(chosen)
        own, size = clip(chosen, folder, fps if chosen.is_dir() else None)
        for field, pixels in ((f"W_{name}", size[0]), (f"H_{name}", size[1])):
            node = intri.root.getNode(field)
            if not node.empty() and node.real() > 0 and node.real() != pixels:
                raise ValueError(
                    f"{intri.path}: {field}: expected {pixels}, as {chosen.name} has; found {node.real():g}. Calibrate "
                    "with videos of this size."
                )
        K = intrinsics(intri.matrix(f"K_{name}", (3, 3)), f"{intri.path}: K_{name}", HALF)
        lens = distortion(intri.matrix(f"dist_{name}", (None, None)), f"{intri.path}: dist_{name}")
        videos.append({"name": name, **own, "camera": camera(K, w2c, size, lens)})
    every_clip_taken(taken, clips, str(intri.path))
    return scene(videos, "easymocap")
