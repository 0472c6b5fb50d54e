"""Windows of an overlap, each matched by itself at every offset; and clocks mended by what they tell."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

from otsync import Status, TrackSet, synchronize
from otsync.align.likelihood import LikelihoodScan
from otsync.bench.trust.worlds import CLASSES
from otsync.refine.splines import SplineRefine
from otsync.sync.hearing import Hearing
from otsync.sync.mend.ways import ByWindows, readings_of
from otsync.sync.mend.windows import EVERY, NEAR, STEADY, Windows, matches_of_parts
from otsync.sync.pairs import Job, run
from otsync.sync.rematching import at_each
from otsync.types import Break, Clock

from .test_places import motion

N, FPS = 40, 30.0


def job(jump: int = 0, at: int = 75, late: float = 1.0, noise: float = 0.01, seed: int = 0, lost: int = 0) -> Job:
    """Two videos of 5 s whose tracks have like features and come in another order; from frame ``at`` on the second one
    shows what comes ``jump`` frames later, and ``lost`` frames of it are not there, by its timestamps."""
    rng = np.random.default_rng([seed, 2])
    move, k = motion(seed), np.arange(150)
    x, y = move(k / FPS), move(k / FPS + late + jump / FPS * (k >= at))
    order = rng.permutation(N)
    kept = (k < at) | (k >= at + lost)
    alike = np.ones((N, 4))  # features that tell nothing
    a = TrackSet(x + noise * rng.normal(size=x.shape), fps=FPS, frame="world", features=alike)
    y = (y + noise * rng.normal(size=y.shape))[order][:, kept]
    b = TrackSet(y, timestamps=k[kept] / FPS, frame="world", features=alike)
    return Job((0, 1), a, b, None, LikelihoodScan(), SplineRefine(), None)


@pytest.mark.parametrize("jump", [-20, -10, 10, 20])
@pytest.mark.parametrize("answer", ["first", "second"])
def test_the_part_with_another_offset_is_found_from_either_side(jump, answer):
    offset = 1.0 if answer == "first" else 1.0 + jump / FPS
    windows = Windows.of(job(jump, at=50), Clock(offset))
    split = windows.split()
    assert split is not None and split.gain > 1 and not windows.steady
    (best, *_) = windows.breaks()
    assert best == split
    parts = windows.parts(split)
    np.testing.assert_allclose(parts[:, 1], [1.0, 1.0 + jump / FPS], atol=NEAR * EVERY)
    # a's frames of a gap have no partner; those that b shows twice have two
    low, high = sorted((80 / FPS, (80 + jump) / FPS))
    assert low - 0.45 < parts[1, 0] < high + 0.45


@pytest.mark.parametrize("seed", range(4))
def test_a_clock_that_runs_evenly_is_steady_in_all_windows(seed):
    windows = Windows.of(job(seed=seed, noise=0.03), Clock(1.0))
    assert windows.steady and not windows.breaks()
    assert windows.evidence.shape == (len(windows.begin), len(windows.late))
    middle = len(windows.late) // 2
    assert (np.abs(windows.evidence.argmax(1) - middle) <= NEAR).all()


def test_an_offset_that_is_not_right_is_not_steady():
    assert not Windows.of(job(), Clock(1.0 - 15 / FPS)).steady


def test_a_gap_of_a_mended_clock_is_asked_nothing():
    """Its windows are half empty at the right offset, and full at others."""
    windows = Windows.of(job(lost=20), Clock(1.0))
    assert not windows.whole.all() and windows.whole.any()
    assert windows.steady
    assert not replace(windows, whole=np.ones_like(windows.whole)).steady


def test_too_little_in_common_says_nothing():
    windows = Windows.of(job(), Clock(149 / FPS))
    assert len(windows.begin) == 0 and windows.split() is None and not windows.steady and windows.usual == 0


@pytest.mark.parametrize("jump", [0, 15])
def test_a_long_clip_is_read_window_by_window_with_the_same_answer(jump, monkeypatch):
    asked = job(jump, at=50)
    whole = Windows.of(asked, Clock(1.0))
    monkeypatch.setattr("otsync.sync.mend.windows.LONG", 10)
    parts = Windows.of(asked, Clock(1.0))
    np.testing.assert_array_equal(parts.whole, whole.whole)
    np.testing.assert_allclose(parts.evidence, whole.evidence, rtol=0.2, atol=0.02 * whole.evidence.max())
    assert parts.steady == whole.steady == (jump == 0)


def test_all_of_an_overlap_may_be_one_window(monkeypatch):
    asked = job(noise=0.03)
    (one,) = Windows.of(asked, Clock(1.0), whole=True).evidence
    assert one.argmax() == len(one) // 2 and not Windows.of(asked, Clock(1.0), whole=True).rivals(0.7)
    monkeypatch.setattr("otsync.sync.mend.windows.LONG_WINDOW", 10)
    many = Windows.of(asked, Clock(1.0), whole=True)
    np.testing.assert_array_equal(many.evidence, Windows.of(asked, Clock(1.0)).evidence)


@pytest.mark.parametrize("late", [-21, -9, 9, 21])
def test_a_part_of_the_scene_at_another_time_is_a_rival(late):
    """Tracks of two performers, of whom the second video shows one ``late`` frames later than the other."""
    first, second = job(seed=1), job(seed=2, late=1.0 + late / FPS)
    a, b = (
        replace(x, xyz=np.concatenate([x.xyz, y.xyz + 50.0]), visible=None, features=np.ones((2 * N, 4)))
        for x, y in ((first.a, second.a), (first.b, second.b))
    )
    best, *_ = Windows.of(replace(first, a=a, b=b), Clock(1.0), whole=True).rivals(0.5)
    assert best == pytest.approx(late / FPS)


def test_things_at_rest_are_not_steady():
    """Nothing tells their time, so that nothing frees their clock of a doubt."""
    x = np.repeat(np.random.default_rng(0).normal(size=(N, 1, 3)), 150, 1)
    still = TrackSet(x, fps=FPS, frame="world")
    windows = Windows.of(replace(job(), a=still, b=still), Clock(0.5))
    assert windows.split() is None or windows.split().gain > STEADY
    assert not windows.steady


def test_matches_of_parts_are_right_in_both():
    asked = job(15)
    order = np.random.default_rng([0, 2]).permutation(N)
    parts = np.array([[1.0, 1.0], [3.5, 1.5]])
    found = matches_of_parts(asked, parts, 1.0)
    assert len(found) >= N - 2 and len(np.unique(found.pairs, axis=0)) == len(found)
    assert (order[found.pairs[:, 1]] == found.pairs[:, 0]).mean() > 0.9


@pytest.mark.parametrize(
    ("name", "seed", "jump"),
    [
        ("freeze of 15, hard", 41012, -15),  # by the first matches .55 s, and refused
        ("ten frames dropped, hard", 41004, 10),
        ("ten frames dropped", 53004, 10),
        ("a second missing", 41017, 30),
        ("a second missing", 53011, 30),  # by the second reading: its motion nearly repeats
    ],
)
def test_breaks_that_wrong_matches_hide_are_named_and_mended(name, seed, jump):
    """All were 7 to 30 frames off at one end, and flagged."""
    world = CLASSES[name](seed)
    offsets = synchronize(world.tracks)
    (found,) = offsets.breaks[1]
    assert found.jump * FPS == pytest.approx(jump, abs=0.5)
    assert offsets.status[1].ok and world.errors(offsets)[0][0] < min(0.4, 3 * offsets.sigma[1] * FPS)


def test_a_time_that_is_hardly_ahead_of_another_is_told_nothing_of():
    asked = job()
    (best,) = (run(once) for once in at_each(asked, (1.0,)))
    later = replace(best, refined=replace(best.refined, offset=best.refined.offset + 1.0))
    assert readings_of((asked, [best], best)) and not readings_of((asked, [best, later], best))


def test_a_doubt_that_wrong_matches_make_is_lifted():
    """Half of the first matches are wrong, and say that its clock breaks: it does not."""
    world = CLASSES["brutal"](53003)
    assert Status.BROKEN_CLOCK in synchronize(world.tracks, rematch=0).flags[1]
    offsets = synchronize(world.tracks)
    assert Status.BROKEN_CLOCK not in offsets.flags[1]
    assert world.errors(offsets)[0][0] < 1


@pytest.mark.parametrize(
    ("name", "seed"), [("slow motion", 41000), ("two takes", 53014), ("freeze that catches up", 0)]
)
def test_what_is_steady_in_windows_only_stays_in_doubt(name, seed):
    """A change of speed that is taken for lost frames; people who do the same a little differently."""
    offsets = synchronize(CLASSES[name](seed).tracks)
    assert Status.BROKEN_CLOCK in offsets.flags[1]


def test_where_a_reading_is_refused_the_next_one_is_tried():
    answers = [SimpleNamespace(pair=(0, 1), scanned=SimpleNamespace(parts=np.full((2, 2), k))) for k in (1.0, 2.0)]
    way = ByWindows({(0, 1): answers})
    assert way.doubtful((), ()) == answers[:1]
    assert way.refused([(0, 2), (0, 1)])
    assert way.doubtful((), ()) == answers[1:]
    assert not way.refused([(0, 1)])


def test_a_mended_clock_that_runs_unevenly_is_told_nothing_of(monkeypatch):
    """A change of speed that was taken for lost frames is steady in windows: its clock stays in doubt."""
    verb = import_module("otsync.sync.mend.verb")
    answer, job = SimpleNamespace(pair=(0, 1)), SimpleNamespace(pair=(0, 1))
    breaks = {1: (Break(2.0, 0.3), Break(4.0, -0.2))}
    asked = []

    def steady_beside(fresh, tracks, v, found):
        asked.append((v, found.at))
        return len(asked) < 2

    for name, always in (
        ("asks", True),
        ("_may_break", True),
        ("at_peaks", {(0, 1): [answer]}),
        ("readings_of", [answer]),
    ):
        monkeypatch.setattr(verb, name, lambda *given, always=always: always)
    monkeypatch.setattr(verb, "steady_beside", steady_beside)
    hearing = Hearing((job,), SimpleNamespace(answers=(answer,)), ((), ()), breaks, lambda *given: None, map)
    assert verb.mend_by_windows(hearing) == (hearing, set())
    assert asked == [(1, 2.0), (1, pytest.approx(4.3))]  # on the clock that the first break was mended on
