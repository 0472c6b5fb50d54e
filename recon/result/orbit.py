"""Camera paths for showing a scene: around what moves, at the height and distance of the cameras that filmed it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from otsync.types import Camera

SURROUNDED = np.radians(120)
"""Cameras whose largest gap is smaller stand all around; otherwise the path swings between the outermost of them."""

SWING = 0.9
"""Share of the filmed arc that a swing uses: beyond the outermost cameras nobody has seen the scene."""


def look_at(
    eye: Float[np.ndarray, " 3"], focus: Float[np.ndarray, " 3"], up: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    """World to camera (OpenCV axes) of a camera at ``eye`` that looks at ``focus``, its rows along the horizon."""
    z = focus - eye
    z = z / np.linalg.norm(z)
    x = np.cross(z, up)
    if np.linalg.norm(x) < 1e-6 * np.linalg.norm(up):
        raise ValueError("up: expected an axis across the line of sight; found it along it. Move the eye aside.")
    x /= np.linalg.norm(x)
    w2c = np.eye(4)
    w2c[:3, :3] = np.stack([x, np.cross(z, x), z])
    w2c[:3, 3] = -w2c[:3, :3] @ eye
    return w2c


def up_of(poses: Float[np.ndarray, "V 4 4"]) -> Float[np.ndarray, " 3"]:
    """The world's up, at right angles to the horizontals of the cameras as far as can be; unit.

    Cameras that look down at a scene are pitched towards it, which their horizontals do not show. Few that stand side
    by side have but one horizontal, and their images' vertical decides.
    """
    across, up = poses[:, 0, :3], -poses[:, 1, :3].mean(0)
    axis = np.linalg.eigh(across.T @ across / len(poses) - 0.1 * np.outer(up, up))[1][:, 0]
    return axis * (np.sign(axis @ up) or 1.0)


def orbit(
    cameras: Sequence[Camera], focus: Float[np.ndarray, " 3"], frames: int, *, turns: float = 1.0
) -> Float[np.ndarray, "T 4 4"]:
    """Poses (world to camera) of a path around ``focus`` (world units), begun at the first camera's side.

    Cameras all around: ``turns`` circles. Cameras on one side: a swing to and fro between the outermost of them.
    """
    if frames < 1:
        raise ValueError(f"frames: expected at least 1; found {frames}.")
    poses = np.stack([c.w2c if c.w2c.ndim == 2 else c.w2c[0] for c in cameras])
    up = up_of(poses)
    eyes = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]) - focus
    height = float(np.median(eyes @ up))
    flat = eyes - (eyes @ up)[:, None] * up
    radius = float(np.median(np.linalg.norm(flat, axis=1)))
    if not radius > 0:
        raise ValueError("cameras: expected them beside the scene; found them above its middle. Render one by name.")
    ahead = flat[0] / max(float(np.linalg.norm(flat[0])), 1e-9 * radius)
    side = np.cross(up, ahead)
    azimuth = np.sort(np.arctan2(flat @ side, flat @ ahead))
    gaps = np.diff(azimuth, append=azimuth[0] + 2 * np.pi)
    if gaps.max() < SURROUNDED:
        angles = 2 * np.pi * turns * np.arange(frames) / frames
    else:
        arc = 2 * np.pi - gaps.max()
        middle = azimuth[(int(gaps.argmax()) + 1) % len(azimuth)] + arc / 2
        phase = 2 * np.pi * turns * np.arange(frames) / frames
        angles = middle + 0.5 * SWING * arc * np.sin(phase)
    around = np.cos(angles)[:, None] * ahead + np.sin(angles)[:, None] * side
    return np.stack([look_at(focus + radius * a + height * up, focus, up) for a in around])
