"""Splines in continuous time, and two videos on one clock."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.interpolate import BSpline

from otsync import Matches, TrackSet
from otsync.clocks.common import common_clock, is_uniform
from otsync.clocks.splines import RIDGE, SMOOTHING, TrackSplines, sampled
from tests.conftest import wiggle


def curve(t):
    return np.stack([np.sin(2 * t), np.cos(3 * t), 0.5 * t**2 - t], -1)


def test_a_cubic_polynomial_is_reproduced_with_its_velocity():
    """Third differences of its coefficients are constant, so only a strong penalty bends it."""
    t = np.arange(60) / 30
    x = np.stack([t**2, 1 - t, 0.3 * t**2], -1)[None]
    s = TrackSplines(t, x)
    inside = np.linspace(0.1, 1.8, 50)
    np.testing.assert_allclose(s.value(inside)[0], np.stack([inside**2, 1 - inside, 0.3 * inside**2], -1), atol=1e-5)
    np.testing.assert_allclose(s.velocity(inside)[0, :, 1], -1, atol=1e-3)


def test_smooth_motion_between_samples_is_far_better_than_linear():
    t = np.arange(90) / 30
    s = TrackSplines(t, curve(t)[None], smoothing=0.1)
    between = t[5:-5] + 1 / 60
    spline = np.abs(s.value(between)[0] - curve(between)).max()
    linear = np.abs((curve(t)[5:-5] + curve(t)[6:-4]) / 2 - curve(between)).max()
    assert spline < linear / 10


def test_velocity_is_the_derivative_of_value():
    rng = np.random.default_rng(0)
    t = np.arange(40) / 25
    s = TrackSplines(t, wiggle(rng, 3, 40))
    at, h = np.linspace(0.2, 1.3, 17), 1e-6
    np.testing.assert_allclose(s.velocity(at), (s.value(at + h) - s.value(at - h)) / (2 * h), atol=1e-6)


def test_the_curve_is_the_one_that_its_coefficients_say():
    """Against scipy's B-splines, at the ends and beyond them too."""
    rng = np.random.default_rng(0)
    t = np.arange(40) / 25 + 3
    s = TrackSplines(t, wiggle(rng, 3, 40))
    at = np.concatenate([np.linspace(t[0] - 0.1, t[-1] + 0.1, 57), t[[0, -1]]])
    curves = BSpline(s.knots, s.by_track.transpose(1, 0, 2), 3)
    inside = np.clip(at, t[0], t[-1] - 1e-9)
    expected = curves(inside).transpose(1, 0, 2) + s.mean[:, None]
    np.testing.assert_allclose(s.joined(at), expected, atol=1e-7)
    value, velocity = s.value_and_velocity(at)
    np.testing.assert_allclose(value, s.value(at), atol=0)
    np.testing.assert_allclose(velocity, curves.derivative()(inside).transpose(1, 0, 2), atol=1e-6)


def test_support_never_bridges_a_gap_nor_leaves_the_clip():
    x = np.zeros((1, 30, 3))
    x[0, 10:13] = np.nan
    s = TrackSplines(np.arange(30) / 30, x)
    at = np.array([-0.01, 0, 9 / 30, 9.5 / 30, 11 / 30, 12.9 / 30, 13 / 30, 20.5 / 30, 29 / 30, 29.1 / 30])
    assert s.support(at)[0].tolist() == [False, True, True, False, False, False, True, True, True, False]
    assert np.isnan(s.sample(at)[0, 3]).all() and np.isfinite(s.sample(at)[0, 7]).all()


def test_one_dropped_frame_is_bridged_and_three_are_not():
    t = np.delete(np.arange(30) / 30, [5, 15, 16, 17])
    s = TrackSplines(t, np.zeros((1, 26, 3)))
    assert s.support(np.array([5 / 30, 16 / 30]))[0].tolist() == [True, False]


def test_take_equals_fitting_the_subset():
    t, x = np.arange(50) / 30, wiggle(np.random.default_rng(1), 6, 50)
    index = np.array([4, 1, 1])
    at = np.linspace(0, 1.6, 9)
    np.testing.assert_allclose(
        TrackSplines(t, x).take(index).value(at), TrackSplines(t, x[index]).value(at), atol=1e-12
    )


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_very_short_clips_do_not_break(n):
    s = TrackSplines(np.arange(n) / 30, np.ones((2, n, 3)))
    np.testing.assert_allclose(s.value(np.arange(n) / 30), 1)


def as_video(t, offset=0.0, **clock):
    """One track of the curve, filmed from world time ``offset`` on, at the video's own seconds ``t``."""
    return TrackSet(curve(t + offset)[None], **clock)


def test_equal_clocks_are_taken_as_they_are():
    t = np.arange(60) / 30
    a, b = as_video(t, fps=30), as_video(t, 0.2, fps=30)
    pair = common_clock(a, b, Matches([[0, 0]]))
    np.testing.assert_array_equal(pair.a, a.xyz)
    assert pair.seconds(6) == pytest.approx(0.2) and pair.origin == 0
    np.testing.assert_allclose(pair.a[:, 6:], pair.b[:, :-6])


@pytest.mark.parametrize("fps_b", [25.0, 60.0, 29.97])
def test_different_rates_meet_on_the_slower_clock(fps_b):
    t, u = np.arange(90) / 30, np.arange(int(3 * fps_b)) / fps_b
    pair = common_clock(as_video(t, fps=30), as_video(u, fps=fps_b), Matches([[0, 0]]))
    assert pair.fps == min(30, fps_b)
    n = min(pair.a.shape[1], pair.b.shape[1]) - 3
    np.testing.assert_allclose(pair.a[:, 3:n], pair.b[:, 3:n], atol=2e-3)


def test_timestamps_are_honoured():
    rng = np.random.default_rng(2)
    kept = np.sort(rng.choice(120, 105, replace=False))
    t = kept / 30 + 7.0
    b = as_video(t - 7.0, 0.5, timestamps=t)
    assert not is_uniform(b)
    pair = common_clock(as_video(np.arange(120) / 30, fps=30), b, Matches([[0, 0]]))
    # world time of b's clock is t - 7 + 0.5, so offset(a, b) = -6.5
    lag = round(pair.lag(-6.5))
    known = np.isfinite(pair.b[0, :, 0])
    shared = [j for j in np.flatnonzero(known) if 0 <= j + lag < 120]
    assert len(shared) > 80  # else nothing is compared
    for j in shared:
        np.testing.assert_allclose(pair.b[0, j], pair.a[0, j + lag], atol=5e-3)


def test_the_normal_equations_are_those_of_the_definition():
    """Against dense matrices, on tracks with gaps."""
    rng = np.random.default_rng(3)
    t, x = np.arange(37) / 30, wiggle(rng, 5, 37)
    x[rng.random((5, 37)) < 0.3] = np.nan
    s = TrackSplines(t, x)
    B = BSpline.design_matrix(np.clip(t, s.knots[3], s.knots[-4]), s.knots, 3).toarray()
    D = np.diff(np.eye(s.n), 3, axis=0)
    for m in range(5):
        seen = np.isfinite(x[m, :, 0])
        A = B[seen].T @ B[seen] + SMOOTHING * D.T @ D + RIDGE * np.eye(s.n)
        expected = np.linalg.solve(A, B[seen].T @ (x[m, seen] - x[m, seen].mean(0)))
        np.testing.assert_allclose(s.by_track[m], expected, atol=1e-9)


@pytest.mark.parametrize("frames, pause", [(150, 4900.0), (108_000, 0.0)], ids=["a long pause", "an hour"])
def test_memory_grows_with_the_length_of_a_clip_and_not_with_its_square(frames, pause):
    t = np.arange(frames) / 30
    t[frames // 2 :] += pause
    x = np.stack([np.sin(t), np.cos(2 * t), 0 * t], -1)[None].repeat(3, 0)
    tracemalloc.start()
    s = TrackSplines(t, x)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert s.n > 50_000
    assert peak < 200 * 2**20  # dense: 20 GiB and more
    np.testing.assert_allclose(s.value(t[:70:7])[1], x[1, :70:7], atol=0.02)


@pytest.mark.parametrize("moments", [6, 400])
def test_few_moments_of_a_long_clip_need_no_curve_of_all_of_it(moments):
    """Beside gaps, jumps and both ends; many moments take the one curve."""
    rng = np.random.default_rng(3)
    t = np.arange(4000) / 30
    noise = 0.01
    x = np.sin(t[:, None] * [1.0, 1.7, 2.3]) + noise * rng.normal(size=(3, 4000, 3))
    x[0, 1990:2030] = np.nan
    x[1, 2500:] += 2.0
    asked = np.sort(np.r_[t[0], t[-1], t[2000], rng.uniform(0, t[-1], moments - 3)])
    whole, near = TrackSplines(t, x).sample(asked), sampled(t, x, np.isfinite(x[..., 0]), asked)
    np.testing.assert_array_equal(np.isnan(near), np.isnan(whole))
    assert np.isnan(whole).any() and np.nanmax(np.abs(near - whole)) < (0.2 * noise if moments == 6 else 1e-12)


def test_moments_near_each_other_are_read_from_one_curve(monkeypatch):
    """In any order, and as each would be by itself; over a gap and beside both ends, too."""
    rng = np.random.default_rng(4)
    t = np.arange(30_000) / 30
    noise = 0.01
    x = np.sin(t[:, None] * [1.0, 1.7, 2.3]) + noise * rng.normal(size=(3, len(t), 3))
    x[1, 9000:9030] = np.nan
    seen = np.isfinite(x[..., 0])
    asked = rng.permutation(np.r_[t[:4], t[-4:], 300 + np.arange(40) / 30, 700 + rng.uniform(0, 3, 20)])
    alone = np.concatenate([sampled(t, x, seen, asked[n : n + 1]) for n in range(len(asked))], 1)
    made = []
    fit = TrackSplines._fit

    def counted(self: TrackSplines, xyz: np.ndarray, penalty: float) -> tuple[np.ndarray, np.ndarray]:
        made.append(xyz.shape[1])
        return fit(self, xyz, penalty)

    monkeypatch.setattr(TrackSplines, "_fit", counted)
    together = sampled(t, x, seen, asked)
    assert len(made) == 4 and max(made) < 300
    np.testing.assert_array_equal(np.isnan(together), np.isnan(alone))
    assert np.isnan(alone).any() and np.nanmax(np.abs(together - alone)) < 0.2 * noise
