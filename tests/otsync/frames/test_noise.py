"""Errors along the lines of sight: their variances are read off, and they do not turn the answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from otsync.clocks.splines import TrackSplines
from otsync.frames import kernels_fit
from otsync.frames.clouds import line_of_sight
from otsync.frames.fit import fit_jointly
from otsync.frames.noise import Metric, Noise
from otsync.simulate import simulate
from otsync.types import Clock, Similarity

F = Similarity(1.3, Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([0.5, -2.0, 1.0]))
SIGHT_A, SIGHT_B = np.array([0.0, 0.0, 1.0]), np.array([np.sin(0.8), 0.0, np.cos(0.8)])


def deep(depth: float, seed: int, n: int = 60):
    """Curves of n points seen from two cameras: depth drifts by ``depth``, all else by a sixth of it."""
    rng = np.random.default_rng(seed)
    t = np.arange(120) / 30
    size, phase = 0.15 * rng.normal(size=(n, 4, 1, 3)), rng.uniform(0, 6, (n, 4, 1, 3))
    speed = np.array([1.2, 2.2, 3.4, 4.6])[None, :, None, None]

    def at(t):
        return where + (size * np.sin(speed * t[None, None, :, None] + phase)).sum(1)

    def drift(k: int):
        turn = rng.uniform(2, 7, (n, 1, k)) * t[:, None] + rng.uniform(0, 6, (n, 1, k))
        return depth * np.sqrt(2) * np.sin(turn)

    where = rng.normal(size=(n, 1, 3))
    out = []
    for sight in (SIGHT_A, SIGHT_B):
        out.append(at(t) + drift(1) * sight + drift(3) / 6)
    back = F.inverse()
    a, b = TrackSplines(t, out[0]), TrackSplines(t, back(out[1]))
    towards = np.tile(SIGHT_A, (n, 1)), np.tile(SIGHT_B @ F.R, (n, 1))
    return a, b, towards


def fitted(depth: float, seed: int, sighted: bool):
    a, b, sight = deep(depth, seed)
    return fit_jointly(a, b, Clock(0.0), F, 14 / 30, sight=sight if sighted else None, iterations=40, tolerance=1e-7)


def turns(depth: float, sighted: bool) -> np.ndarray:
    """(seeds, 3) rotation vectors by which the answer is off, in a's frame."""
    found = [fitted(depth, seed, sighted).transform.R @ F.R.T for seed in range(12)]
    return Rotation.from_matrix(found).as_rotvec(degrees=True)


def test_errors_of_depth_turn_no_answer_and_count_for_less():
    """Errors as large as the motion: their mean over worlds stays near none, and they scatter far less than without."""
    sighted, even = turns(0.2, True), turns(0.2, False)
    spread = np.sqrt((sighted**2).sum(1).mean())
    assert spread < 0.6 * np.sqrt((even**2).sum(1).mean())
    assert (np.abs(sighted.mean(0)) < 3 * sighted.std(0) / np.sqrt(len(sighted)) + 0.05).all()


def test_exchanged_videos_have_the_inverse_answer():
    a, b, sight = deep(0.1, 0)
    options = {"iterations": 60, "tolerance": 1e-9}
    one = fit_jointly(a, b, Clock(0.01), F, 14 / 30, sight=sight, **options)
    two = fit_jointly(b, a, Clock(-0.01), F.inverse(), 14 / 30, sight=sight[::-1], **options)
    assert two.clock.offset == pytest.approx(-one.clock.offset, abs=1e-6)
    assert two.transform.after(one.transform).degrees_from(Similarity(1.0, np.eye(3), np.zeros(3))) < 1e-3
    assert two.transform.scale == pytest.approx(1 / one.transform.scale, rel=1e-5)


@pytest.mark.parametrize("variances", [(0.5, 0.2, 0.3), (0.0, 0.0, 1.0), (0.0, 0.7, 0.1)])
def test_variances_are_read_off(variances):
    rng = np.random.default_rng(0)
    M, T = 30, 400
    sight = tuple(v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, M, 3)))
    own = [np.sqrt(v) * rng.normal(size=(M, T, 1)) * s[:, None] for v, s in zip(variances[:2], sight, strict=True)]
    u = own[0] + own[1] + np.sqrt(variances[2]) * rng.normal(size=(M, T, 3))
    products, count = np.zeros((M, 2, 3, 3)), np.zeros((M, 2))
    slow = np.concatenate([2 * u, np.zeros((M, T, 6))], 2)  # the slow part is twice the residual, the fast minus once
    weight, used = np.ones((M, T)), np.ones((M, T), bool)
    kernels_fit.scatter(u, np.zeros_like(u), slow, np.zeros(3), used, weight, weight, products, count)
    noise = Noise.of(sight, products, count)
    share = np.array(variances) / (sum(variances[:2]) + 3 * variances[2])
    share[2] = max(share[2], 0.02 * share.sum())
    np.testing.assert_allclose(noise.variances, [share, share], atol=0.06)


def test_a_metric_is_the_inverse_of_what_both_videos_err():
    rng = np.random.default_rng(1)
    sight = tuple(v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 5, 3)))
    metric = Noise(np.array([[0.5, 0.2, 0.1], [0.1, 0.0, 0.4]])).metric(sight)
    np.testing.assert_allclose(
        metric.inverse @ (metric.of_a + metric.of_b), np.broadcast_to(np.eye(3), (5, 2, 3, 3)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(metric.inverse), 1)
    along = np.einsum("md,mde,me->m", sight[0], metric.of_a[:, 0], sight[0])
    across = np.einsum("md,mde,me->m", sight[0], metric.of_b[:, 1], sight[1])
    assert (along > 0).all() and np.isfinite(across).all()
    even = Metric.even(2)
    np.testing.assert_array_equal(even.of_a + even.of_b, even.inverse)


def test_no_scatter_is_no_noise():
    sight = np.eye(3), np.eye(3)
    assert Noise.of(sight, np.zeros((3, 2, 3, 3)), np.ones((3, 2))) is None


def test_lines_of_sight_are_of_the_videos_frame():
    (a, _), _ = simulate("tennis", preset="clean", own_frames=True, seed=1)
    towards = line_of_sight(a)
    np.testing.assert_allclose(np.linalg.norm(towards, axis=1), 1)
    depth = a.camera.to_camera(a.camera.center + towards[:, None, :])[:, 0, 2]
    assert (depth > 0.5).all()  # what it sees lies before it
    assert line_of_sight(replace(a, camera=None, uv=None)) is None
