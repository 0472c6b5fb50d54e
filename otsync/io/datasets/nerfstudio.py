"""nerfstudio's ``transforms.json``: images with poses, and times, depth and masks where they are.

``transform_matrix`` is camera-to-world with OpenGL axes. Images of one folder are one video; where every frame names a
``camera_id`` (or ``camera_index``) that decides instead. Depth is 16-bit images of millimetres (times
``applied_scale``), masks are black where nerfstudio leaves pixels out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ...files.arrays import read_json
from ...files.strict import shown
from ..images import image_size
from ..order import natural
from .common import camera, distortion, from_opengl, intrinsics, numbers, pinhole, pixels, positive, scene, told

FILE = "transforms.json"
DEPTH_UNIT = 1e-3
"""Metres a step of a depth image: nerfstudio's ``depth_unit_scale_factor``."""

PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
CAMERA = ("camera_id", "camera_index", "camera_name")


class Nerfstudio:
    """nerfstudio's ``transforms.json``; static and moving cameras."""

    name = "nerfstudio"
    looks_for = f"{FILE} with frames that name images"
    brings = "cameras, distortion, times, depth, masks"

    def claims(self, folder: Path) -> bool:
        return (folder / FILE).is_file()

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        """``fps``: what scales ``time``, which runs from 0 to 1 as a rule. ValueError names file and field."""
        path = folder / FILE
        meta = read_json(path)
        return told(path, "frames with file_path and transform_matrix", lambda: document_of(folder, path, meta, fps))


def document_of(folder: Path, path: Path, meta: dict[str, Any], fps: float | None) -> dict[str, Any]:
    frames = meta["frames"]
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{path}: frames: expected a list of frames; found {shown(frames)}. Export it again.")
    model = meta.get("camera_model", "OPENCV")
    if model not in PINHOLES:
        raise ValueError(
            f"{path}: camera_model: expected one of {', '.join(PINHOLES)}; found {shown(model)}. Undistort the images "
            "to a pinhole first."
        )
    for field in ("time", "depth_file_path", "mask_path"):
        having = sum(field in frame for frame in frames)
        if having not in (0, len(frames)):
            raise ValueError(
                f"{path}: {field}: expected in all {len(frames)} frames or in none; found it in {having}. Complete it."
            )
    groups: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    by = next((field for field in CAMERA if all(field in frame for frame in frames)), None)
    for n, frame in enumerate(frames):
        where = frame["file_path"]
        if not isinstance(where, str) or not where:
            raise ValueError(f"{path}: frames[{n}].file_path: expected a path; found {shown(where)}. Correct it.")
        key = str(frame[by]) if by else str(PurePosixPath(where).parent)
        groups.setdefault(key, []).append((n, frame))
    if by is None and len(groups) == len(frames) > 1:
        raise ValueError(
            f"{path}: expected several frames a camera; every image lies in a folder of its own. Put the images of "
            "each camera into one folder, or name its camera_id in every frame."
        )
    groups = {key: groups[key] for key in sorted(groups, key=lambda key: natural(Path(key)))}
    names = _names(list(groups), by)
    notes: list[str] = []
    clocks = _clocks(path, meta, groups, fps, notes)
    videos = [
        _video(folder, path, meta, name, group, clocks.get(key), fps)
        for name, (key, group) in zip(names, groups.items(), strict=True)
    ]
    if any(f"{name}" in meta for name in ("applied_transform", "applied_scale")):
        notes.append("poses are those of the file, with its applied_transform and applied_scale")
    return scene(videos, "nerfstudio", notes)


def _names(keys: list[str], by: str | None) -> list[str]:
    """The last part of each folder where that tells them apart; else all of it."""
    if by is not None:
        return keys
    last = [PurePosixPath(key).name or "images" for key in keys]
    return last if len(set(last)) == len(last) else [key.replace("/", "-") for key in keys]


def _clocks(
    path: Path,
    meta: dict[str, Any],
    groups: dict[str, list[tuple[int, dict[str, Any]]]],
    fps: float | None,
    notes: list[str],
) -> dict[str, np.ndarray]:
    """``time`` of the frames of every group, sorted into the group's order, in seconds; empty where no frame has it.

    Where the rate is known, the unit is: the median step of a camera is a frame. Where it is not, times up to 1 are
    shares of a length that nobody knows.
    """
    if "time" not in next(iter(groups.values()))[0][1]:
        return {}
    times = {}
    for key, group in groups.items():
        told_times = [float(numbers(f["time"], (), f"{path}: frames[{n}].time")) for n, f in group]
        order = np.argsort(told_times, kind="stable")
        groups[key] = [group[k] for k in order]
        times[key] = np.array(told_times)[order]
        if (np.diff(times[key]) <= 0).any():
            k = int(np.argmax(np.diff(times[key]) <= 0))
            raise ValueError(
                f"{path}: frames of {shown(key)}: expected one image a moment; found two at time {times[key][k]:g}. If "
                "they are of several cameras, put each into a folder of its own or name its camera_id."
            )
    steps = [np.median(np.diff(t)) for t in times.values() if len(t) > 1]
    last = max(float(t[-1]) for t in times.values())
    if last > 1 or not steps:
        if fps is not None:
            raise ValueError(f"fps: expected none, because {path} gives times in seconds; found {fps:g}. Leave it out.")
        return times
    if "otsync_seconds" in meta:  # otsync export's own, which knows the unit
        if fps is not None:
            raise ValueError(f"fps: expected none, because {path} tells otsync_seconds; found {fps:g}. Leave it out.")
        own = positive(meta["otsync_seconds"], f"{path}: otsync_seconds")
        return {key: t * own for key, t in times.items()}
    if fps is None:
        return {}
    unit = 1 / (fps * float(np.min(steps)))
    notes.append(f"times up to {last:g} are taken as shares: 1 is {unit:.6g} s, by the smallest step and {fps:g} fps")
    return {key: t * unit for key, t in times.items()}


def _video(
    folder: Path,
    path: Path,
    meta: dict[str, Any],
    name: str,
    group: Sequence[tuple[int, dict[str, Any]]],
    times: np.ndarray | None,
    fps: float | None,
) -> dict[str, Any]:
    if "time" not in group[0][1]:
        group = sorted(group, key=lambda item: natural(Path(item[1]["file_path"])))
    images = [_file(folder, path, n, frame, "file_path") for n, frame in group]
    size = image_size(folder / images[0])
    lenses = [_lens(path, n, meta, frame, size) for n, frame in group]
    if any(not np.allclose(lens[0], lenses[0][0]) or lens[1:] != lenses[0][1:] for lens in lenses):
        raise ValueError(f"{path}: {name}: expected one lens for all frames; it changes (zoom is not supported).")
    K, lens = lenses[0]
    poses = np.stack([from_opengl(f["transform_matrix"], f"{path}: frames[{n}].transform_matrix") for n, f in group])
    entry: dict[str, Any] = {"name": name, "frames": images, "camera": camera(K, poses, size, lens)}
    entry |= {"fps": fps} if times is None else {"timestamps": times.tolist()}
    if "depth_file_path" in group[0][1]:
        unit = positive(meta.get("depth_unit_scale_factor", DEPTH_UNIT), f"{path}: depth_unit_scale_factor")
        unit *= positive(meta.get("applied_scale", 1.0), f"{path}: applied_scale")
        entry["depth"] = {"frames": [_file(folder, path, n, f, "depth_file_path") for n, f in group], "scale": unit}
    if "mask_path" in group[0][1]:
        entry["masks"] = [_file(folder, path, n, f, "mask_path") for n, f in group]
    return entry


def _file(folder: Path, path: Path, n: int, frame: dict[str, Any], field: str) -> str:
    """A file of a frame; ``images/a`` stands for ``images/a.png`` too, as in Blender's own exports."""
    text = frame[field]
    if not isinstance(text, str) or not text or "\0" in text:
        raise ValueError(f"{path}: frames[{n}].{field}: expected a path; found {shown(text)}. Correct it.")
    for each in (text, f"{text}.png", f"{text}.jpg"):
        if (folder / each).is_file():
            return PurePosixPath(each).as_posix()
    raise FileNotFoundError(f"{path}: frames[{n}].{field}: {shown(text)}: no such file in {folder}. Bring it.")


def _lens(
    path: Path, n: int, meta: dict[str, Any], frame: dict[str, Any], size: tuple[int, int]
) -> tuple[np.ndarray, list[float] | None]:
    """K at the size that the images have, and the distortion; a frame's own fields go before the file's."""
    own = meta | {k: v for k, v in frame.items() if k not in ("file_path", "transform_matrix")}
    where = f"{path}: frames[{n}]"
    w, h = (pixels(own[f], f"{where}.{f}") if f in own else size[k] for k, f in enumerate("wh"))
    if (w, h) != size:
        raise ValueError(
            f"{where}: expected {w} x {h} pixels as w and h say; found {size[0]} x {size[1]}. Name the images at full "
            "resolution, not images_2/."
        )
    if "fl_x" in own:
        fx = positive(own["fl_x"], f"{where}.fl_x")
        fy = positive(own.get("fl_y", fx), f"{where}.fl_y")
    elif "camera_angle_x" in own:
        fx = w / (2 * np.tan(positive(own["camera_angle_x"], f"{where}.camera_angle_x") / 2))
        angle = own.get("camera_angle_y")
        fy = fx if angle is None else h / (2 * np.tan(positive(angle, f"{where}.camera_angle_y") / 2))
    else:
        raise ValueError(f"{where}: expected fl_x, fl_y or camera_angle_x; found neither. Add the focal length.")
    cx, cy = (float(numbers(own.get(f, half), (), f"{where}.{f}")) for f, half in (("cx", w / 2), ("cy", h / 2)))
    lens = [own.get(f, 0.0) for f in LENS]
    while len(lens) > 4 and lens[-1] == 0:
        lens.pop()
    return intrinsics(pinhole(fx, fy, cx, cy), where), distortion(lens, f"{where}: {', '.join(LENS)}")
