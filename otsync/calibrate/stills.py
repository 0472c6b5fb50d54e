"""Pictures of what stands still: the background of a camera on a tripod, masked key frames of one that moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from ..compute.indices import evenly
from ..geometry import sampson
from ..priors.flow import DISFlow
from ..priors.masks import tidy
from ..priors.working import WorkingFrames

STILL = 0.75
"""Pixels at 640 of width that a corner of a static camera's image may seem to move: compression and noise."""

STAYING = 0.1
"""Share of the corners that stay where they were, from which on a camera counts as static. People before plain walls
leave .17 to .75 (dome), hands and walks none."""

LOOKS = 7
"""Frames that are compared with the first one."""

SAMPLES = 50
"""Frames that the median of a background is taken of."""

RESIDUAL = 1.5
"""Pixels at 640 of width by which what moves leaves the epipolar lines between two near frames of a moving camera."""

SPARE = 9
"""Pixels at 640 of width around a moving thing that are left out too."""


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture for the mapping.

    Args:
        frame: which frame of the clip; -1: the background of all.
        image: (h,w,3) RGB at the mapping's size. use: (h,w) where features may be, or None: everywhere.
    """

    frame: int
    image: UInt8[np.ndarray, "h w 3"]
    use: Bool[np.ndarray, "h w"] | None = None


def stands_still(frames: WorkingFrames) -> bool:
    """Whether the camera does not move: some of the first frame's corners stay where they were."""
    import cv2

    follow: Any = cv2.calcOpticalFlowPyrLK
    first = frames.gray(0)
    corners = cv2.goodFeaturesToTrack(first, 500, 0.01, 8 * frames.unit)
    if corners is None or len(frames) == 1:
        return True
    staying = []
    for k in evenly(len(frames), LOOKS + 1)[1:]:
        moved, ok, _ = follow(first, frames.gray(int(k)), corners, None, winSize=(15, 15))
        near = np.linalg.norm((moved - corners).reshape(-1, 2), axis=1) < STILL * max(frames.unit, 0.5)
        staying.append(float((near & (ok.ravel() > 0)).mean()))
    return bool(np.median(staying) >= STAYING and min(staying) >= STAYING / 2)


def background(frames: WorkingFrames) -> Picture:
    """The median over time: what a static camera sees most of the time."""
    picks = evenly(len(frames), SAMPLES)
    return Picture(-1, np.median(np.stack([frames[int(k)] for k in picks]), 0).astype(np.uint8))


def key_frames(frames: WorkingFrames, count: int, step: int) -> list[Picture]:
    """Frames evenly spread over the clip of a moving camera, without what moves in them.

    Args:
        step: frames between a key frame and the one that it is compared with.
    """
    flow = DISFlow()
    return [Picture(int(k), frames[int(k)], ~_moving(frames, int(k), step, flow)) for k in evenly(len(frames), count)]


def _moving(frames: WorkingFrames, k: int, step: int, flow: DISFlow) -> Bool[np.ndarray, "h w"]:
    """Pixels whose flow leaves the epipolar geometry that most of the image obeys; none where there is no such one."""
    import cv2

    w, h = frames.size
    other = k + step if k + step < len(frames) else k - step
    nothing = np.zeros((h, w), bool)
    if not 0 <= other < len(frames):
        return nothing
    forward, _ = flow.pair(frames.gray(k), frames.gray(other))
    grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2).astype(float)
    there = grid + forward.reshape(-1, 2)
    some = np.stack(np.meshgrid(np.arange(4, w, 12), np.arange(4, h, 12)), -1).reshape(-1, 2) @ [1, w]
    cv2.setRNGSeed(0)
    F, _ = cv2.findFundamentalMat(grid[some], there[some], cv2.FM_RANSAC, 0.5 * max(frames.unit, 0.5), 0.999, 2000)
    if F is None or F.shape != (3, 3):
        return nothing
    leaves = np.abs(sampson(F, grid, there)).reshape(h, w) > RESIDUAL * frames.unit
    mask = tidy(leaves, frames.unit, 150)
    if mask.mean() > 0.6:  # the geometry is of something else
        return nothing
    edge = max(3, round(SPARE * frames.unit))
    return cv2.dilate(mask.astype(np.uint8), np.ones((edge, edge), np.uint8)) > 0


def pictures_of(frames: Sequence[np.ndarray], size: tuple[int, int], width: int) -> WorkingFrames:
    """The frames at the mapping's size: the longer side has at most ``width`` pixels."""
    return WorkingFrames(frames, size, round(width * min(1.0, size[0] / size[1])))
