"""How long a picture of a video is shown, by its tracks alone."""

from __future__ import annotations

import numpy as np
import pytest

from otsync.clocks.stillness import picture_frames


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
