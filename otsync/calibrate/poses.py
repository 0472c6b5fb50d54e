"""The pose of every frame of a moving camera: points of the model followed from key frames, then PnP by poselib.

A leaf: nothing but it and :mod:`otsync.calibrate.left_out` imports poselib.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..priors.working import WorkingFrames
from .clips import Lens
from .mapping import Model, found_camera

LEAST = 20
"""Points that must agree on a frame's pose."""

ERROR = 2.0
"""Pixels at 640 of width that a point may lie off in such an agreement."""

DRIFT = 0.7
"""Pixels at 640 of width by which a point may miss where it began when it is followed back."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses (T,4,4) of a clip's frames. found: (T,) which were found; the others lie between their neighbours."""

    w2c: Float[np.ndarray, "T 4 4"]
    found: Bool[np.ndarray, " T"]


def every_pose(
    frames: WorkingFrames, lens: Lens, keys: Int[np.ndarray, " P"], model: Model, pictures: Int[np.ndarray, " P"]
) -> Poses:
    """Poses of all frames of one clip.

    Args:
        frames: at the mapping's size. lens: at that size, as the mapping found it.
        keys: frames of the clip that have a pose in the model, ascending. pictures: their indices in the model.

    Between two key frames the points that either sees are followed towards the other one; before the first and after
    the last as far as the clip goes.
    """
    count = len(frames)
    w2c, found = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, bool)
    uv: list[list[np.ndarray]] = [[] for _ in range(count)]
    xyz: list[list[np.ndarray]] = [[] for _ in range(count)]
    edges = [-1, *keys.tolist(), count]
    for n, (key, picture) in enumerate(zip(keys.tolist(), pictures.tolist(), strict=True), 1):
        seen = model.seen[:, 0] == picture
        w2c[key], found[key] = model.w2c[picture], True
        for stop in (edges[n - 1], edges[n + 1]):
            for k, pixels, points in _followed(frames, key, stop, model.uv[seen], model.points[model.seen[seen, 1]]):
                uv[k].append(pixels)
                xyz[k].append(points)
    for k in range(count):
        if not found[k] and uv[k]:
            pose = _pnp(np.concatenate(uv[k]), np.concatenate(xyz[k]), lens, frames)
            if pose is not None:
                w2c[k], found[k] = pose, True
    return Poses(bridged(w2c, found), found)


def _followed(
    frames: WorkingFrames, key: int, stop: int, uv: Float[np.ndarray, "N 2"], xyz: Float[np.ndarray, "N 3"]
) -> Any:
    """(frame, pixels, points) for the frames between ``key`` and ``stop``, both left out; pixels' centres at +0.5."""
    import cv2

    cv2.setNumThreads(1)
    follow: Any = cv2.calcOpticalFlowPyrLK
    step = 1 if stop > key else -1
    if abs(stop - key) < 2 or not len(uv):
        return
    size = max(9, round(21 * frames.unit)) | 1
    before, here = frames.gray(key), (uv - 0.5).astype(np.float32).reshape(-1, 1, 2)
    for k in range(key + step, stop, step):
        after = frames.gray(k)
        there, ok, _ = follow(before, after, here, None, winSize=(size, size), maxLevel=3)
        back, again, _ = follow(after, before, there, None, winSize=(size, size), maxLevel=3)
        keep = (ok.ravel() > 0) & (again.ravel() > 0)
        keep &= np.linalg.norm((back - here).reshape(-1, 2), axis=1) < DRIFT * frames.unit
        here, xyz, before = there[keep], xyz[keep], after
        if len(xyz) < LEAST:
            return
        yield k, here.reshape(-1, 2).astype(float) + 0.5, xyz


def _pnp(
    uv: Float[np.ndarray, "N 2"], xyz: Float[np.ndarray, "N 3"], lens: Lens, frames: WorkingFrames
) -> Float[np.ndarray, "4 4"] | None:
    """The pose on which at least ``LEAST`` points, and a third of all, agree; None where none do."""
    import poselib

    options = {"max_reproj_error": ERROR * max(frames.unit, 0.3), "seed": 0}
    pose, info = poselib.estimate_absolute_pose(uv, xyz, found_camera(lens), options, {})
    if info["num_inliers"] < max(LEAST, len(uv) / 3):
        return None
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = pose.R, pose.t
    return w2c


def bridged(w2c: Float[np.ndarray, "T 4 4"], found: Bool[np.ndarray, " T"]) -> Float[np.ndarray, "T 4 4"]:
    """Poses with those that were not found put between their neighbours; before the first and after the last the same.

    ValueError where none was found.
    """
    from scipy.spatial.transform import Rotation, Slerp

    if not found.any():
        raise ValueError("found: expected at least one pose; found none.")
    known, out = np.flatnonzero(found), w2c.copy()
    if len(known) == 1:
        out[:] = w2c[known[0]]
        return out
    k = np.arange(len(w2c)).clip(known[0], known[-1])
    centre = -np.einsum("tji,tj->ti", w2c[known, :3, :3], w2c[known, :3, 3])
    R = Slerp(known, Rotation.from_matrix(w2c[known, :3, :3]))(k).as_matrix()
    C = np.stack([np.interp(k, known, centre[:, i]) for i in range(3)], 1)
    out[~found, :3, :3] = R[~found]
    out[~found, :3, 3] = -np.einsum("tij,tj->ti", R, C)[~found]
    return out


def key_pictures(
    of: Sequence[int] | np.ndarray, frames: Sequence[int], model: Model, video: int
) -> tuple[np.ndarray, np.ndarray]:
    """(frames of one video that have a pose in the model, their indices in the model), in order of the frames."""
    here = [n for n, p in enumerate(model.pictures) if of[int(p)] == video]
    at = np.array([frames[int(model.pictures[n])] for n in here], int)
    order = np.argsort(at)
    return at[order], np.array(here, int)[order]
