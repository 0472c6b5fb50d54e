"""``otsync init FOLDER``: a scene document from what lies in a folder, with what is missing named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .document import FORMAT, VERSION
from .images import read_image
from .panoptic import describe_panoptic, is_panoptic

VIDEO_SUFFIXES = {".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".mts"}
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp")


def describe_folder(folder: Path, *, fps: float | None = None) -> dict[str, Any]:
    """A scene document for ``folder``: Panoptic layout, video files, or one folder of images per camera.

    Calibration is not guessed: fields that no file tells are null, and ``missing`` lists them in words.

    Args:
        fps: of image folders, which carry no clock.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of recordings; found none. Check the path.")
    if is_panoptic(folder):
        return describe_panoptic(folder, fps=fps or 30.0)
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES and p.is_file())
    videos = [_video_file(p) for p in files]
    for sub in sorted(p for p in folder.iterdir() if p.is_dir()):
        entry = _image_folder(sub, fps)
        if entry is not None:
            videos.append(entry)
    if not videos:
        raise ValueError(
            f"{folder}: expected video files ({', '.join(sorted(VIDEO_SUFFIXES))}), folders of images, or the "
            "Panoptic layout; found none of them."
        )
    missing = [
        f"{v['name']}: {what}"
        for v in videos
        for what, absent in (
            ("camera.K and camera.w2c (world to camera, OpenCV axes)", True),
            ("fps or timestamps", "file" not in v and v["fps"] is None),
        )
        if absent
    ]
    return {"format": FORMAT, "version": VERSION, "frame": "world", "videos": videos, "missing": missing}


def _video_file(path: Path) -> dict[str, Any]:
    from .frames import VideoFrames

    video = VideoFrames(path)
    return {"name": path.stem, "file": path.name, "camera": _camera(video.width, video.height)}


def _image_folder(path: Path, fps: float | None) -> dict[str, Any] | None:
    for suffix in IMAGE_SUFFIXES:
        images = sorted(p for p in path.iterdir() if p.suffix == suffix)
        if images:
            height, width = read_image(images[0]).shape[:2]
            return {
                "name": path.name,
                "frames": f"{path.name}/*{suffix}",
                "fps": fps,
                "camera": _camera(width, height),
            }
    return None


def _camera(width: int, height: int) -> dict[str, Any]:
    return {"K": None, "w2c": None, "width": width, "height": height}
