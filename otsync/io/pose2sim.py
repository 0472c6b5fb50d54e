"""Pose2Sim's layout: ``calibration/`` with a .toml (as Caliscope and anipose write it, too) or a Qualisys .qca.txt, and
``videos/``.

.toml: a table a camera with ``name``, ``size``, ``matrix``, ``distortions``, ``rotation`` (a Rodrigues vector or 3x3)
and ``translation``, world to camera with OpenCV's axes; Pose2Sim's are metres. .qca.txt: XML; focal lengths and centres
in 1/64 pixel, places in mm, rotations of a camera that looks along -z.
"""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..files.arrays import existing
from .document import document, missing_fields, unknown_camera
from .footage import VIDEO_SUFFIXES

LARGEST = 4 * 2**20
"""Bytes of a calibration file."""

SUBPIXELS = 64
"""Of a pixel, in a .qca.txt."""

AS_FILMED = 0.02
"""Share by which the size of a video may differ from the calibrated one without being another size: encoders crop to
whole blocks."""


class Pose2Sim:
    """A project of Pose2Sim or Caliscope: videos, and a calibration that names their cameras."""

    name = "pose2sim"
    looks_for = "a .toml of cameras (matrix, rotation, translation) or a .qca.txt, in the folder or in calibration/"
    brings = "cameras, distortion; the clock of videos"

    def claims(self, folder: Path) -> bool:
        return bool(_videos(folder)) and _calibration(folder) is not None

    def describe(self, folder: Path) -> dict[str, Any]:
        """ValueError names the file and what is wrong. Videos without a camera of their name are ``missing``."""
        from .frames import VideoFrames

        path = _calibration(folder)
        assert path is not None
        cameras = read_cameras(path)
        by_name = {_plain(name): camera for name, camera in cameras.items()}
        notes, videos = [f"cameras from {path.relative_to(folder)}"], []
        for file in _videos(folder):
            video = VideoFrames(file)
            entry: dict[str, Any] = {"name": file.stem, "file": file.relative_to(folder).as_posix()}
            camera = by_name.get(_plain(file.stem))
            if camera is None:
                videos.append(entry | {"camera": unknown_camera(video.width, video.height)})
                continue
            camera, note = _at_size(camera, video.width, video.height)
            if note:
                notes.append(f"{file.stem}: {note}")
            videos.append(entry | {"camera": camera})
        left = sorted(set(by_name) - {_plain(str(v["name"])) for v in videos})
        if left:
            notes.append(f"cameras without a video: {', '.join(left)}")
        missing = missing_fields(videos)
        return document(videos, path.stem, notes=notes, **({"missing": missing} if missing else {}))


def read_cameras(path: Path) -> dict[str, dict[str, Any]]:
    """Cameras by name: K, w2c, width, height and distortion as in scene.json. ValueError names file and field."""
    size = existing(path).stat().st_size
    if size > LARGEST:
        raise ValueError(f"{path}: expected a calibration of at most {LARGEST} bytes; found {size}.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: expected text; {error}. Export the calibration again.") from None
    cameras = _from_toml(path, text) if path.suffix == ".toml" else _from_qualisys(path, text)
    if not cameras:
        raise ValueError(f"{path}: expected cameras; found none. Export the calibration again.")
    return cameras


def _from_toml(path: Path, text: str) -> dict[str, dict[str, Any]]:
    try:
        told = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: expected TOML; {error}. Export the calibration again.") from None
    cameras = {}
    for key, one in _tables(told).items():
        where = f"{path}: [{key}]"
        if one.get("rotation") is None or one.get("translation") is None:
            continue  # Caliscope keeps cameras that it has not placed
        if one.get("fisheye"):
            raise ValueError(f"{where}: expected a pinhole camera; found fisheye = true. Undistort its video first.")
        K = _numbers(one.get("matrix"), (3, 3), f"{where} matrix")
        turn = np.asarray(one["rotation"], float) if _flat(one["rotation"]) else np.zeros(0)
        R = rotation(turn) if turn.shape == (3,) else _numbers(one["rotation"], (3, 3), f"{where} rotation")
        t = _numbers(one["translation"], (3,), f"{where} translation")
        width, height = _numbers(one.get("size"), (2,), f"{where} size")
        bend = one.get("distortions", [])
        bend = _numbers(bend, (len(bend),), f"{where} distortions") if isinstance(bend, list) else np.zeros(0)
        cameras[str(one.get("name", key))] = _camera(K, R, t, width, height, bend)
    return cameras


def _tables(told: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The tables with a matrix, on the first level or the second."""
    found = {}
    for key, value in told.items():
        if isinstance(value, dict):
            if "matrix" in value:
                found[key] = value
            else:
                found |= {k: v for k, v in value.items() if isinstance(v, dict) and "matrix" in v}
    return found


def _from_qualisys(path: Path, text: str) -> dict[str, dict[str, Any]]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError(f"{path}: expected plain XML; found a document type. Export the calibration again.")
    try:
        root = ElementTree.fromstring(text.encode())
    except (ElementTree.ParseError, RecursionError) as error:
        raise ValueError(f"{path}: expected XML; {error}. Export the calibration again.") from None
    cameras = {}
    for n, camera in enumerate(root.iter("camera")):
        where = f"{path}: camera {n}"
        parts = {name: camera.find(name) for name in ("transform", "intrinsic", "fov_video")}
        lacking = [name for name, part in parts.items() if part is None]
        if lacking:
            raise ValueError(f"{where}: expected {', '.join(lacking)}; found none. Export the calibration again.")

        def of(part: str, *fields: str, parts: dict[str, Any] = parts, where: str = where) -> np.ndarray:
            told = [parts[part].get(field) for field in fields]
            return _numbers(told, (len(fields),), f"{where}: {part} {', '.join(fields)}")

        left, top, right, bottom = of("fov_video", "left", "top", "right", "bottom")
        f = of("intrinsic", "focalLengthU", "focalLengthV") / SUBPIXELS
        c = of("intrinsic", "centerPointU", "centerPointV") / SUBPIXELS - (left, top)
        bend = of(
            "intrinsic",
            *("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2"),
            "radialDistortion3",
        )
        rows = of("transform", *(f"r{i}{j}" for i in "123" for j in "123")).reshape(3, 3)
        R = np.diag([1.0, -1.0, -1.0]) @ rows
        centre = of("transform", "x", "y", "z") / 1000
        K = np.array([[f[0], 0, c[0]], [0, f[1], c[1]], [0, 0, 1.0]])
        name = camera.get("serial") or f"camera {n}"
        cameras[name] = _camera(K, R, -R @ centre, right - left + 1, bottom - top + 1, bend)
    return cameras


def _camera(
    K: np.ndarray, R: np.ndarray, t: np.ndarray, width: float, height: float, bend: np.ndarray
) -> dict[str, Any]:
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = R, t
    out: dict[str, Any] = {"K": K.tolist(), "w2c": w2c.tolist(), "width": round(width), "height": round(height)}
    return out | ({"distortion": bend.tolist()} if bend.any() else {})


def _at_size(camera: dict[str, Any], width: int, height: int) -> tuple[dict[str, Any], str]:
    """The camera of a video of that size, and what was done to it."""
    was = (camera["width"], camera["height"])
    if was == (width, height):
        return camera, ""
    ratio = np.array([width / was[0], height / was[1]])
    size = f"calibrated at {was[0]} x {was[1]}, the video has {width} x {height}"
    if (np.abs(ratio - 1) < AS_FILMED).all():
        return camera | {"width": width, "height": height}, f"{size}: taken as cropped, K as it is"
    if abs(ratio[0] / ratio[1] - 1) > AS_FILMED:
        return unknown_camera(width, height), f"{size}, which is another shape: its calibration is not used"
    K = np.diag([ratio[0], ratio[1], 1.0]) @ np.array(camera["K"])
    return camera | {"K": K.tolist(), "width": width, "height": height}, f"{size}: K scaled"


def rotation(turn: np.ndarray) -> np.ndarray:
    """The rotation about a vector (3,) by its length, radians (Rodrigues)."""
    angle = float(np.linalg.norm(turn))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = turn / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _numbers(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    try:
        found = np.asarray(value, float)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.shape != shape or not np.isfinite(found).all():
        raise ValueError(f"{where}: expected finite numbers of shape {shape}; found {str(value)[:80]}. Mend the file.")
    return found


def _flat(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(x, int | float) for x in value)


def _plain(name: str) -> str:
    """Names that mean the same camera: cam_01, Cam1, cam01."""
    parts = re.findall(r"[a-z]+|\d+", name.lower())
    return "".join(str(int(p)) if p.isdigit() else p for p in parts)


def _videos(folder: Path) -> list[Path]:
    """Video files in ``videos/``, else in the folder."""
    for home in (folder / "videos", folder):
        if home.is_dir():
            found = sorted(p for p in home.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES and p.is_file())
            if found:
                return found
    return []


def _calibration(folder: Path) -> Path | None:
    """The calibration file, in ``calibration/`` or in the folder: a .qca.txt, or a .toml with cameras."""
    for home in (folder / "calibration", folder):
        if not home.is_dir():
            continue
        for path in sorted(home.glob("*.toml")):
            if path.stat().st_size <= LARGEST and _has_cameras(path):
                return path
        found = sorted(home.glob("*.qca.txt"))
        if found:
            return found[0]
    return None


def _has_cameras(path: Path) -> bool:
    try:
        tables = _tables(tomllib.loads(path.read_text(encoding="utf-8-sig")))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError, RecursionError):
        return False
    return any(one.get("rotation") is not None for one in tables.values())
