"""The world's frame: from a mapper's own to an upright one in metres, and one model laid over another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..geometry import common_target
from ..types import Camera

USUAL_DISTANCE = 3.0
"""Units from a camera to where all look, in a world of arbitrary scale: as if a room were filmed in metres."""

TURNED_ALIKE = 10.0
"""Degrees within which cameras agree on how one world is turned in another."""


@dataclass(frozen=True, eq=False)
class Similar:
    """A similarity of worlds: x' = scale R x + t."""

    scale: float
    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, " 3"]

    def camera(self, w2c: Float[np.ndarray, "*T 4 4"]) -> Float[np.ndarray, "*T 4 4"]:
        """The same cameras, as seen from the other world."""
        out = np.array(w2c, float)
        out[..., :3, :3] = w2c[..., :3, :3] @ self.R.T
        out[..., :3, 3] = self.scale * w2c[..., :3, 3] - np.einsum("...ij,j->...i", out[..., :3, :3], self.t)
        return out

    def __call__(self, xyz: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 3"]:
        return self.scale * xyz @ self.R.T + self.t


def centres(w2c: Float[np.ndarray, "*T 4 4"]) -> Float[np.ndarray, "*T 3"]:
    """Where cameras stand: -Rᵀ t."""
    return -np.einsum("...ji,...j->...i", w2c[..., :3, :3], w2c[..., :3, 3])


def degrees(R: Float[np.ndarray, "*T 3 3"]) -> Float[np.ndarray, "*T"]:
    """The angle that a rotation turns by."""
    return np.degrees(np.arccos(np.clip((np.trace(R, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))


def laid_over(a: Float[np.ndarray, "P 4 4"], b: Float[np.ndarray, "P 4 4"]) -> Similar:
    """The similarity that takes the world of cameras ``a`` to that of the same cameras ``b``.

    Robust: the rotation on which most cameras agree, then scale and shift with least absolute errors of the places.
    ValueError for fewer than two cameras.
    """
    if len(a) < 2 or len(a) != len(b):
        raise ValueError(f"cameras: expected two and more, the same in both worlds; found {len(a)} and {len(b)}.")
    turns = np.swapaxes(b[:, :3, :3], 1, 2) @ a[:, :3, :3]
    apart = degrees(turns[:, None] @ np.swapaxes(turns, 1, 2)[None])
    alike = turns[apart[int(np.median(apart, 1).argmin())] < TURNED_ALIKE]
    U, _, Vt = np.linalg.svd(alike.sum(0))
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    x, y = centres(a) @ R.T, centres(b)
    size = float(np.linalg.norm(y - y.mean(0), axis=1).max())
    weight, scale, t = np.ones(len(x)), 1.0, np.zeros(3)
    for _ in range(50):
        mx, my = np.average(x, 0, weight), np.average(y, 0, weight)
        spread = (weight[:, None] * (x - mx) ** 2).sum()
        scale = float((weight[:, None] * (x - mx) * (y - my)).sum() / max(spread, 1e-300))
        t = my - scale * mx
        weight = 1 / np.maximum(np.linalg.norm(y - scale * x - t, axis=1), 1e-4 * max(size, 1e-12))
    return Similar(scale, R, t)


def upright(
    cameras: Sequence[Float[np.ndarray, "*T 4 4"]],
    turned: Sequence[int],
    metres: tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"], float] | None = None,
) -> Similar:
    """From a mapper's world to one with z up, its origin where the cameras look, in metres where a distance is known.

    Args:
        cameras: (4,4) or (T,4,4) each. turned: degrees by which players turn their images clockwise.
        metres: two points of the mapper's world, and the metres between them; None: a median distance of 3 units.

    People hold cameras level: "up" is the direction to which all horizontal axes of images are square, on the side to
    which their tops point.
    """
    groups = [w.reshape(-1, 4, 4) for w in cameras]
    poses = np.concatenate(groups)
    angle = np.radians(np.repeat(np.asarray(turned, float), [len(group) for group in groups]))
    rows = poses[:, :3, :3]
    # shown turned by an angle clockwise, what is to the right on the screen was elsewhere in the image as it is stored
    right = np.cos(angle)[:, None] * rows[:, 0] - np.sin(angle)[:, None] * rows[:, 1]
    down = np.sin(angle)[:, None] * rows[:, 0] + np.cos(angle)[:, None] * rows[:, 1]
    _, across, axes = np.linalg.svd(right)
    up = axes[2] if len(across) > 1 and across[1] > 0.05 * across[0] else -down.mean(0)
    up = up / np.linalg.norm(up)
    up = up if up @ down.mean(0) < 0 else -up
    first = right[0] - (right[0] @ up) * up
    x = first / np.linalg.norm(first)
    R = np.stack([x, np.cross(up, x), up])
    target = common_target([Camera(np.eye(3), p, 1, 1) for p in poses])
    if metres is None:
        scale = USUAL_DISTANCE / max(float(np.median(np.linalg.norm(centres(poses) - target, axis=1))), 1e-300)
    else:
        a, b, length = metres
        scale = length / max(float(np.linalg.norm(a - b)), 1e-300)
    return Similar(scale, R, -scale * R @ target)
