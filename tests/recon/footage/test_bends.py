"""Bends of clocks: no offset and no rate in them, half of them one way, as large as the clocks are unsure."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.footage.bends import bend_curve, bent, bent_tracks, chosen_bends
from tests.recon.footage.test_footage import clip, video


@given(n=st.integers(12, 400), step=st.floats(0.001, 1.0), start=st.floats(-100, 100))
def test_no_offset_and_no_rate_takes_up_a_bend(n: int, step: float, start: float):
    times = start + step * np.arange(n)
    curve = bend_curve(times)
    slope = np.polyfit(np.linspace(-1, 1, n), curve, 1)[0]
    assert (
        abs(curve.mean()) < 2 / n
        and abs(slope) < 1e-6
        and np.sqrt(np.square(curve).mean()) == pytest.approx(1, rel=0.1)
    )


@given(n=st.integers(2, 30), seed=st.integers(0, 9))
def test_half_of_the_clocks_are_bent_one_way(n: int, seed: int):
    sigma = np.full(n, 0.004)
    sigma[0] = 0
    bends = chosen_bends(sigma, 1 / 30, 0.2, seed)
    assert np.allclose(np.abs(bends), 0.004) and abs(np.sign(bends).sum()) <= 1
    assert np.allclose(np.abs(chosen_bends(50 * sigma, 1 / 30, 0.2, seed)), 0.2 / 30)
    np.testing.assert_array_equal(bends, chosen_bends(sigma, 1 / 30, 0.2, seed))


@pytest.mark.parametrize("sigma", [[0.0, 0.0], [0.0, np.nan], [0.0]])
def test_clocks_without_sigma_are_not_bent(sigma: list[float]):
    assert not chosen_bends(np.array(sigma), 1 / 30, 0.2).any()


def test_a_bend_of_nothing_is_none():
    assert not chosen_bends(np.array([0.0, 0.01]), 1 / 30, 0.0).any()
    plain = video()
    assert bent(plain, 0.0) is plain


def test_a_video_and_its_tracks_bend_alike():
    from otsync.types import TrackSet

    plain = video(clip(20))
    xyz = np.random.default_rng(0).normal(size=(3, 20, 3))
    tracks = TrackSet(xyz, np.ones((3, 20), bool), np.zeros((3, 1)), plain.fps, plain.timestamps, plain.name)
    crooked, along = bent(plain, 0.005), bent_tracks(tracks, plain, 0.005)
    np.testing.assert_allclose(crooked.times - plain.times, 0.005 * bend_curve(plain.times))
    np.testing.assert_allclose(along.times, crooked.times)
    assert (np.diff(crooked.times) > 0).all()
