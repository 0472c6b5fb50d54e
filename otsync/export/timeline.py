"""An OpenTimelineIO file (.otio): the videos as tracks of an editor, shifted onto the common clock.

Written by its public schema, so that nothing has to be installed. https://opentimelineio.readthedocs.io
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ..files.arrays import write_json
from ..io.frames import FrameRange, ImageFrames
from .slot import Aligned, Clip, Export


class Timeline(Export):
    """An OpenTimelineIO timeline with a track for every video. Gaps and metadata hold the exact offsets."""

    name = "timeline"

    def targets(self, videos: Aligned, folder: Path) -> list[Path]:
        return [folder / "timeline.otio"]

    def write(self, videos: Aligned, folder: Path, *, width: int, fps: float) -> list[str]:
        start = videos.span[0]
        tracks = [_track(clip, start, videos.fps, folder) for clip in videos.clips]
        about = {"reference": videos.reference, "world_seconds_of_zero": start}
        document = _thing("Timeline.1", "otsync", about)
        document["global_start_time"] = None
        document["tracks"] = _thing("Stack.1", "tracks") | {"children": tracks, "source_range": None}
        write_json(folder / "timeline.otio", document)
        return [
            f"{c.name}: its clock breaks; the timeline holds the clock before the break"
            for c in videos.clips
            if c.broken
        ]


def _thing(schema: str, name: str, otsync: dict[str, Any] | None = None) -> dict[str, Any]:
    metadata = {} if otsync is None else {"otsync": otsync}
    return {"OTIO_SCHEMA": schema, "name": name, "metadata": metadata, "effects": [], "markers": [], "enabled": True}


def _time(seconds: float, rate: float) -> dict[str, Any]:
    """Seconds as a fractional number of frames: rates differ between videos, and offsets are no whole frames."""
    return {"OTIO_SCHEMA": "RationalTime.1", "rate": rate, "value": seconds * rate}


def _range(start: float, duration: float, rate: float) -> dict[str, Any]:
    ends = {"start_time": _time(start, rate), "duration": _time(duration, rate)}
    return {"OTIO_SCHEMA": "TimeRange.1", **ends}


def _track(clip: Clip, start: float, rate: float, folder: Path) -> dict[str, Any]:
    """A gap until the video begins, then the video; one that runs fast or slow carries a linear time warp."""
    own = clip.video.times
    fps = clip.video.fps or rate
    step = float(np.median(np.diff(own))) if len(own) > 1 else 1 / fps
    length = float(own[-1] - own[0]) + step
    known = {
        "offset_seconds": clip.clock.offset,
        "rate": clip.clock.rate,
        "sigma_seconds": clip.sigma if np.isfinite(clip.sigma) else None,
        "status": clip.status,
    }
    shown = _thing("Clip.2", clip.name, known)
    shown["source_range"] = _range(float(own[0]), length, fps)
    shown["media_references"] = {"DEFAULT_MEDIA": _media(clip, float(own[0]), length, fps, folder)}
    shown["active_media_reference_key"] = "DEFAULT_MEDIA"
    if clip.clock.rate != 1:
        warp = {"OTIO_SCHEMA": "LinearTimeWarp.1", "name": "", "metadata": {}, "effect_name": "LinearTimeWarp"}
        shown["effects"] = [warp | {"time_scalar": 1 / clip.clock.rate}]
    gap = _thing("Gap.1", "") | {"source_range": _range(0.0, float(clip.clock.world(own[0])) - start, rate)}
    track = _thing("Track.1", clip.name) | {"kind": "Video", "source_range": None}
    return track | {"children": [gap, shown]}


def _media(clip: Clip, first: float, length: float, fps: float, folder: Path) -> dict[str, Any]:
    """Where the video lies, relative to the timeline's folder."""
    about = {
        "name": clip.name,
        "metadata": {},
        "available_range": _range(first, length, fps),
        "available_image_bounds": None,
    }
    if clip.file is not None:
        return {"OTIO_SCHEMA": "ExternalReference.1", "target_url": _relative(clip.file, folder), **about}
    frames = clip.video.frames
    while isinstance(frames, FrameRange):
        frames = frames.base
    if isinstance(frames, ImageFrames):  # editors read numbered images from the folder
        first_image = frames.paths[0]
        stem = first_image.stem
        digits = stem[len(stem.rstrip("0123456789")) :]
        sequence = {
            "target_url_base": f"{_relative(first_image.parent, folder)}/",
            "name_prefix": stem[: len(stem) - len(digits)],
            "name_suffix": first_image.suffix,
            "start_frame": int(digits or 0),
            "frame_step": 1,
            "rate": fps,
            "frame_zero_padding": len(digits),
            "missing_frame_policy": "error",
        }
        return {"OTIO_SCHEMA": "ImageSequenceReference.1", **sequence, **about}
    return {"OTIO_SCHEMA": "MissingReference.1", **about}


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()
