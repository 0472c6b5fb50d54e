"""DANNCE's layout: a ``.mat`` of parameters a camera, and videos in ``videos/Camera1/`` (or ``cam1.mp4``).

MATLAB's convention: K and r are transposed (``x_camera = x_world r + t``), the centre of the first pixel is (1, 1),
lengths are millimetres as a rule. RDistort has two or three radial coefficients, TDistort two tangential ones.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ...files.arrays import existing
from ...files.strict import shown
from ..order import natural
from .common import (
    HALF,
    camera,
    clip,
    distortion,
    every_clip_taken,
    folders_in,
    images_in,
    intrinsics,
    numbers,
    same_count,
    scene,
    videos_in,
    world_to_camera,
)

HOMES = ("calibration", "params", "parameters", "")
PARAMS = re.compile(r"(?:hires_)?cam(\d+)_params\.mat", re.IGNORECASE)
CLIP = re.compile(r"cam(?:era)?_?(\d+)", re.IGNORECASE)
LARGEST = 2**24
"""Bytes of a file of parameters: real ones have a kilobyte."""


class Dannce:
    """DANNCE (Dunn et al., Nature Methods 2021): static calibrated cameras."""

    name = "dannce"
    looks_for = "calibration/hires_cam1_params.mat, ... (or params/cam1_params.mat), and videos/Camera1/, ..."
    brings = "cameras, distortion; the clock of videos"

    def claims(self, folder: Path) -> bool:
        return bool(_params(folder))

    def describe(self, folder: Path, *, order: tuple[str, ...] | None = None) -> dict[str, Any]:
        """``order``: names of the videos of cam1, cam2, ..., where their own names do not tell.

        ValueError names file and field.
        """
        params = _params(folder)
        if not params:
            raise ValueError(f"{folder}: expected {self.looks_for}; found no parameters. Check the path.")
        clips = _clips(folder)
        chosen = _by_number(folder, params, clips) if order is None else _by_order(params, clips, order)
        every_clip_taken(chosen.values(), clips, str(folder))
        videos = []
        for number, path in params.items():
            video = chosen[number]
            names = {c: name for name, c in clips.items()}
            fields = _lens(path)
            own, size = clip(video, folder)
            videos.append({"name": names[video], **own, "camera": camera(fields[0], fields[1], size, fields[2])})
        return scene(videos, "dannce", ["lengths are in the unit of the calibration, millimetres as a rule"])


def _params(folder: Path) -> dict[int, Path]:
    """Files of parameters by the number of their camera, in the first place that has any."""
    for home in HOMES:
        place = folder / home if home else folder
        files = sorted(place.iterdir(), key=natural) if place.is_dir() else []
        found = {int(match[1]): p for p in files if (match := PARAMS.fullmatch(p.name))}
        if found:
            return dict(sorted(found.items()))
    return {}


def _clips(folder: Path) -> dict[str, Path]:
    """Videos by name: ``videos/Camera1/0.mp4`` is Camera1."""
    found: dict[str, Path] = {}
    for home in folders_in(folder / "videos"):
        inside = videos_in(home)
        if len(inside) > 1:
            raise ValueError(
                f"{home}: expected one video; found {len(inside)}, parts of one recording perhaps. Join them first."
            )
        if inside or images_in(home):
            found[home.name] = inside[0] if inside else home
    for home in () if found else (folder / "videos", folder):
        found = found or {p.stem: p for p in videos_in(home)}
    if not found:
        raise ValueError(f"{folder}: expected videos/Camera1/0.mp4, ... or *.mp4; found no videos. Put them there.")
    return found


def _by_number(folder: Path, params: dict[int, Path], clips: dict[str, Path]) -> dict[int, Path]:
    numbered = {int(match[1]): p for name, p in clips.items() if (match := CLIP.fullmatch(name))}
    if set(numbered) != set(params) or len(numbered) < len(clips):
        raise ValueError(
            f"{folder}: expected videos named Camera{next(iter(params))}, ... as {len(params)} files of parameters "
            f"are; found {', '.join(clips)}. Name them so, or give their order: --order NAME NAME ..."
        )
    return numbered


def _by_order(params: dict[int, Path], clips: dict[str, Path], order: tuple[str, ...]) -> dict[int, Path]:
    same_count(len(order), len(params), "order: names of videos", "Name one video a file of parameters.")
    unknown = [name for name in order if name not in clips]
    if unknown or len(set(order)) < len(order):
        raise ValueError(f"order: expected each of {', '.join(clips)} once; found {' '.join(order)}. Correct it.")
    return {number: clips[name] for number, name in zip(params, order, strict=True)}


def _lens(path: Path) -> tuple[np.ndarray, np.ndarray, list[float] | None]:
    """K, w2c and distortion of one file."""
    from scipy.io import loadmat, whosmat

    if existing(path).stat().st_size > LARGEST:
        raise ValueError(f"{path}: expected at most {LARGEST} bytes; found {path.stat().st_size}. Another file?")
    wanted = ("K", "r", "t", "RDistort", "TDistort")
    try:
        shapes = {name: shape for name, shape, _ in whosmat(path)}
        large = [name for name in wanted if np.prod(shapes.get(name, (0,)), dtype=float) > 100]
        if large:
            raise ValueError(f"{large[0]} of shape {shapes[large[0]]}")
        fields = loadmat(path, variable_names=wanted)
    except Exception as error:  # scipy raises what a damaged stream makes it raise
        raise ValueError(
            f"{path}: expected a MATLAB file (up to version 7) of small matrices; {type(error).__name__}: {error}. "
            "Save it again with save -v7."
        ) from None
    missing = [name for name in wanted if name not in fields]
    if missing:
        raise ValueError(f"{path}: expected {', '.join(wanted)}; {', '.join(missing)} missing. Calibrate again.")
    given = numbers(fields["K"], (3, 3), f"{path}: K")
    if np.abs(given[:2, 2]).max() > np.abs(given[2, :2]).max():
        raise ValueError(
            f"{path}: K: expected MATLAB's, transposed; found the principal point in the last column. Save K' and r'."
        )
    # the centre of MATLAB's first pixel is 1, of ours a half
    K = intrinsics(given.T, f"{path}: K", -HALF)
    r, t = numbers(fields["r"], (3, 3), f"{path}: r"), numbers(fields["t"], (None, None), f"{path}: t")
    if t.size != 3:
        raise ValueError(f"{path}: t: expected 3 numbers; found {shown(t.tolist())}. Calibrate again.")
    radial = numbers(fields["RDistort"], (None, None), f"{path}: RDistort").reshape(-1)
    tangential = numbers(fields["TDistort"], (None, None), f"{path}: TDistort").reshape(-1)
    if len(radial) not in (2, 3) or len(tangential) != 2:
        raise ValueError(
            f"{path}: RDistort, TDistort: expected two or three, and two coefficients; found {len(radial)} and "
            f"{len(tangential)}. Calibrate again."
        )
    lens = distortion([*radial[:2], *tangential, *radial[2:]], f"{path}: RDistort")
    return K, world_to_camera(r.T, t, f"{path}: r"), lens
