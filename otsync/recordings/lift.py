"""Lifting: pixels, depth and camera to positions in space (paper, Sec. 3.2), smoothed without delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ..clocks.shutter import at_frame_times
from ..types import TrackSet

LATERAL = 0.5
"""Pixels: the error of a tracked point across the line of sight."""

DEPTH_SHARE = 0.004
"""Error of a measured depth as a share of it, besides its scatter over time."""

MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""

FLAT = 0.05
"""Largest range of the nine values around a point, as a share of their median: more is an outline."""


@dataclass(frozen=True)
class Lift:
    """Positions of pixel tracks from the depth of their samples.

    Args:
        smooth: seconds, sigma of the symmetric Gaussian over time (no lag: a one-sided filter would shift the clock).
        jump: a depth further than this share of itself from its track's running median is dropped; an edge of the
            mask or a passing limb does that.
        window: seconds of the running median.
        least: samples that a lifted track must keep.
    """

    smooth: float = 1.5 / 30
    jump: float = 0.03
    window: float = 9 / 30
    least: int = 8

    def __call__(self, tracks: TrackSet, depth: Float[np.ndarray, "N T"]) -> TrackSet:
        """``tracks`` (undistorted uv, camera) with xyz, sigma and visibility where the depth (0 unknown) is sound.

        Pixels and depth are the image's own, whose rows a rolling shutter reads at their times; what comes back is at
        the frames' times, as a global shutter's, where the camera declares its readout.
        """
        if tracks.uv is None or tracks.camera is None:
            raise ValueError("tracks: expected pixels (uv) and a camera to lift them; one is missing.")
        if depth.shape != tracks.seen.shape:
            raise ValueError(f"depth: expected shape {tracks.seen.shape}, one a sample; found {depth.shape}.")
        fps = tracks.fps or 30.0
        z = np.where(tracks.seen & (depth > 0), depth, np.nan).astype(float)
        half = max(1, round(self.window * fps / 2))
        middle = running_median(z, half)
        z = np.where(np.abs(z - middle) <= self.jump * middle, z, np.nan)
        rough = running_median(np.abs(z - middle), half)
        camera = tracks.camera
        rays = np.concatenate([tracks.uv, np.ones((*z.shape, 1))], 2) @ np.linalg.inv(camera.K).T
        local = rays * z[..., None]
        xyz = smooth_in_time(camera.to_world(local), self.smooth * fps)
        seen = np.isfinite(xyz[..., 0])
        # smoothing over ~2.7 samples calms both the error across the line of sight and the scatter along it
        lateral = LATERAL * z / camera.K[0, 0]
        sigma = np.where(seen, np.hypot(lateral, np.nan_to_num(rough, nan=0.0) * MAD + DEPTH_SHARE * z), np.nan)
        enough = seen.sum(1) >= self.least
        lifted = replace(
            tracks, xyz=np.where(seen[..., None], xyz, 0.0), visible=seen, sigma=np.where(seen, sigma, 0.0)
        )
        return at_frame_times(lifted.take(np.flatnonzero(enough)))


def depth_at(
    maps: Sequence[np.ndarray | None], tracks: TrackSet, raw_uv: Float[np.ndarray, "N T 2"], edge: float = FLAT
) -> Float[np.ndarray, "N T"]:
    """Depth of every track sample from given maps: the median of the 3x3 pixels around it, 0 at edges and holes.

    Args:
        maps: per frame (H,W), 0 unknown, of any resolution with the camera's field of view; None where there is none.
        raw_uv: pixels of the images as they are, with distortion: where the maps are read.
        edge: largest relative range of the nine values; beyond it the point sits on an outline.
    """
    assert tracks.camera is not None
    out = np.zeros(tracks.seen.shape, np.float32)
    around = np.array([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)])
    for k in range(tracks.n_frames):
        at = np.flatnonzero(tracks.seen[:, k])
        given = maps[k] if len(at) else None
        if given is None:
            continue
        depth = np.asarray(given)
        shrink = np.array([depth.shape[1] / tracks.camera.width, depth.shape[0] / tracks.camera.height])
        pixel = np.floor(raw_uv[at, k] * shrink).astype(int)[:, None] + around
        pixel = np.clip(pixel, 0, [depth.shape[1] - 1, depth.shape[0] - 1])
        nine = np.sort(depth[pixel[..., 1], pixel[..., 0]], axis=1)
        known = (nine > 0).all(1) & (nine[:, -1] - nine[:, 0] <= edge * nine[:, 4])
        out[at, k] = np.where(known, nine[:, 4], 0)
    return out


def running_median(z: Float[np.ndarray, "N T"], half: int) -> Float[np.ndarray, "N T"]:
    """Median over ±``half`` frames of the known samples; nan where there is none."""
    padded = np.pad(z, ((0, 0), (half, half)), constant_values=np.nan)
    windows = np.sort(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=1), axis=2)
    count = np.isfinite(windows).sum(2)
    low = np.take_along_axis(windows, np.maximum(count - 1, 0)[..., None] // 2, 2)[..., 0]
    high = np.take_along_axis(windows, (count // 2)[..., None], 2)[..., 0]
    return np.where(count > 0, 0.5 * (low + np.where(count > 0, high, low)), np.nan)


def smooth_in_time(x: Float[np.ndarray, "N T 3"], sigma: float) -> Float[np.ndarray, "N T 3"]:
    """Symmetric Gaussian mean over the seen samples; unseen ones stay nan."""
    reach = int(3 * sigma)
    if sigma <= 0 or reach < 1:
        return x
    seen: Bool[np.ndarray, "N T"] = np.isfinite(x[..., 0])
    filled = np.where(seen[..., None], x, 0.0)
    total, weight = np.zeros_like(filled), np.zeros(seen.shape)
    T = x.shape[1]
    for d in range(-reach, reach + 1):
        g = np.exp(-0.5 * (d / sigma) ** 2)
        to, of = slice(max(0, -d), min(T, T - d)), slice(max(0, d), min(T, T + d))
        total[:, to] += g * filled[:, of]
        weight[:, to] += g * seen[:, of]
    return np.where(seen[..., None], total / np.maximum(weight, 1e-12)[..., None], np.nan)
