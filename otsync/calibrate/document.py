"""A calibration as a part of a scene document."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..files.strict import checked
from ..io.document import document
from ..io.layout import SceneFile
from ..io.scene import file_of, names_of, read_document
from .clips import kind_of, uncalibrated
from .found import Calibration, FoundCamera


def calibrated_document(before: Mapping[str, Any], calibration: Calibration) -> dict[str, Any]:
    """The scene document ``before`` with the cameras that were found, and what was found out about each.

    Videos without a camera are left out of ``videos``; ``calibration`` names them with the reason. So are clips that
    only helped.
    """
    videos = []
    for name, entry in zip(names_of(before["videos"]), before["videos"], strict=True):
        if kind_of(name) != "scene":
            continue
        camera = calibration[name]
        if camera.w2c is not None:
            videos.append({**entry, "name": name, "camera": _camera(camera, entry)})
    lost = [camera.name for camera in calibration.cameras if camera.w2c is None]
    doubtful = [camera.name for camera in calibration.found if not camera.ok]
    notes = [str(note) for note in before.get("notes") or ()]
    if lost:
        notes.append(f"no camera was found for {', '.join(lost)}: calibration says why and what to film")
    if doubtful:
        notes.append(f"the cameras of {', '.join(doubtful)} are doubtful: calibration says why and what to film")
    missing = [item for item in before.get("missing") or () if "camera." not in item]
    more: dict[str, Any] = {"calibration": told_of(calibration)}
    if notes:
        more["notes"] = notes
    if missing:
        more["missing"] = missing
    return document(videos, str(before.get("frame", "world")), **more)


def told_of(calibration: Calibration) -> dict[str, Any]:
    """What was found out about every camera: the field ``calibration`` of scene.json."""
    return {
        "method": calibration.method,
        "unit": calibration.unit,
        "helpers": [camera.name for camera in calibration.helpers],
        "cameras": {camera.name: _told(camera) for camera in calibration.cameras},
    }


def came_later(folder: str | os.PathLike[str]) -> tuple[str, ...]:
    """Clips of a folder that were not there when ``otsync calibrate`` found the cameras of its scene.json.

    None where that file does not say, or is no sound scene: whoever reads it says why.
    """
    try:
        document, _ = read_document(folder)
        checked(document, SceneFile, file_of(Path(folder)))
    except ValueError:
        return ()
    told = document.get("calibration") or {}
    if "helpers" not in told:
        return ()
    known = {*told["cameras"], *told["helpers"]}
    names = [str(entry["name"]) for entry in uncalibrated(folder)["videos"]]
    return tuple(name for name in names if name not in known and kind_of(name) != "board")


def _camera(camera: FoundCamera, entry: Mapping[str, Any]) -> dict[str, Any]:
    assert camera.w2c is not None
    w2c = camera.w2c
    told: dict[str, Any] = {
        "K": camera.K.tolist(),
        "w2c": np.round(w2c, 9).tolist(),
        "width": camera.width,
        "height": camera.height,
    }
    if camera.distortion is not None:
        told["distortion"] = camera.distortion.tolist()
    readout = (entry.get("camera") or {}).get("readout")
    if readout is not None:
        told["readout"] = readout
    return told


def _told(camera: FoundCamera) -> dict[str, Any]:
    def finite(x: float) -> float | None:
        return round(float(x), 6) if np.isfinite(x) else None

    told: dict[str, Any] = {
        "lens": camera.lens,
        "sigma_degrees": finite(camera.sigma_degrees),
        "sigma_position": finite(camera.sigma_position),
        "inliers": camera.inliers,
        "points": camera.points,
    }
    if camera.bridged:
        told["bridged"] = finite(camera.bridged)
    if camera.doubt:
        told |= {"doubtful": camera.doubt, "remedy": camera.remedy}
    return told
