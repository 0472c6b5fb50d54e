"""COLMAP's models, text and binary: ``sparse/0/`` beside ``images/``, or beside video files.

Beside video files every image stands for the static camera of the video that is named as it is. Else images of one
folder are one video, whose camera moves unless all its poses are the same. Poses are up to scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ...files.strict import shown
from ..images import image_size
from ..order import natural
from .colmap_files import Lens, Posed, read_model
from .common import camera, clip, images_in, scene, told, videos_in

MODELS = ("sparse/0", "sparse", "colmap/sparse/0", "")
IMAGES = ("images", "input", "")


class Colmap:
    """COLMAP's models; distortion as far as OpenCV knows it."""

    name = "colmap"
    looks_for = "sparse/0/cameras.bin and images.bin (or .txt), and images/ or videos that are named as the images"
    brings = "cameras, distortion; the clock of videos"

    def claims(self, folder: Path) -> bool:
        return _model(folder) is not None

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        """``fps``: of images, which carry no clock. ValueError names file and field."""
        model = _model(folder)
        if model is None:
            raise ValueError(f"{folder}: expected {self.looks_for}; found no model. Run COLMAP, or check the path.")
        lenses, posed = told(model / "images", "cameras and images", lambda: read_model(model))
        for image in posed:
            if PurePosixPath(image.name).is_absolute() or ".." in PurePosixPath(image.name).parts or "\0" in image.name:
                raise ValueError(
                    f"{model}: expected names of images below {folder}; found {shown(image.name)}. Rename it."
                )
        posed = sorted(posed, key=lambda image: (str(PurePosixPath(image.name).parent), natural(Path(image.name))))
        videos = videos_in(folder)
        note = "lengths are in the unit of the model, which COLMAP leaves open"
        if videos:
            if fps is not None:
                raise ValueError(
                    f"fps: expected none beside video files, which carry a clock; found {fps:g}. Leave it out."
                )
            return scene(_of_videos(folder, videos, lenses, posed), "colmap", [note])
        entries, notes = _of_images(folder, lenses, posed, fps)
        return scene(entries, "colmap", [note, *notes])


def _model(folder: Path) -> Path | None:
    for place in MODELS:
        home = folder / place if place else folder
        for suffix in ("bin", "txt"):
            if (home / f"cameras.{suffix}").is_file() and (home / f"images.{suffix}").is_file():
                return home
    return None


def _of_videos(folder: Path, videos: Sequence[Path], lenses: dict[int, Lens], posed: Sequence[Posed]) -> list[dict]:
    """One static camera a video, by the image's name."""
    by_name: dict[str, list[Posed]] = {}
    for image in posed:
        inside = PurePosixPath(image.name)
        by_name.setdefault(inside.stem if str(inside.parent) == "." else str(inside.parts[0]), []).append(image)
    names = {video.stem for video in videos}
    if names != set(by_name):
        lacking, extra = sorted(names - set(by_name)), sorted(set(by_name) - names)
        raise ValueError(
            f"{folder}: expected an image of the model for every video, of the same name; "
            f"{'no image of ' + ', '.join(lacking[:8]) if lacking else 'no video of ' + ', '.join(extra[:8])}. Name "
            "one image of each video as the video, and map them again; or move the videos away."
        )
    entries = []
    for video in videos:
        images = by_name[video.stem]
        poses = np.stack([image.w2c for image in images])
        if np.ptp(poses, axis=0).max() > 1e-6:
            raise ValueError(
                f"{video}: expected one pose, of a static camera; the model has {len(poses)} different ones. For a "
                "camera that moves bring its images instead of the video."
            )
        own, size = clip(video, folder)
        lens = _fitting(lenses[images[0].camera], size, str(video))
        entries.append({"name": video.stem, **own, "camera": camera(lens.K, poses[0], size, lens.distortion)})
    return entries


def _of_images(
    folder: Path, lenses: dict[int, Lens], posed: Sequence[Posed], fps: float | None
) -> tuple[list[dict], list[str]]:
    """A video a folder of images."""
    home = next((folder / p if p else folder for p in IMAGES if ((folder / p) / posed[0].name).is_file()), None)
    if home is None:
        raise FileNotFoundError(f"{folder}: expected {shown(posed[0].name)} in images/; found none. Bring the images.")
    groups: dict[str, list[Posed]] = {}
    for image in posed:
        groups.setdefault(str(PurePosixPath(image.name).parent), []).append(image)
    entries, notes = [], []
    for key, group in groups.items():
        name = "images" if key == "." else key.replace("/", "-")
        there = [path.name for path in images_in(home / key)]
        known = [PurePosixPath(image.name).name for image in group]
        lacking = [own for own in known if own not in set(there)]
        if lacking:
            raise ValueError(f"{home / key}: expected {shown(lacking[0])}, which the model has; found none. Bring it.")
        if len({image.camera for image in group}) > 1 and len({_key(lenses[image.camera]) for image in group}) > 1:
            raise ValueError(
                f"{folder}: {name}: expected one lens for all images; the model has {len({i.camera for i in group})}. "
                "Map with one camera a folder (--ImageReader.single_camera_per_folder 1)."
            )
        lens = _fitting(lenses[group[0].camera], image_size(home / group[0].name), str(home / key))
        entry: dict[str, Any] = {"name": name}
        entry["frames"] = [(home / image.name).relative_to(folder).as_posix() for image in group]
        entry["camera"] = camera(lens.K, np.stack([image.w2c for image in group]), lens.size, lens.distortion)
        if len(known) < len(there):
            # the images between keep their place in time: frame k of the folder is at k / fps
            if fps is None:
                raise ValueError(
                    f"{home / key}: expected a pose of every image; {len(there) - len(known)} of {len(there)} have "
                    "none. Give --fps, so that the others keep their times, or map again."
                )
            place = {own: k for k, own in enumerate(there)}
            entry["timestamps"] = [place[own] / fps for own in known]
            notes.append(f"{name}: {len(there) - len(known)} of {len(there)} images have no pose and are left out")
        else:
            entry["fps"] = fps
        entries.append(entry)
    return entries, notes


def _key(lens: Lens) -> tuple:
    return (lens.K.tobytes(), lens.size, tuple(lens.distortion or ()))


def _fitting(lens: Lens, size: tuple[int, int], where: str) -> Lens:
    if lens.size != size:
        raise ValueError(
            f"{where}: expected {lens.size[0]} x {lens.size[1]} pixels as the model says; found {size[0]} x {size[1]}. "
            "Bring the images that were mapped."
        )
    return lens
