"""Similarities of points against scipy; the joint fit on curves that were made with their answer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from otsync import TrackSet
from otsync.clocks.splines import TrackSplines
from otsync.frames import kernels
from otsync.frames.clouds import clouds, sizes
from otsync.frames.fit import State, fit_jointly, linearise, read
from otsync.types import Clock, Similarity


def draw(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(
        float(rng.uniform(0.5, 2)), Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3)
    )


@pytest.mark.parametrize("seed", range(5))
def test_points_fit_as_scipy_fits_them(seed):
    rng = np.random.default_rng(seed)
    f, b = draw(seed), rng.normal(size=(40, 3))
    a = f(b) + 0.01 * rng.normal(size=(40, 3))
    found = np.zeros(13)
    assert kernels.fit_points(a, b, 40, found) > 0.1
    middle_a, middle_b = a.mean(0), b.mean(0)
    R = Rotation.align_vectors(a - middle_a, b - middle_b)[0].as_matrix()
    scale = np.sqrt(((a - middle_a) ** 2).sum() / ((b - middle_b) ** 2).sum())
    np.testing.assert_allclose(found[1:10].reshape(3, 3), R, atol=1e-9)
    np.testing.assert_allclose(found[0], scale)
    np.testing.assert_allclose(found[10:], middle_a - scale * R @ middle_b)


def test_a_mirror_image_is_fitted_by_a_rotation():
    rng = np.random.default_rng(0)
    b, found = rng.normal(size=(30, 3)), np.zeros(13)
    kernels.fit_points(b * [1, 1, -1], b, 30, found)
    assert np.linalg.det(found[1:10].reshape(3, 3)) == pytest.approx(1)


def test_points_on_a_line_are_told():
    b, found = np.outer(np.linspace(-1, 1, 20), [1.0, 2, 3]), np.zeros(13)
    assert kernels.fit_points(b, b, 20, found) < 1e-6


def curves(offset: float, f: Similarity, noise: float = 0.0, seed: int = 0, n: int = 40, smoothing: float = 1e-4):
    """Curves of n points in both frames; b started ``offset`` seconds later."""
    rng = np.random.default_rng(seed)
    where, phase = rng.normal(size=(n, 1, 3)), rng.uniform(0, 6, (n, 4, 1, 3))
    size, speed = 0.2 * rng.normal(size=(n, 4, 1, 3)), np.array([0.6, 1.1, 1.7, 2.3])[None, :, None, None]

    def at(t):
        return where + (size * np.sin(speed * 2 * t[None, None, :, None] + phase)).sum(1)

    t = np.arange(90) / 30
    a, b = at(t), f.inverse()(at(t + offset))
    a, b = a + noise * rng.normal(size=a.shape), b + noise / f.scale * rng.normal(size=b.shape)
    return TrackSplines(t, a, smoothing=smoothing), TrackSplines(t, b, smoothing=smoothing)


@pytest.mark.parametrize("seed", range(3))
def test_exact_curves_are_fitted_exactly(seed):
    f, offset = draw(seed), 0.213
    start = f.moved(np.r_[0.1, -0.1, 0.05, 0.05, 0.1, 0, 0.1])
    found = fit_jointly(*curves(offset, f, seed=seed), Clock(0.15), start, 14 / 30, iterations=40)
    assert abs(found.clock.offset - offset) * 30 < 2e-3
    assert found.transform.degrees_from(f) < 0.02
    assert found.transform.scale == pytest.approx(f.scale, rel=1e-3)


def test_one_step_goes_nearly_all_the_way():
    """Near the answer the problem is linear: with a wrong Jacobian much would be left after a Gauss-Newton step."""
    f = draw(1)
    a, b = curves(0.2, f, noise=0.02)
    own = read(a), read(b)
    state = State.of(a, b, Clock(0.2031), f.moved(np.full(7, 0.01)))
    first = linearise(a, b, own, state, 14 / 30).step()
    second = linearise(a, b, own, state.stepped(first), 14 / 30).step()
    assert np.linalg.norm(second[:5]) < 0.3 * np.linalg.norm(first[:5])


def test_sigmas_cover_the_errors():
    z = []
    for seed in range(30):
        f = draw(seed)
        found = fit_jointly(*curves(0.1, f, noise=0.03, seed=seed, smoothing=1.0), Clock(0.1), f, 14 / 30)
        away = found.transform.difference(f)
        z.append(
            [
                (found.clock.offset - 0.1) / np.sqrt(found.offset_variance),
                *(away[:4] / np.sqrt(np.diag(found.transform.covariance)[:4])),
            ]
        )
    rms = np.sqrt(np.mean(np.square(z), 0))
    assert (rms < 1.6).all() and (rms > 0.3).all()


def test_nothing_in_common_is_no_answer():
    a, b = curves(0.0, draw(0))
    assert fit_jointly(a, b, Clock(10.0), draw(0), 14 / 30) is None


@pytest.mark.parametrize("seed", range(3))
def test_a_fit_begins_where_it_is_told_to(seed):
    f = draw(seed)
    a, b = curves(0.2, f, seed=seed)
    start = State.of(a, b, Clock(0.2), f).transform(np.zeros((8, 8)))
    np.testing.assert_allclose(start.t, f.t, atol=1e-9)
    np.testing.assert_allclose(start.R, f.R, atol=1e-12)
    assert start.scale == pytest.approx(f.scale)


def test_exchanging_the_videos_changes_no_misfit():
    """Distances count in the unit midway between the frames, whichever video is called a."""
    rng = np.random.default_rng(0)
    f = draw(3)
    y = rng.normal(size=(6, 12, 3))
    x = f(y) + 0.1 * rng.normal(size=y.shape)
    seen = np.ones((6, 12), bool)
    errors = np.empty((2, 6))
    for out, first, second, g in zip(errors, (x, y), (y, x), (f, f.inverse()), strict=True):
        kernels.misfits(first, seen, second, seen, 0, 1, 5, np.r_[g.scale, g.R.ravel(), g.t], 1.0, out)
    np.testing.assert_allclose(errors[0], errors[1])
    assert abs(f.scale - 1) > 0.1 and errors.min() > 0


@pytest.mark.parametrize("k", range(1, 8))
def test_covariances_are_of_the_frames_own_changes(k):
    """A small step of the fit's parameters changes the similarity as its covariance says."""
    f = draw(4)
    a, b = curves(0.2, f)
    state = State.of(a, b, Clock(0.2), f.moved(np.full(7, 0.05)))
    h = 1e-5 * np.eye(8)[k]
    there, back = (state.stepped(s * h).transform(np.zeros((8, 8))) for s in (1, -1))
    change = back.difference(there) / 2e-5
    told = state.transform(np.outer(np.eye(8)[k], np.eye(8)[k])).covariance
    np.testing.assert_allclose(told, np.outer(change, change), atol=1e-4 * np.abs(told).max())


def test_units_are_midway_between_what_extents_and_speeds_say():
    """b sees the same points move as fast, but those at the rim of the scene are missing."""
    rng = np.random.default_rng(0)
    t = np.arange(60) / 30
    x = rng.normal(size=(40, 1, 3)) + 0.2 * np.sin(rng.uniform(2, 5, (40, 1, 3)) * t[None, :, None])
    inner = np.argsort(np.linalg.norm(x.mean(1), axis=1))[:20]
    a, b = TrackSet(x, fps=30), TrackSet(3.0 * x[inner], fps=30)
    one, other = clouds(a, b, 100)
    (extent_a, hop_a), (extent_b, hop_b) = sizes(a), sizes(b)
    assert extent_b / extent_a < 0.9 * hop_b / hop_a
    assert other.unit / one.unit == pytest.approx(np.sqrt(extent_b / extent_a * hop_b / hop_a))
