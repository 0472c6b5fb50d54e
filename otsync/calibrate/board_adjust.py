"""Corners of a board as cameras, places and lenses say that they are seen, and how that changes with each of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, eq=False)
class Views:
    """What is adjusted: all corners of all cameras.

    Args:
        camera, place: (N,) whose corner it is, and at which place of the board. xyz: (N,3) on the board, in squares.
        uv: (N,2) pixels without distortion. boards: (P,4,4) the board's places, to the world.
    """

    camera: Int[np.ndarray, " N"]
    place: Int[np.ndarray, " N"]
    xyz: Float[np.ndarray, "N 3"]
    uv: Float[np.ndarray, "N 2"]
    boards: Float[np.ndarray, "P 4 4"]


@dataclass(frozen=True, eq=False)
class Problem:
    """Least squares over X = 6 F + 6 P + 2 L + 1 numbers: turn and move of each free camera and of each place; by lens
    the logarithm of its focal length's factor and what is added to its first radial coefficient; and the logarithm of
    how much wider than high the board's squares are.

    Args:
        views: the corners. w2c: (V,4,4) poses to begin with. K: (V,3,3) intrinsics.
        free: cameras that are adjusted; one is not. loose: cameras whose lens is.
        firm: (2 L + 1,) pixels by which a residual grows with each of the lenses' numbers and with the board's.
    """

    views: Views
    w2c: Float[np.ndarray, "V 4 4"]
    K: Float[np.ndarray, "V 3 3"]
    free: Sequence[int]
    loose: Sequence[int]
    firm: Float[np.ndarray, " S"]

    @property
    def cameras(self) -> int:
        """Numbers of the cameras, which come first."""
        return 6 * len(self.free)

    @property
    def poses(self) -> int:
        """Numbers of cameras and places together."""
        return self.cameras + 6 * len(self.views.boards)

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return self.poses + len(self.firm)

    def at(self, x: Float[np.ndarray, " X"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Cameras (V,4,4), places (P,4,4), factors of focal lengths (V,) and what is added to coefficients (V,)."""
        w2c, zoom, bend = self.w2c.copy(), np.ones(len(self.w2c)), np.zeros(len(self.w2c))
        w2c[list(self.free)] = nudged(w2c[list(self.free)], x[: self.cameras].reshape(-1, 6))
        lenses = x[self.poses : -1]
        zoom[list(self.loose)], bend[list(self.loose)] = np.exp(lenses[::2]), lenses[1::2]
        return w2c, nudged(self.views.boards, x[self.cameras : self.poses].reshape(-1, 6)), zoom, bend

    def residuals(self, x: Float[np.ndarray, " X"]) -> Float[np.ndarray, " R"]:
        """Pixels that corners are off (u, v in turns), then what lenses and the board are off."""
        _, _, _, uv = self._seen(x)
        return np.concatenate([(uv - self.views.uv).ravel(), self.firm * x[self.poses :]])

    def jacobian(self, x: Float[np.ndarray, " X"]) -> Float[np.ndarray, "R X"]:
        """Derivatives of the residuals."""
        w2c, boards, zoom, bend = self.at(x)
        world, local, ray, uv = self._seen(x)
        v, n = self.views, len(self.views.uv)
        wide = 1 + bend[v.camera] * (ray**2).sum(1)
        bent = wide[:, None, None] * np.eye(2) + 2 * bend[v.camera, None, None] * ray[:, :, None] * ray[:, None]
        depth = np.maximum(local[:, 2], LEAST_DEPTH)[:, None]
        seen = np.concatenate([np.tile(np.eye(2), (n, 1, 1)), -ray[:, :, None]], 2) / depth[:, None]
        lens = zoom[v.camera, None, None] * self.K[v.camera, :2, :2]
        of_local = lens @ bent @ seen
        out = np.zeros((2 * n + len(self.firm), self.size))
        corners = out[: 2 * n].reshape(n, 2, self.size)
        for k, camera in enumerate(self.free):
            mine = v.camera == camera
            step = x[6 * k : 6 * k + 6]
            corners[mine, :, 6 * k : 6 * k + 6] = of_local[mine] @ _moves(local[mine], step)
        of_world = of_local @ w2c[v.camera, :3, :3]
        for place in range(len(v.boards)):
            mine, first = v.place == place, self.cameras + 6 * place
            corners[mine, :, first : first + 6] = of_world[mine] @ _moves(world[mine], x[first : first + 6])
        for k, camera in enumerate(self.loose):
            mine, first = v.camera == camera, self.poses + 2 * k
            corners[mine, :, first] = uv[mine] - self.K[camera, :2, 2]
            corners[mine, :, first + 1] = np.einsum(
                "nij,nj->ni", lens[mine], ray[mine] * (ray[mine] ** 2).sum(1)[:, None]
            )
        wider = np.einsum("nij,nj->ni", boards[v.place, :3, :2], printed(v.xyz, x[-1])[:, :2] * [0.5, -0.5])
        corners[:, :, -1] = np.einsum("nij,nj->ni", of_world, wider)
        out[2 * n + np.arange(len(self.firm)), self.poses + np.arange(len(self.firm))] = self.firm
        return out

    def _seen(self, x: Float[np.ndarray, " X"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Corners in the world, before their cameras, as rays (at depth 1), and their pixels."""
        w2c, boards, zoom, bend = self.at(x)
        v = self.views
        xyz = printed(v.xyz, x[-1])
        world = np.einsum("nij,nj->ni", boards[v.place, :3, :3], xyz) + boards[v.place, :3, 3]
        local = np.einsum("nij,nj->ni", w2c[v.camera, :3, :3], world) + w2c[v.camera, :3, 3]
        ray = local[:, :2] / np.maximum(local[:, 2:], LEAST_DEPTH)
        wide = 1 + bend[v.camera] * (ray**2).sum(1)
        lens = zoom[v.camera, None, None] * self.K[v.camera, :2, :2]
        return world, local, ray, np.einsum("nij,nj->ni", lens, ray * wide[:, None]) + self.K[v.camera, :2, 2]


LEAST_DEPTH = 1e-6
"""Squares before a camera at which a corner is taken to be at the least."""


def printed(xyz: Float[np.ndarray, "N 3"], wider: float) -> Float[np.ndarray, "N 3"]:
    """Corners of a board whose squares are wider than high by a factor, of which this is the logarithm."""
    return xyz * [np.exp(wider / 2), np.exp(-wider / 2), 1.0]


def nudged(poses: Float[np.ndarray, "P 4 4"], steps: Float[np.ndarray, "P 6"]) -> Float[np.ndarray, "P 4 4"]:
    """Poses turned by rotation vectors, and moved, in the axes that they lead to."""
    more = np.tile(np.eye(4), (len(poses), 1, 1))
    more[:, :3, :3] = Rotation.from_rotvec(steps[:, :3]).as_matrix()
    more[:, :3, 3] = steps[:, 3:]
    return more @ poses


def _moves(points: Float[np.ndarray, "N 3"], step: Float[np.ndarray, " 6"]) -> Float[np.ndarray, "N 3 6"]:
    """How points that a step has turned and moved change with it: -[p]x times the rotation's left Jacobian, and 1."""
    turned = points - step[3:]
    w = _crossed(step[None, :3])[0]
    angle = float(np.linalg.norm(step[:3]))
    a, b = (0.5, 1 / 6) if angle < 1e-4 else ((1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3)
    left = np.eye(3) + a * w + b * w @ w
    return np.concatenate([-_crossed(turned) @ left, np.tile(np.eye(3), (len(points), 1, 1))], 2)


def _crossed(v: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 3"]:
    """The matrices that take a vector w to v x w."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - np.swapaxes(out, 1, 2)
