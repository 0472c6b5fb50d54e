"""Static cameras that a mapper leaves out."""

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
