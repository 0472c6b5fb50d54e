"""Static cameras that a mapper leaves out, and the adjustment to every match that obeys."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync.calibrate.clips import Lens
from otsync.calibrate.mapping import Model, Pictures
from otsync.calibrate.stills import Picture
from otsync.calibrate.world import centres, degrees

poselib = pytest.importorskip("poselib", reason="needs the extra calibrate")

K = np.array([[520.0, 0, 320], [0, 520, 180], [0, 0, 1]])


def looking(azimuth: float) -> np.ndarray:
    """World to camera from a circle of radius 3 to its middle."""
    eye = 3 * np.array([np.sin(azimuth), 0.1 * np.cos(3 * azimuth), -np.cos(azimuth)])
    z = -eye / np.linalg.norm(eye)
    x = np.cross([0, 1.0, 0], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return np.block([[R, -(R @ eye)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def rig(seed: int, matches: int, right: float, known: bool = True):
    """Five cameras, the third of which the model lacks; of its matches a share is right."""
    rng = np.random.default_rng(seed)
    poses = np.stack([looking(0.35 * k) for k in range(5)])
    lens = Lens(K, None, "given" if known else "guessed")
    picture = Picture(-1, np.zeros((360, 640, 3), np.uint8))
    pictures = Pictures(tuple("abcde"), np.arange(5), (picture,) * 5, (lens,) * 5, (False,) * 5)
    placed = np.array([0, 1, 3, 4])
    nothing = np.zeros((0, 2), int)
    halves = np.stack([poses[placed]] * 2)
    model = Model(
        placed, poses[placed], np.full(5, 520.0), np.zeros(5), np.zeros((0, 3)), nothing, nothing * 1.0, 0.5, halves
    )
    found = {}
    for other in placed:
        xyz = rng.uniform(-1, 1, (matches, 3))
        uv = []
        for k in (other, 2):
            q = xyz @ poses[k, :3, :3].T + poses[k, :3, 3]
            uv.append(q[:, :2] / q[:, 2:] * 520 + [320, 180] + 0.2 * rng.normal(size=(matches, 2)))
        wrong = rng.random(matches) > right
        uv[1][wrong] = rng.uniform([0, 0], [640, 360], (int(wrong.sum()), 2))
        low, high = sorted((int(other), 2))
        found[low, high] = np.concatenate(uv if other < 2 else uv[::-1], 1)
    return model, found, pictures, poses


@pytest.mark.parametrize("seed", range(3))
def test_a_camera_with_few_right_matches_is_placed_by_all_of_them(seed):
    from otsync.calibrate.left_out import with_left_out

    model, matches, pictures, poses = rig(seed, 40, 0.4)
    found = with_left_out(model, matches, pictures)
    assert found.pictures.tolist() == [0, 1, 2, 3, 4]
    assert degrees(found.w2c[2, :3, :3] @ poses[2, :3, :3].T) < 0.5
    assert np.linalg.norm(centres(found.w2c[2]) - centres(poses[2])) < 0.03
    np.testing.assert_array_equal(found.w2c[[0, 1, 3, 4]], model.w2c)  # the others stay
    assert found.halves.shape == (2, 5, 4, 4)


def test_what_was_seen_stays_with_its_picture():
    from otsync.calibrate.left_out import with_left_out

    model, matches, pictures, _ = rig(0, 40, 0.6)
    model = replace(model, points=np.ones((2, 3)), seen=np.array([[1, 0], [2, 1]]), uv=np.ones((2, 2)))
    found = with_left_out(model, matches, pictures)
    assert [int(found.pictures[n]) for n in found.seen[:, 0]] == [1, 3]


def test_noise_few_matches_and_unknown_lenses_place_nothing():
    from otsync.calibrate.left_out import with_left_out

    for model, matches, pictures, _ in (rig(1, 60, 0.0), rig(1, 5, 1.0), rig(1, 40, 0.6, known=False)):
        assert with_left_out(model, matches, pictures).pictures.tolist() == [0, 1, 3, 4]


def all_pairs(seed: int, right: float = 0.8, points: int = 80):
    """The same cameras, all placed; every pair sees the same points, and a share of each pair's matches is right."""
    rng = np.random.default_rng(seed)
    model, _, pictures, poses = rig(seed, 1, 1.0)
    xyz = rng.uniform(-1, 1, (points, 3))
    q = np.einsum("kij,nj->kni", poses[:, :3, :3], xyz) + poses[:, None, :3, 3]
    uv = q[..., :2] / q[..., 2:] * 520 + [320, 180] + 0.2 * rng.normal(size=(5, points, 2))
    matches = {}
    for a in range(5):
        for b in range(a + 1, 5):
            there = uv[b].copy()
            wrong = rng.random(points) > right
            there[wrong] = rng.uniform([0, 0], [640, 360], (int(wrong.sum()), 2))
            matches[a, b] = np.concatenate([uv[a], there], 1)
    return replace(model, pictures=np.arange(5), w2c=poses.copy(), halves=model.halves[:0]), matches, pictures, poses


def test_adjustment_to_all_matches_brings_cameras_nearer_and_leaves_out_wrong_matches():
    pytest.importorskip("pycolmap", reason="needs the extra calibrate")
    from otsync.calibrate.adjusted import adjusted
    from otsync.calibrate.world import laid_over

    model, matches, pictures, poses = all_pairs(3)
    model.w2c[:, :3, 3] += 0.004 * np.random.default_rng(0).normal(size=(5, 3))

    def off(w2c):
        moved = laid_over(w2c, poses).camera(w2c)
        return np.linalg.norm(centres(moved) - centres(poses), axis=1).max()

    found = adjusted(model, matches, pictures)
    assert off(found.w2c) < 0.5 * off(model.w2c)
    assert found.error < 0.5 and found.halves.shape == (2, 5, 4, 4)
    assert 70 < len(found.points) < 110  # 80, and some of the wrong ones lie on epipolar lines
    np.testing.assert_array_equal(found.w2c, adjusted(model, matches, pictures).w2c)


def test_a_picture_in_which_too_few_matches_obey_stays_where_it_is():
    pytest.importorskip("pycolmap", reason="needs the extra calibrate")
    from otsync.calibrate.adjusted import adjusted

    model, matches, pictures, _ = all_pairs(4, 1.0)
    model.w2c[4, :3, 3] += 1.0  # its matches obey no more
    found = adjusted(model, matches, pictures)
    np.testing.assert_array_equal(found.w2c[4], model.w2c[4])
    assert 4 not in found.seen[:, 0] and len(found.points) >= 70
