"""Bends of clocks: no offset in them, half of them one way, as large as the clocks are unsure."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.footage.bends import LEAST, MOST, bent, bent_tracks, chosen_bends, motion_of, wave
from recon.footage.footage import footage_of
from tests.recon.footage.test_footage import clip, video


@given(n=st.integers(60, 400), begin=st.floats(0, 0.7), share=st.floats(0.2, 1.0))
def test_no_offset_takes_up_a_bend(n: int, begin: float, share: float):
    """However little of the video moves: by what frames tell of time, the wave has mean 0 and rms 1."""
    at = np.linspace(0, 1, n)
    motion = np.clip(((at >= begin) & (at <= begin + share)) / max(share, 1e-9), LEAST, MOST)
    curve = wave(motion)
    assert abs((motion * curve).sum() / motion.sum()) < 0.1
    assert (motion * curve**2).sum() / motion.sum() == pytest.approx(1, abs=0.1)


def test_motion_is_where_pictures_change():
    still = np.full((20, 48, 64, 3), 90, np.uint8)
    still[8:14, 10:20, 10:20] = np.random.default_rng(0).integers(0, 255, (6, 10, 10, 3), dtype=np.uint8)
    motion = motion_of(footage_of(video(list(still)), width=64))
    assert motion[:6].max() == LEAST and motion[8:13].min() > 1 and motion[17:].max() == LEAST
    np.testing.assert_array_equal(motion_of(footage_of(video(list(still[:6])), width=64)), 1.0)


def test_time_runs_on_however_far_a_clock_is_bent():
    plain = video(clip(20))
    crooked, seconds = bent(plain, 5.0, wave(np.ones(20)))
    assert 0 < seconds < 0.2 and (np.diff(crooked.times) > 0.4 / 30).all()


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
    plain = video(clip(20))
    assert bent(plain, 0.0, wave(np.ones(20)))[0] is plain
    one = video(clip(1))
    assert bent(one, 0.005, wave(np.ones(1))) == (one, 0.0)


def test_a_video_and_its_tracks_bend_alike():
    from otsync.types import TrackSet

    plain = video(clip(20))
    xyz = np.random.default_rng(0).normal(size=(3, 20, 3))
    tracks = TrackSet(xyz, np.ones((3, 20), bool), np.zeros((3, 1)), plain.fps, plain.timestamps, plain.name)
    curve = wave(np.linspace(0.5, 1.5, 20))
    (crooked, seconds), along = bent(plain, 0.005, curve), bent_tracks(tracks, plain, 0.005, curve)
    np.testing.assert_allclose(crooked.times - plain.times, 0.005 * curve)
    assert seconds == 0.005 and crooked.fps == along.fps == plain.fps  # so that what is kept of its pixels is found
    np.testing.assert_allclose(along.times, crooked.times)
    assert (np.diff(crooked.times) > 0).all()
