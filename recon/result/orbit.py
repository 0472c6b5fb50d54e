"""Camera paths for showing a scene: around what moves, at the height and distance of the cameras that filmed it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from otsync.types import Camera
from recon.backdrop.surroundings import up_axis
from recon.rotations import look_at

SURROUNDED = np.radians(120)
"""With a larger gap the cameras do not stand all around, and the path swings between the outermost of them."""

SWING = 0.9
"""Share of the filmed arc that a swing uses: beyond the outermost cameras nothing has been seen of the scene."""


def orbit(
    cameras: Sequence[Camera], focus: Float[np.ndarray, " 3"], frames: int, *, turns: float = 1.0
) -> Float[np.ndarray, "T 4 4"]:
    """Poses (world to camera) of a path around ``focus`` (world units), from the first camera's side.

    Cameras all around: ``turns`` circles. Cameras on one side: a swing to and fro between the outermost of them.
    """
    if frames < 1:
        raise ValueError(f"frames: expected at least 1; found {frames}.")
    poses = np.stack([c.w2c if c.w2c.ndim == 2 else c.w2c[0] for c in cameras])
    up = up_axis(poses)
    eyes = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]) - focus
    height = float(np.median(eyes @ up))
    flat = eyes - (eyes @ up)[:, None] * up
    radius = float(np.median(np.linalg.norm(flat, axis=1)))
    if not radius > 0:
        raise ValueError(
            "cameras: expected some beside the scene; found them above its middle. Render from one by name."
        )
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
