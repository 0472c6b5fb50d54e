"""Readers of uncalibrated footage: video files, one folder of images per camera, or both side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .document import document, missing_fields, unknown_camera
from .images import read_image

VIDEO_SUFFIXES = {".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".mts"}
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp")


class VideoFiles:
    """Video files; their clocks come from the containers. No calibration: ``missing`` asks for it."""

    name = "video-files"
    looks_for = f"video files ({', '.join(sorted(VIDEO_SUFFIXES))}), one a camera"
    brings = "names, sizes, clocks"

    def claims(self, folder: Path) -> bool:
        return bool(_video_paths(folder))

    def describe(self, folder: Path) -> dict[str, Any]:
        return _uncalibrated(_video_entries(folder))


class ImageFolders:
    """One folder of images per camera. No calibration, and no clock unless ``fps`` is given."""

    name = "image-folders"
    looks_for = f"one folder of images ({', '.join(IMAGE_SUFFIXES)}) per camera"
    brings = "names, sizes"

    def claims(self, folder: Path) -> bool:
        return bool(_image_patterns(folder))

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        return _uncalibrated(_image_entries(folder, fps))


class VideosAndImages:
    """Video files beside folders of images: some cameras gave the one, some the other."""

    name = "videos-and-images"
    looks_for = "video files beside folders of images"
    brings = "names, sizes, clocks of videos"

    def claims(self, folder: Path) -> bool:
        return bool(_video_paths(folder) and _image_patterns(folder))

    def describe(self, folder: Path, *, fps: float | None = None) -> dict[str, Any]:
        return _uncalibrated([*_video_entries(folder), *_image_entries(folder, fps)])


def _uncalibrated(videos: list[dict[str, Any]]) -> dict[str, Any]:
    return document(videos, missing=missing_fields(videos))


def _video_paths(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES and p.is_file())


def _video_entries(folder: Path) -> list[dict[str, Any]]:
    from .frames import VideoFrames

    entries = []
    for path in _video_paths(folder):
        video = VideoFrames(path)
        entries.append({"name": path.stem, "file": path.name, "camera": unknown_camera(video.width, video.height)})
    return entries


def _image_patterns(folder: Path) -> dict[str, tuple[str, Path]]:
    """Per subfolder with images: the pattern that names them, and the first one."""
    patterns = {}
    for sub in sorted(p for p in folder.iterdir() if p.is_dir()):
        by_suffix = {suffix: sorted(p for p in sub.iterdir() if p.suffix == suffix) for suffix in IMAGE_SUFFIXES}
        first = next(((suffix, images[0]) for suffix, images in by_suffix.items() if images), None)
        if first is not None:
            patterns[sub.name] = (f"{sub.name}/*{first[0]}", first[1])
    return patterns


def _image_entries(folder: Path, fps: float | None) -> list[dict[str, Any]]:
    entries = []
    for name, (pattern, image) in _image_patterns(folder).items():
        height, width = read_image(image).shape[:2]
        entries.append({"name": name, "frames": pattern, "fps": fps, "camera": unknown_camera(width, height)})
    return entries
