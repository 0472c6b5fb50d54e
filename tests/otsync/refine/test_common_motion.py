"""Motion that both videos have in common, frame by frame: by its share of the motion, whatever noise is alike."""

from __future__ import annotations

import numpy as np
import pytest

from otsync.clocks.splines import TrackSplines
from otsync.refine.common_motion import common_motion
from otsync.types import Clock

from .test_refine import smooth

WINDOW, SAME = 14 / 30, Clock(0.0)


def two(noise: float, *, drift: float = 0.0, move: float = 1.0, late: float = 0.0, n: int = 40, frames: int = 150):
    """Curves of the same points in two videos, the second one begun ``late`` s later."""
    rng = np.random.default_rng(7)
    motion, t = smooth(rng, n), np.arange(frames) / 30
    slow = drift * np.sin(0.9 * t)[None, :, None]
    return [
        TrackSplines(t, move * motion(t + begun) + slow + noise * rng.standard_normal((n, frames, 3)))
        for begun in (0.0, late)
    ]


def share(a, b, clock=SAME, weight=None):
    return common_motion(a, b, clock, np.ones(len(a.mean)) if weight is None else weight, WINDOW)


def test_without_noise_all_motion_is_common():
    assert share(*two(0.0)) == pytest.approx(1.0, abs=1e-6)


def test_noise_alone_has_next_to_nothing_in_common():
    assert abs(share(*two(0.05, move=0.0))) < 0.05


def test_a_drift_that_both_share_is_not_motion_in_common():
    """It correlates slow velocities, and says nothing about the offset that it would not say about any other."""
    assert share(*two(0.05, move=0.0, drift=1.0)) < 0.15


def test_it_is_the_share_of_common_power():
    """Noise of the same power as the motion, seen through the same splines, leaves half."""
    motion, noise = two(0.0)[0], two(0.02, move=0.0)[0]
    power = [float((c.velocity(c.times) ** 2).sum()) for c in (motion, noise)]
    size = 0.02 * np.sqrt(power[0] / power[1])
    assert share(*two(size)) == pytest.approx(0.5, abs=0.06)
    assert share(*two(2 * size)) == pytest.approx(0.2, abs=0.05)
    assert share(*two(size / 3)) == pytest.approx(0.9, abs=0.05)


def test_exchanging_the_videos_changes_nothing():
    a, b = two(0.02, late=0.21)
    weight = np.random.default_rng(4).random(len(a.mean))
    there, here = share(a, b, Clock(0.2, 1.001), weight), share(b, a, Clock(-0.2 / 1.001, 1 / 1.001), weight)
    assert there == pytest.approx(here, rel=0.01) and there > 0.2


def test_nothing_that_moves_or_overlaps_says_nothing():
    a, b = two(0.0, move=0.0)
    assert share(a, b) == 0.0
    a, b = two(0.01)
    assert share(a, b, Clock(60.0)) == 0.0
