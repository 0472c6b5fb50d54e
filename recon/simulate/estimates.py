"""Tracks and depth maps of a filmed world, with the errors of trackers and depth estimators."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from otsync.simulate.observation import stream
from otsync.types import Camera, TrackSet
from recon.simulate.camera import Frames
from recon.simulate.world import FPS, SPLAT, World

TRACK_NOISE, DRIFTING, DRIFT, SHORTEST = 0.006, 0.05, 0.01, 8
"""Tracks: m of white noise; share that drifts and its random walk, m per frame; frames that a track must be seen."""

DEPTH_SCALE, DEPTH_NOISE = 0.004, 0.006
"""Depth maps: relative error of a whole frame, and m of noise of every pixel."""

LEAST_DEPTH = 0.05
"""m in front of a camera from which a point is seen."""


def noisy_depth(frames: Frames, rng: np.random.Generator) -> Float[np.ndarray, "T h w"]:
    """Depth maps as an estimator would give them; 0 where unknown."""
    scale = 1 + DEPTH_SCALE * rng.standard_normal((len(frames.depth), 1, 1))
    noisy = frames.depth * scale + DEPTH_NOISE * rng.standard_normal(frames.depth.shape)
    return np.where(frames.depth > 0, noisy, 0).astype(np.float32)


def noisy_tracks(
    world: World, camera: Camera, depth: np.ndarray, times: np.ndarray, name: str, seed: int, c: int
) -> TrackSet:
    """Tracks of the surface points that camera ``c`` sees, as a tracker would give them."""
    rng = stream(seed, c, "tracks")
    true = world.positions(times)
    z, uv = camera.to_camera(true)[..., 2], camera.project(true)
    inside = (z > LEAST_DEPTH) & (uv >= 0).all(-1) & (uv < (camera.width, camera.height)).all(-1)
    column, row = np.where(inside[..., None], uv, 0).astype(int).transpose(2, 0, 1)
    surface = depth[np.arange(len(times)), row, column]
    visible = inside & (surface > 0) & (z < surface + SPLAT)
    xyz = true + TRACK_NOISE * rng.standard_normal(true.shape)
    walk = np.cumsum(DRIFT * rng.standard_normal(true.shape), 1)
    xyz += np.where(rng.random(len(true)) < DRIFTING, 1.0, 0.0)[:, None, None] * walk
    keep = visible.sum(1) >= min(SHORTEST, len(times))
    xyz = np.where(visible[..., None], xyz, np.nan)[keep]
    return TrackSet(xyz, visible[keep], fps=FPS, name=name, uv=camera.project(xyz), camera=camera, frame="world")
