"""Lenses from clips of a board: a checkerboard, or a ChArUco board (a checkerboard with markers), by OpenCV.

A clip ``board left.mp4`` is of the lens that filmed ``left``; ``board.mp4`` is of all videos without a clip of their
own and of the same size. A board fixes a phone's lens once; it must be filmed in the mode that films the scene.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ..compute.indices import evenly
from ..files.cache import Cache
from ..progress import Tell
from .clips import Clip, Lens

LOOKS_A_SECOND, LEAST_LOOKS, USED = 8.0, 120, 30
"""How often the board is looked for, in how many frames at the least, and pictures that the lens is found from."""

LEAST_PICTURES, LEAST_CORNERS = 8, 6
"""Pictures of the board that a lens needs, and corners of a picture that counts."""

WORST = 1.5
"""Pixels at 1000 of width: a larger mean error is that of a board which is not flat, or not the one that was named."""

LARGEST = 1600
"""Pixels of the longer side of a picture in which corners are looked for."""

TILT = 20.0
"""Degrees between the most different views of a board: of one view any focal length is right."""

MARKER = 0.75
"""Side of a marker over that of its square."""


@dataclass(frozen=True)
class Board:
    """A flat board.

    Args:
        columns, rows: inner corners of a checkerboard; squares of a ChArUco board.
        dictionary: OpenCV's name of the markers (DICT_4X4_50, ...); empty: a checkerboard.
    """

    columns: int
    rows: int
    dictionary: str = ""

    @classmethod
    def parse(cls, text: str) -> Board:
        """``9x6`` (inner corners of a checkerboard), or ``5x7:DICT_4X4_50`` (squares, markers of a ChArUco board)."""
        match = re.fullmatch(r"(\d{1,3})x(\d{1,3})(?::(DICT_\w+))?", text.strip())
        if not match or min(int(match[1]), int(match[2])) < 3:
            raise ValueError(
                f"--board: expected 9x6 (inner corners of a checkerboard) or 5x7:DICT_4X4_50 (squares of a ChArUco "
                f"board and its markers); found {text!r}."
            )
        board = cls(int(match[1]), int(match[2]), match[3] or "")
        if board.dictionary:
            import cv2

            if not hasattr(cv2.aruco, board.dictionary):
                raise ValueError(f"--board: expected OpenCV's name of a dictionary; found {board.dictionary!r}.")
        return board

    def corners(self, image: np.ndarray) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 2"]] | None:
        """Corners on the board (in squares) and their pixels (centres at +0.5); None where too few are seen.

        They are looked for in a picture of 1600 pixels at the most: in larger ones that takes seconds.
        """
        import cv2

        smaller = min(1.0, LARGEST / max(image.shape[:2]))
        if smaller < 1:
            h, w = (round(smaller * n) for n in image.shape[:2])
            reduced = self.corners(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA))
            return None if reduced is None else (reduced[0], reduced[1] * [image.shape[1] / w, image.shape[0] / h])
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if not self.dictionary:
            found, uv = cv2.findChessboardCornersSB(gray, (self.columns, self.rows))
            grid = np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2)
            return (np.pad(grid, ((0, 0), (0, 1))).astype(float), uv.reshape(-1, 2) + 0.5) if found else None
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        for legacy in (False, True):  # boards of OpenCV before 4.6 begin with another colour
            board = cv2.aruco.CharucoBoard((self.columns, self.rows), 1.0, MARKER, markers)
            board.setLegacyPattern(legacy)
            uv, index, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(gray)
            if index is not None and len(index) >= LEAST_CORNERS:
                return np.asarray(board.getChessboardCorners(), float)[index.ravel()], uv.reshape(-1, 2) + 0.5
        return None


Look = tuple[int, Float[np.ndarray, "N 3"], Float[np.ndarray, "N 2"]]
"""Frame of a clip, corners on the board (in squares), and their pixels."""


def step_of(clip: Clip) -> int:
    """Frames from one look for the board to the next: of a short clip each is looked at."""
    return max(1, min(round(clip.fps / LOOKS_A_SECOND), len(clip.frames) // LEAST_LOOKS))


def looks_of(clip: Clip, board: Board, cache: Cache | None = None, tell: Tell = lambda text: None) -> list[Look]:
    """Where the board is in a clip: the looks that found it. ``cache``: where they are kept."""
    every = range(0, len(clip.frames), step_of(clip))

    def look() -> dict[str, np.ndarray]:
        tell(f"{clip.name}: looking for the board in {len(every)} pictures")
        found = [(k, *seen) for k in every if (seen := board.corners(clip.frames[k]))]
        return {
            "frame": np.concatenate([np.zeros(0, int), *(np.full(len(xyz), k) for k, xyz, _ in found)]),
            "xyz": np.concatenate([np.zeros((0, 3)), *(xyz for _, xyz, _ in found)]),
            "uv": np.concatenate([np.zeros((0, 2)), *(uv for _, _, uv in found)]),
        }

    kept = (cache or Cache()).arrays("corners", (clip.key, board, len(every)), look)
    frames = [int(k) for k in np.unique(kept["frame"])]
    return [(k, kept["xyz"][kept["frame"] == k], kept["uv"][kept["frame"] == k]) for k in frames]


def lens_of(clip: Clip, board: Board, looks: Sequence[Look] | None = None) -> Lens:
    """The lens that filmed a clip of the board: focal length and one radial term, the principal point in the middle.

    Args:
        looks: as of :func:`looks_of`; default: they are made.

    ValueError names the clip where the board is seen too little, from one side only, or does not fit.
    """
    import cv2

    w, h = clip.size
    views = [(xyz, uv) for _, xyz, uv in (looks_of(clip, board) if looks is None else looks)]
    if len(views) < LEAST_PICTURES:
        raise ValueError(
            f"{clip.name}: expected the board in {LEAST_PICTURES} pictures and more; found it in {len(views)}. Film it "
            "larger, sharper and from many sides; check --board."
        )
    views = [views[int(k)] for k in evenly(len(views), USED)]
    calibrate: Any = cv2.calibrateCamera
    fixed = cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
    fixed |= cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    error, K, bends, turns, _ = calibrate(
        [xyz.astype(np.float32) for xyz, _ in views],
        [uv.astype(np.float32).reshape(-1, 1, 2) for _, uv in views],
        (w, h),
        clip.lens.K.copy(),
        np.zeros(5),
        flags=fixed,
    )
    if error > WORST * max(w, h) / 1000:
        raise ValueError(
            f"{clip.name}: expected a flat board; found corners that are {error:.1f} pixels off. Check --board, and "
            "that the board is flat."
        )
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    if np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1))).max() < TILT:
        raise ValueError(f"{clip.name}: expected the board from many sides; found it from one. Tilt it while you film.")
    return Lens(K, np.array([float(np.ravel(bends)[0]), 0.0, 0.0, 0.0]), "board")


def with_boards(
    clips: Sequence[Clip], text: str | None, cache: Cache | None = None, tell: Tell = lambda text: None
) -> tuple[list[Clip], dict[str, Clip]]:
    """The clips without those of boards, with the lenses that these tell; and by video's name the clip of its board.

    Args:
        text: which board it is, as :meth:`Board.parse` reads it. cache: where corners are kept.

    ValueError for board clips of an unknown board, for a board that no clip shows, and for a clip of no video.
    """
    shown, others = [c for c in clips if c.kind == "board"], [c for c in clips if c.kind != "board"]
    if not shown and text is None:
        return others, {}
    if not shown:
        raise ValueError("--board: expected a clip of the board (board.mp4) in the folder; found none. Leave it out.")
    if text is None:
        raise ValueError(
            f"{shown[0].name}: expected --board to say which board it shows, such as --board 9x6 or --board "
            "5x7:DICT_4X4_50; found nothing."
        )
    board, lenses = Board.parse(text), {}
    own: dict[str, Clip] = {}
    for clip in shown:
        whose = re.sub(r"^board[\W_]*", "", clip.name, flags=re.IGNORECASE)
        if whose and whose not in [other.name for other in others]:
            raise ValueError(
                f"{clip.name}: expected the name of a video after 'board' ({', '.join(o.name for o in others)}), or "
                f"nothing; found {whose!r}. Rename it."
            )
        if whose in own:
            raise ValueError(f"{clip.name}: expected one clip of a board for {whose}; found {own[whose].name}, too.")
        if whose:
            own[whose] = clip
        if any(other.name == whose and other.lens.source == "given" for other in others):
            continue  # the lens is known: the clip may tell where the camera stands
        try:
            lenses[whose] = lens_of(clip, board, looks_of(clip, board, cache, tell)), clip.size
        except ValueError as error:
            if not whose or len(shown) == 1:
                raise
            tell(f"note: {error}")  # the other phones' clips may be good
            continue
        tell(f"{clip.name}: focal length {lenses[whose][0].K[0, 0]:.1f} pixels")
    out = []
    for other in others:
        found = lenses.get(other.name) or lenses.get("")
        fits = found is not None and found[1] == other.size and other.lens.source != "given"
        out.append(replace(other, lens=found[0]) if found is not None and fits else other)
    return out, own
