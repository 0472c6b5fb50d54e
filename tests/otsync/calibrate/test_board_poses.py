"""Cameras from a board at rest: corners that were projected through known cameras, and clips of a filmed room."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from otsync.calibrate import CalibrateOptions, calibrate
from otsync.calibrate.board_adjust import Problem
from otsync.calibrate.board_poses import cameras_by_board
from otsync.calibrate.board_rests import Rest, grid_of, poses_of, turns_of
from otsync.calibrate.board_solve import LEAST_PLACES, linked, related, solve
from otsync.calibrate.boards import Board
from otsync.calibrate.clips import Clip, pinhole
from otsync.calibrate.world import centres, degrees, laid_over
from otsync.files.cache import Cache
from otsync.simulate.phones import film
from otsync.simulate.room import dead_leaves, draw_room, look_at

from .test_boards import drawn

BOARDS = [Board(9, 6), Board(6, 6), Board(5, 7, "DICT_4X4_50")]
K = np.array([[900.0, 0, 480], [0, 900, 270], [0, 0, 1]])
SQUARE = 0.06
"""m: worlds are in metres, answers in squares."""


def ring(rng: np.random.Generator, count: int, gap: float = 50.0) -> list[np.ndarray]:
    """Cameras round the middle, degrees apart."""
    azimuths = np.radians(gap) * np.arange(count)
    stands = [np.array([2.5 * np.sin(a), rng.uniform(-0.6, 0.1), -2.5 * np.cos(a)]) for a in azimuths]
    return [look_at(stand, 0.2 * rng.normal(size=3)) for stand in stands]


def filmed(board, cameras, rng, places=12, noise=0.2, wider=1.0):
    """What each camera has of a board that rests at places in turns before two neighbours; clocks differ by minutes."""
    rests = [[] for _ in cameras]
    clocks = rng.uniform(-60, 60, len(cameras))
    grid = grid_of(board)
    time = 0.0
    for n in range(places):
        time += rng.uniform(2, 5)
        one = cameras[n % (len(cameras) - 1)]
        two = cameras[n % (len(cameras) - 1) + 1]
        middle = 0.4 * rng.normal(size=3)
        towards = (centres(one) + centres(two)) / 2 - middle
        z = -towards / np.linalg.norm(towards)
        x = np.cross([0, 1.0, 0], z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z], 1) @ Rotation.from_rotvec(0.35 * rng.normal(size=3)).as_matrix()
        world = middle + SQUARE * (grid - grid.mean(0)) * [wider, 1, 1] @ R.T
        for v, w2c in enumerate(cameras):
            local = world @ w2c[:3, :3].T + w2c[:3, 3]
            facing = (w2c[:3, :3] @ R[:, 2]) @ (local.mean(0) / np.linalg.norm(local.mean(0)))
            if (local[:, 2] < 0.3).any() or facing < np.cos(np.radians(70)):
                continue
            uv = (local @ K.T)[:, :2] / local[:, 2:] + noise * rng.normal(size=(len(grid), 2))
            around = turns_of(board)
            order = _turned(grid, around[rng.integers(len(around))])
            poses = poses_of(order, uv, K, board)
            begin = time + clocks[v] + rng.uniform(0, 0.2)
            rests[v].append(Rest(begin, begin + 1, order, uv, poses, len(around)))
    return rests


def _turned(grid, turn):
    """The corners in the order in which a detector that takes the board for the turned one gives them."""
    return np.round(grid @ turn[:3, :3].T + turn[:3, 3])


def solved_of(rests, board):
    """The adjusted cameras, all with the lens K."""
    return solve(linked(rests, [K] * len(rests), board), [K] * len(rests))


def errors(solved, cameras):
    """Degrees, and metres, of each camera; after one world is laid over the other with its scale known."""
    found = solved.w2c.copy()
    found[:, :3, 3] *= SQUARE
    over = laid_over(found, np.stack(cameras))
    moved = replace(over, scale=1.0, t=over.t + 0).camera(found)
    known = np.stack(cameras)
    shift = np.mean(centres(known) - centres(moved), axis=0)
    turn = degrees(moved[:, :3, :3] @ np.swapaxes(known[:, :3, :3], 1, 2))
    return turn, np.linalg.norm(centres(moved) + shift - centres(known), axis=1)


@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("seed", range(3))
def test_a_board_at_rest_tells_cameras_and_lengths(board, seed):
    rng = np.random.default_rng(seed)
    cameras = ring(rng, 4)
    solved = solved_of(filmed(board, cameras, rng, places=16), board)
    turn, place = errors(solved, cameras)
    assert turn.max() < 0.35 and place.max() < 0.03
    assert (solved.off < 0.5).all() and (solved.places >= LEAST_PLACES).all()


def test_derivatives_are_those_of_the_residuals():
    rng = np.random.default_rng(7)
    cameras = ring(rng, 3)
    links = linked(filmed(BOARDS[2], cameras, rng, places=9), [K] * 3, BOARDS[2])
    w2c = np.stack([links.poses[v] for v in range(3)])
    problem = Problem(links.views, w2c, np.stack([K] * 3), [0, 2], [1, 2], np.array([40.0, 10, 40, 10, 30]))
    for size in (0.0, 0.1):  # at the start, and away from it
        x = size * rng.normal(size=problem.size)
        found = problem.jacobian(x)
        for n in [*rng.choice(problem.size, 25, replace=False), problem.size - 1]:
            step = 1e-6 * np.eye(problem.size)[n]
            true = (problem.residuals(x + step) - problem.residuals(x - step)) / 2e-6
            np.testing.assert_allclose(found[:, n], true, atol=1e-4 * max(1, np.abs(true).max()))


def test_its_sigma_holds():
    z = []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        cameras = ring(rng, 3)
        solved = solved_of(filmed(BOARDS[2], cameras, rng, places=14, noise=0.4), BOARDS[2])
        for a in range(3):
            for b in range(a):
                true = cameras[a] @ np.linalg.inv(cameras[b])
                found = solved.w2c[a] @ np.linalg.inv(solved.w2c[b])
                off = float(degrees(true[:3, :3] @ found[:3, :3].T))
                z.append(off / np.hypot(solved.sigma_degrees[a], solved.sigma_degrees[b]))
    assert np.mean(np.array(z) < 1) > 0.5 and np.mean(np.array(z) < 2) > 0.9 and np.median(z) > 0.2


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(BOARDS))
def test_rests_of_two_boards_are_no_relation(seed, board):
    rng = np.random.default_rng(seed)
    cameras = ring(rng, 2)
    one, _ = filmed(board, cameras, rng, places=12)
    _, two = filmed(board, cameras, np.random.default_rng(seed + 1), places=12)
    found = related(one, two)
    assert found is None or not found.alone


def seen_by(board, w2c, places, times, rng, noise=0.1):
    """Rests of one camera: the board at places (board to world, m), for a second each from the given times on."""
    out = []
    for place, time in zip(places, times, strict=True):
        world = SQUARE * grid_of(board) @ place[:3, :3].T + place[:3, 3]
        local = world @ w2c[:3, :3].T + w2c[:3, 3]
        uv = (local @ K.T)[:, :2] / local[:, 2:] + noise * rng.normal(size=(len(world), 2))
        poses = poses_of(grid_of(board), uv, K, board)
        out.append(Rest(time, time + 1, grid_of(board), uv, poses, len(turns_of(board))))
    return out


def place_of(x, y, z, turn=(0.0, 0.0, 0.0)):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), (x, y, z)
    return out


PAIR = [look_at(np.array([x, -0.2, -2.5]), np.zeros(3)) for x in (-0.9, 0.9)]


@pytest.mark.parametrize("board", BOARDS)
def test_pieces_of_one_rest_are_one_place(board):
    """Cameras that share nothing: the one sees the board lying here, the other there, each in six pieces."""
    rng = np.random.default_rng(1)
    here, there = place_of(-0.4, 0, 0, (0.3, 0.1, 0)), place_of(0.5, 0.1, 0.2, (-0.2, 0.3, 0.1))
    times = np.arange(6) * 2.0
    one = seen_by(board, PAIR[0], [here] * 6, times, rng)
    assert related(one, seen_by(board, PAIR[1], [there] * 6, times + 7, rng)) is None
    long = replace(seen_by(board, PAIR[1], [there], [0], rng)[0], end=12.0)
    assert related(one, [long]) is None


def test_places_that_are_shared_outweigh_a_board_left_lying():
    board, rng = BOARDS[2], np.random.default_rng(2)
    places = [place_of(*rng.uniform(-0.4, 0.4, 3), 0.35 * rng.normal(size=3)) for _ in range(6)]
    times = np.cumsum(rng.uniform(2, 4, 6))
    stray = [place_of(0.2, 0.4, 0.1, (0.4, 0, 0)), place_of(-0.3, 0.3, 0.2, (0.4, 0.1, 0))]
    one = seen_by(board, PAIR[0], [stray[0]] * 8 + places, [*range(-20, -4, 2), *times], rng)
    two = seen_by(board, PAIR[1], places + [stray[1]] * 8, [*(times + 5), *range(40, 56, 2)], rng)
    found = related(one, two)
    true = PAIR[1] @ np.linalg.inv(PAIR[0])
    assert found.alone and len(found.rests) == 6
    assert float(degrees(found.pose[:3, :3] @ true[:3, :3].T)) < 1


@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("step", [0.15, 0.05])
def test_even_steps_with_one_tilt_are_not_believed(board, step):
    rng = np.random.default_rng(3)
    places, times = [place_of(-0.8 + step * n, 0, 0, (0.2, 0.1, 0)) for n in range(12)], np.arange(12) * 3.0
    one = seen_by(board, PAIR[0], places[:9], times[:9], rng)
    two = seen_by(board, PAIR[1], places[2:], times[2:] + 11, rng)
    found = related(one, two)
    assert found is None or not found.alone
    links = linked([one, two], [K, K], board)
    assert len(links.poses) < 2 and (found is None or links.alike == {0, 1})
    assert solve(links, [K, K]) is None


def test_sigma_knows_that_lenses_are_not_known_exactly():
    """Focal lengths that are half a per cent off, as a clip of the board may tell them."""
    z = []
    for seed in range(6):
        rng = np.random.default_rng(200 + seed)
        cameras = ring(rng, 2)
        links = linked(filmed(BOARDS[2], cameras, rng, places=10, noise=0.05), [K, K], BOARDS[2])
        off = [np.diag([1 + e, 1 + e, 1]) @ K + np.outer([480, 270, 0], [0, 0, -e]) for e in 0.005 * rng.normal(size=2)]
        solved = solve(links, off, [0.007, 0.007])
        true, found = relative(cameras), relative(solved.w2c)
        away = np.linalg.norm(centres(true) - SQUARE * centres(found))
        z.append(away / (SQUARE * np.hypot(*solved.sigma_position)))
    assert 0.35 < np.sqrt(np.mean(np.square(z))) < 1.6 and max(z) < 3  # nor is it far too careful


def test_squares_that_a_printer_made_wider_are_found():
    z = []
    for seed in range(4):
        rng = np.random.default_rng(300 + seed)
        cameras = ring(rng, 2)
        links = linked(filmed(BOARDS[2], cameras, rng, places=10, noise=0.1, wider=1.01), [K, K], BOARDS[2])
        solved = solve(links, [K, K])
        assert solved.wider == pytest.approx(0.01, abs=0.002)
        true, found = relative(cameras), relative(solved.w2c)
        z.append(float(degrees(true[:3, :3] @ found[:3, :3].T)) / np.hypot(*solved.sigma_degrees))
        # lengths are in the mean of both sides
        away = np.linalg.norm(centres(true) - SQUARE * 1.01**0.5 * centres(found))
        z.append(away / (SQUARE * np.hypot(*solved.sigma_position)))
    assert np.sqrt(np.mean(np.square(z))) < 1.6 and max(z) < 3


def test_a_camera_that_shares_no_place_is_left_out():
    rng = np.random.default_rng(5)
    cameras = ring(rng, 4)
    rests = filmed(BOARDS[2], cameras, rng, places=15)
    rests[3] = rests[3][:2]
    solved = solved_of(rests, BOARDS[2])
    assert np.isnan(solved.w2c[3]).all() and np.isfinite(solved.w2c[:3]).all()
    assert solved_of([rests[0], [], [], rests[3]], BOARDS[2]) is None


SIZE, FOCAL = (480, 360), 430.0
LENS = pinhole(FOCAL, SIZE, "given")


def views_of(board, cameras, poses, walls) -> list[Clip]:
    """Clips of cameras before which the board is at places for six frames each, and away for one between them."""
    picture = drawn(board)
    shift = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # OpenCV's pixels have their centres at 0
    clips = []
    for v, (w2c, wall) in enumerate(zip(cameras, walls, strict=True)):
        frames = []
        for pose in poses:
            local = w2c @ pose
            plane = np.stack([local[:3, 0], local[:3, 1], local[:3, 3]], 1)
            H = shift @ LENS.K @ plane @ np.linalg.inv(shift)
            image = cv2.warpPerspective(picture, H, SIZE, flags=cv2.INTER_AREA)
            there = cv2.warpPerspective(np.ones_like(picture), H, SIZE)[..., None] > 0
            seen = np.where(there, cv2.GaussianBlur(image, (0, 0), 0.7)[..., None], wall).astype(np.uint8)
            frames += [seen] * 6 + [wall]
        clips.append(Clip(f"board cam{v}", {}, frames, SIZE, 8.0, LENS, "board"))
    return clips


@pytest.fixture(scope="module")
def cameras_of(tmp_path_factory):
    """``cameras_by_board`` that looks for the corners of a clip once."""
    return partial(cameras_by_board, cache=Cache(tmp_path_factory.mktemp("corners")))


@pytest.fixture(scope="module")
def stood():
    """A board before two cameras: the board, clips of it, of the scene, true poses, and the side of a square."""
    board, rng = BOARDS[2], np.random.default_rng(3)
    h, w = drawn(board).shape
    cameras = [look_at(np.array([x, -0.2, -2.0]) * w * 1.1, np.zeros(3)) for x in (-0.7, 0.7)]
    poses = []
    for _ in range(8):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(0.3 * rng.normal(size=3)).as_matrix()
        pose[:3, 3] = rng.uniform(-0.25, 0.25, 3) * w - pose[:3, :3] @ [w / 2, h / 2, 0]
        poses.append(pose)
    walls = [cv2.resize(dead_leaves(np.random.default_rng(v)), SIZE, interpolation=cv2.INTER_AREA) for v in range(2)]
    shown = views_of(board, cameras, poses, walls)
    scene = [Clip(f"cam{v}", {}, [wall] * 4, SIZE, 8.0, LENS) for v, wall in enumerate(walls)]
    return board, {f"cam{v}": clip for v, clip in enumerate(shown)}, scene, cameras, 40.0  # pixels of the picture


def relative(w2c):
    return w2c[1] @ np.linalg.inv(w2c[0])


def test_cameras_are_found_from_pictures_of_a_board(cameras_of, stood):
    board, shown, scene, cameras, square = stood
    lines = []
    found = cameras_of(scene, shown, board, square=square, tell=lines.append)
    assert found.ok and found.method == "board" and found.unit == "metres"
    assert [line[:31] for line in lines if "rests" in line] == [f"board cam{v}: the board rests at " for v in range(2)]
    got, true = (relative(each) for each in ([c.w2c for c in found.cameras], cameras))
    assert float(degrees(got[:3, :3] @ true[:3, :3].T)) < 0.3
    assert np.linalg.norm(centres(got) - centres(true)) < 0.01 * np.linalg.norm(centres(true))
    assert all(0 < c.sigma_degrees < 0.5 and c.points >= 6 for c in found.cameras)
    assert len(found.points) == 24 * found.cameras[0].points  # the board's corners, at each of its places
    arbitrary = cameras_of(scene, shown, board)
    assert arbitrary.unit == "arbitrary"


def test_a_distance_tells_lengths_too(cameras_of, stood):
    board, shown, scene, _, _ = stood
    found = cameras_of(scene, shown, board, distance=("cam1", "cam0", 3.5))
    assert found.unit == "metres"
    assert np.linalg.norm(np.subtract(*(c.places[0] for c in found.cameras))) == pytest.approx(3.5)


def test_a_phone_that_was_moved_is_doubted(cameras_of, stood):
    board, shown, scene, _, _ = stood
    moved = replace(scene[1], frames=[np.roll(image, 7, 1) for image in scene[1].frames])
    found = cameras_of([scene[0], moved], shown, board)
    assert found.cameras[0].ok and "was moved" in found.cameras[1].doubt
    assert "Leave the phones where they are" in found.cameras[1].remedy
    plain = [replace(clip, frames=[np.full_like(clip.frames[0], 128)] * 4) for clip in scene]
    assert cameras_of(plain, shown, board).ok  # plain walls cannot tell


def test_what_the_board_does_not_tell_is_named(cameras_of, stood):
    board, shown, scene, _, _ = stood
    third = replace(scene[0], name="cam2")
    found = cameras_of([*scene, third], shown, board)
    assert not found.ok and "no clip shows the board to cam2" in found["cam2"].doubt and found["cam2"].w2c is None
    few = {**shown, "cam2": replace(shown["cam0"], frames=shown["cam0"].frames[:14])}
    found = cameras_of([*scene, third], few, board)
    assert "fewer than 4 places" in found["cam2"].doubt and "ten places" in found["cam2"].remedy
    larger = {**shown, "cam1": replace(shown["cam1"], size=(960, 720))}
    assert "different sizes: 960 x 720 and 480 x 360" in cameras_of(scene, larger, board)["cam1"].doubt
    alone = cameras_of(scene, {"cam0": shown["cam0"]}, board)
    assert not alone.found and "no clip shows the board to cam1" in alone["cam1"].doubt


@pytest.mark.parametrize("zoom", [0.9, 0.96, 1.05, 1.4])
def test_a_lens_that_the_board_contradicts_is_doubted(cameras_of, stood, zoom):
    board, shown, scene, _, _ = stood
    other = replace(scene[1], lens=pinhole(zoom * FOCAL, SIZE, "given"))
    found = cameras_of([scene[0], other], shown, board)
    assert found.cameras[0].ok and "say that the focal length of cam1 is" in found.cameras[1].doubt


@pytest.mark.parametrize(
    "options",
    [{"square": 0.1}, {"square": -1.0, "board": "9x6"}, {"square": 0.1, "board": "9x6", "distance": ("a", "b", 1.0)}],
)
def test_sides_of_squares_that_cannot_be_are_refused(options):
    with pytest.raises(ValueError, match="--square"):
        CalibrateOptions(**options)


@pytest.mark.slow
def test_a_white_room_is_calibrated_by_a_board(tmp_path):
    """Nothing on the walls: the background says nothing. The whole way, from video files."""
    pytest.importorskip("pycolmap")
    truth = film(
        tmp_path,
        74,
        phones=3,
        gap=60,
        walk=0,
        frames=20,
        size=(960, 540),
        board=14,
        fps=10,
        max_offset=5,
        room=draw_room(74, contrast=0.0),
    )
    found = calibrate(tmp_path, CalibrateOptions(board="5x7:DICT_4X4_50", square=0.08))
    assert found.ok and found.method == "board" and found.unit == "metres"
    for a in range(3):
        for b in range(a):
            got, true = (
                relative([each[b], each[a]])
                for each in ([c.w2c for c in found.cameras], [c.w2c for c in truth.cameras])
            )
            assert float(degrees(got[:3, :3] @ true[:3, :3].T)) < 0.3
            assert np.linalg.norm(centres(got) - centres(true)) < 0.04
    for camera, true in zip(found.cameras, truth.cameras, strict=True):
        assert camera.K[0, 0] == pytest.approx(true.K[0, 0], rel=0.006)
