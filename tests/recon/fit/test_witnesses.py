"""What bends of clocks tell: against fits whose share kept and errors are drawn, and a real one."""

from __future__ import annotations

import numpy as np
import pytest

from recon.fit.witnesses import VOTED, scaled_start, told_by_bends


def drawn(seed: int, share: float, error: float, videos: int, common: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Bends of one, and what a fit leaves of them that keeps a share and errs."""
    rng = np.random.default_rng(seed)
    bends = rng.permutation(np.resize([1.0, -1.0], videos))
    return bends, share * bends + error * rng.normal(size=videos) + common


@pytest.mark.parametrize("videos", [2, 3, 5, 12])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_the_share_is_found_within_its_sigma(share: float, videos: int):
    """The votes' sigma is as careful here as it usually is: the share is off by its own sigma, two videos or many."""
    off = []
    for seed in range(400):
        bends, left = drawn(seed, share, 0.05, videos)
        told = told_by_bends(bends, left, np.full(videos, 0.05 / VOTED))
        assert told is not None
        off.append((told.share - share) / told.share_sigma)
    assert 0.55 < np.mean(np.abs(off) < 1) < (0.9 if share else 1.0)
    assert np.mean(np.abs(off) < 2) > 0.9


def test_votes_that_are_too_bold_are_scaled():
    scales = [told_by_bends(*drawn(s, 0.2, 0.2, 20), np.full(20, 0.05)).scale for s in range(50)]  # type: ignore[union-attr]
    assert np.median(scales) == pytest.approx(4.0, rel=0.15)
    careful = [told_by_bends(*drawn(s, 0.2, 0.01, 20), np.full(20, 0.05)).scale for s in range(50)]  # type: ignore[union-attr]
    assert 0.3 < np.median(careful) < 0.6  # a few videos' worth of doubt stays


@pytest.mark.parametrize("videos", [3, 4, 7])
def test_what_all_videos_share_tells_nothing(videos: int):
    """A scene may bend with all clocks: nobody sees that, and it is no error."""
    a, b = (told_by_bends(*drawn(1, 0.3, 0.02, videos, common), np.full(videos, 0.05)) for common in (0.0, 5.0))
    assert a is not None and b is not None
    assert (a.share, a.share_sigma, a.scale) == pytest.approx((b.share, b.share_sigma, b.scale))


def test_videos_that_show_no_motion_tell_nothing():
    bends, left = drawn(2, 0.3, 0.02, 6)
    sigma = np.full(6, 0.05)
    blind = np.r_[sigma, np.nan]
    one, other = told_by_bends(bends, left, sigma), told_by_bends(np.r_[bends, 1.0], np.r_[left, 99.0], blind)
    assert one == other
    assert told_by_bends(bends, left, np.where(np.arange(6) == 0, 0.05, np.nan)) is None
    assert told_by_bends(np.zeros(6), left, sigma) is None


def test_a_fit_that_made_it_worse_has_all_of_the_error():
    told = told_by_bends(np.array([1.0, -1.0, 1.0, -1.0]), np.array([1.4, -1.2, 1.3, -1.5]), np.full(4, 0.05))
    assert told is not None and told.share == 1.0 and told.kept == 1.0


def test_gaps_of_all_videos_scale_the_start():
    start, fitted = np.array([0.0, 1.0, 1.0, 1.0, np.nan]), np.full(5, 0.1)
    near, far = np.array([0.0, 0.1, -0.1, 0.1, 3.0]), np.array([0.0, 1.9, -1.9, 1.9, 3.0])
    closer, further = scaled_start(start, near, fitted, 0, 0.0), scaled_start(start, far, fitted, 0, 0.0)
    assert closer[0] == 0 and 0.7 < closer[1] < 0.85 and 1.4 < further[1] < 1.6 and np.isnan(closer[4])
    absurd = scaled_start(start, np.array([0.0, 9.0, 0.1, 0.1, 0]), fitted, 0, 0.0)
    assert absurd[1] < 1.1  # one outlier is a contradiction, not a sign that all starts are worse


def test_a_fit_that_stands_still_is_no_sign_of_a_good_start():
    start, fitted = np.array([0.0, 1.0, 1.0, 1.0]), np.full(4, 0.1)
    np.testing.assert_allclose(scaled_start(start, np.zeros(4), fitted, 0, 1.0), start)
    assert scaled_start(start, np.zeros(4), fitted, 0, 0.9)[1] > 0.84
