"""Lenses from pictures of boards that were drawn through a known lens."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from otsync.calibrate.boards import Board, lens_of, with_boards
from otsync.calibrate.clips import Clip, pinhole

SIZE, FOCAL = (480, 360), 430.0
SQUARE = 40
"""Pixels of a square on the board's own picture."""


def drawn(board: Board) -> np.ndarray:
    """The board's picture, with a white margin of a square."""
    if board.dictionary:
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        made = cv2.aruco.CharucoBoard((board.columns, board.rows), 1.0, 0.75, markers)
        inner = made.generateImage((SQUARE * board.columns, SQUARE * board.rows))
    else:
        squares = np.indices((board.rows + 1, board.columns + 1)).sum(0) % 2
        inner = np.kron(squares * 255, np.ones((SQUARE, SQUARE))).astype(np.uint8)
    return np.pad(inner, SQUARE, constant_values=255)


def clip_of(board: Board, views: int = 10, tilt: float = 35.0, name: str = "board") -> Clip:
    """Views of the board, turned by up to ``tilt`` degrees, through a lens of focal length ``FOCAL``."""
    picture, rng, images = drawn(board), np.random.default_rng(4), []
    h, w = picture.shape
    K = pinhole(FOCAL, SIZE, "given").K
    for _ in range(views):
        R = Rotation.from_euler("xyz", rng.uniform(-tilt, tilt, 3), degrees=True).as_matrix()
        t = np.array([*rng.uniform(-20, 20, 2), 1.35 * w])
        plane = np.stack([R[:, 0], R[:, 1], t - R[:, 0] * w / 2 - R[:, 1] * h / 2], 1)
        shift = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # OpenCV's pixels have their centres at 0
        H = shift @ K @ plane @ np.linalg.inv(shift)
        image = cv2.warpPerspective(picture, H, SIZE, flags=cv2.INTER_AREA, borderValue=200)
        images.append(np.repeat(cv2.GaussianBlur(image, (0, 0), 0.7)[..., None], 3, 2))
    return Clip(name, {}, images, SIZE, 30.0, pinhole(0.85 * SIZE[0], SIZE, "guessed"), "board")


BOARDS = [Board(7, 5), Board(5, 7, "DICT_4X4_50")]


@pytest.mark.parametrize("board", BOARDS)
def test_the_lens_of_a_board(board):
    lens = lens_of(clip_of(board), board)
    assert lens.K[0, 0] == pytest.approx(FOCAL, rel=0.01) and lens.source == "board" and lens.known
    assert abs(lens.distortion[0]) < 0.03


def test_too_little_of_a_board_is_refused():
    board = BOARDS[0]
    with pytest.raises(ValueError, match="8 pictures and more; found it in 3"):
        lens_of(clip_of(board, views=3), board)
    with pytest.raises(ValueError, match="from many sides"):
        lens_of(clip_of(board, tilt=3), board)
    with pytest.raises(ValueError, match="found it in 0"):
        lens_of(clip_of(board), Board(9, 4))


def test_each_video_gets_the_lens_of_its_board():
    board = BOARDS[0]
    guessed = pinhole(400, SIZE, "guessed")
    left, right = (Clip(name, {}, [], SIZE, 30.0, guessed) for name in ("left", "right"))
    small = replace(left, name="small", size=(240, 180))
    known = replace(left, name="known", lens=pinhole(999, SIZE, "given"))
    own, shown = with_boards([left, right, small, clip_of(board, name="board_left")], "7x5")
    assert list(shown) == ["left"] and shown["left"].name == "board_left"
    assert [c.lens.source for c in own] == ["board", "guessed", "guessed"]
    every, shown = with_boards([left, right, small, known, clip_of(board)], "7x5")
    assert not shown  # a clip of all lenses tells no place
    assert [c.lens.source for c in every] == ["board", "board", "guessed", "given"]
    assert with_boards([left, right], None) == ([left, right], {})


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("board", None, "--board"),
        ("board_me", "7x5", "found 'me'"),
        ("board", "7 by 5", "9x6"),
        ("left", "7x5", "none"),
    ],
)
def test_boards_that_nobody_knows_are_refused(name, text, words):
    left = Clip("left", {}, [], SIZE, 30.0, pinhole(400, SIZE, "guessed"))
    shown = replace(left, name=name, kind="board" if name != "left" else "scene")
    with pytest.raises(ValueError, match=words):
        with_boards([left, shown], text)


@pytest.mark.parametrize("text", ["9", "2x9", "5x7:DICT_NONE", "5x7:4X4"])
def test_unsound_names_of_boards_are_refused(text):
    with pytest.raises(ValueError, match="--board"):
        Board.parse(text)
