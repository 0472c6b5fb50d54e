"""``otsync check``: finds common faults of a recording before hours are spent on it, each with its remedy."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..clocks.common import USUAL_FPS
from ..clocks.shutter import LONGEST
from ..files.strict import checked, shown
from ..geometry import common_target
from ..io.frames import VideoFrames
from ..io.layout import MAX_VIDEOS, SceneFile, VideoFile
from ..io.scene import (
    Paths,
    Scene,
    camera_from,
    file_of,
    read_document,
    scene_from_document,
    video_frames,
)
from ..types import Camera, Video

FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's axes (x right, y up, z back) to OpenCV's."""

ORTHONORMAL, LAST_ROW = 1e-3, 1e-6
"""Largest errors of R Rᵀ, and of the last row of a pose: files round to a few digits."""

MIDDLE = (0.25, 0.75)
"""Shares of the image between which a principal point lies; K of another resolution leaves them."""

RESIZED = 0.25
"""Logarithm of the ratio of both coordinates' shares of the middle, below which K is that of a resized image."""

FOCAL = (0.2, 20.0)
"""Focal lengths in widths of the image: from a fisheye to a strong tele."""

SQUARE = (0.8, 1.25)
"""Ratios of the focal lengths: pixels are square but for rounding and old anamorphic video."""

FEW_SECONDS = 1.6
"""Clips below this length rarely hold motion enough (48 frames at 30 fps)."""

SAME_RATE = 0.005
"""Relative difference of frame rates that says nothing: 29.97 and 30 differ by a fifth of it."""

DROPPED = 1.9
"""Median steps that make a gap in the timestamps: a frame is missing."""

FEW = 1 / 3
"""Share of the cameras that may look away alone; of more the poses as a whole are in doubt."""

DEPTH_RATIO = (0.2, 5.0)
"""Median depth over the distance to where the cameras look; units differ by tens and more."""

PARALLEL = np.radians(1.0)
"""Angle between optical axes below which where they meet is a matter of rounding: 57 times their distance away."""

BLANK = " \t\u00a0\u200b\u200c\u200d\u2060\ufeff"
"""Characters beside a name that nobody sees."""

BEYOND = 0.5
"""Images beside an image where the common target may still lie."""


@dataclass(frozen=True)
class Finding:
    """One observation: ``severity`` error or warning, the video it is about ("" for the scene), and what to do."""

    severity: Literal["error", "warning"]
    video: str
    what: str
    remedy: str


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # a stranger's 1e308 is a finding, not a warning
def check_scene(
    path: str | os.PathLike[str], *, every_frame: bool = True, allow_outside: bool = False
) -> list[Finding]:
    """Findings about the scene behind ``path``, errors first.

    Args:
        every_frame: decode every image; else the first, the middle and the last of each video.
    """
    try:
        document, root = read_document(path)
    except (ValueError, OSError) as error:
        return [Finding("error", "", str(error), "Mend the file, or write it anew with otsync init.")]
    findings, entries = _layout(document, file_of(path))
    if not entries:
        return findings
    every = document["videos"]
    document = {**document, "videos": entries}
    for item in document.get("missing") or ():
        findings.append(Finding("error", "", f"still missing: {item}.", "Fill it in, then delete 'missing'."))
    if len(every) < 2:
        findings.append(Finding("error", "", "one video only.", "Add at least a second one."))
    findings += _twice(entries, Paths(root, allow_outside))
    unmirrored = _unmirrored(entries)
    for entry in entries:
        name = entry["name"]
        pose = list(_pose(entry, name, unmirrored))
        findings += pose
        if pose:
            continue
        try:
            one = scene_from_document(
                {**document, "videos": [entry], "missing": []},
                root,
                allow_outside=allow_outside,
                file=file_of(path),
                first=next(
                    n for n, e in enumerate(every) if isinstance(e, dict) and e.get("name", f"video{n}") == name
                ),
            )
        except (ValueError, OSError) as error:
            findings.append(Finding("error", name, str(error), ""))
            continue
        if doubt := one.doubtful.get(name):
            remedy = document["calibration"]["cameras"][name].get("remedy") or "Find it anew: otsync calibrate."
            findings.append(Finding("warning", name, f"its camera is doubtful: {doubt.rstrip('.')}.", remedy))
        findings += _intrinsics(one.videos[0])
        if "calibration" not in document:  # otsync calibrate knows how a phone was held
            findings += _held(one.videos[0])
        findings += _files(one, every_frame)
        findings += _clock(entry, one.videos[0], Paths(root, allow_outside))
    cameras = _cameras(entries)
    findings += _common_volume(cameras)
    findings += _depth_units(document, root, cameras, allow_outside)
    return sorted(findings, key=lambda f: f.severity)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def looking_wrong(document: dict[str, Any]) -> list[Finding]:
    """What the poses of a document alone give away, before any file is read: mirrored, inverted, looking elsewhere.

    Videos without a camera are left out.
    """
    entries = [e for e in document["videos"] if (e.get("camera") or {}).get("w2c") is not None]
    unmirrored = _unmirrored(entries)
    findings = [finding for entry in entries for finding in _pose(entry, entry["name"], unmirrored)]
    return [*findings, *_common_volume(_cameras(entries))]


def _number(every: Sequence[Any], name: str) -> int:
    """Which of a document's videos, sound and unsound ones, has a name."""
    return next(n for n, e in enumerate(every) if isinstance(e, dict) and e.get("name", f"video{n}") == name)


def _layout(document: dict[str, Any], file: Path) -> tuple[list[Finding], list[dict[str, Any]]]:
    """What the schema says of the document and of each video, and the videos that are as it says, named."""
    entries = document.get("videos")
    findings, sound = [], []
    for n, entry in enumerate(entries[:MAX_VIDEOS] if isinstance(entries, list) else ()):
        name = entry.get("name", f"video{n}") if isinstance(entry, dict) else f"video{n}"
        try:
            checked(entry, VideoFile, file, f"videos[{n}]")
        except ValueError as error:
            findings.append(Finding("error", shown(str(name))[1:-1], str(error), ""))
        else:
            sound.append({**entry, "name": name})
    try:
        checked({**document, "videos": sound} if sound else document, SceneFile, file)
    except ValueError as error:
        if sound or not findings:
            findings.append(Finding("error", "", str(error), ""))
        sound = []
    return findings, sound


def _rounded(w2c: Any) -> Any:
    """A pose as something to look up: 1 and 1.0 are one number, and files round to a few digits."""
    try:
        x = np.asarray(w2c, float)
    except (ValueError, TypeError, OverflowError):
        return str(w2c)
    return x.shape, (np.round(x, 6) + 0.0).tobytes()


def _twice(entries: Sequence[dict[str, Any]], paths: Paths) -> Iterable[Finding]:
    """Names that occur twice, poses that two cameras share, files that two videos are made of."""
    names: dict[str, int] = {}
    poses: dict[Any, str] = {}
    files: dict[Path, str] = {}
    for entry in entries:
        name = entry["name"]
        names[name] = names.get(name, 0) + 1
        w2c = (entry.get("camera") or {}).get("w2c")
        first = poses.setdefault(_rounded(w2c), name)
        if w2c is not None and first != name:
            yield Finding(
                "error",
                name,
                f"its camera stands where that of {first} stands, pose for pose.",
                "Two cameras have two places: give each its own w2c.",
            )
        sharing = {first for path in _files_of(entry, paths) if (first := files.setdefault(path, name)) != name}
        for other in sorted(sharing):
            yield Finding(
                "error", name, f"it is made of files that {other} is made of.", "Name the files of each camera once."
            )
    if blank := [name for name in names if not name.strip(BLANK)]:
        yield Finding("error", blank[0], "its name is blank.", "Name it: names stand in tables and in file names.")
    alike: dict[str, str] = {}
    for name in names:
        first = alike.setdefault(name.strip(BLANK).casefold(), name)
        if first != name:
            yield Finding(
                "warning", name, f"its name reads like {first!r}.", "Rename it: on some disks their files are one."
            )
    for name, count in names.items():
        if count > 1:
            yield Finding("error", name, f"{count} videos have this name.", "Rename them: names tell videos apart.")


def _files_of(entry: dict[str, Any], paths: Paths) -> Sequence[Path]:
    """The files of a video's frames, links followed; none where they cannot be found, which other checks report."""
    try:
        wanted = [paths.one(entry["file"])] if "file" in entry else paths.many(entry.get("frames"))
        return [path.resolve() for path in wanted]
    except (ValueError, OSError):
        return ()


READINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "camera-to-world whose z axis points back: negate column 2, then invert": lambda m: np.linalg.inv(m @ flip(2)),
    "camera-to-world whose y axis points up: negate column 1, then invert": lambda m: np.linalg.inv(m @ flip(1)),
    "camera-to-world whose x axis points left: negate column 0, then invert": lambda m: np.linalg.inv(m @ flip(0)),
    "world-to-camera whose z axis points back: negate row 2": lambda m: flip(2) @ m,
    "world-to-camera whose y axis points up: negate row 1": lambda m: flip(1) @ m,
    "world-to-camera whose x axis points left: negate row 0": lambda m: flip(0) @ m,
}
"""What matrices with det(R) = -1 may be, and how they become world-to-camera with OpenCV axes."""


def flip(axis: int) -> np.ndarray:
    """(4,4): negates one axis."""
    return np.diag([-1.0 if n == axis else 1.0 for n in range(4)])


def _unmirrored(entries: Sequence[dict[str, Any]]) -> str:
    """Which readings of mirrored matrices make all cameras look at one place, in words."""
    cameras: list[tuple[Camera, np.ndarray]] = []
    for entry in entries:
        camera = entry.get("camera") or {}
        with suppress(TypeError, ValueError, KeyError):
            w2c = np.asarray(camera["w2c"], float).reshape(-1, 4, 4)[0]
            sound = Camera(np.asarray(camera["K"], float), np.eye(4), camera["width"], camera["height"])
            cameras.append((sound, w2c))
    fitting = []
    for told, read in READINGS.items():
        with suppress(ValueError, np.linalg.LinAlgError):
            again = [replace(c, w2c=read(m) if np.linalg.det(m[:3, :3]) < 0 else m) for c, m in cameras]
            if len(again) > 1 and not _parallel(again) and not _looking_away(again).any():
                fitting.append(told)
    if not fitting:
        return "No reading of it makes the cameras look at one place: check what the matrices are."
    return (
        f"Read like this, the cameras look at one place: {'; or '.join(fitting)}. Those that are left differ in what "
        "is up or left: look at the images."
    )


def _pose(entry: dict[str, Any], name: str, unmirrored: str) -> Iterable[Finding]:
    """det(R) and orthonormality, before the strict constructor refuses them with fewer words."""
    camera = entry.get("camera")
    try:
        w2c: np.ndarray = np.asarray((camera or {})["w2c"], np.float64)
        if w2c.shape[-2:] != (4, 4) or w2c.ndim not in (2, 3) or not np.isfinite(w2c).all():
            raise ValueError(f"expected finite 4x4 matrices; found shape {w2c.shape}")
    except (TypeError, KeyError, ValueError) as error:
        yield Finding("error", name, f"camera.w2c is missing or unsound ({error}).", "Add world-to-camera matrices.")
        return
    R = w2c[..., :3, :3]
    scale = np.cbrt(np.abs(np.linalg.det(R)))
    if (np.linalg.det(R) < 0).any():
        yield Finding(
            "error",
            name,
            "camera.w2c has det(R) = -1: a mirrored frame.",
            unmirrored,
        )
    elif not np.allclose(R @ np.swapaxes(R, -1, -2), np.eye(3), atol=ORTHONORMAL):
        yield Finding(
            "error",
            name,
            f"camera.w2c holds no rotation (its scale is about {float(np.median(scale)):.4g}).",
            "Take scale and shear out of the upper 3x3.",
        )
    if not np.allclose(w2c[..., 3, :], [0, 0, 0, 1], atol=LAST_ROW):
        yield Finding(
            "error",
            name,
            "the last row of camera.w2c is not 0 0 0 1.",
            "Perhaps the matrix is transposed: transpose it.",
        )


def _intrinsics(video: Video) -> Iterable[Finding]:
    K, w, h = video.camera.K, video.camera.width, video.camera.height
    low, high = MIDDLE
    if not (low * w < K[0, 2] < high * w and low * h < K[1, 2] < high * h):
        across, down = 2 * K[0, 2] / w, 2 * K[1, 2] / h
        scaled = across > 0 and down > 0 and abs(np.log(across / down)) < RESIZED
        what = f"the principal point ({K[0, 2]:.0f}, {K[1, 2]:.0f}) is far from the middle of {w} x {h} pixels."
        if scaled:
            yield Finding(
                "error",
                video.name,
                what,
                f"K probably belongs to another resolution, of {across:.3g} times the width: divide its first two rows "
                "by that.",
            )
        else:
            yield Finding(
                "warning",
                video.name,
                what,
                "Some laboratories calibrate so: if the calibration's own residuals are small, leave it. Else check K, "
                "or whether the images were cut.",
            )
    if not FOCAL[0] * w < K[0, 0] < FOCAL[1] * w:
        yield Finding(
            "warning",
            video.name,
            f"a focal length of {K[0, 0]:.4g} pixels is odd for a width of {w}.",
            "Check the unit (pixels, not millimetres) and the resolution of K.",
        )
    if not SQUARE[0] < K[0, 0] / K[1, 1] < SQUARE[1]:
        yield Finding(
            "warning", video.name, f"focal lengths {K[0, 0]:.4g} and {K[1, 1]:.4g} differ a lot.", "Check K's rows."
        )


def _held(video: Video) -> Iterable[Finding]:
    """Videos that players turn: a camera that another program calibrated on turned images is not that of ours."""
    turned = 0
    with suppress(ValueError):  # frames that do not decode are told by _files
        turned = video.frames.turned if isinstance(video.frames, VideoFrames) else 0
    if turned:
        yield Finding(
            "warning",
            video.name,
            f"players turn it by {turned} degrees; otsync takes the image as it is stored.",
            "K and w2c must be of the stored image. If they were found on the turned one, as OpenCV shows it, turn the "
            "pixels for good: ffmpeg -i old.mp4 new.mp4.",
        )


def _files(scene: Scene, every_frame: bool) -> Iterable[Finding]:
    """Frames, masks, labels and depth that do not decode, and sizes that disagree with the camera."""
    video = scene.videos[0]
    n = len(video.frames)
    if n < FEW_SECONDS * (video.fps or USUAL_FPS):
        yield Finding("warning", video.name, f"{n} frames are few.", "Use clips of two seconds and more.")
    picks = range(n) if every_frame else sorted({0, n // 2, n - 1})
    labels = scene.labels[0] if scene.labels else None
    kinds = (("frame", video.frames), ("mask", scene.masks[0]), ("depth map", video.depth), ("label image", labels))
    for what, sequence in kinds:
        if sequence is None:
            continue
        bad, size = [], None
        for k in picks:
            try:
                size = sequence[k].shape[:2]
                if what == "frame" and size != (video.camera.height, video.camera.width):
                    raise ValueError(
                        f"{what} {k} has {size[1]} x {size[0]} pixels where the camera says {video.camera.width} x "
                        f"{video.camera.height}; correct width and height (and K)"
                    )
            except (ValueError, OSError) as error:
                bad.append(str(error))
        if bad:
            yield Finding(
                "error",
                video.name,
                f"{len(bad)} of {len(picks)} {what}s cannot be used; the first: {bad[0]}",
                "Copy those files again, or leave the frames out with 'range'.",
            )


def _clock(entry: dict[str, Any], video: Video, paths: Paths) -> Iterable[Finding]:
    """Declared fps against timestamps, and against the container's; a readout longer than a frame."""
    if entry.get("timestamps") is not None and entry.get("fps") is not None and len(video.frames) > 1:
        declared, seen = float(entry["fps"]), 1.0 / float(np.median(np.diff(video.times)))
        if abs(declared / seen - 1) > SAME_RATE:
            yield Finding(
                "error",
                video.name,
                f"fps says {declared:.4g}, timestamps say {seen:.4g}.",
                "Timestamps win: delete fps, or correct the timestamps' unit (seconds).",
            )
    if "file" in entry and entry.get("fps") is not None:
        frames, _, _ = video_frames(entry, paths)
        if isinstance(frames, VideoFrames) and len(frames) > 1:
            seen = 1.0 / float(np.median(np.diff(frames.timestamps)))
            if abs(float(entry["fps"]) / seen - 1) > SAME_RATE:
                yield Finding(
                    "warning",
                    video.name,
                    f"fps says {entry['fps']}, the container says {seen:.5g}.",
                    "Delete fps to use the container's timestamps, unless you know that it lies (slow motion).",
                )
    steps = np.diff(video.times)
    readout = video.camera.readout
    if readout is not None and len(steps) and readout > LONGEST * np.median(steps):
        yield Finding(
            "error",
            video.name,
            f"camera.readout is {readout:g} s; a frame lasts {float(np.median(steps)):.4g} s.",
            "Give the seconds from the first to the last row (phones: 0.005 to 0.03), or leave it out.",
        )
    if len(steps) and steps.max() > DROPPED * np.median(steps):
        yield Finding(
            "warning",
            video.name,
            f"{int((steps > DROPPED * np.median(steps)).sum())} gaps in the timestamps.",
            "Frames were dropped; nothing to do unless they are many.",
        )


def _cameras(entries: Sequence[dict[str, Any]]) -> dict[str, Camera]:
    out = {}
    for entry in entries:
        try:
            out[entry["name"]] = camera_from(entry.get("camera"))
        except (ValueError, TypeError, KeyError, OverflowError):
            continue  # the checks of each video report it
    return out


def _common_volume(cameras: dict[str, Camera]) -> Iterable[Finding]:
    """Whether the cameras look at one place; and if not, which reading of their poses would make them."""
    if len(cameras) < 2:
        return
    if _parallel(list(cameras.values())):
        yield Finding(
            "warning",
            "",
            "the cameras look in parallel: their axes meet nowhere, so the poses cannot be checked by where they meet.",
            "If the cameras stand side by side, this is as it should be. If not, check the poses: w2c maps world to "
            "camera, OpenCV axes (x right, y down, z forward), one world for all.",
        )
        return
    astray = _looking_away(list(cameras.values()))
    if not astray.any():
        return
    names = [n for n, a in zip(cameras, astray, strict=True) if a]
    readings = {
        "They look like camera-to-world matrices: invert them.": lambda m: np.linalg.inv(m),
        "They look like world-to-camera with OpenGL axes: negate rows 1 and 2.": lambda m: FROM_OPENGL @ m,
        "They look like camera-to-world with OpenGL axes: negate columns 1 and 2, then invert.": lambda m: (
            np.linalg.inv(m @ FROM_OPENGL)
        ),
    }
    for remedy, read in readings.items():
        again = [Camera(c.K, read(c.w2c), c.width, c.height) for c in cameras.values()]
        if not _looking_away(again).any():
            yield Finding("error", "", "the cameras do not look at a common volume.", remedy)
            return
    few = len(names) / len(cameras) <= FEW
    yield Finding(
        "warning" if few else "error",
        ", ".join(names) if few else "",
        "does not see the place that the others look at." if few else "the cameras do not look at a common volume.",
        "Check the poses: w2c maps world to camera, OpenCV axes (x right, y down, z forward), one world for all.",
    )


def _parallel(cameras: list[Camera]) -> bool:
    """Whether all optical axes (of the first poses) point the same way, so that no point is nearest to them."""
    axes = np.array([camera.w2c.reshape(-1, 4, 4)[0, 2, :3] for camera in cameras])
    return bool((axes @ axes[0] > np.cos(PARALLEL)).all())


def _looking_away(cameras: list[Camera]) -> np.ndarray:
    """Which cameras have the point nearest to all optical axes behind them or far outside their image."""
    target = common_target(cameras)
    away = []
    for camera in cameras:
        w2c = np.atleast_3d(camera.w2c.T).T[0] if camera.w2c.ndim == 3 else camera.w2c
        local = w2c[:3, :3] @ target + w2c[:3, 3]
        u = camera.K @ local
        z = local[2]
        place = u[:2] / z / [camera.width, camera.height] if z > 1e-6 else np.array([np.inf, np.inf])
        inside = bool((place > -BEYOND).all() and (place < 1 + BEYOND).all())
        away.append(not inside)
    return np.array(away)


def _depth_units(
    document: dict[str, Any], root: Path, cameras: dict[str, Camera], allow_outside: bool
) -> Iterable[Finding]:
    """Depth in other units than the poses: its median against the distance to where the cameras look."""
    if len(cameras) < 2 or _parallel(list(cameras.values())):
        return
    target = common_target(list(cameras.values()))
    for entry in document["videos"]:
        name = entry["name"]
        if entry.get("depth") is None or name not in cameras:
            continue
        try:
            one = scene_from_document({**document, "videos": [entry], "missing": []}, root, allow_outside=allow_outside)
            video = one.videos[0]
            assert video.depth is not None
            depth = np.asarray(video.depth[len(video.depth) // 2])
        except (ValueError, OSError):
            continue  # the check of the files reports it
        if not (depth > 0).any():
            yield Finding("warning", name, "the middle depth map is empty.", "0 means unknown: check the files.")
            continue
        expected = float(np.linalg.norm(np.atleast_2d(cameras[name].center)[0] - target))
        ratio = float(np.median(depth[depth > 0])) / max(expected, 1e-12)
        if not DEPTH_RATIO[0] < ratio < DEPTH_RATIO[1]:
            power = 10.0 ** -round(float(np.log10(ratio)))
            yield Finding(
                "error",
                name,
                f"depth is {ratio:.3g} times the distance to where the cameras look.",
                f"It is probably in another unit than the poses: try depth.scale times {power:g}.",
            )
