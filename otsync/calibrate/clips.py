"""The videos of a folder: which belong to the scene, which only help, and what is known of their lenses."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..files.arrays import read_json
from ..files.digest import sequence_key
from ..files.strict import shown
from ..io.frames import FrameRange, VideoFrames
from ..io.readers import describe_folder
from ..io.scene import Paths, names_of, read_document, video_frames
from ..types.camera import matrix_of

USUAL_FOCAL = 0.85
"""Focal length of a phone's main camera in video, over the longer side of the image: 28 mm equivalents with the crop of
a stabiliser give .75 to .95."""

DIAGONAL_35MM = 43.27
"""Of a frame of 35 mm film, mm: "35 mm equivalents" compare diagonals."""


@dataclass(frozen=True, eq=False)
class Lens:
    """Intrinsics and where they come from: "given", "board", "file" (metadata) or "guessed"."""

    K: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, " D"] | None = None
    source: str = "guessed"

    @property
    def known(self) -> bool:
        """Whether the mapping holds it fixed in any case."""
        return self.source in ("given", "board")

    def scaled(self, factor: float) -> Lens:
        """The same lens for images that are ``factor`` times as large."""
        return Lens(np.diag([factor, factor, 1.0]) @ self.K, self.distortion, self.source)


@dataclass(frozen=True, eq=False)
class Clip:
    """One video while its camera is being looked for.

    Args:
        entry: of the scene document. frames: lazy, of the scene's range.
        kind: "scene"; or "walk" or "board", which only help.
        turned: degrees by which players turn the image clockwise; otsync keeps it as it is stored.
    """

    name: str
    entry: Mapping[str, Any]
    frames: Sequence[np.ndarray]
    size: tuple[int, int]
    fps: float
    lens: Lens
    kind: str = "scene"
    turned: int = 0

    @property
    def key(self) -> str:
        """A hash of its pictures."""
        return sequence_key(self.frames)


def read_clips(
    folder: str | os.PathLike[str], intrinsics: str | os.PathLike[str] | None = None
) -> tuple[list[Clip], dict[str, Any]]:
    """The clips of a folder and its scene document.

    The folder is described by its scene.json, or by the reader that claims it. Intrinsics that the document holds are
    given ones; those of the file ``intrinsics`` replace them. ValueError where there are fewer than two videos besides
    walk and board clips, and for whatever does not read.
    """
    document, root = uncalibrated(folder), Path(folder)
    given = {} if intrinsics is None else read_intrinsics(intrinsics)
    paths, clips = Paths(root), []
    for name, entry in zip(names_of(document["videos"]), document["videos"], strict=True):
        clips.append(_clip(name, entry, paths, given))
    unknown = sorted(set(given) - {clip.name for clip in clips} - {"*"})
    if unknown:
        raise ValueError(
            f"{intrinsics}: expected names of the videos ({', '.join(c.name for c in clips)}); found "
            f"{', '.join(map(shown, unknown))}. Correct the names."
        )
    if sum(clip.kind == "scene" for clip in clips) < 2:
        raise ValueError(
            f"{folder}: expected two videos and more besides walk and board clips; found "
            f"{sum(clip.kind == 'scene' for clip in clips)}. Add the videos of the other cameras."
        )
    return clips, document


def uncalibrated(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """The folder's scene document before its cameras were found.

    A scene.json that an earlier calibration wrote lacks walk clips and videos without a camera: those come from the
    reader again, and of its lenses only those that were given stay.
    """
    document, _ = read_document(folder)
    before = document.get("calibration")
    if not isinstance(before, dict):
        return document
    lenses = before.get("cameras") or {}
    videos = []
    for name, entry in zip(names_of(document["videos"]), document["videos"], strict=True):
        camera = dict(entry.get("camera") or {}, w2c=None)
        if lenses.get(name, {}).get("lens") != "given":
            camera |= {"K": None, "distortion": None}
        videos.append({**entry, "name": name, "camera": camera})
    known = {str(entry["name"]) for entry in videos}
    with suppress(ValueError):  # no reader knows the folder: what scene.json names is all there is
        described = describe_folder(folder)
        again = zip(names_of(described["videos"]), described["videos"], strict=True)
        videos += [{**entry, "name": name} for name, entry in again if name not in known]
    notes = [note for note in document.get("notes") or () if "calibration says" not in str(note)]
    kept = {key: value for key, value in document.items() if key not in ("calibration", "notes")}
    return {**kept, "notes": notes, "videos": sorted(videos, key=lambda entry: str(entry["name"]))}


def kind_of(name: str) -> str:
    """What a clip is for, by its name: ``walk...`` and ``board...`` help to find the cameras of the others."""
    match = re.match(r"(walk|board)([\W_\d].*)?$", name, re.IGNORECASE)
    return match[1].lower() if match else "scene"


def _clip(name: str, entry: Mapping[str, Any], paths: Paths, given: Mapping[str, Lens]) -> Clip:
    where = f"video {name}"
    try:
        frames, timestamps, fps = video_frames(dict(entry), paths)
    except (ValueError, OSError) as error:
        raise ValueError(f"{where}: {error}") from None
    first, stop = entry.get("range") or (0, len(frames))
    used = frames if (first, stop) == (0, len(frames)) else FrameRange(frames, range(first, stop))
    if len(used) == 0:
        raise ValueError(f"{where}: range: expected frames; found none. Correct it.")
    rate = fps or (
        1 / float(np.median(np.diff(timestamps))) if timestamps is not None and len(timestamps) > 1 else 30.0
    )
    height, width = used[0].shape[:2]
    told = _metadata(frames.path) if isinstance(frames, VideoFrames) else {}
    lens = _lens(entry.get("camera") or {}, (width, height), told, given.get(name, given.get("*")))
    return Clip(name, entry, used, (width, height), rate, lens, kind_of(name), int(told.get("turned", 0)))


def _lens(camera: Mapping[str, Any], size: tuple[int, int], told: Mapping[str, float], given: Lens | None) -> Lens:
    if given is not None:
        return given
    own = (
        pinhole(float(told["mm35"]) / DIAGONAL_35MM * float(np.hypot(*size)), size, "file") if "mm35" in told else None
    )
    if camera.get("K") is not None:
        distortion, K = camera.get("distortion"), matrix_of(camera["K"], "camera.K", "(3,3)")
        if own is not None and distortion is None and np.allclose(K, own.K, rtol=1e-6):
            return own  # otsync init filled it in: a phone's word is less than a calibration
        return Lens(K, None if distortion is None else np.asarray(distortion, float), "given")
    if own is not None:
        return own
    return pinhole(USUAL_FOCAL * max(size), size, "guessed")


def fill_lenses(document: dict[str, Any], folder: str | os.PathLike[str]) -> dict[str, Any]:
    """The document with K of the video files that tell their focal length themselves, each with a note.

    A 35 mm equivalent is right to some per cent: calibration begins with it and does not hold it fixed.
    """
    videos, notes = [], list(document.get("notes") or ())
    for name, entry in zip(names_of(document["videos"]), document["videos"], strict=True):
        camera = dict(entry.get("camera") or {})
        if "file" in entry and camera.get("K") is None and camera.get("width") and camera.get("height"):
            size = (int(camera["width"]), int(camera["height"]))
            lens = _lens({}, size, _metadata(Paths(Path(folder)).one(entry["file"])), None)
            if lens.source == "file":
                camera["K"] = lens.K.tolist()
                notes.append(f"{name}: K from the focal length that the file tells: {lens.K[0, 0]:.0f} pixels, about")
                entry = {**entry, "camera": camera}
        videos.append(entry)
    more = {"notes": notes} if notes else {}
    return {**document, "videos": videos, **more}


def pinhole(focal: float, size: tuple[int, int], source: str) -> Lens:
    """A lens with square pixels and its principal point in the middle. ``focal``: in pixels."""
    return Lens(np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]]), None, source)


def _metadata(path: Path) -> dict[str, float]:
    """What a video file's own metadata tell: ``mm35`` focal length as a 35 mm equivalent, ``turned`` degrees."""
    import av

    told: dict[str, float] = {}
    with av.open(f"file:{path.resolve()}") as container:
        stream = container.streams.video[0]
        tags = {**container.metadata, **stream.metadata}
        for tag, value in tags.items():
            if re.search(r"focal.?length.*35", tag, re.IGNORECASE):
                number = re.match(r"\s*(\d+(\.\d+)?)", str(value))
                if number and 5 <= float(number[1]) <= 500:
                    told["mm35"] = float(number[1])
            elif tag.lower() == "rotate" and re.fullmatch(r"-?\d{1,3}", str(value)):
                told["turned"] = float(value) % 360
        if "turned" not in told:
            frame = next(container.decode(stream), None)
            turned = 0 if frame is None else float(getattr(frame, "rotation", 0))
            if turned:
                told["turned"] = -turned % 360
    return told


def read_intrinsics(path: str | os.PathLike[str]) -> dict[str, Lens]:
    """Lenses by the name of the video; ``*`` is every video.

    A JSON object of ``{name: {"K": 3x3, "distortion": [k1, k2, p1, p2, k3, ...]}}``, or a scene document, whose poses
    are not read. ValueError names the file and the video.
    """
    content = read_json(path, remedy='Give {"name of a video, or *": {"K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]}}.')
    if isinstance(content, dict) and isinstance(content.get("videos"), list):
        content = {
            str(entry.get("name", f"video{n}")): entry.get("camera")
            for n, entry in enumerate(content["videos"])
            if isinstance(entry, dict)
        }
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{path}: expected an object of cameras by their videos' names; found {shown(content)}.")
    lenses = {}
    for name, camera in content.items():
        try:
            K = matrix_of(camera["K"], "K", "(3,3)")
            distortion = camera.get("distortion")
            bends = None if distortion is None else np.asarray(distortion, float).reshape(-1)
        except (TypeError, KeyError, ValueError) as error:
            raise ValueError(
                f"{path}: {shown(str(name))[1:-1]}: expected K (3,3) in pixels, and distortion or none; "
                f"{str(error).rstrip('.')}."
            ) from None
        if K.shape != (3, 3) or not np.isfinite(K).all() or not (K[0, 0] > 0 and K[1, 1] > 0):
            raise ValueError(f"{path}: {name}: K: expected 3x3 with positive focal lengths; found {shown(K.tolist())}.")
        if bends is not None and (len(bends) not in (4, 5, 8) or not np.isfinite(bends).all()):
            raise ValueError(
                f"{path}: {name}: distortion: expected 4, 5 or 8 of OpenCV's coefficients; found {len(bends)}. Leave "
                "the last ones out where they are small."
            )
        lenses[str(name)] = Lens(K, bends, "given")
    return lenses
