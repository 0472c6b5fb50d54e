"""The Panoptic / Dynamic3DGaussians layout: ``{train,test}_meta.json``, ``ims/<cam>/<frame>.jpg``, ``seg/<cam>/*.png``.

Meta: ``w``, ``h``; ``fn[t][c]`` relative to ims; ``k[t][c]`` 3x3; ``w2c[t][c]`` 4x4 OpenCV; ``cam_id[t][c]``.
The capture rate is not in the files (30 is the studio's; viewers play it at 20).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..files.arrays import read_json
from ..files.strict import in_words
from ..types import Camera
from .document import document

METAS = ("train_meta.json", "test_meta.json")

STUDIO_FPS = 30.0
"""Capture rate where none is given: the files do not tell it."""


class Panoptic:
    """The layout of the Panoptic Sports scenes, calibrated; cameras in the order of their numbers."""

    name = "panoptic"
    looks_for = f"{' or '.join(METAS)} beside ims/"
    brings = "cameras, masks"

    def claims(self, folder: Path) -> bool:
        return any((folder / meta).is_file() for meta in METAS) and (folder / "ims").is_dir()

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        """ValueError names file and field. ``fps``: the capture rate, assumed where it is not given."""
        rate = STUDIO_FPS if fps is None else fps
        videos = []
        for name in METAS:
            if (folder / name).is_file():
                try:
                    videos += _videos(read_json(folder / name), folder, rate)
                except (KeyError, TypeError, IndexError, ValueError, AttributeError) as error:
                    raise ValueError(
                        f"{folder / name}: expected w, h, fn, k, w2c and cam_id; {in_words(error)}. Mend the file."
                    ) from None
                names = [video["name"] for video in videos]
                twice = sorted({n for n in names if names.count(n) > 1})
                if twice:
                    raise ValueError(
                        f"{folder / name}: cam_id: expected every camera once; found {', '.join(twice)} again. "
                        "Mend the file."
                    )
        videos.sort(key=lambda v: (len(v["name"]), v["name"]))
        assumed = f"the layout does not store the capture rate; {rate:g} fps assumed"
        return document(videos, "panoptic", notes=[assumed] if fps is None else [])


def _videos(meta: dict[str, Any], folder: Path, fps: float) -> list[dict[str, Any]]:
    k, w2c, fn = np.asarray(meta["k"], float), np.asarray(meta["w2c"], float), meta["fn"]
    T, C = len(fn), len(fn[0])
    if k.shape != (T, C, 3, 3) or w2c.shape != (T, C, 4, 4) or any(len(row) != C for row in fn):
        raise ValueError(f"k {k.shape}, w2c {w2c.shape} and fn ({T} x {C}) do not agree")
    entries = []
    for c in range(C):
        cam = str(int(meta["cam_id"][0][c]))
        poses = w2c[:, c]
        static = bool(np.ptp(poses, 0).max() == 0)
        if np.ptp(k[:, c], 0).max() > 0:
            raise ValueError(f"camera {cam}: expected one K for all frames; it changes (zoom is not supported)")
        try:
            Camera(k[0, c], poses[0] if static else poses, int(meta["w"]), int(meta["h"]))
        except ValueError as error:
            raise ValueError(f"camera {cam}: {error}") from None
        entry: dict[str, Any] = {
            "name": cam,
            "frames": _pattern([str(row[c]) for row in fn], folder / "ims", "ims"),
            "fps": fps,
            "camera": {
                "K": k[0, c].tolist(),
                "w2c": (poses[0] if static else poses).tolist(),
                "width": int(meta["w"]),
                "height": int(meta["h"]),
            },
        }
        masks = [str(Path(row[c]).with_suffix(".png")) for row in fn]
        if (folder / "seg" / masks[0]).is_file():
            entry["masks"] = _pattern(masks, folder / "seg", "seg")
        entries.append(entry)
    return entries


def _pattern(names: list[str], home: Path, prefix: str) -> str | list[str]:
    """``ims/3/*.jpg`` when that names the same files in the same order; else the list."""
    first = Path(names[0])
    pattern = f"{prefix}/{first.parent.as_posix()}/*{first.suffix}"
    if ".." not in first.parts and not first.is_absolute():
        there = sorted(p.name for p in (home / first.parent).glob(f"*{first.suffix}"))
        if [(first.parent / name).as_posix() for name in there] == names:
            return pattern
    return [f"{prefix}/{n}" for n in names]
