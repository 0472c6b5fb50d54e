"""``scene.json``: the videos of a recording with their clocks and cameras; and the :class:`Scene` it describes.

A document::

    {"format": "otsync.scene", "version": 1, "frame": "world",
     "videos": [{"name": "left", "file": "left.mp4",
                 "camera": {"K": [[f,0,cx],[0,f,cy],[0,0,1]], "w2c": [[...4x4...]], "width": 1920, "height": 1080}},
                {"name": "right", "frames": "right/*.png", "fps": 30, "range": [10, 160],
                 "camera": {...}, "masks": "seg/right/*.png", "labels": "who/right/*.png",
                 "depth": {"frames": "depth/right/*.png", "scale": 0.001},
                 "points": {"files": "right_dlc.csv"}}]}

Paths are relative to the file's folder and may not leave it. ``w2c`` is world-to-camera, OpenCV axes, 4x4 or one per
frame. ``range`` [first, stop) keeps some frames; a video file's clock comes from its container unless fps or
timestamps are given. ``points``: what another program found in the video, in place of our own tracks: a file of
DeepLabCut, SLEAP, COCO or a table, or OpenPose's files (:mod:`otsync.io.keypoints`); ``least`` is the lowest score that
counts. ``masks``: black and white images, or an object for label images, stacks and run lengths
(:mod:`otsync.io.masks`). ``labels``: images of whole numbers that mean the same thing or class in every video, 0 none.

A camera may have ``distortion`` (OpenCV's coefficients) and ``readout``: the seconds that a rolling shutter takes from
the image's first to its last row (phones: 0.005 to 0.03; measure it, or leave it out, as for images that were turned
after they were taken). Synchronisation undoes it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..files.arrays import read_json
from ..files.strict import checked, shown
from ..types import Camera, Video
from ..types.camera import matrix_of
from .document import FORMAT, VERSION
from .frames import ArrayFrames, FrameRange, ImageFrames, LazyFrames, VideoFrames
from .images import read_depth, read_image, read_labels, read_mask
from .keypoints import KEYPOINTS, Detections, read_detections
from .layout import LEAST_SCORE, MAX_FILES, SceneFile
from .masks import read_masks
from .order import natural
from .readers import describe_folder
from .tracks import TrackFile


@dataclass(frozen=True, eq=False)
class Scene:
    """The videos of one recording.

    Args:
        videos: each with its camera and clock; frames decode lazily.
        masks: per video a sequence of (H,W) bool foreground masks, or None.
        frame: name of the world frame that the cameras share.
        root: the folder that paths are relative to.
        notes: what the reader assumed or could not find.
        labels: per video a sequence of (H,W) integer labels that all videos share, 0 none; or None. Empty: none at all.
        tracks: per video the file of point tracks that came along, or None. Empty: none at all.
        doubtful: why the camera of a video is not to be trusted, by its name: what ``otsync calibrate`` says.
        points: per video what another program found in it, used in place of our own tracks; or None. Empty: none.
        pose_sigma: one sigma of the cameras' rotations, degrees, by the names of their videos, where they were found.
    """

    videos: tuple[Video, ...]
    masks: tuple[Sequence[np.ndarray] | None, ...]
    frame: str = "world"
    root: Path = Path()
    notes: tuple[str, ...] = field(default_factory=tuple)
    labels: tuple[Sequence[np.ndarray] | None, ...] = ()
    tracks: tuple[TrackFile | None, ...] = ()
    doubtful: Mapping[str, str] = field(default_factory=dict)
    points: tuple[Detections | None, ...] = ()
    pose_sigma: Mapping[str, float] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(v.name for v in self.videos)

    def take(self, names: Sequence[str]) -> Scene:
        """The named videos, in that order. ValueError lists what there is."""
        missing = [n for n in names if n not in self.names]
        if missing:
            raise ValueError(
                f"cameras: expected some of {', '.join(self.names)}; found {', '.join(missing)}. Check the names."
            )
        index = [self.names.index(n) for n in names]
        return replace(
            self,
            videos=tuple(self.videos[i] for i in index),
            masks=tuple(self.masks[i] for i in index),
            labels=tuple(self.labels[i] for i in index) if self.labels else (),
            points=tuple(self.points[i] for i in index) if self.points else (),
            tracks=tuple(self.tracks[i] for i in index) if self.tracks else (),
        )


def open_scene(path: str | os.PathLike[str], *, reader: str | None = None, allow_outside: bool = False) -> Scene:
    """Read ``scene.json``, a folder that holds one, or a folder that a reader describes in full.

    Args:
        reader: the name of one of :func:`otsync.io.readers`, to read a folder with, whether it holds a ``scene.json``
            or not; default: ``scene.json``, else the first reader that claims the folder.
        allow_outside: let the file name paths outside its own folder. Off, because a file from a stranger could
            otherwise have any file of yours read.
    """
    document, root = read_document(path, reader=reader)
    return scene_from_document(document, root, allow_outside=allow_outside, file=file_of(path))


def file_of(path: str | os.PathLike[str]) -> Path:
    """The file that tells of a scene, for errors; of a folder without one the folder."""
    path = Path(path)
    return path / "scene.json" if (path / "scene.json").is_file() else path


def read_document(path: str | os.PathLike[str], *, reader: str | None = None) -> tuple[dict[str, Any], Path]:
    """The scene document behind ``path``, and the folder that its paths are relative to.

    Args:
        reader: as in :func:`open_scene`.
    """
    path = Path(path)
    if reader is not None or (path.is_dir() and not (path / "scene.json").is_file()):
        return describe_folder(path, reader=reader), path
    if path.is_dir():
        path = path / "scene.json"
    document = read_json(path, remedy="Mend it there, or write it anew with otsync init.")
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"{path}: expected a scene (format {FORMAT!r}); found something else. Run: otsync init FOLDER")
    if document.get("version") != VERSION:
        raise ValueError(f"{path}: expected version {VERSION}; found {document.get('version')!r}. Write it anew.")
    return document, path.parent


def scene_from_document(
    document: dict[str, Any],
    root: Path,
    *,
    allow_outside: bool = False,
    file: Path | None = None,
    first: int = 0,
) -> Scene:
    """Build the scene; ValueError names the file, the video and the field for anything unsound.

    Args:
        root: the folder that paths are relative to. file: where the document is from, for errors; first: which of its
            videos the document begins with.
    """
    file = file or file_of(root)
    checked(document, SceneFile, file)
    entries = document["videos"]
    if document.get("missing"):
        raise ValueError(
            f"{file}: still missing: {shown(document['missing'])}. Find the cameras (otsync calibrate), or fill "
            "it in, then delete 'missing'."
        )
    names = names_of(entries)
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(
            f"{file}: videos: expected unique names; {', '.join(map(shown, twice))} occur more than once. Rename them."
        )
    builder = Paths(root, allow_outside)
    built = [_video(entry, n, builder, file) for n, entry in enumerate(entries, first)]
    return Scene(
        tuple(video for video, _, _, _ in built),
        tuple(masks for _, masks, _, _ in built),
        str(document.get("frame", "world")),
        Path(root),
        tuple(str(n) for n in document.get("notes", ())),
        tuple(labels for _, _, labels, _ in built),
        tuple(_tracks(entry, builder) for entry in entries) if any(e.get("tracks") for e in entries) else (),
        _doubtful(document),
        tuple(points for _, _, _, points in built) if any(p is not None for *_, p in built) else (),
        {name: float(told["sigma_degrees"]) for name, told in _found(document).items() if told.get("sigma_degrees")},
    )


def _doubtful(document: dict[str, Any]) -> dict[str, str]:
    """Why cameras are not to be trusted, by the names of their videos."""
    return {name: told["doubtful"] for name, told in _found(document).items() if told.get("doubtful")}


def _found(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What is told of cameras that were found, by the names of their videos."""
    return (document.get("calibration") or {}).get("cameras") or {}


def names_of(entries: Sequence[dict[str, Any]]) -> list[str]:
    """The names of a document's videos, those without one by their number."""
    return [entry.get("name", f"video{n}") for n, entry in enumerate(entries)]


def _video(
    entry: dict[str, Any], n: int, paths: Paths, file: Path
) -> tuple[Video, Sequence[np.ndarray] | None, Sequence[np.ndarray] | None, Detections | None]:
    name = entry.get("name", f"video{n}")
    where = f"{file}: videos[{n}] ({shown(name)[1:-1]})"
    try:
        frames, timestamps, fps = video_frames(entry, paths)
        used = _range(entry, len(frames))
        camera = camera_from(entry.get("camera"))
        if camera.w2c.ndim == 3 and len(camera.w2c) == len(frames):
            camera = replace(camera, w2c=camera.w2c[used.start : used.stop])
        if timestamps is not None and len(timestamps) == len(frames):
            timestamps = timestamps[used.start : used.stop]

        def cut(sequence: LazyFrames | None, what: str) -> LazyFrames | None:
            if sequence is None:
                return None
            if len(sequence) != len(frames):
                raise ValueError(f"{what}: expected {len(frames)} files, one a frame; found {len(sequence)}.")
            return sequence if len(used) == len(sequence) else FrameRange(sequence, used)

        depth = cut(_depth(entry.get("depth"), paths), "depth")
        masks = cut(_masks(entry.get("masks"), paths), "masks")
        labels = cut(_images(entry.get("labels"), paths, read_labels, "labels"), "labels")
        video = Video(cut(frames, "frames") or frames, camera, fps, timestamps, name, depth)
        return video, masks, labels, _points(entry.get("points"), paths, len(frames), used)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{where}: {error}") from None
    except OSError as error:
        raise OSError(f"{where}: cannot be read ({error}). Check the files and their permissions.") from None
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise ValueError(f"{where}: {error}") from None


def video_frames(entry: dict[str, Any], paths: Paths) -> tuple[LazyFrames, np.ndarray | None, float | None]:
    """Frames, timestamps and fps of one entry, before ``range``."""
    stamps, fps = entry.get("timestamps"), entry.get("fps")
    timestamps = None if stamps is None else np.asarray(stamps, float)
    fps = None if fps is None else float(fps)
    if ("file" in entry) == ("frames" in entry):
        raise ValueError("expected either 'file' (a video) or 'frames' (a pattern of images); found both or neither.")
    if "file" in entry:
        video = VideoFrames(paths.one(entry["file"]))
        if timestamps is None and fps is None:
            timestamps = video.timestamps
        return video, timestamps, fps
    return ImageFrames(paths.many(entry["frames"]), read_image), timestamps, fps


def camera_from(value: Any) -> Camera:
    """A camera of the document. ValueError says which field is missing."""
    if not isinstance(value, dict):
        raise ValueError(
            "camera: expected K, w2c, width and height; found none. Add the calibration, or let otsync calibrate "
            "find it."
        )
    missing = [f for f in ("K", "w2c", "width", "height") if value.get(f) is None]
    if missing:
        own = " Or, with depth for every video, let the poses be found: otsync sync --frames own."
        raise ValueError(
            f"camera: expected K, w2c, width and height; {', '.join(missing)} missing. Add them."
            + (own if missing == ["w2c"] else "")
        )
    return Camera(
        matrix_of(value["K"], "camera.K", "(3,3)"),
        matrix_of(value["w2c"], "camera.w2c", "(4,4), or (T,4,4)"),
        int(value["width"]),
        int(value["height"]),
        None if value.get("distortion") is None else np.asarray(value["distortion"], float),
        None if value.get("readout") is None else float(value["readout"]),
    )


def _depth(value: Any, paths: Paths) -> LazyFrames | None:
    if value is None:
        return None
    if not isinstance(value, dict) or ("file" in value) == ("frames" in value):
        raise ValueError("depth: expected {'frames': pattern, 'scale': units per step} or {'file': 'x.npy'}.")
    scale = float(value.get("scale", 1.0))
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"depth.scale: expected world units per stored step, above 0; found {scale}.")
    if "file" in value:
        return ArrayFrames(paths.one(value["file"]), scale)
    return ImageFrames(paths.many(value["frames"]), lambda path: read_depth(path, scale), f"depth*{scale:g}")


def _points(value: Any, paths: Paths, frames: int, used: range) -> Detections | None:
    """What another program found in a video of so many frames, in those that are used; its sure points."""
    if value is None:
        return None
    files = value["files"]
    listed = paths.many(files) if isinstance(files, list) or "*" in files else [paths.one(files)]
    kind = value.get("kind")
    known = {reader.name: reader for reader in KEYPOINTS}
    if kind is not None and kind not in known:
        raise ValueError(f"points.kind: expected one of {', '.join(known)}; found {shown(kind)}.")
    found = read_detections(listed, KEYPOINTS if kind is None else (known[kind],))
    if found.last >= frames:
        raise ValueError(
            f"points: {listed[0].name}: expected points of the {frames} frames of the video; found one of frame "
            f"{found.last}. Is it the file of another video?"
        )
    least = float(value.get("least", LEAST_SCORE))
    sure = found.surer(least)
    if len(sure) == 0:
        raise ValueError(
            f"points: {listed[0].name}: expected points with a score of {least:g} and more; the best of {len(found)} "
            f"has {found.score.max():g}. Lower points.least."
        )
    return sure.within(used)


def _tracks(entry: dict[str, Any], paths: Paths) -> TrackFile | None:
    """The file of a video's tracks. ValueError beside ``range``, of which nobody knows whether it is cut too."""
    told = entry.get("tracks")
    if told is None:
        return None
    if entry.get("range") is not None:
        raise ValueError(
            "tracks, range: expected one of them. Cut the frames and track those, or leave the tracks out."
        )
    size = told.get("size")
    return TrackFile(paths.one(told["file"]), told.get("kind"), None if size is None else (size[0], size[1]))


def _images(value: Any, paths: Paths, read: Callable[[Path], np.ndarray], kind: str) -> LazyFrames | None:
    return None if value is None else ImageFrames(paths.many(value), read, kind)


def _masks(value: Any, paths: Paths) -> LazyFrames | None:
    """Black and white images, or what the object says (:mod:`otsync.io.masks`)."""
    if not isinstance(value, dict):
        return _images(value, paths, read_mask, "mask")
    if ("file" in value) == ("frames" in value):
        raise ValueError(
            "masks: expected either 'frames' (a file a frame) or 'file' (one of all); found both or neither."
        )
    files = paths.one(value["file"]) if "file" in value else paths.many(value["frames"])
    return read_masks(files, value.get("kind"), value.get("ids", ()))


def _range(entry: dict[str, Any], n: int) -> range:
    value = entry.get("range")
    if value is None:
        return range(n)
    if not (isinstance(value, list) and len(value) == 2 and all(isinstance(x, int) for x in value)):
        raise ValueError(f"range: expected [first, stop]; found {shown(value)}.")
    if not 0 <= value[0] < value[1] <= n:
        raise ValueError(f"range: expected 0 <= first < stop <= {n}, the number of frames; found {value}.")
    return range(value[0], value[1])


@dataclass(frozen=True)
class Paths:
    """Turns the document's paths into files below ``root``; links are followed before the check."""

    root: Path
    allow_outside: bool = False
    resolve: Callable[[Path], Path] = Path.resolve

    def one(self, text: Any) -> Path:
        """A single file."""
        if not isinstance(text, str) or not text or "\0" in text:
            raise ValueError(f"path: expected a file name; found {shown(text)}.")
        path = Path(self.root) / text
        if not self.allow_outside:
            home = self.resolve(Path(self.root))
            if not self.resolve(path).is_relative_to(home):
                raise ValueError(
                    f"path {text!r}: expected a file inside {self.root}; it points outside. Move the file there, or "
                    "allow it (allow_outside=True; --allow-outside, or otsync sync --recording.allow-outside)."
                )
        return path

    def many(self, pattern: Any) -> list[Path]:
        """Files of a list, or of a pattern with ``*``, in natural order (9 before 10)."""
        if isinstance(pattern, list):
            if not 0 < len(pattern) <= MAX_FILES:
                raise ValueError(f"frames: expected 1 to {MAX_FILES} files; found {len(pattern)}.")
            return [self.one(p) for p in pattern]
        if isinstance(pattern, str) and ".." in Path(pattern).parts:
            raise ValueError(
                f"frames: expected files inside {self.root}; {shown(pattern)} points outside. Move them there, or list "
                "the files one by one and allow it (allow_outside=True; --allow-outside, or otsync sync "
                "--recording.allow-outside)."
            )
        if not isinstance(pattern, str) or "*" not in pattern or "**" in pattern:
            raise ValueError(f"frames: expected a pattern like 'left/*.jpg', or a list; found {shown(pattern)}.")
        base, _, name = pattern.rpartition("/")
        if "*" in base:
            raise ValueError(f"frames: expected '*' in the file name only; found {shown(pattern)}.")
        folder = self.one(base or ".")
        files = sorted(folder.glob(name), key=natural)[: MAX_FILES + 1] if folder.is_dir() else []
        if not 0 < len(files) <= MAX_FILES:
            raise FileNotFoundError(f"no files (or more than {MAX_FILES}) match {pattern!r} in {self.root}.")
        if self.allow_outside:
            return files
        return [self.one(f"{base}/{p.name}" if base else p.name) for p in files]
