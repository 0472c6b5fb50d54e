"""Cameras by what moves: ``otsync calibrate`` where every video has depth and intrinsics of its own.

Phones with LiDAR and RGB-D cameras need no common background. Each video's tracks are lifted in its camera's own frame,
and clocks and poses are found together, from the motion alone (:func:`synchronize_own_scene`).
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..calibrate import Calibration, FoundCamera
from ..calibrate.clips import kind_of, uncalibrated
from ..calibrate.document import calibrated_document
from ..calibrate.world import Similar, upright
from ..compute.threads import MapLike
from ..files.cache import Cache
from ..files.strict import checked
from ..io.layout import SceneFile
from ..io.scene import Scene, file_of, names_of, read_document, scene_from_document
from ..progress import Tell
from ..types import Offsets
from .own_frames import at_origins, synchronize_own_scene
from .stages import Stages

REMEDY = (
    "Film longer, with more that moves in the view of all cameras at once; or let the background tell: otsync "
    "calibrate --way background."
)


def has_depth(document: dict[str, Any]) -> bool:
    """Whether every video of a scene document has depth and intrinsics, or had when motion told its cameras."""
    if (document.get("calibration") or {}).get("method") == "motion":
        return True
    videos = _of_scene(document)
    return len(videos) >= 2 and all(v.get("depth") and (v.get("camera") or {}).get("K") is not None for v in videos)


def calibrate_by_motion(
    folder: str | os.PathLike[str],
    *,
    stages: Stages | None = None,
    cache: Cache | None = None,
    map: MapLike = map,
    tell: Tell = lambda text: None,
) -> tuple[Calibration, dict[str, Any]]:
    """The cameras of a folder whose videos have depth, z up, in the unit of the first one; and its scene document.

    Poses that the folder's scene.json has already do not count. Scales of depth maps are multiplied by the scale of
    their video, so that all are in one unit. A camera whose pose or clock is not to be trusted is named with the
    reason. ValueError names the video that lacks depth or intrinsics.
    """
    listed = set(names_of(read_document(folder)[0]["videos"]))  # what a reader finds beside them has no depth
    document = uncalibrated(folder)
    of_scene = [v for v in _of_scene(document) if v["name"] in listed]
    document["videos"] = [{**v, "camera": {**(v.get("camera") or {}), "w2c": None}} for v in of_scene]
    checked(document, SceneFile, file_of(folder))
    scene = scene_from_document(at_origins(document), Path(folder), file=file_of(folder))
    answer = synchronize_own_scene(scene, stages=stages, cache=cache, map=map, tell=tell)
    offsets = answer.offsets
    cameras = tuple(_found(scene, offsets, v) for v in range(len(scene.videos)))
    found = Calibration(_upright(cameras), "motion", seconds=answer.seconds)
    for video, S in zip(document["videos"], offsets.transforms, strict=True):
        if S is not None:
            video["depth"] = {**video["depth"], "scale": float(video["depth"].get("scale", 1.0)) * S.scale}
    return found, calibrated_document(document, found)


def _of_scene(document: dict[str, Any]) -> list[dict[str, Any]]:
    """The entries of a document's videos, named, without clips that only help."""
    named = zip(names_of(document["videos"]), document["videos"], strict=True)
    return [{**entry, "name": name} for name, entry in named if kind_of(name) == "scene"]


def _upright(cameras: tuple[FoundCamera, ...]) -> tuple[FoundCamera, ...]:
    """The cameras in a world with z up, its origin where they look; lengths stay as they are."""
    poses = [c.w2c for c in cameras if c.w2c is not None]
    if not poses:
        return cameras
    there = upright(poses, [0] * len(poses))
    world = Similar(1.0, there.R, there.t / there.scale)
    return tuple(c if c.w2c is None else replace(c, w2c=world.camera(c.w2c)) for c in cameras)


def _found(scene: Scene, offsets: Offsets, v: int) -> FoundCamera:
    """The camera of video v, as far as its motion was found again in the others."""
    own, S = scene.videos[v].camera, offsets.transforms[v]
    camera = FoundCamera(scene.videos[v].name, own.width, own.height, own.K, own.distortion, "given")
    if S is None or offsets.component[v] != offsets.component[offsets.reference]:
        return camera.doubted("what moves before it was not found again in the other videos", REMEDY)
    pairs = [len(m) for pair, m in offsets.matches.items() if v in pair]
    known = 0.0 if v == offsets.reference else S.rotation_sigma
    place = 0.0 if v == offsets.reference else S.sigma_at(np.zeros(3))
    camera = replace(
        camera, w2c=S.camera(own).w2c, sigma_degrees=known, sigma_position=place, inliers=max(pairs, default=0)
    )
    status = offsets.status[v]
    return camera if status.ok else camera.doubted(f"clock and pose are doubtful ({status.code}): {status}", REMEDY)
