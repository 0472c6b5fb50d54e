"""The epipolar distance as a cost, and costs at known clocks: laws on exact tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync import Cosine, TrackSet
from otsync.costs.epipolar import EpipolarDistance
from otsync.costs.positions import CurveDistance, MedianPosition, SynchronousDistance, at_clock
from otsync.types import Clock
from tests.recording_world import ring

FPS = 30.0
LATE = 0.4
"""Seconds that b started later."""


def paths(t: np.ndarray, n: int, seed: int) -> np.ndarray:
    """(n, T, 3): smooth paths without corners, which splines would round."""
    rng = np.random.default_rng(seed)
    out = 0.35 * rng.normal(size=(n, 1, 3))
    for _ in range(3):
        turn = 2 * np.pi * rng.uniform(0.2, 1.0, (n, 1, 3)) * t[None, :, None] + rng.uniform(0, 6.3, (n, 1, 3))
        out = out + 0.15 * rng.normal(size=(n, 1, 3)) * np.sin(turn)
    return out


def two_views(late: float = LATE, n: int = 12, frames: int = 90) -> tuple[TrackSet, TrackSet]:
    first, second = ring(4, width=640, height=360)[:2]
    t = np.arange(frames) / FPS
    return tuple(
        TrackSet(None, uv=camera.project(paths(t + start, n, 3)), camera=camera, fps=FPS)
        for camera, start in ((first, 0.0), (second, late))
    )


def test_while_no_clock_is_known_every_pair_costs_nothing():
    a, b = two_views()
    assert not EpipolarDistance().matrix(a, b).any()
    bare = TrackSet(None, uv=a.uv, fps=FPS)  # not even cameras are asked for
    assert EpipolarDistance().pairs(bare, b, np.array([0]), np.array([1])).tolist() == [0]


def test_true_partners_at_the_true_clock_cost_nothing_and_others_much():
    a, b = two_views()
    cost = EpipolarDistance().at(Clock(LATE)).matrix(a, b)
    own, others = np.diag(cost), cost[~np.eye(12, dtype=bool)]
    assert own.max() < 0.02 and np.median(others) > 1.0
    assert (cost.argmin(1) == np.arange(12)).all() and (cost.argmin(0) == np.arange(12)).all()
    assert cost.max() <= EpipolarDistance().cap


def test_at_a_wrong_clock_true_partners_cost():
    a, b = two_views()
    right, wrong = (np.diag(EpipolarDistance(clock=Clock(x)).matrix(a, b)) for x in (LATE, LATE + 0.2))
    assert np.median(wrong) > 0.3 > 10 * np.median(right)


def test_exchanging_the_videos_with_the_inverse_clock_transposes():
    """The Sampson distance is symmetric; which video is read at its own frames is not, to splines' accuracy."""
    a, b = two_views()
    there = EpipolarDistance(clock=Clock(LATE)).matrix(a, b)
    back = EpipolarDistance(clock=Clock(-LATE)).matrix(b, a)
    np.testing.assert_allclose(there, back.T, atol=0.05)


def test_a_rate_is_heeded():
    first, second = ring(4, width=640, height=360)[:2]
    t = np.arange(120) / FPS
    a = TrackSet(None, uv=first.project(paths(t, 8, 3)), camera=first, fps=FPS)
    b = TrackSet(None, uv=second.project(paths(LATE + 1.05 * t, 8, 3)), camera=second, fps=FPS)
    right, wrong = (np.diag(EpipolarDistance(clock=Clock(LATE, r)).matrix(a, b)) for r in (1.05, 1.0))
    assert right.max() < 0.05 < 0.2 < np.median(wrong)


def test_images_of_twice_the_width_cost_the_same():
    """s is given at 640 pixels of width."""
    a, b = two_views()
    shaken = [replace(x, uv=x.uv + np.random.default_rng(k).normal(size=x.uv.shape)) for k, x in enumerate((a, b))]

    def doubled(x: TrackSet) -> TrackSet:
        K = np.diag([2.0, 2.0, 1.0]) @ x.camera.K
        camera = replace(x.camera, K=K, width=2 * x.camera.width, height=2 * x.camera.height)
        return replace(x, uv=2 * x.uv, camera=camera)

    cost = EpipolarDistance(clock=Clock(LATE))
    np.testing.assert_allclose(cost.matrix(*shaken), cost.matrix(*map(doubled, shaken)), atol=1e-6)


def test_pairs_that_share_too_little_cost_as_much_as_any_wrong_pair():
    a, b = two_views()
    late = replace(b, visible=np.arange(90)[None] < np.full((12, 1), 5))
    assert (EpipolarDistance(clock=Clock(LATE)).matrix(a, late) == EpipolarDistance().cap).all()
    with pytest.raises(ValueError, match=r"b: expected pixels \(uv\) and a camera"):
        EpipolarDistance(clock=Clock(0)).matrix(a, TrackSet(None, uv=b.uv, fps=FPS))


def test_costs_at_a_known_clock():
    clock = Clock(0.5, 1.01)
    told = at_clock((Cosine(), EpipolarDistance()), clock)
    assert told == (Cosine(), EpipolarDistance(clock=clock))
    assert at_clock((Cosine(), CurveDistance()), clock) == (Cosine(), SynchronousDistance(0.5, rate=1.01))
    assert at_clock((Cosine(),), clock) == (Cosine(), SynchronousDistance(0.5, rate=1.01))
    # two forms of one thing are one
    assert at_clock((CurveDistance(), MedianPosition()), clock) == (SynchronousDistance(0.5, rate=1.01),)
    again = at_clock(at_clock((Cosine(), CurveDistance()), clock), Clock(2.0))
    assert again == (Cosine(), SynchronousDistance(2.0))
