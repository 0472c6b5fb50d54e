"""MoSca's working folder: ``images/`` with depth, tracks and masks that its first stage wrote; or several such folders.

``{mode}_depth/<stem>.npz`` holds a map ``dep`` (H,W), ``*_tap.npz`` tracks (T,N,2|3) and visibility (T,N). Cameras that
MoSca found lie in pickles, which are not read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..document import unknown_camera
from ..images import image_size
from .common import folders_in, images_in, same_count, scene

SHARP = "_sharp"


class MoSca:
    """MoSca (Lei et al., CVPR 2025): one folder a video, without calibration."""

    name = "mosca"
    looks_for = "images/ beside *_depth/ or *_tap.npz; or folders of this kind, one a video"
    brings = "depth, tracks, masks; no calibration"

    def claims(self, folder: Path) -> bool:
        return bool(_homes(folder))

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        """``fps``: of the images, which carry no clock. ValueError names a folder whose files are not one a frame."""
        homes = _homes(folder)
        if not homes:
            raise ValueError(f"{folder}: expected {self.looks_for}; found none. Check the path.")
        notes = ["depth is up to a scale of its own in every video, as estimators leave it"]
        videos = [_video(home, folder, fps, notes) for home in homes]
        return scene(videos, "mosca", notes)


def _homes(folder: Path) -> list[Path]:
    if _is_one(folder):
        return [folder]
    inside = folders_in(folder)
    return [home for home in inside if _is_one(home)]


def _is_one(home: Path) -> bool:
    return bool(images_in(home / "images")) and any((*home.glob("*_depth/"), *home.glob("*_tap.npz")))


def _video(home: Path, folder: Path, fps: float | None, notes: list[str]) -> dict[str, Any]:
    def inside(path: Path) -> str:
        return path.relative_to(folder).as_posix()

    images = images_in(home / "images")
    name = home.resolve().name if home == folder else home.name
    size = image_size(images[0])
    entry: dict[str, Any] = {"name": name, "frames": [inside(path) for path in images], "fps": fps}
    entry["camera"] = unknown_camera(*size)
    depths = sorted(home.glob("*_depth/"), key=lambda p: (p.name.endswith(SHARP), p.name))
    if len({p.name.removesuffix(SHARP) for p in depths}) > 1:
        raise ValueError(
            f"{home}: expected depth of one kind; found {', '.join(p.name for p in depths)}. Move the others away."
        )
    if depths:
        # sharpened maps have fewer values between what is near and what is far
        entry["depth"] = {"frames": _one_a_frame(depths[-1], images, (".npz", ".npy"), folder)}
    for place in ("masks", "mask"):
        if (home / place).is_dir():
            entry["masks"] = _one_a_frame(home / place, images, (".npz", ".npy", ".png", ".jpg"), folder)
            break
    tracks = sorted(home.glob("*_tap.npz"))
    if tracks:
        chosen = next((path for path in tracks if path.name.startswith("dynamic")), tracks[0])
        entry["tracks"] = {"file": inside(chosen), "size": list(size)}
        others = [path.name for path in tracks if path != chosen]
        if others:
            notes.append(f"{name}: tracks of {chosen.name}; not of {', '.join(others)}")
    return entry


def _one_a_frame(home: Path, images: list[Path], suffixes: tuple[str, ...], folder: Path) -> list[str]:
    """A file for every image, by its stem. ValueError for one that is missing, and for more than there are images."""
    there = {p.stem: p for p in sorted(home.iterdir()) if p.suffix.lower() in suffixes and p.is_file()}
    lacking = [image.name for image in images if image.stem not in there]
    if lacking:
        raise ValueError(f"{home}: expected a file for every image; none for {lacking[0]}. Run MoSca's stage again.")
    same_count(len(there), len(images), f"{home}: files for the images", "Take out what belongs to no image.")
    return [there[image.stem].relative_to(folder).as_posix() for image in images]
