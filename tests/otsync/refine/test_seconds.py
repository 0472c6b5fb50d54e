"""Single seconds of an overlap: each finds its own offset, and together they say whether one clock runs evenly."""

from __future__ import annotations

import sys
from functools import partial

import numpy as np
import pytest

from otsync import SplineRefine, Status, TrackSet, refine, synchronize
from otsync.bench.trust.worlds import CLASSES
from otsync.clocks.splines import TrackSplines
from otsync.refine.gauss_newton import fit_clock
from otsync.refine.seconds import FURTHER, LEAST, LENGTH, MOST, STEP, Seconds
from otsync.types import Clock

from .test_refine import films, near, smooth

WINDOW = 14 / 30


def seconds_of(a, b, clock, **options):
    curves = TrackSplines(a.times, a.positions()), TrackSplines(b.times, b.positions())
    return Seconds.of(*curves, clock, WINDOW, **options)


def wandering(late, seed: int = 3, n: int = 40, frames: int = 150, noise: float = 0.004):
    """Two videos; the second one's frames are ``late(t)`` s late."""
    rng = np.random.default_rng(seed)
    move, t = smooth(rng, n), np.arange(frames) / 30
    a, b = (move(x) + noise * rng.normal(size=(n, frames, 3)) for x in (t, t + late(t)))
    return TrackSet(a, fps=30), TrackSet(b, fps=30)


def test_every_second_finds_the_offset_that_holds_in_it():
    a, b = wandering(lambda t: np.where(t < 2.0, 0.0, 2 / 30))
    told = seconds_of(a, b, Clock(0.0))
    before, behind = told.at + LENGTH / 2 < 1.9, told.at - LENGTH / 2 > 2.1
    assert before.sum() >= 2 and behind.sum() >= 4
    np.testing.assert_allclose(told.late[before] * 30, 0.0, atol=0.1)
    np.testing.assert_allclose(told.late[behind] * 30, 2.0, atol=0.15)
    assert (np.abs(told.late[before]) < 5 * told.sigma[before] + 0.02 / 30).all()


def test_both_ends_of_the_overlap_are_looked_at():
    a, b, _ = films(offset=0.31)
    told = seconds_of(a, b, Clock(0.31))
    begin, end = 0.31, float(a.times[-1])
    assert told.at[0] - LENGTH / 2 == pytest.approx(begin)
    assert told.at[-1] + LENGTH / 2 == pytest.approx(end)
    assert np.diff(told.at).max() <= STEP + 1e-9


def test_long_overlaps_are_looked_at_here_and_there():
    a, b = wandering(lambda t: 0 * t, n=3, frames=1800)
    told = seconds_of(a, b, Clock(0.0))
    assert len(told.at) == MOST and np.ptp(told.at) == pytest.approx(60 - 1 / 30 - LENGTH)


def test_a_span_is_the_fit_of_the_frames_within_it():
    """``span`` leaves out frames; cutting the videos there gives the same answer, but for curves at the cuts."""
    a, b, _ = films(noise=0.003)
    curves = TrackSplines(a.times, a.positions()), TrackSplines(b.times, b.positions())
    some = fit_clock(*curves, Clock(0.3), WINDOW, span=(1.0, 2.5))
    inside = (a.times >= 1.0 - 1e-9) & (a.times <= 2.5 + 1e-9)
    other = (b.times >= 0.7 - 1e-9) & (b.times <= 2.2 + 1e-9)
    cut = [TrackSplines(t.times[k], t.positions()[:, k]) for t, k in ((a, inside), (b, other))]
    alone = fit_clock(*cut, Clock(0.3), WINDOW)
    assert some is not None and alone is not None
    assert some.clock.offset == pytest.approx(alone.clock.offset, abs=0.1 / 30)
    assert fit_clock(*curves, Clock(0.3), WINDOW, span=(50.0, 51.0)) is None


def test_exchanging_the_videos_turns_the_sign_of_every_second():
    a, b = wandering(lambda t: 0.3 + np.where(t < 2.0, 0.0, 1.5 / 30))
    there, back = seconds_of(a, b, Clock(0.3)), seconds_of(b, a, Clock(-0.3))
    np.testing.assert_allclose(there.late, -back.late, atol=1e-3 / 30)
    assert there.unsteady(0.001) == pytest.approx(back.unsteady(0.001), rel=0.02)


def test_a_clock_that_wanders_is_unsteady_and_one_that_runs_evenly_is_not():
    def late(t):
        return 0.3 + 2.5 / 30 * np.sin(2 * np.pi * t / 3.0)

    told = {}
    for name, which in (("even", lambda t: 0.3 + 0 * t), ("wanders", late)):
        a, b = wandering(which)
        _, _, matches = films(n=40)
        told[name] = refine(a, b, matches, near(0.3), throw=False)
    limit = SplineRefine().trust.unsteady
    assert told["even"].stats["unsteady"] < 0.5 * limit and told["even"].status.ok
    assert told["wanders"].stats["unsteady"] > limit and Status.BROKEN_CLOCK in told["wanders"].flags


def test_one_second_of_many_is_not_hidden_by_the_others():
    late = np.zeros(12)
    late[3] = 0.05
    told = Seconds(np.arange(12.0), late, np.full(12, 0.01), np.ones(12))
    assert told.astray(0.0) == pytest.approx(5.0) and told.unsteady(0.0) == pytest.approx(5 / 12**0.5)
    assert told.astray(0.01) == pytest.approx(5 / 2**0.5)
    few = Seconds(np.arange(12.0), np.where(np.arange(12) < 5, late, np.nan), np.full(12, 0.01), np.ones(12))
    assert few.astray(0.0) == pytest.approx(5.0)
    fewer = Seconds(np.arange(12.0), np.where(np.abs(np.arange(12) - 3) < 1, late, np.nan), few.sigma, few.moving)
    assert fewer.astray(0.0) == fewer.unsteady(0.0) == 0.0


@pytest.mark.parametrize("seed", [80113])
def test_two_takes_that_differ_in_one_second_are_not_trusted(seed):
    """Its first second is 1.4 frames off, the other seven agree: it was trusted."""
    found = synchronize(list(CLASSES["two takes"](seed).tracks))
    pair = found.alignments[0, 1]
    assert pair.stats["unsteady"] < SplineRefine().trust.unsteady < SplineRefine().trust.astray < pair.stats["astray"]
    assert Status.BROKEN_CLOCK in found.flags[1]


@pytest.mark.parametrize("alone", [True, False])
def test_one_track_by_itself_tells_no_second(alone):
    """It agrees with itself, exactly: a wrong match would be sure. Beside others its weight falls."""
    a, b = wandering(lambda t: 0.3 + 0 * t)
    x, y = a.positions().copy(), b.positions().copy()
    y[0] = np.roll(y[0], 8, axis=0)  # the first match is wrong by 8 frames
    if alone:
        x[1:, :39], y[1:, :30] = np.nan, np.nan
    told = seconds_of(
        TrackSet(x, np.isfinite(x[..., 0]), fps=30), TrackSet(y, np.isfinite(y[..., 0]), fps=30), Clock(0.3)
    )
    assert np.isnan(told.late[0]) == alone
    assert told.unsteady(0.001) < SplineRefine().trust.unsteady


def test_an_end_that_moves_and_fits_nothing_is_not_vouched_for():
    """In its last second the second video shows something else: no offset suits that."""
    rng = np.random.default_rng(5)
    a, b = wandering(lambda t: 0.3 + 0 * t)
    x = b.positions().copy()
    other = smooth(rng, 40)(np.arange(150) / 30)
    x[:, 105:] = other[:, 105:] - other[:, [105]] + x[:, [105]]
    strange = TrackSet(x, fps=30)
    _, _, matches = films(n=40)
    sound = refine(a, b, matches, near(0.3), throw=False)
    doubted = refine(a, strange, matches, near(0.3), throw=False)
    assert sound.stats["untold"] == 0.0 and sound.status.ok
    assert doubted.stats["untold"] > SplineRefine().trust.untold and Status.BROKEN_CLOCK in doubted.flags


def test_an_end_at_which_nothing_moves_speaks_against_nothing():
    rng = np.random.default_rng(6)
    move, t = smooth(rng, 40), np.arange(150) / 30
    shown = np.minimum(t, 3.5)  # everybody stands still at the end
    a = move(shown) + 0.003 * rng.normal(size=(40, 150, 3))
    b = move(np.minimum(t + 0.3, 3.5)) + 0.003 * rng.normal(size=(40, 150, 3))
    _, _, matches = films(n=40)
    found = refine(TrackSet(a, fps=30), TrackSet(b, fps=30), matches, near(0.3), throw=False)
    assert found.stats["untold"] <= SplineRefine().trust.untold
    assert found.offset == pytest.approx(0.3, abs=0.1 / 30) and Status.BROKEN_CLOCK not in found.flags


def test_only_ends_that_move_and_are_unusually_unsure_are_untold():
    at, late, moves = np.arange(6.0), np.zeros(6), np.ones(6)
    sure, unsure = np.full(6, 0.003), np.array([0.003] * 5 + [1.0])
    rests = np.array([1.0] * 5 + [0.001])
    assert Seconds(at, late, unsure, moves).untold() == 1.0
    assert Seconds(at, late, unsure[::-1], moves).untold() == 1.0
    assert Seconds(at, late, unsure, rests).untold() == 0.0
    assert Seconds(at, late, sure, moves).untold() == 0.0
    assert Seconds(at, late, np.full(6, 1.0), moves).untold() == 0.0  # nobody knows more: sigma says so


def test_a_clock_that_sways_is_unsure_by_as_much():
    """Each answer is right on average, and off by up to half a frame, or two, in turn."""
    _, _, matches = films(n=40)
    told = {}
    for size in (0.0, 0.5, 2.0):
        a, b = wandering(lambda t, size=size: 0.3 + size / 30 * np.sin(np.pi * t))
        told[size] = refine(a, b, matches, near(0.3), throw=False).sigma * 30
    assert told[0.0] < 0.03
    # their root mean square is .35 and 1.4, of which means over a second show .8; blocks of a second differ by .15
    assert 0.25 < told[0.5] < 0.5
    assert 0.8 < told[2.0] < 2.0


def test_what_is_beyond_chance_is_the_variance_that_sigmas_leave():
    rng = np.random.default_rng(4)
    at, moves, sigma = np.arange(4000.0), np.ones(4000), rng.uniform(0.5, 1.5, 4000)
    chance = np.hypot(sigma, 0.4)
    assert Seconds(at, chance * rng.normal(size=4000), sigma, moves).sway(0.4) < 0.2
    more = np.hypot(chance, 0.8)
    # what is wild is cut off, so that a little of it is missed
    assert Seconds(at, more * rng.normal(size=4000), sigma, moves).sway(0.4) == pytest.approx(0.8, abs=0.08)


def test_a_clock_that_bends_is_unsure_at_its_ends_by_as_much():
    """An even clock through one that bends by .4 frame is off by two thirds of that at both ends."""
    _, _, matches = films(n=40)
    told = {}
    for size in (0.0, 0.4):
        a, b = wandering(lambda t, size=size: 0.3 + size / 30 * ((t - 2.5) / 2.5) ** 2)
        stats = refine(a, b, matches, near(0.3), throw=False).stats
        told[size] = stats["sigma_begin"] * 30, stats["sigma_end"] * 30
    assert max(told[0.0]) < 0.03
    assert all(0.18 < sigma < 0.4 for sigma in told[0.4])


def test_a_parabola_is_told_from_chance():
    rng = np.random.default_rng(5)
    at, sigma, moves = np.arange(0.5, 10.5), np.full(10, 0.1), np.ones(10)
    even = [max(Seconds(at, 0.1 * rng.normal(size=10), sigma, moves).bend(0.0)) for _ in range(400)]
    assert np.mean(np.array(even) == 0) > 0.7 and np.sqrt(np.mean(np.square(even))) < 0.12
    late = 0.6 * ((at - 5) / 5) ** 2
    bent = [Seconds(at, late + 0.1 * rng.normal(size=10), sigma, moves).bend(0.0) for _ in range(400)]
    np.testing.assert_allclose(np.median(bent, 0), 0.57, atol=0.04)
    unseen = [max(Seconds(at, 0.5 * rng.normal(size=10), sigma, moves).bend(0.5 / FURTHER)) for _ in range(400)]
    assert np.mean(np.array(unseen) == 0) > 0.7
    one_end = Seconds(at, 0.06 * (at - 5) + 0.3, sigma, moves).bend(0.0)
    assert one_end[0] < 0.05 and one_end[1] == pytest.approx(0.57, abs=0.04)  # of a rate, only where it is off


def test_parts_that_overlap_say_the_same_twice():
    rng = np.random.default_rng(6)
    at, sigma, moves = np.arange(0.5, 10.01, 0.5), np.full(20, 0.1), np.ones(20)
    halves = 0.1 * rng.normal(size=(400, 21)) / np.sqrt(2)
    even = [max(Seconds(at, late, sigma, moves).bend(0.0)) for late in halves[:, 1:] + halves[:, :-1]]
    assert np.mean(np.array(even) == 0) > 0.7


def test_one_wild_second_makes_no_answer_unsure():
    at, late, sigma, moves = np.arange(8.0), np.zeros(8), np.full(8, 0.1), np.ones(8)
    late[3] = 50.0
    assert Seconds(at, late, sigma, moves).sway(0.0) <= 0.1


def test_few_seconds_say_nothing():
    some = np.arange(LEAST - 1.0)
    told = Seconds(some, some + 9, some + 0.01, some + 1)
    assert told.unsteady(0.001) == told.sway(0.001) == 0.0 and told.untold() == 0.0
    assert told.bend(0.0) == (0.0, 0.0)
    again = Seconds(np.repeat([1.0, 2.0], 3), np.arange(6.0), np.ones(6), np.ones(6))
    ten = np.arange(10.0)
    assert again.bend(0.0) == Seconds(ten, ten, ten / 9, ten).bend(np.inf) == (0.0, 0.0)
    unknown = Seconds(np.arange(6.0), np.full(6, np.nan), np.full(6, np.nan), np.full(6, np.nan))
    assert unknown.unsteady(0.001) == 0.0 and unknown.untold() == 0.0 and unknown.bend(0.0) == (0.0, 0.0)


def test_an_answer_to_little_common_motion_is_weak():
    """Where noise is as large as the motion, the answer is where noise is alike by chance."""
    rng = np.random.default_rng(1)
    a, b, matches = films(n=40)
    small = [0.03 * t.positions() + 0.05 * rng.normal(size=t.positions().shape) for t in (a, b)]
    found = refine(TrackSet(small[0], fps=30), TrackSet(small[1], fps=30), matches, near(0.25), throw=False)
    trust = SplineRefine().trust
    assert found.stats["blur"] < trust.blur and found.stats["common_motion"] < trust.common
    assert Status.WEAK in found.flags
    sound = refine(a, b, matches, near(0.31))
    assert sound.stats["common_motion"] > 0.9 and sound.stats["settled"] == 1.0


def test_an_answer_that_did_not_settle_is_weak(monkeypatch):
    a, b, matches = films(n=40)
    monkeypatch.setattr(sys.modules[SplineRefine.__module__], "fit_clock", partial(fit_clock, iterations=2))
    found = refine(a, b, matches, near(0.31), throw=False)
    assert found.stats["settled"] == 0.0 and Status.WEAK in found.flags


@pytest.mark.parametrize(("overlap", "broken"), [(1.6, False), (2.0, True), (5.0, True)])
def test_a_part_of_a_second_does_not_differ_from_one(overlap, broken):
    """The wander of blocks of a second speaks from two whole ones on."""
    even = dict.fromkeys(("moved", "spread", "unsteady", "astray", "untold"), 0.0)
    good = {"common_motion": 1.0, "settled": 1.0, "effective_matches": 50.0, "correlation": 1.0}
    stats = even | good | {"blur": 0.03, "wander": 0.02, "overlap": overlap}
    assert (Status.BROKEN_CLOCK in SplineRefine()._flags(stats)) == broken
