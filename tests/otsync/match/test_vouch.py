"""What is said of answers whose matcher cannot tell: one of several like objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync import (
    Cosine,
    OptimalTransport,
    PartialFGW,
    Status,
    TrackSet,
    UnbalancedFGW,
    match,
)
from otsync.costs.positions import SynchronousDistance
from otsync.match.synchronous import SynchronousMatching

MATCHERS = (OptimalTransport(), PartialFGW(), UnbalancedFGW())


def filmed(xyz: np.ndarray, features: np.ndarray, rng: np.random.Generator) -> TrackSet:
    noisy = features + 0.2 * rng.normal(size=features.shape)
    return TrackSet(xyz + 0.01 * rng.normal(size=xyz.shape), features=noisy, fps=30)


def two_and_one(seed: int, *, like: bool) -> tuple[TrackSet, TrackSet]:
    """A video of two bodies and one of the first of them; the second is like the first, or one of its own."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, 40)[None, :, None]

    def body() -> tuple[np.ndarray, np.ndarray]:
        swing = np.sin(6.28 * t * rng.uniform(0.5, 3, (50, 1, 1)) + rng.uniform(0, 6.28, (50, 1, 3)))
        return rng.normal(size=(50, 1, 3)) * [0.25, 0.25, 0.5] + 0.15 * swing, rng.normal(size=(50, 24))

    (x, f), (other, g) = body(), body()
    if like:
        other, g = x, f
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1.0]])
    both = filmed(np.concatenate([x, other + np.array([2.5, 0, 0])]), np.concatenate([f, g]), rng)
    return both, filmed(x @ turn.T + [1.0, 2, 0], f, rng)


@pytest.mark.parametrize("matcher", MATCHERS, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("seed", range(3))
def test_a_body_of_which_the_other_video_shows_two_may_be_either(matcher, seed):
    both, one = two_and_one(seed, like=True)
    for videos in ((both, one), (one, both)):
        assert Status.AMBIGUOUS in match(*videos, matcher=matcher, throw=False).flags
    both, one = two_and_one(seed, like=False)
    for videos in ((both, one), (one, both)):
        assert Status.AMBIGUOUS not in match(*videos, matcher=matcher, throw=False).flags


@pytest.mark.parametrize("ahead", [3.0, -3.0])
def test_costs_of_known_times_are_asked_in_their_direction(ahead):
    """Of two alike bodies on one path, 3 m apart, b shows one; it is there two seconds before or after the other."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        middle, f = rng.normal(size=(40, 1, 3)) * [0.25, 0.25, 0.5], rng.normal(size=(40, 16))
        swing, phase = rng.uniform(0.5, 3, (40, 1, 1)), rng.uniform(0, 6.28, (40, 1, 3))

        def body(t, at, middle=middle, swing=swing, phase=phase):
            along = np.stack([at + 1.5 * t, 0 * t, 0 * t], 1)
            return middle + 0.1 * np.sin(t[None, :, None] * swing + phase) + along

        t = np.arange(180) / 30
        both = filmed(np.concatenate([body(t, 0.0), body(t, ahead)]), np.tile(f, (2, 1)), rng)
        a, b = (replace(x, frame="world") for x in (both, filmed(body(t + 1, 0.0), f, rng)))
        costs = (Cosine(), SynchronousDistance(1.0, weight=3.0))
        for matcher in (OptimalTransport(costs=costs), SynchronousMatching(1.0)):
            found = match(a, b, matcher=matcher, throw=False)
            assert not found.flags and (found.pairs[:, 0] == found.pairs[:, 1]).all()
