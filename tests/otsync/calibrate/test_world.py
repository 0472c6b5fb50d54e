"""Similarities of worlds against random ones; which way is up, whatever way the phones are held."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from otsync.calibrate.poses import bridged
from otsync.calibrate.world import Similar, centres, degrees, laid_over, upright
from tests.recording_world import ring


def poses(n: int = 7) -> np.ndarray:
    return np.stack([camera.w2c for camera in ring(n)])


def similar(seed: int = 0) -> Similar:
    rng = np.random.default_rng(seed)
    return Similar(float(rng.uniform(0.2, 5)), Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3))


@pytest.mark.parametrize("seed", range(4))
def test_a_similarity_moves_cameras_and_points_alike(seed):
    world, rng = similar(seed), np.random.default_rng(seed)
    w2c, x = poses(1)[0], rng.normal(size=(5, 3))
    moved = world.camera(w2c)
    before = x @ w2c[:3, :3].T + w2c[:3, 3]
    after = world(x) @ moved[:3, :3].T + moved[:3, 3]
    np.testing.assert_allclose(after, world.scale * before, atol=1e-9)
    np.testing.assert_allclose(centres(moved), world(centres(w2c)), atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_one_world_is_laid_over_another_in_spite_of_a_wrong_camera(seed):
    world, a = similar(seed), poses()
    b = world.camera(a)
    wrong = b.copy()
    wrong[2] = b[5]
    found = laid_over(a, wrong)
    off = np.delete(found.camera(a), 2, 0)
    np.testing.assert_allclose(off, np.delete(b, 2, 0), atol=2e-3 * world.scale)


def test_one_camera_fixes_no_similarity():
    with pytest.raises(ValueError, match="two and more"):
        laid_over(poses(1), poses(1))


@pytest.mark.parametrize("turned", [0, 90, 180, 270])
def test_up_is_up_however_phones_are_held(turned):
    """The ring stands upright in a world with y down; what a turned phone stores is turned back by its players."""
    level = poses()
    roll = Rotation.from_euler("z", -turned, degrees=True).as_matrix()  # a player turns by +turned: clockwise, y down
    stored = level.copy()
    stored[:, :3, :3], stored[:, :3, 3] = roll @ level[:, :3, :3], level[:, :3, 3] @ roll.T
    world = similar(3)
    found = upright([world.camera(w) for w in stored], [turned] * len(stored))
    up = found.R @ world.R @ np.array([0, -1.0, 0])
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)


def test_the_unit_is_that_of_a_known_distance_else_a_usual_one():
    a = poses()
    ends = centres(a[0]), centres(a[3])
    metres = upright(list(a), [0] * len(a), (*ends, 4.2))
    np.testing.assert_allclose(np.linalg.norm(metres(ends[0]) - metres(ends[1])), 4.2)
    usual = upright(list(a), [0] * len(a))
    assert np.median(np.linalg.norm(centres(usual.camera(a)), axis=1)) == pytest.approx(3.0)


def test_poses_between_found_ones_lie_between_them():
    R = Rotation.from_euler("y", [[0], [10], [20], [30], [40]], degrees=True).as_matrix().reshape(-1, 3, 3)
    w2c = np.tile(np.eye(4), (5, 1, 1))
    w2c[:, :3, :3] = R
    w2c[:, :3, 3] = -np.einsum("tij,tj->ti", R, np.outer(np.arange(5), [1.0, 2, 3]))
    holes = w2c.copy()
    found = np.array([False, True, False, True, False])
    holes[~found] = np.eye(4)
    filled = bridged(holes, found)
    np.testing.assert_allclose(filled[1:4], w2c[1:4], atol=1e-9)
    np.testing.assert_allclose(filled[[0, 4]], w2c[[1, 3]], atol=1e-9)
    with pytest.raises(ValueError, match="at least one"):
        bridged(holes, np.zeros(5, bool))


def test_degrees_of_a_rotation():
    R = Rotation.from_rotvec(np.radians([0, 37.0, 0])).as_matrix()
    assert float(degrees(R)) == pytest.approx(37.0)
