"""D-NeRF's layout: ``transforms_{train,val,test}.json``, one image a moment, from a camera that jumps.

``camera_angle_x`` (radians), ``time`` from 0 to 1, ``transform_matrix`` camera-to-world with OpenGL axes, ``file_path``
without its suffix. Every split is a video with a moving camera.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from ...files.arrays import read_json
from .common import scene, told
from .nerfstudio import document_of

SPLITS = ("train", "val", "test")


class DNerf:
    """D-NeRF (Pumarola et al., CVPR 2021) and others with its splits."""

    name = "d-nerf"
    looks_for = " or ".join(f"transforms_{split}.json" for split in SPLITS)
    brings = "cameras, times (with --fps)"

    def claims(self, folder: Path) -> bool:
        return any((folder / f"transforms_{split}.json").is_file() for split in SPLITS)

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        """``fps``: frames per second of the train split (of the first that there is), which gives ``time`` a unit."""
        videos, notes, unit = [], [], None
        for split in SPLITS:
            path = folder / f"transforms_{split}.json"
            if not path.is_file():
                continue
            meta = read_json(path)

            def read(path: Path = path, meta: Any = meta, split: str = split) -> list[dict[str, Any]]:
                for n, frame in enumerate(meta["frames"]):
                    if "time" not in frame:
                        raise ValueError(f"{path}: frames[{n}].time: expected a time; found none. D-NeRF needs it.")
                # one camera, whatever folders its images lie in
                own = [{**frame, "camera_id": split} for frame in meta["frames"]]
                return document_of(folder, path, {**meta, "frames": own}, None)["videos"]

            video = told(path, "camera_angle_x, and frames with time", read)[0]
            if fps is not None and "timestamps" not in video:
                shares = sorted(float(frame["time"]) for frame in meta["frames"])
                step = min((b - a for a, b in itertools.pairwise(shares)), default=1.0)
                unit = 1 / (fps * step) if unit is None else unit
                del video["fps"]
                video["timestamps"] = [share * unit for share in shares]
            elif fps is not None:
                raise ValueError(
                    f"fps: expected none, because {path} gives times in seconds; found {fps:g}. Leave it out."
                )
            videos.append(video)
        if not videos:
            raise ValueError(f"{folder}: expected {self.looks_for}; found none. Check the path.")
        if unit is not None:
            notes.append(f"times run from 0 to 1: 1 is taken as {unit:.6g} s, by the smallest step and {fps:g} fps")
        return scene(videos, "d-nerf", notes)
