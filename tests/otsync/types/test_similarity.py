"""Similarities are a group; their covariances follow what they are made of; files keep them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from otsync.types import Camera, Offsets, Similarity
from otsync.types.similarity import adjoint, rotation_of, rotation_vector

seeds = st.integers(0, 10_000)


def draw(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(
        float(rng.uniform(0.2, 4)), Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3)
    )


@settings(max_examples=40, deadline=None)
@given(seeds, seeds)
def test_they_are_a_group(i, j):
    f, g, x = draw(i), draw(j), np.random.default_rng(i).normal(size=(4, 3))
    np.testing.assert_allclose(f.after(g)(x), f(g(x)), atol=1e-9)
    np.testing.assert_allclose(f.inverse()(f(x)), x, atol=1e-9)
    np.testing.assert_allclose(f.moved(f.difference(g))(x), g(x), atol=1e-9)


@given(seeds, st.sampled_from([0.0, 1e-7, 0.3, 3.0, np.pi - 1e-7, np.pi]))
def test_the_angle_between_rotations_is_exact_near_none_and_near_a_half_turn(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    f = draw(0)
    g = Similarity(2.0, rotation_of(angle * axis / np.linalg.norm(axis)) @ f.R, f.t)
    assert f.degrees_from(g) == pytest.approx(np.degrees(angle), abs=1e-7)


@given(seeds)
def test_quaternions_are_scipys_with_w_first(seed):
    f = draw(seed)
    q = Rotation.from_matrix(f.R).as_quat()[[3, 0, 1, 2]]
    np.testing.assert_allclose(f.quaternion, q * np.sign(q[0]), atol=1e-12)
    np.testing.assert_allclose(rotation_of(rotation_vector(f.R)), f.R, atol=1e-12)
    again = Similarity.from_dict(f.with_covariance(np.eye(7)).to_dict())
    np.testing.assert_allclose(again.R, f.R, atol=1e-12)
    assert again.scale == f.scale and np.array_equal(again.covariance, np.eye(7))


@given(seeds)
def test_the_adjoint_carries_small_errors(seed):
    f, e = draw(seed), 1e-7 * np.random.default_rng(seed).normal(size=7)
    x = np.random.default_rng(seed + 1).normal(size=3)
    none = Similarity(1.0, np.eye(3), np.zeros(3))
    np.testing.assert_allclose(f.after(none.moved(e))(x), none.moved(adjoint(f) @ e).after(f)(x), atol=1e-11)


def test_covariances_are_those_of_draws():
    rng = np.random.default_rng(0)
    f, g = draw(1), draw(2)
    A, B = (0.003 * rng.normal(size=(7, 7)) for _ in range(2))
    f, g = f.with_covariance(A @ A.T), g.with_covariance(B @ B.T)
    both, back = f.after(g), f.inverse()
    draws = [
        (
            both.difference(f.moved(A @ rng.normal(size=7)).after(g.moved(B @ rng.normal(size=7)))),
            back.difference(f.moved(A @ rng.normal(size=7)).inverse()),
        )
        for _ in range(3000)
    ]
    for sample, expected in zip(map(np.array, zip(*draws, strict=True)), (both, back), strict=True):
        spread = np.sqrt(np.diag(expected.covariance))
        np.testing.assert_allclose(np.std(sample, 0), spread, rtol=0.1)


def test_sigma_at_a_point_grows_with_its_distance():
    turn = np.zeros((7, 7))
    turn[:3, :3] = np.radians(1) ** 2 * np.eye(3)
    f = Similarity(1.0, np.eye(3), np.zeros(3), turn)
    assert f.sigma_at(np.zeros(3)) == 0
    assert f.sigma_at(np.array([0, 0, 10.0])) == pytest.approx(10 * np.radians(1) * np.sqrt(2))
    assert f.rotation_sigma == pytest.approx(np.sqrt(3))
    assert np.isnan(draw(0).rotation_sigma) and np.isnan(draw(0).sigma_at(np.ones(3)))


def test_cameras_see_what_they_saw():
    rng = np.random.default_rng(0)
    K = np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]])
    w2c = np.tile(np.eye(4), (5, 1, 1))
    w2c[:, :3, :3], w2c[:, :3, 3] = (
        Rotation.from_quat(rng.normal(size=(5, 4))).as_matrix(),
        rng.normal(size=(5, 3)) + np.array([0, 0, 9]),
    )
    f, x = draw(3), rng.normal(size=(7, 3))
    for moving in (w2c, w2c[0]):
        before = Camera(K, moving, 640, 360)
        after = f.camera(before)
        for one, other in zip(np.atleast_3d(before.w2c.T).T, np.atleast_3d(after.w2c.T).T, strict=True):
            np.testing.assert_allclose(
                f.scale * (x @ one[:3, :3].T + one[:3, 3]), f(x) @ other[:3, :3].T + other[:3, 3]
            )


@pytest.mark.parametrize(
    "bad",
    [
        {"scale": 0, "quaternion": [1, 0, 0, 0], "translation": [0, 0, 0]},
        {"scale": 1, "quaternion": [0, 0, 0, 0], "translation": [0, 0, 0]},
        {"scale": 1, "quaternion": [1, 0, 0], "translation": [0, 0, 0]},
        {"scale": 1, "quaternion": [1, 0, 0, 0]},
        {"scale": 1, "quaternion": [1, 0, 0, 0], "translation": [0, 0, 0], "covariance": [[1]]},
        "turned",
    ],
)
def test_a_file_with_an_unsound_transform_is_refused(bad, tmp_path):
    import json

    known = Offsets.known(["a", "b"], np.zeros(2), 30, transforms=[draw(0), None])
    known.save(tmp_path / "o.json")
    loaded = Offsets.load(tmp_path / "o.json")
    np.testing.assert_allclose(loaded.transforms[0].t, known.transforms[0].t)
    assert loaded.transforms[1] is None
    document = json.loads((tmp_path / "o.json").read_text())
    document["videos"][1]["transform"] = bad
    (tmp_path / "o.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match="videos, b"):
        Offsets.load(tmp_path / "o.json")


def test_files_without_transforms_are_read_as_before(tmp_path):
    Offsets.known(["a", "b"], np.zeros(2), 30).save(tmp_path / "o.json")
    assert "transform" not in (tmp_path / "o.json").read_text()
    assert Offsets.load(tmp_path / "o.json").transforms == ()
    with pytest.raises(ValueError, match="transforms"):
        Offsets.known(["a", "b"], np.zeros(2), 30, transforms=[None])
