"""Parts of a scene: some of its frames, and which frames cannot be read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..types import Offsets, Video, mended_frames
from .frames import FrameRange, LazyFrames
from .scene import Scene


def cut(scene: Scene, first: int, stop: int) -> Scene:
    """Frames ``first`` to ``stop`` (exclusive) of every video, at the times they had.

    ValueError for a video without such frames.
    """
    for video in scene.videos:
        if not 0 <= first < min(stop, len(video.frames)):
            raise ValueError(
                f"frames: expected first < stop within the {len(video.frames)} frames of {video.name}; found "
                f"{first} to {stop}."
            )
    return keep_frames(scene, [range(first, min(stop, len(v.frames))) for v in scene.videos])


def keep_frames(scene: Scene, index: Sequence[Sequence[int]]) -> Scene:
    """The frames at ``index`` of every video, with their masks, labels, points, depth, poses and times."""
    videos, masks, labels, points = [], [], [], []
    labels_of = scene.labels or (None,) * len(scene.videos)
    points_of = scene.points or (None,) * len(scene.videos)
    given = zip(scene.videos, scene.masks, labels_of, points_of, index, strict=True)
    for video, mask, label, found, picks in given:
        whole = np.array_equal(picks, np.arange(len(video.frames)))
        masks.append(mask if whole or mask is None else _some(mask, picks))
        labels.append(label if whole or label is None else _some(label, picks))
        points.append(found if whole or found is None else found.within(picks))
        if whole:
            videos.append(video)
            continue
        camera, at = video.camera, np.asarray(picks, int)
        if camera.w2c.ndim == 3:
            camera = replace(camera, w2c=camera.w2c[at])
        depth = None if video.depth is None else _some(video.depth, picks)
        times = video.times[at]
        rising = len(at) < 2 or bool((np.diff(at) > 0).all())
        # few frames that are left of many have another rate than the video: then their times alone tell it
        thinned = video.fps is not None and len(at) > 1 and float(np.median(np.diff(times))) > 1.5 / video.fps
        frames, fps = _some(video.frames, picks), None if thinned else video.fps
        told = times if rising else np.sort(times)  # of frames in another order the caller tells the times
        videos.append(replace(video, frames=frames, camera=camera, fps=fps, timestamps=told, depth=depth))
    tracks = tuple(
        t if t is None or np.array_equal(picks, np.arange(len(v.frames))) else t.take(picks)
        for t, v, picks in zip(scene.tracks, scene.videos, index, strict=False)
    )
    return replace(
        scene,
        videos=tuple(videos),
        masks=tuple(masks),
        labels=tuple(labels) if scene.labels else (),
        points=tuple(points) if scene.points else (),
        tracks=tracks,
    )


def on_mended_clocks(scene: Scene, offsets: Offsets) -> Scene:
    """The scene with every video's breaks undone: frames in the order of what they show, at the times they show.

    Frames that stood still are left out. The offsets then hold for the whole of every video.
    """
    known = dict(zip(offsets.names, offsets.breaks, strict=True))
    if not any(known.get(name) for name in scene.names):
        return scene
    told = [mended_frames(v.times, known.get(v.name, ())) for v in scene.videos]
    kept = keep_frames(scene, [index.tolist() for index, _ in told])
    videos = [
        replace(v, timestamps=times, fps=None) if known.get(v.name) else v
        for v, (_, times) in zip(kept.videos, told, strict=True)
    ]
    return replace(kept, videos=tuple(videos))


def unreadable(video: Video, masks: Sequence[Any] | None = None) -> dict[int, str]:
    """Frames that are of no use, and why: damaged, of another size than the camera says, or with NaN.

    Every frame is decoded once, its mask and depth map too.
    """
    bad = {}
    size = (video.camera.height, video.camera.width)
    for k in range(len(video.frames)):
        try:
            image = np.asarray(video.frames[k])
            if image.shape != (*size, 3):
                raise ValueError(f"expected {size[1]} x {size[0]} RGB pixels as the camera says; found {image.shape}")
            if image.dtype.kind == "f" and not np.isfinite(image).all():
                raise ValueError("expected finite colours; found NaN or infinity")
            if masks is not None:
                np.asarray(masks[k])
            if video.depth is not None:
                np.asarray(video.depth[k])
        except (ValueError, OSError, EOFError, SyntaxError) as error:
            bad[k] = str(error)
    return bad


def _some(sequence: Sequence[Any], picks: Sequence[int]) -> Sequence[Any]:
    if isinstance(sequence, LazyFrames):
        return FrameRange(sequence, picks)
    return [sequence[k] for k in picks]
