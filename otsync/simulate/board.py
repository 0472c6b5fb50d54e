"""A ChArUco board that somebody carries about before phones, and holds still here and there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from .observation import stream
from .room import MIDDLE, Room, ShownBoard

COLUMNS, ROWS, DICTIONARY, SQUARE = 5, 7, "DICT_4X4_50", 0.08
"""Squares of the board, OpenCV's name of its markers, and the side of a square, m."""

MARKER, TEXELS = 0.75, 24
"""Side of a marker over that of its square, and pixels of a square on the board's picture."""

HOLD, CARRY = 1.2, 0.8
"""Seconds at a place, and from one to the next."""

TREMOR = 0.0004
"""Standard deviation of a held board's place, m."""


def board_picture() -> np.ndarray:
    """(h,w,3) of the front: the board without a margin."""
    import cv2

    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    made = cv2.aruco.CharucoBoard((COLUMNS, ROWS), 1.0, MARKER, markers)
    return np.repeat(made.generateImage((TEXELS * COLUMNS, TEXELS * ROWS))[..., None], 3, 2)


def with_board(room: Room, seed: int, places: int, stands: Float[np.ndarray, "V 3"]) -> Room:
    """The room, empty but for its furniture, where the board is held at so many places from time 0 on.

    Args:
        stands: where the phones stand: the board is turned to between two neighbours, in turns.
    """
    rng = stream(seed, "board")
    poses = []
    for n in range(places):
        one = n % max(len(stands) - 1, 1)
        between = stands[[one, min(one + 1, len(stands) - 1)]].mean(0)
        poses.append(_facing(MIDDLE + rng.uniform(-0.5, 0.5, 3) * [1, 0.5, 1], between, rng.normal(size=3) * 0.3))
    waves = rng.uniform(3, 9, (3, 2)), rng.uniform(0, 2 * np.pi, (3, 2))

    def pose(t: float) -> Float[np.ndarray, "4 4"]:
        from scipy.spatial.transform import Rotation, Slerp

        n, late = divmod(float(np.clip(t, 0, places * (HOLD + CARRY) - 1e-6)), HOLD + CARRY)
        one, two = poses[int(n)], poses[min(int(n) + 1, places - 1)]
        way = np.clip((late - HOLD) / CARRY, 0, 1)
        way = way * way * (3 - 2 * way)
        out = np.eye(4)
        out[:3, :3] = Slerp([0, 1], Rotation.from_matrix(np.stack([one[:3, :3], two[:3, :3]])))(way).as_matrix()
        middle = np.array([COLUMNS, ROWS, 0]) * SQUARE / 2
        centre = (1 - way) * (one[:3, :3] @ middle + one[:3, 3]) + way * (two[:3, :3] @ middle + two[:3, 3])
        centre = centre + TREMOR * np.sin(waves[0] * t + waves[1]).sum(1)
        out[:3, 3] = centre - out[:3, :3] @ middle
        return out

    shown = ShownBoard(board_picture(), (COLUMNS * SQUARE, ROWS * SQUARE), pose)
    nothing = replace(room, radii=room.radii[:0], colours=room.colours[:0], places=lambda t: np.zeros((0, len(t), 3)))
    return replace(nothing, board=shown)


def length(places: int) -> float:
    """Seconds for which the board is shown."""
    return places * (HOLD + CARRY)


def _facing(
    centre: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"], turn: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    """Board to world of an upright board about ``centre`` whose front is turned to ``target``, and then by ``turn``."""
    from scipy.spatial.transform import Rotation

    z = (centre - target) / np.linalg.norm(centre - target)
    x = np.cross([0, 1.0, 0], z)
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3, :3] = np.stack([x, np.cross(z, x), z], 1) @ Rotation.from_rotvec(turn).as_matrix()
    out[:3, 3] = centre - out[:3, :3] @ np.array([COLUMNS, ROWS, 0]) * SQUARE / 2
    return out
