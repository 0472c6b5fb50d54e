"""A part of the scene that is shown late speaks against the answer of all; parts of one time do not."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from otsync import Matches, TrackSet, synchronize
from otsync.align.likelihood import LikelihoodScan
from otsync.bench.trust.worlds import CLASSES, plain
from otsync.refine.slot import Refiner
from otsync.refine.splines import SplineRefine
from otsync.simulate.effects import In, PartLate
from otsync.sync.hearing import Hearing
from otsync.sync.mend.breaks import mended
from otsync.sync.pairs import Job, run
from otsync.sync.rematching import at_each
from otsync.sync.verdict import Answer
from otsync.sync.witnesses import (
    FEWEST,
    OF_EACH,
    REST,
    Side,
    WhereSound,
    competing,
    elsewhere,
    fitted_where_sound,
    left_over,
    parted,
    sides,
    surest,
    times_to_ask,
)
from otsync.types import Alignment, Break, Status

FPS = 30.0


@pytest.mark.parametrize(
    ("preset", "seed"),
    [
        ("mid", 41001),
        ("mid", 41012),  # the last matches are all of the late one
        ("hard", 41001),
        ("hard", 41003),
        ("hard", 41007),
        ("hard", 56014),  # the rest tells two times, and seems to break
        ("hard", 56017),  # of the rest, too, most is of the late ones
        ("hard", 50005),  # the rest's matches without a time tell the late ones' time alone
        ("hard", 59007),
        ("hard", 66004),  # the late one was taken for frames that are lost
    ],
)
def test_one_of_two_performers_that_is_shown_late_is_flagged(preset, seed):
    """Trusted before, 8 frames off at sigma .03 to .2."""
    late = (In(1, PartLate(8 / FPS)),)
    found = synchronize(plain(seed, preset=preset, classes=("basketball", "football"), first=late).tracks)
    assert Status.LAGGING in found.flags[1]


@pytest.mark.parametrize("seed", [68105, 68107])
def test_one_that_is_as_late_as_frames_are_lost_is_flagged(seed):
    """Twice the frames seemed lost: before the break the late one was followed, behind it the other; 8 frames off."""
    found = synchronize(CLASSES["one of two late, frames lost"](seed).tracks)
    assert Status.LAGGING in found.flags[1]


@pytest.mark.parametrize("seed", range(41000, 41003))
def test_without_it_the_same_worlds_are_trusted(seed):
    world = plain(seed, preset="mid", classes=("basketball", "football"))
    assert synchronize(world.tracks).status[1].ok


def two_groups(late: float, share: int, n: int = 24) -> tuple[Answer, TrackSet, TrackSet]:
    """Tracks at two places; of the second place's first ``share`` tracks b shows ``late`` s earlier motion."""
    rng = np.random.default_rng(0)
    t = np.arange(120) / FPS
    speed, phase = rng.uniform(2, 5, (n, 1, 3)), rng.uniform(0, 6, (n, 1, 3))
    place = np.where(np.arange(n) < n // 2, 0.0, 9.0)[:, None, None] + rng.uniform(-0.3, 0.3, (n, 1, 3))

    def shown(at: np.ndarray) -> np.ndarray:
        return place + 0.3 * np.sin(speed * at + phase) + rng.normal(0, 0.002, (n, 120, 3))

    delay = np.where((np.arange(n) >= n // 2) & (np.arange(n) < n // 2 + share), late, 0.0)[:, None, None]
    own = rng.normal(size=(n, 16))
    a, b = (
        TrackSet(shown(t[:, None] - d), fps=FPS, features=own + rng.normal(0, 0.1, own.shape), frame="world")
        for d in (0.0, delay)
    )
    matches = Matches(np.stack([np.arange(n)] * 2, 1), np.ones(n))
    answer = Alignment(0.0, sigma=0.001, fps=FPS, stats={"blur": 0.004})
    return Answer((0, 1), matches, answer, answer), a, b


def off(answer, a, b):
    return parted((answer, Job(answer.pair, a, b, None, LikelihoodScan(), SplineRefine(), None)))


def test_a_neighbourhood_is_measured_by_itself():
    assert off(*two_groups(0.0, 12)) < 1
    assert off(*two_groups(5 / FPS, 12)) > 7


def test_exchanging_the_videos_changes_nothing():
    answer, a, b = two_groups(5 / FPS, 12)
    assert off(answer, b, a) == pytest.approx(off(answer, a, b), rel=0.02)


def test_too_few_matches_are_no_witnesses():
    answer, a, b = two_groups(5 / FPS, 12)
    few = answer.matches.pairs[: 12 + FEWEST - 1]
    fewer = replace(answer, matches=Matches(few, np.ones(len(few))))
    assert off(fewer, a, b) < 1


def test_the_rest_is_what_the_answer_does_not_explain():
    """The second place's tracks come late: the answer of the first place leaves them over, all and no others."""
    answer, a, b = two_groups(5 / FPS, 40, n=80)
    rest = left_over((answer, Job((0, 1), a, b, None, LikelihoodScan(), SplineRefine(), None)))
    assert rest is not None
    places = [np.nanmean(t.xyz[..., 0], 1) > 4 for t in (rest.a, rest.b)]
    assert all(p.all() and len(p) == 40 for p in places)
    (time,) = times_to_ask((rest, answer))
    (found,) = map(run, at_each(fitted_where_sound(rest), [time]))
    assert found.refined.status.ok and found.refined.offset == pytest.approx(-5 / FPS, abs=0.1 / FPS)
    assert elsewhere(found, answer, 2.0) and not elsewhere(answer, answer, 2.0)


def test_of_the_rest_times_are_asked_that_its_scan_does_not_tell(monkeypatch):
    """Matches that are made at a time tell of it, whatever those that were made without one do."""
    answer, a, b = two_groups(6 / FPS, 40, n=80)
    rest = left_over((answer, Job((0, 1), a, b, None, LikelihoodScan(), SplineRefine(), None)))
    assert rest is not None
    monkeypatch.setattr("otsync.sync.witnesses.competing", lambda scan: [1.0])
    first, second = times_to_ask((rest, answer))
    assert first == 1.0 and second == pytest.approx(-6 / FPS)
    (found,) = map(run, at_each(fitted_where_sound(rest), [second]))
    assert found.refined.offset == pytest.approx(-6 / FPS, abs=0.2 / FPS) and elsewhere(found, answer, 2.0)


def told_of(answer: Answer, a: TrackSet, b: TrackSet, video: int, found: Break) -> tuple[list[Side], list[bool]]:
    """What is left over beside a break of one of the videos, and whether it tells both times."""
    sets = [mended(t, (found,)) if v == video else t for v, t in enumerate((a, b))]
    job = Job((0, 1), *sets, None, LikelihoodScan(), SplineRefine(), None)
    both = sides(answer, job, {video: (found,)})
    return both, [side.tells_both(*map(run, side.tries())) for side in both]


@pytest.mark.parametrize(("video", "late"), [(1, 8.3), (1, -8.3), (0, 8.3), (0, -8.3)])
def test_a_late_performer_is_no_break(video, late):
    """Before the break the first place's tracks are right, behind it the second place's: each side shows both."""
    answer, a, b = two_groups(late / FPS, 40, n=80)
    jump = (-late if video == 1 else late) / FPS
    both, told = told_of(answer, a, b, video, Break(2.0, jump, still=max(-jump, 0.0)))
    assert [side.other - side.own for side in both] == pytest.approx([-late / FPS, late / FPS])
    assert told == [True, True]


@pytest.mark.parametrize("lost", [7, 15])
def test_beside_a_break_only_one_time_is_told(lost):
    """Frames of all are lost; what is left over are strangers, who move otherwise in either video."""
    answer, a, b = two_groups(0.0, 0, n=80)
    _, other, _ = two_groups(1.3, 40, n=80)
    strange = np.arange(80) >= 50
    shown = np.where(strange[:, None, None], other.xyz[::-1] * [-1, 1, 1], b.xyz)
    kept = np.delete(np.arange(120), np.arange(60, 60 + lost))
    fewer = replace(b, xyz=shown[:, kept], visible=None)
    both, told = told_of(answer, a, fewer, 1, Break(59.5 / FPS, lost / FPS))
    assert both and not any(told)


def network(n: int, seed: int = 0) -> tuple[dict[tuple[int, int], Answer], list[Job]]:
    """Every pair of n videos, with evidence by chance."""
    rng = np.random.default_rng(seed)
    _, a, b = two_groups(0.0, 0, n=12)
    answers, jobs = {}, []
    for pair in combinations(range(n), 2):
        found = Alignment(0.0, sigma=0.001, fps=FPS, stats={"evidence": float(rng.uniform(10, 90))})
        answers[pair] = Answer(pair, Matches(np.zeros((10, 2), int), np.ones(10)), found, found)
        jobs.append(Job(pair, a, b, None, LikelihoodScan(), SplineRefine(), None))
    return answers, jobs


@pytest.mark.parametrize("n", [2, 3, 4, 5, 9, 14])
def test_of_many_videos_each_is_asked_in_its_surest_pairs(n):
    answers, jobs = network(n)
    chosen = [job.pair for job in surest(answers, jobs)]
    for v in range(n):
        own = sorted((p for p in answers if v in p), key=lambda p: -answers[p].refined.stats["evidence"])
        assert set(own[:OF_EACH]) <= set(chosen)
    assert len(chosen) <= OF_EACH * n and (n > OF_EACH + 1 or len(chosen) == len(jobs))


def test_where_a_pair_is_doubted_all_pairs_of_its_videos_are_asked(monkeypatch):
    answers, jobs = network(9)
    asked: list[tuple[int, int]] = []

    def contradicted(answers, jobs, *rest):
        asked.extend(job.pair for job in jobs)
        return {job.pair for job in jobs if 5 in job.pair}

    verb = import_module("otsync.sync.verb")
    monkeypatch.setattr(verb, "contradicted", contradicted)
    hearing = Hearing(
        jobs=tuple(jobs),
        verdict=SimpleNamespace(answers=tuple(answers.values())),
        tracks=(),
        broken={},
        judge=lambda told, tracks: SimpleNamespace(answers=told),
        map=map,
    )
    judged = verb.with_witnesses_heard(hearing, True, 7.0)
    doubted = {a.pair for a in judged.answers if Status.LAGGING in a.refined.flags}
    assert doubted == {p for p in answers if 5 in p}
    assert len(asked) == len(set(asked)) < len(answers)


def test_few_tracks_that_are_left_over_are_not_asked():
    answer, a, b = two_groups(5 / FPS, REST - 1)
    job = Job((0, 1), a, b, None, LikelihoodScan(), SplineRefine(), None)
    assert left_over((answer, job)) is None
    assert left_over((two_groups(0.0, 12)[0], job)) is None


def test_an_answer_of_the_rest_counts_where_it_is_sound_and_another_one():
    answer, _, _ = two_groups(0.0, 12)
    late = replace(answer, refined=replace(answer.refined, offset=2 / FPS))
    assert elsewhere(late, answer, 0.0)
    assert not elsewhere(replace(late, refined=replace(late.refined, sigma=1 / FPS)), answer, 0.0)
    assert not elsewhere(replace(late, refined=replace(late.refined, flags=(Status.AMBIGUOUS,))), answer, 0.0)
    assert elsewhere(replace(late, refined=replace(late.refined, flags=(Status.BROKEN_CLOCK,))), answer, 0.0)


def test_answers_of_other_rates_are_compared_where_the_videos_meet():
    """Offsets are those at time zero; of clocks that differ by a percent they are three frames apart after 10 s."""
    answer, _, _ = two_groups(0.0, 12)
    other = replace(answer, refined=replace(answer.refined, offset=-0.1, rate=1.01))
    assert not elsewhere(other, answer, 10.0) and elsewhere(other, answer, 0.0)


def test_times_of_the_rest_that_come_near_the_best_compete():
    score = np.array([1.0, 1.0, 9.0, 1.0, 6.0, 1.0, 4.0, 1.0, -np.inf])
    curve = np.stack([np.arange(9) / 10, score], 1)
    scan = Alignment(0.2, fps=FPS, curve=curve, hypotheses=curve[[2, 4, 6]])
    assert competing(scan) == [0.2, 0.4]
    assert competing(Alignment(0.3, fps=FPS)) == [0.3]


@pytest.mark.parametrize(
    ("flags", "fitted"),
    [((), True), ((Status.NO_MATCH,), True), ((Status.BROKEN_CLOCK,), True), ((Status.AMBIGUOUS,), False)],
)
def test_the_rest_is_fitted_where_that_may_say_something(flags, fitted):
    class Moves(Refiner):
        def __call__(self, a, b, matches, alignment):
            return replace(alignment, offset=1.0)

    _, a, b = two_groups(0.0, 0)
    scanned = Alignment(0.5, fps=FPS, flags=flags)
    found = WhereSound(Moves())(a, b, Matches(np.zeros((0, 2), int)), scanned)
    assert found.offset == (1.0 if fitted else 0.5) and found.flags == flags
