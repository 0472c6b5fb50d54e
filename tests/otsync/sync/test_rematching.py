"""Times that compete for a pair are decided by matches that are made at each of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync import Matches, synchronize
from otsync.align.likelihood import LikelihoodScan
from otsync.bench.trust.worlds import CLASSES
from otsync.match.synchronous import SynchronousMatching
from otsync.refine.splines import SplineRefine
from otsync.simulate import simulate
from otsync.sync.graph import Graph
from otsync.sync.pairs import Job, run
from otsync.sync.rematching import CLEARLY, NOISY, at_known_times, contested, winner
from otsync.sync.verdict import Answer, Verdict, judge
from otsync.types import Alignment, Clock, Status

FPS = 30.0


def answer(offset: float, evidence: float, matches: int = 10) -> Answer:
    found = Alignment(offset, sigma=0.01, fps=FPS, stats={"evidence": evidence})
    return Answer((0, 1), Matches(np.stack([np.arange(matches)] * 2, 1)), found, found)


def test_the_time_with_most_evidence_wins_where_it_is_clearly_ahead():
    best, other = answer(0.5, 40.0), answer(-1.0, 20.0)
    assert winner([other, best]) is best
    assert winner([best]) is best
    assert winner([other, best, replace(best)]) is best  # who comes to the same time is no rival


def test_times_with_about_as_much_evidence_stay_in_doubt():
    best, other = answer(0.5, 40.0), answer(-1.0, 1.05 * (1 - CLEARLY) * 40.0)
    assert winner([best, other]) is None
    assert winner([answer(0.5, 0.0)]) is None


def test_evidence_is_that_of_all_matches():
    few, many = answer(0.5, 40.0, matches=5), answer(-1.0, 30.0, matches=20)
    assert winner([few, many]) is many


def test_partners_of_one_track_do_not_make_matches_many():
    tracks, _ = simulate("football", preset="clean", videos=2, seed=8)
    few = np.array([(i, j) for i in range(4) for j in (i, (i + 1) % 4)])
    found = run(Job((0, 1), *tracks, None, LikelihoodScan(), SplineRefine(), Matches(few)))
    assert found.refined.stats["effective_matches"] <= 4 and Status.FEW_MATCHES in found.refined.flags


@pytest.mark.parametrize("seed", [504, 509, 41026])
def test_noisy_worlds_in_which_several_times_compete_are_decided(seed):
    """Each was refused for a doubt about which time is right; 41026 was .75 frame off then."""
    world = CLASSES["hard"](seed)
    without = synchronize(world.tracks, rematch=0)
    assert NOISY & set(without.flags[1])
    offsets = synchronize(world.tracks)
    assert offsets.status[1].ok
    assert world.errors(offsets)[0][0] < min(0.4, 3 * offsets.sigma[1] * FPS)


@pytest.mark.parametrize(("name", "seed"), [("carousel", 41001), ("exact loop", 41000), ("played backwards", 41011)])
def test_what_happens_twice_stays_in_doubt(name, seed):
    """Their best time is wrong or one of several, and its own matches have no flag but that of a rival, or none."""
    offsets = synchronize(CLASSES[name](seed).tracks)
    assert not offsets.status[1].ok


def first_answers(tracks) -> tuple[list[Job], Verdict]:
    """What is known of two videos before anything is matched once more."""
    refiner = SplineRefine()
    jobs = [Job((0, 1), tracks[0], tracks[1], None, LikelihoodScan(), refiner, None)]
    return jobs, judge(2, list(map(run, jobs)), 0, 0, Graph(), refiner.trust, lambda tasks: [])


def flagged(verdict: Verdict, *flags: Status) -> Verdict:
    """The verdict with a pair, and a video, that are flagged so and not otherwise."""
    (a,) = verdict.answers
    answers = (replace(a, refined=replace(a.refined, flags=flags)),)
    return replace(verdict, answers=answers, flags=((), flags))


def test_only_doubts_that_wrong_matches_make_are_contested():
    """A clock that breaks, things at rest: matches that were made at one time agree with it."""
    tracks, _ = simulate("tennis", preset="mid", videos=2, frames=90, tracks=60, offsets=[0, 0.2], seed=3)
    jobs, verdict = first_answers(tracks)
    for doubt in NOISY:
        (found,) = contested(jobs, flagged(verdict, doubt), map).values()
        assert found.refined.offset == pytest.approx(0.2, abs=0.2 / FPS)
    for other in (Status.BROKEN_CLOCK, Status.STATIC, Status.RATE_MISMATCH, Status.SHORT_OVERLAP):
        assert not contested(jobs, flagged(verdict, Status.AMBIGUOUS, other), map)
    assert not contested(jobs, flagged(verdict), map)  # nobody doubts them


def test_without_a_common_frame_nothing_is_contested():
    """Places are what tells the times apart."""
    tracks, _ = simulate("tennis", preset="mid", videos=2, frames=90, tracks=60, offsets=[0, 0.2], seed=3)
    jobs, verdict = first_answers([replace(t, frame=None) for t in tracks])
    assert not contested(jobs, flagged(verdict, Status.AMBIGUOUS), map)


def test_the_callers_own_matching_at_equal_times_is_kept_at_other_times():
    """Its options once were those of another one, made in its place."""
    given = SynchronousMatching(0.1, costs=(), limit=25)
    assert at_known_times(given, Clock(0.3, 1.01)) == SynchronousMatching(0.3, 1.01, (), 25)
    tracks, _ = simulate("tennis", preset="mid", offsets=[0.0, 0.1], tracks=80, seed=3)
    assert 5 < len(synchronize(tracks, matcher=given).matches[0, 1]) <= 25
    with pytest.raises(ValueError, match="xyz"):
        synchronize([replace(t, xyz=None, sigma=None) for t in tracks], matcher=given)
