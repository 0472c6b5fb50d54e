"""Where a clip shows a board at rest, and the poses that it may have there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from ..files.cache import Cache
from ..geometry import undistort
from ..progress import Tell
from ..types import Camera
from .boards import LEAST_CORNERS, Board, Look, looks_of, step_of
from .clips import Clip, Lens

STEADY, DRIFT = 1.0, 3.0
"""Pixels at 1000 of width that a resting board may seem to move from one look to the next, and in all."""

LOST = 3
"""Looks in a row in which a resting board may not be found: a hand before it, noise."""

RESTS = 0.5
"""Seconds for which a board is still at the least."""


@dataclass(frozen=True, eq=False)
class Rest:
    """A board that one camera sees at rest.

    Args:
        begin, end: seconds of the camera's clip.
        xyz: (N,3) corners on the board, in squares. uv: (N,2) their pixels, without the lens's distortion.
        poses: (S,4,4) the board's possible poses, to the camera: a flat board seen from afar has two, and one without
            markers looks alike when it is turned round; these are together.
        around: how many ways round it looks alike.
    """

    begin: float
    end: float
    xyz: Float[np.ndarray, "N 3"]
    uv: Float[np.ndarray, "N 2"]
    poses: Float[np.ndarray, "S 4 4"]
    around: int = 1


def rests_of(
    clip: Clip, board: Board, lens: Lens, cache: Cache | None = None, tell: Tell = lambda text: None
) -> list[Rest]:
    """Where a clip shows the board at rest, in order of time. ``cache``: where corners are kept."""
    looks = looks_of(clip, board, cache, tell)
    unit = max(clip.size) / 1000
    camera = Camera(lens.K, np.eye(4), *clip.size, lens.distortion)
    out = []
    for group in _steady(looks, step_of(clip), unit):
        seconds = (group[-1][0] - group[0][0]) / clip.fps
        if seconds < RESTS:
            continue
        xyz, uv = _stillest(group)
        if len(xyz) < LEAST_CORNERS:
            continue
        ideal = undistort(camera, uv)
        poses = poses_of(xyz, ideal, lens.K, board)
        if len(poses):
            out.append(Rest(group[0][0] / clip.fps, group[-1][0] / clip.fps, xyz, ideal, poses, len(turns_of(board))))
    return out


def _steady(looks: Sequence[Look], step: int, unit: float) -> list[list[Look]]:
    """Runs of looks between which the board does not move."""
    groups: list[list[Look]] = []
    for look in looks:
        last = groups[-1] if groups else []
        near = bool(last) and look[0] - last[-1][0] <= (1 + LOST) * step
        near = near and _moved(last[-1], look) < STEADY * unit and _moved(last[0], look) < DRIFT * unit
        if near:
            last.append(look)
        else:
            groups.append([look])
    return groups


def _moved(one: Look, two: Look) -> float:
    """Pixels that the corners which both looks have moved by, in the median; infinity where they share too few."""
    _, i, j = np.intersect1d(_names(one[1]), _names(two[1]), return_indices=True)
    if len(i) < LEAST_CORNERS:
        return float("inf")
    return float(np.median(np.linalg.norm(one[2][i] - two[2][j], axis=1)))


def _names(xyz: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """One number a corner of the board."""
    at = np.round(xyz).astype(int)
    return 1000 * at[:, 0] + at[:, 1]


def _stillest(group: Sequence[Look]) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 2"]]:
    """The corners of a board at rest and their pixels, from the half of the looks in which it is stillest.

    A board that is set down is slow at first and last: each camera would see another part of that.
    """
    usual = (0, *_usual(group))
    still = sorted(group, key=lambda look: _moved(usual, look))[: max(3, (len(group) + 1) // 2)]
    return _usual(still)


def _usual(looks: Sequence[Look]) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 2"]]:
    """The corners that most looks have, and the median of their pixels."""
    xyz, uv = (np.concatenate([look[n] for look in looks]) for n in (1, 2))
    _, first, corner, count = np.unique(_names(xyz), return_index=True, return_inverse=True, return_counts=True)
    often = np.flatnonzero(2 * count > len(looks))
    return xyz[first[often]], np.array([np.median(uv[corner == k], 0) for k in often]).reshape(-1, 2)


def turns_of(board: Board) -> Float[np.ndarray, "R 4 4"]:
    """The motions of the board after which it may look the same: of one with markers none but the identity."""
    if board.dictionary:
        return np.eye(4)[None]
    out = []
    for quarter in range(0, 4, 1 if board.columns == board.rows else 2):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", 90 * quarter, degrees=True).as_matrix()
        middle = np.array([(board.columns - 1) / 2, (board.rows - 1) / 2, 0])
        turn[:3, 3] = middle - turn[:3, :3] @ middle
        out.append(turn)
    return np.stack(out)


def poses_of(
    xyz: Float[np.ndarray, "N 3"], uv: Float[np.ndarray, "N 2"], K: Float[np.ndarray, "3 3"], board: Board
) -> Float[np.ndarray, "S 4 4"]:
    """The board's possible poses; the second of a flat thing's two where it suits the pixels nearly as well."""
    import cv2

    solve_pnp: Any = cv2.solvePnPGeneric
    try:
        _, turns, moves, errors = solve_pnp(xyz, uv, K, None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:  # corners on one line
        return np.zeros((0, 4, 4))
    best, out = float(np.min(errors)), []
    for turn, move, error in zip(turns, moves, np.ravel(errors), strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(move)
        if np.isfinite(pose).all() and error < 3 * best + 0.2:
            out += [pose @ around for around in turns_of(board)]
    return np.array(out).reshape(-1, 4, 4)


def carried(pose: Float[np.ndarray, "4 4"], xyz: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Points of the board where a pose takes them."""
    return xyz @ pose[:3, :3].T + pose[:3, 3]


def grid_of(board: Board) -> Float[np.ndarray, "N 3"]:
    """The board's corners, in squares."""
    inner = (board.columns - 1, board.rows - 1) if board.dictionary else (board.columns, board.rows)
    grid = np.mgrid[: inner[0], : inner[1]].T.reshape(-1, 2).astype(float)
    return np.pad(grid + (1.0 if board.dictionary else 0.0), ((0, 0), (0, 1)))
