"""Costs against closed forms and naive loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync import Cosine, TrackSet, track_distance
from otsync.compute.indices import blocks
from otsync.compute.threads import get_threads, set_threads
from otsync.costs import linear
from otsync.costs.linear import (
    binary_scale,
    cosine_distance,
    fill_unseen,
    frame_cost,
    total_cost,
    unit_features,
    velocity,
)


def naive_track_distance(x, seen, y, seen_y):
    out = np.full((len(x), len(y)), np.nan)
    for i in range(len(x)):
        for j in range(len(y)):
            both = seen[i] & seen_y[j]
            if both.any():
                out[i, j] = np.linalg.norm(x[i, both] - y[j, both], axis=1).max()
    return out


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("share", [1.0, 0.6, 0.1])
def test_track_distance_equals_a_naive_loop(dtype, share):
    rng = np.random.default_rng(int(share * 10))
    x = rng.normal(size=(150, 9, 3)).astype(dtype)
    seen = rng.random((150, 9)) < share
    x[~seen] = np.nan
    np.testing.assert_allclose(track_distance(x, seen), naive_track_distance(x, seen, x, seen), rtol=3e-7)
    y, seen_y = x[:37, ::-1] * 2, seen[:37, ::-1]
    np.testing.assert_allclose(track_distance(x, seen, y, seen_y), naive_track_distance(x, seen, y, seen_y), rtol=3e-7)


@given(st.integers(0, 10**6), st.sampled_from([1e-30, 1e-6, 1e6, 1e30]), st.integers(1, 3))
@settings(max_examples=25, deadline=None)
def test_track_distance_scales_and_is_symmetric(seed, unit, threads):
    rng = np.random.default_rng(seed)
    x, seen = rng.normal(size=(20, 7, 3)), rng.random((20, 7)) < 0.7
    d = track_distance(x, seen)
    np.testing.assert_array_equal(d, d.T)
    before = get_threads()
    set_threads(threads)
    try:
        np.testing.assert_allclose(track_distance(x * unit, seen), d * unit, rtol=1e-12)
    finally:
        set_threads(before)


def test_far_away_origin_costs_no_digits():
    """Differences are exact in the input's own precision: no cancellation as in a Gram matrix."""
    rng = np.random.default_rng(0)
    x = (rng.normal(size=(30, 5, 3)) + 1e4).astype(np.float32)
    seen = np.ones((30, 5), bool)
    exact = naive_track_distance(x.astype(float), seen, x.astype(float), seen)
    np.testing.assert_allclose(track_distance(x, seen), exact, rtol=1e-5)


def test_pairs_never_seen_together_get_the_median():
    distance = np.array([[0.0, 1, np.nan], [1, 0, 5], [np.nan, 5, 0]])
    np.testing.assert_array_equal(fill_unseen(distance), [[0, 1, 3], [1, 0, 5], [3, 5, 0]])
    assert (fill_unseen(np.full((2, 2), np.nan)) == 0).all()
    assert fill_unseen(np.zeros((1, 1))).shape == (1, 1)


@pytest.mark.parametrize("power", [-200, -30, 0, 30, 200])
def test_cosine_survives_any_magnitude(power):
    rng = np.random.default_rng(3)
    f, g = rng.normal(size=(6, 5)), rng.normal(size=(4, 5))
    expected = 1 - (f / np.linalg.norm(f, axis=1)[:, None]) @ (g / np.linalg.norm(g, axis=1)[:, None]).T
    np.testing.assert_allclose(cosine_distance(unit_features(f * 10.0**power), unit_features(g)), expected, atol=1e-12)


def test_centring_removes_what_all_features_share():
    rng = np.random.default_rng(4)
    f = rng.normal(size=(50, 8))
    a = TrackSet(np.zeros((50, 2, 3)), features=unit_features(f), fps=30)
    np.testing.assert_allclose(np.diag(Cosine().matrix(a, a)), 0, atol=1e-12)
    assert (unit_features(np.ones((5, 3)), center=True) == 0).all()


def test_centred_features_are_units_about_the_mean_of_the_set():
    f = np.random.default_rng(6).normal(size=(30, 6)) + 2
    u = f / np.linalg.norm(f, axis=1, keepdims=True)
    u -= u.mean(0)
    np.testing.assert_allclose(unit_features(f, center=True), u / np.linalg.norm(u, axis=1, keepdims=True))


def test_cosine_refuses_other_dimensions():
    a = TrackSet(np.zeros((2, 2, 3)), features=np.ones((2, 3)), fps=30)
    b = TrackSet(np.zeros((2, 2, 3)), features=np.ones((2, 4)), fps=30)
    with pytest.raises(ValueError, match=r"b\.features: expected 3 dimensions as a has; found 4"):
        Cosine().matrix(a, b)


def test_frame_cost_equals_a_naive_loop_with_gaps():
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(6, 8, 3)), rng.normal(size=(6, 5, 3))
    a[rng.random((6, 8)) < 0.5] = np.nan
    b[rng.random((6, 5)) < 0.5] = np.nan
    b[:, 4] = np.nan
    cost, count = frame_cost(a, b)
    for i in range(8):
        for j in range(5):
            terms = np.abs(a[:, i] - b[:, j]).sum(1)
            terms = terms[np.isfinite(terms)]
            assert count[i, j] == len(terms)
            np.testing.assert_allclose(cost[i, j], terms.mean() if len(terms) else np.nan)


def test_velocity_is_the_slope_and_never_crosses_a_gap():
    t = np.arange(20.0)
    x = np.stack([3 * t, 0 * t, -t], -1)[None].copy()
    x[0, 10] = np.nan
    v = velocity(x, 2)
    expected = np.isfinite(v[0, :, 0])
    assert np.flatnonzero(expected).tolist() == [2, 3, 4, 5, 6, 7, 13, 14, 15, 16, 17]
    np.testing.assert_allclose(v[0, expected], np.tile([3, 0, -1], (expected.sum(), 1)))
    assert np.isnan(velocity(x[:, :3], 2)).all()


def test_binary_scale_is_a_power_of_two():
    for x in (0.3, 1e-30, 7e12):
        s = binary_scale(np.array([x, np.nan, -x / 3]))
        assert np.frexp(s)[0] == 0.5 and 0.5 <= x / s <= 1
    assert binary_scale(np.zeros(3)) == binary_scale(np.array([np.nan])) == 1


def test_track_distance_refuses_what_it_cannot_compare():
    x, seen = np.zeros((4, 6, 3)), np.ones((4, 6), bool)
    with pytest.raises(ValueError, match="other: expected"):
        track_distance(x, seen, np.zeros((4, 3, 3)), seen[:, :3])
    with pytest.raises(ValueError, match="xyz: expected finite"):
        track_distance(np.full((4, 6, 3), np.nan), seen)
    assert track_distance(x, seen, np.ones((7, 6, 3))).shape == (4, 7)


@pytest.mark.parametrize("weight", [-1.0, np.nan])
def test_weights_are_checked(weight):
    a = TrackSet(np.zeros((2, 2, 3)), features=np.eye(2), fps=30)
    with pytest.raises(ValueError, match="expected weights >= 0"):
        total_cost((Cosine(weight=weight),), a, a)


@pytest.mark.parametrize("share", [1.0, 0.02])
def test_a_long_clip_is_looked_at_in_pieces(share, monkeypatch):
    """Two tracks may meet in one piece only, or never."""
    rng = np.random.default_rng(4)
    x, y = rng.standard_normal((9, 120, 3)), rng.standard_normal((7, 120, 3))
    seen, seen_y = rng.random((9, 120)) < share, rng.random((7, 120)) < share
    x[~seen] = np.nan
    found = [track_distance(x, seen), track_distance(x, seen, y, seen_y)]
    monkeypatch.setattr(linear, "blocks", lambda rows, columns: blocks(rows, columns, 9 * 25))
    for whole, pieces in zip(found, [track_distance(x, seen), track_distance(x, seen, y, seen_y)], strict=True):
        np.testing.assert_array_equal(whole, pieces)


def test_a_scale_is_of_what_counts():
    x = np.array([3.0, -900.0, np.nan, np.inf])
    assert binary_scale(x) == 1024
    assert binary_scale(x, np.array([True, False, True, True])) == 4
    assert binary_scale(np.full(3, np.nan)) == binary_scale(np.zeros((0, 3))) == 1
