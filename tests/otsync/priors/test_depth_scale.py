"""Scale and shift of estimated depth: made up with their answers, noise, outliers and flicker; what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from otsync.priors.depth_scale import (
    Limits,
    Untied,
    as_inverse,
    brought,
    depth_of,
    fit_line,
    noise,
    steadied,
    tie_moving,
    tie_static,
)


def points(n: int, seed: int = 0, low: float = 2.0, high: float = 9.0) -> np.ndarray:
    """Depths of points."""
    return np.random.default_rng(seed).uniform(low, high, n)


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.5])
@pytest.mark.parametrize("shift", [True, False])
def test_a_line_is_found_among_outliers(outliers, shift):
    rng = np.random.default_rng(1)
    q = 1 / points(200)
    a, b = 0.02, 0.07 if shift else 0.0
    d = (q * (1 + 0.02 * rng.normal(size=200)) - b) / a
    wrong = rng.permutation(200)[: int(outliers * 200)]
    d[wrong] = rng.uniform(d.min(), d.max(), len(wrong)) * 1.7
    line = fit_line(d, q, noise(q, np.zeros(200)), shift=shift)
    ideal = np.abs((line.scale * (q - b) / a + line.shift) / q - 1)
    assert np.median(ideal) < 0.01 and ideal.max() < 0.04
    assert line.agree[np.setdiff1d(np.arange(200), wrong)].mean() > 0.97
    assert line.error < 0.03


def test_an_estimator_in_other_units_gives_the_same_depth():
    rng = np.random.default_rng(2)
    q = 1 / points(80)
    d = q * (1 + 0.03 * rng.normal(size=80))
    one, other = (fit_line(x, q, noise(q, np.zeros(80))) for x in (d, 700 * d - 30))
    np.testing.assert_allclose(one.scale * d + one.shift, other.scale * (700 * d - 30) + other.shift, rtol=1e-6)
    again = fit_line(d, q, noise(q, np.zeros(80)))
    assert (again.scale, again.shift) == (one.scale, one.shift)  # what is drawn is drawn alike


@pytest.mark.parametrize(
    "d, q, says",
    [
        (np.arange(5.0), np.arange(1.0, 6), "5 points, fewer than 12"),
        (-np.linspace(0.1, 1, 40), np.linspace(0.1, 1, 40), "near is far"),
        (np.linspace(0, 1, 40), np.full(40, 0.2) + np.linspace(0, 1e-3, 40), "one depth"),
        (np.random.default_rng(0).uniform(0, 1, 300), np.random.default_rng(1).uniform(0.1, 10, 300) ** 3, "agree"),
    ],
)
def test_points_that_tell_no_line_are_refused(d, q, says):
    with pytest.raises(Untied, match=says):
        fit_line(d, q, noise(q, np.zeros(len(q))))


def test_one_depth_is_enough_for_a_scale():
    q = np.full(40, 0.25)
    assert fit_line(5 * q, q, noise(q, np.zeros(40)), shift=False).scale == pytest.approx(0.2)


def flickering(z: np.ndarray, frames: int, seed: int, *, shift: bool = True) -> np.ndarray:
    """(T,N) what an estimator says of points at depths ``z``, of another scale and shift in every frame."""
    rng = np.random.default_rng(seed)
    a = 30 * np.exp(0.1 * rng.normal(size=(frames, 1)))
    b = 2 * rng.normal(size=(frames, 1)) if shift else 0.0
    return a / z + b


def test_flicker_is_taken_out():
    z = points(400, seed=3)
    d = flickering(z, 12, 4)
    d[:, 100:180] = np.where(np.random.default_rng(5).random((12, 80)) < 0.3, np.nan, d[:, 100:180])
    frames = steadied(d, shift=True)
    now = frames[:, :1] * d + frames[:, 1:]
    spread = np.nanmax(now, 0) - np.nanmin(now, 0)
    assert spread.max() < 1e-3 * np.nanstd(d)  # without it the frames differ by about as much as the points do
    assert np.nanstd(d, axis=0).min() > 0.1 * np.nanstd(d)


@pytest.mark.parametrize("gives", ["relative", "inverse", "depth"])
def test_a_static_camera_is_tied_and_what_moves_with_it(gives):
    rng = np.random.default_rng(6)
    z, wall = points(60, seed=7), points(500, seed=8)
    said = flickering(np.concatenate([z, wall, [1.5]]), 20, 9, shift=gives == "relative")
    if gives == "depth":
        said = 1 / said
    at, behind, nearer = said[:, :60].copy(), said[:, 60:-1].copy(), said[:, -1]
    at *= 1 + 0.02 * rng.normal(size=60)  # an estimator errs alike in every frame
    at[:, :12] = rng.uniform(0, at.max(), 12)
    behind[3] = np.nan  # something covers it all
    at[3] = np.nan
    affine, line = tie_static(at, behind, z, np.full(60, 0.01), gives=gives)
    assert line.agree.sum() >= 40
    q = affine[:, 0] * as_inverse(nearer, gives) + affine[:, 1]
    known = np.arange(20) != 3
    np.testing.assert_allclose(1 / q[known], 1.5, rtol=0.06)
    assert np.ptp(1 / q[known]) < 0.01  # no flicker is left


def test_a_moving_camera_is_tied_frame_by_frame_and_between():
    rng = np.random.default_rng(10)
    T, M = 15, 80
    z = points(M, seed=11) + np.linspace(0, 1, T)[:, None]
    a, b = np.linspace(20, 24, T)[:, None], np.linspace(-1, 1, T)[:, None]
    d = (1 / z) * (1 + 0.02 * rng.normal(size=(T, M))) * a + b
    d[:, :16] = rng.uniform(d.min(), d.max(), (T, 16))
    d[rng.random((T, M)) < 0.3] = np.nan
    d[6, 5:] = np.nan
    affine, line = tie_moving(d, z, np.full(M, 0.01), gives="relative")
    here = affine[:, :1] * (a / 3.0 + b) + affine[:, 1:]
    np.testing.assert_allclose(1 / here, 3.0, rtol=0.04)  # the seventh too, which lies between its neighbours
    assert line.agree.sum() > 50
    d[:10] = np.nan
    with pytest.raises(Untied, match="5 of 15 frames are tied, fewer than 50%"):
        tie_moving(d, z, np.full(M, 0.01), gives="relative")


def test_points_that_are_never_in_sight_tie_nothing():
    with pytest.raises(Untied, match="no point of known depth is ever in sight"):
        tie_static(np.full((4, 30), np.nan), np.ones((4, 40)), points(30), np.zeros(30), gives="relative")


def test_two_estimates_that_contradict_each_other_have_no_scale():
    x = np.linspace(0, 1, 50)
    assert brought(x, 3 * x + 1, shift=True) == pytest.approx((3, 1))
    assert brought(x, 3 * x, shift=False) == pytest.approx((3, 0))
    assert brought(x, 1 - x, shift=True)[0] <= 0


def test_depth_is_unknown_beyond_the_farthest_and_where_nothing_is_told():
    d = np.array([[1.0, 0.1, -5.0], [np.nan, np.inf, 0.5]])
    np.testing.assert_allclose(depth_of(d, 0.5, 0.0, gives="inverse", farthest=8.0), [[2.0, 0.0, 0.0], [0.0, 0.0, 4.0]])
    np.testing.assert_allclose(
        depth_of(d, 1.0, 0.0, gives="depth", farthest=8.0), [[1.0, 0.1, 0.0], [0.0, 0.0, 0.5]], rtol=1e-6
    )


@pytest.mark.parametrize("wrong", [{"least": 2}, {"share": 0.0}, {"frames": 1.5}])
def test_limits_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match="least, share, frames: expected"):
        Limits(**wrong)
