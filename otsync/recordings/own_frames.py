"""Recordings whose cameras have intrinsics and depth but no pose: each video's tracks in its camera's own frame.

Several depth cameras, or phones with depth, need neither a clock nor an extrinsic calibration: positions are lifted
with the camera at the origin, clocks and similarities are found together (:mod:`otsync.frames`), and the cameras that
follow are written as a scene document that every other command reads.
"""

from __future__ import annotations

import copy
import os
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from ..clocks.shutter import check_within_a_frame
from ..compute.processes import Processes
from ..compute.threads import MapLike
from ..files.cache import Cache
from ..files.strict import checked
from ..frames import OwnFrames
from ..io.layout import SceneFile
from ..io.scene import Scene, camera_from, file_of, read_document, scene_from_document
from ..progress import Progress, Tell
from ..sync.method import Method
from ..sync.verb import synchronize
from ..types import Offsets
from ..types.checks import check_whole
from .kept_pairs import KeptPairs
from .routes import lift_given, track_all, without_times
from .silent import of_those_that_move
from .stages import Stages
from .synchronized import Synchronized


def open_without_poses(path: str | os.PathLike[str], *, allow_outside: bool = False) -> tuple[Scene, dict[str, Any]]:
    """The scene behind ``path``, cameras without ``w2c`` standing at the origin of a frame of their own; its document.

    Poses that are there are kept: they turn the video's own frame, no more. ValueError for what else is missing.
    """
    document, root = read_document(path)
    checked(document, SceneFile, file_of(path))
    filled = at_origins(document)
    return scene_from_document(filled, root, allow_outside=allow_outside, file=file_of(path)), document


def at_origins(document: dict[str, Any]) -> dict[str, Any]:
    """The document with each camera that has no pose at the origin of a frame of its own."""
    filled = copy.deepcopy(document)
    filled.pop("missing", None)  # what is missing besides poses is named by the field that lacks it
    for video in filled["videos"]:
        camera = video.get("camera") if isinstance(video, dict) else None
        if isinstance(camera, dict) and camera.get("w2c") is None:
            camera["w2c"] = np.eye(4).tolist()
    return filled


def synchronize_own_scene(
    scene: Scene,
    *,
    reference: int | Literal["auto"] = 0,
    method: Method | None = None,
    stages: Stages | None = None,
    solver: OwnFrames | None = None,
    cache: Cache | None = None,
    map: MapLike = map,
    processes: int = 1,
    tell: Tell = lambda text: None,
) -> Synchronized:
    """Clocks and frames of the videos of a scene, from tracks that are lifted in each camera's own frame.

    ``method``: the matcher of first matches and the graph; ValueError names a slot that own frames have no use for. It
    also names the videos without depth: pixels alone have no distances that could be compared. ``processes``: as of
    :func:`~otsync.recordings.routes.synchronize_scene`, and so is what becomes of a video in which nothing moves.
    """
    check_whole("processes", processes, 1)
    if stages is not None and stages.depth is not None:
        raise ValueError(
            "stages.depth: expected no estimator, since without poses nothing ties its scale to the world; found "
            f"{type(stages.depth).__name__}. Add depth maps of one scale, or calibrate the cameras."
        )
    flat = [v.name for v in scene.videos if v.depth is None]
    if flat:
        raise ValueError(
            f"frames own: expected depth for every video; it is missing for {', '.join(flat)}. Add depth maps, or "
            "calibrate the cameras and leave --frames out."
        )
    if len(scene.videos) < 2:
        raise ValueError(f"scene: expected at least two videos; found {len(scene.videos)}.")
    for video in scene.videos:
        check_within_a_frame(video.camera.readout, video.times, f"camera.readout of {video.name!r}")
    solve = partial(
        _synchronized, method=method, stages=stages, solver=solver, cache=cache, map=map, processes=processes, tell=tell
    )
    return of_those_that_move(scene, reference, solve, tell)


def _synchronized(
    scene: Scene,
    *,
    reference: int | Literal["auto"],
    method: Method | None,
    stages: Stages | None,
    solver: OwnFrames | None,
    cache: Cache | None,
    map: MapLike,
    processes: int,
    tell: Tell,
) -> Synchronized:
    """:func:`synchronize_own_scene` of videos that all have something to follow; NothingToFollow names others."""
    stages, cache = stages or Stages(), cache or Cache()
    progress = Progress(tell)
    with progress.stage("tracks"):
        raw = track_all(scene, stages, cache, map, tell)
    with progress.stage("lift"):
        lifted = [replace(t, frame=t.name) for t in lift_given(scene, raw, stages, cache, map)]
    with progress.stage("synchronise"), Processes(processes) as call:
        kept = KeptPairs(cache, map, call)
        offsets = synchronize(lifted, reference=reference, method=method, frames=solver or "own", map=kept)
    why = ["route own frames: as asked; depth is given, poses are not used across videos"]
    if method is not None and method.slots():
        why.append(method.told())
    if any(labels is not None for labels in scene.labels):
        why.append("labels are given; without a common frame they are not used")
    for line in why:
        tell(line)
    return Synchronized(without_times(offsets), tuple(lifted), "own frames", tuple(why), None, progress.seconds)


def found_document(document: dict[str, Any], offsets: Offsets) -> dict[str, Any]:
    """The scene document with the cameras that were found, in the frame and unit of the reference.

    Scales of depth maps are multiplied by the video's scale. Videos without an answer keep what they had and are named
    under ``missing``. ``calibration`` tells how sure the others are.
    """
    found = copy.deepcopy(document)
    found.pop("missing", None)
    found["frame"] = f"{offsets.names[offsets.reference]} (found by otsync)"
    lost = []
    videos = []
    sure: dict[str, Any] = {}
    for n, video in enumerate(found["videos"]):
        name = str(video.get("name", f"video{n}"))
        if name not in offsets.names:
            continue  # not among the cameras that were asked for
        videos.append(video)
        v = offsets.names.index(name)
        S = offsets.transforms[v]
        if S is None or offsets.component[v] != offsets.reference:
            lost.append(f"{name}: camera.w2c could not be found (world to camera, OpenCV axes)")
            video["camera"]["w2c"] = None
            continue
        sure[name] = {"lens": "given", "sigma_degrees": _finite(S.rotation_sigma)}
        before = dict(video["camera"])
        if before.get("w2c") is None:
            before["w2c"] = np.eye(4).tolist()
        video["camera"]["w2c"] = S.camera(camera_from(before)).w2c.tolist()
        if isinstance(video.get("depth"), dict):
            video["depth"]["scale"] = float(video["depth"].get("scale", 1.0)) * S.scale
    found["videos"] = videos
    notes = [str(n) for n in found.get("notes", ())]
    flagged = [n for n, s in zip(offsets.names, offsets.status, strict=True) if not s.ok]
    notes.append("poses found by otsync sync --frames own" + (f"; doubtful: {', '.join(flagged)}" if flagged else ""))
    found["notes"] = notes
    found["calibration"] = {"method": "motion", "unit": "arbitrary", "cameras": sure}
    if lost:
        found["missing"] = lost
    return found


def _finite(x: float) -> float | None:
    return round(float(x), 6) if np.isfinite(x) else None
