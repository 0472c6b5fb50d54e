"""What the matches of one answer hide: other times that suit as well, and drifts that all tracks share."""

from __future__ import annotations

import numpy as np
import pytest

from otsync import match, synchronize
from otsync.align.rivals import Left, _beyond_the_valley, rival
from otsync.bench.trust.worlds import drawn
from otsync.simulate import PRESETS, simulate
from otsync.simulate.effects import SharedDrift, Transient
from otsync.types import Status


def test_a_carousel_suits_at_other_times_and_a_player_does_not():
    found = {}
    for motion in ("carousel", "tennis"):
        (a, b), _ = simulate(motion, preset="mid", videos=2, offsets=[0.0, 0.1], seed=6)
        found[motion] = rival(a, b, match(a, b, throw=False), 0.1)
    assert found["carousel"].as_good and found["carousel"].ratio < 1.1
    assert not found["tennis"].as_good and found["tennis"].ratio > 1.5


@pytest.mark.parametrize("seed", range(3))
def test_like_things_that_take_each_others_places_are_never_trusted_wrongly(seed):
    tracks, truth = simulate("carousel", preset="mid", videos=2, max_offset=30, seed=seed)
    offsets = synchronize(tracks)
    assert not offsets.status[1].ok or abs(offsets.seconds[1] - truth.offsets[1]) * 30 < 1


@pytest.mark.parametrize("effect", [Transient(0.2), SharedDrift(0.2, seed=5)], ids=["settling", "one drift for all"])
def test_a_static_scene_that_drifts_alike_is_static(effect):
    effects = (*PRESETS["mid"].effects, effect)
    tracks, _ = simulate("static", preset="mid", videos=2, offsets=[0.0, 0.4], effects=effects, seed=1)
    assert Status.STATIC in synchronize(tracks).flags[1]


@pytest.mark.parametrize(("preset", "seed"), [("hard", 4), ("brutal", 3), ("brutal", 4)])
def test_noisy_tracks_that_are_near_by_chance_at_another_time_are_no_rival(preset, seed):
    (a, b), truth = simulate("juggle", preset=preset, videos=2, offsets=[0.0, 0.4], seed=seed)
    found = rival(a, b, match(a, b, throw=False), float(truth.offsets[1]))
    assert found.ratio < 1 and not found.as_good


def test_a_little_more_that_all_tracks_say_is_worse_and_a_little_more_that_some_say_is_not():
    rng = np.random.default_rng(0)
    power, here = np.ones(80), rng.uniform(0.1, 0.3, 80)
    everywhere = here * rng.normal(1.2, 0.1, 80)
    for_some = here * np.where(np.arange(80) < 40, 1.9, 0.5)
    assert Left(power, everywhere).surely_worse_than(Left(power, here))
    assert not Left(power, everywhere).much_worse_than(Left(power, here))
    assert not Left(power, for_some).surely_worse_than(Left(power, here))
    assert not Left(power, here).surely_worse_than(Left(power, everywhere))
    assert Left(power, 2 * for_some).much_worse_than(Left(power, here))  # nobody needs to be asked one by one


def test_what_nobody_can_tell_is_not_worse():
    known = Left(np.ones(20), np.full(20, 0.1))
    unknown = Left(np.full(20, np.nan), np.full(20, np.nan))
    still = Left(np.zeros(20), np.zeros(20))
    for odd in (unknown, still):
        assert not odd.surely_worse_than(known) and not odd.much_worse_than(known)
        assert not known.surely_worse_than(odd) and not known.much_worse_than(odd)


@pytest.mark.parametrize("seed", [526, 22007])
def test_like_things_that_stay_somewhat_apart_at_another_time_are_rivals_too(seed):
    """Trusted and 27 frames off where only what is as near was taken for a rival."""
    tracks, _ = drawn(seed, motion="carousel", alike=True)
    assert Status.AMBIGUOUS in synchronize(list(tracks)).flags[1]


def test_shoulders_of_the_answers_own_valley_are_no_other_times():
    nan = np.nan
    for apart, kept in (
        ([1.0, 1.1, 1.4, 1.2, 1.5], [nan, nan, nan, 1.2, 1.5]),
        ([1.0, nan, 1.1, 1.1, 1.2], [nan] * 5),
        ([1.3, 0.9, nan, 1.0], [nan, 0.9, nan, 1.0]),
        ([nan, nan], [nan, nan]),
    ):
        np.testing.assert_array_equal(_beyond_the_valley(np.array(apart)), kept)


def test_slow_things_have_no_rival_beside_the_answer():
    """Eight frames beside the answer the tracks are nearly as near still (1.05); at other times they are not."""
    (a, b), truth = drawn(508, preset="brutal")
    assert rival(a, b, match(a, b, throw=False), float(truth.offsets[1])).ratio > 1.3
