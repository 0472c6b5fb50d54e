"""How long a picture of a video is shown, and how long a pause lasts in a file that repeats some, by tracks alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otsync.clocks.stillness import pause_of_pictures, picture_frames

FRAME = 1 / 30


@pytest.mark.parametrize("rate, frames", [(30.0, 1.0), (24.0, 1.25), (20.0, 1.5), (15.0, 2.0), (10.0, 3.0)])
@pytest.mark.parametrize("rests", [False, True])
def test_how_long_a_picture_is_shown_is_told_beside_pauses(rate, frames, rests):
    now = np.arange(150) / 30
    shown = np.floor(now * rate + 1e-9) / rate
    if rests:
        shown[60:100] = shown[60]
    x = np.sin(3 * shown[None, :, None] + np.arange(20)[:, None, None]) * np.ones(3)
    assert picture_frames(x) == pytest.approx(frames, abs=0.05)


def test_what_does_not_move_shows_new_pictures():
    assert picture_frames(np.zeros((5, 60, 3))) == 1.0
    assert picture_frames(np.full((5, 60, 3), np.nan)) == 1.0


def filmed(shown: np.ndarray, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """(20,T,3) tracks that swing, at the moments (T,) that the frames show."""
    rng = np.random.default_rng(seed)
    swings = np.sin(3 * shown[None, :, None] + np.arange(20)[:, None, None]) * np.ones(3)
    return swings + noise * rng.standard_normal(swings.shape)


RATES = [10.0, 12.0, 15.0, 20.0, 24.0, 25.0]


PAUSES = given(
    rate=st.sampled_from(RATES),
    lasts=st.integers(6, 45),
    at=st.integers(40, 60),
    behind=st.integers(22, 60),
    guess=st.floats(-1.5, 1.5),
    seed=st.integers(0, 99),
)


def pictures(frames: np.ndarray, rate: float) -> np.ndarray:
    """The moments, in frames, that a file of 30 a second shows of footage with ``rate`` pictures a second."""
    return np.floor(frames * rate / 30 + 1e-9) * 30 / rate


def paused(frames: np.ndarray, at: int, lasts: int) -> np.ndarray:
    """The moments, in frames, of a file that shows its frame ``at`` - 1 for ``lasts`` frames more."""
    return np.where(frames < at, frames, np.maximum(frames - lasts, at - 1))


@PAUSES
def test_a_pause_of_a_file_that_repeats_pictures_is_counted(rate, lasts, at, behind, guess, seed):
    k = np.arange(at + lasts + behind)
    x = filmed(pictures(paused(k, at, lasts), rate) * FRAME, 0.002, seed)
    found = pause_of_pictures(k * FRAME, x, at * FRAME, (lasts + guess) * FRAME)
    told = 6 / 5 if rate == 25 else 30 / rate
    if lasts % told > 1e-9:  # else it may have been in the footage as well
        assert found is not None
    if found is not None:
        assert found[1] == lasts
        assert abs(found[0] / FRAME - at - lasts) < 3


@PAUSES
def test_a_pause_of_the_footage_is_not_counted_in_frames_of_a_file_that_repeats_pictures(
    rate, lasts, at, behind, guess, seed
):
    k = np.arange(at + lasts + behind)
    x = filmed(paused(pictures(k, rate), at, lasts) * FRAME, 0.002, seed)
    assert pause_of_pictures(k * FRAME, x, at * FRAME, (lasts + guess) * FRAME) is None


@pytest.mark.parametrize("frames", [1, 2, 3, 12])
def test_clips_too_short_to_count_pictures_tell_no_pause(frames):
    x = filmed(np.arange(frames) * FRAME)
    assert pause_of_pictures(np.arange(frames) * FRAME, x, 0.0, 0.3) is None
    assert pause_of_pictures(np.arange(frames) * FRAME, np.full_like(x, np.nan), 0.0, 0.3) is None
