"""From answers of pairs to clocks: rates, contradictions and trust, on answers that were made with their clocks."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from otsync import Graph, LikelihoodScan, Matches, SplineRefine, Status, TrackSet, synchronize
from otsync.bench.hard_cases.graphs import LATE, given, video, videos
from otsync.sync.graph import FLAGGED
from otsync.sync.pairs import Job, run
from otsync.sync.verdict import Answer, Network, Verdict, judge, off_rates
from otsync.types import Alignment
from otsync.types.trust import Trust
from tests.conftest import wiggle

NONE = Matches(np.zeros((0, 2), int))
X, RATES = np.array([0.0, 2.0, -1.5]), np.array([1.0, 1.25, 0.8])
"""World seconds at which three videos' own clocks show 0, and how fast these run."""


def between(a: int, b: int) -> Alignment:
    """b's clock on a's: t_a = rate t_b + offset, sure of itself."""
    rate = RATES[b] / RATES[a]
    known = {"fitted_rate": rate, "rate_sigma": 1e-4}
    return Alignment((X[b] - X[a]) / RATES[a], rate, sigma=0.002 if 1 in (a, b) else 0.005, fps=30.0, stats=known)


def settle(answers: list[Answer], reference: int | None, graph: Graph) -> tuple[Verdict, list[tuple]]:
    """The verdict, and what was asked to be fitted anew: (pair, offset, rate). A new fit finds the truth."""
    asked = []

    def refit(tasks):
        asked.extend((answer.pair, offset, rate) for answer, offset, rate in tasks)
        return [between(*answer.pair) for answer, _, _ in tasks]

    return judge(3, answers, reference, 0, graph, Trust(), refit), asked


@pytest.mark.parametrize("reference", [0, 1, 2, None])
def test_clocks_of_any_rate_are_told_on_the_reference_s(reference):
    answers = [Answer(p, NONE, between(*p), between(*p)) for p in itertools.combinations(range(3), 2)]
    found, _ = settle(answers, reference, Graph(curves=False))
    assert found.reference == (1 if reference is None else reference)  # 1 is the one best tied
    of = RATES[found.reference]
    np.testing.assert_allclose(found.rates, RATES / of, atol=1e-9)
    np.testing.assert_allclose(found.x, (X - X[found.reference]) / of, atol=1e-6)
    assert not any(found.flags)


def test_what_a_flag_makes_of_a_sigma_is_for_the_cycles_to_judge():
    """Of a variance that a flag makes nine times as large, eight ninths and the tentative share of the ninth."""

    def edge(*flags: Status):
        told = Alignment(0.5, sigma=0.01, fps=30.0, flags=flags, stats={"tentative": 0.25})
        network = Network(2, (Answer((0, 1), NONE, told, told),), np.ones(2), 0, Graph(), Trust())
        return network.edges[0]

    assert (edge().sigma, edge().measured) == (0.01, 0.75)
    flagged = edge(Status.SPREAD)
    assert flagged.sigma == pytest.approx(FLAGGED * 0.01)
    assert flagged.measured == pytest.approx(0.75 / FLAGGED**2)
    assert flagged.sigma / flagged.doubt == pytest.approx(0.01)


def test_a_pair_astray_is_fitted_anew_at_its_own_rate_from_where_the_others_put_it():
    pairs = [(0, 1), (0, 2), (1, 2)]
    wrong = Alignment(
        between(1, 2).offset + 3.0, RATES[2] / RATES[1], sigma=0.5, fps=30.0, stats=dict(between(1, 2).stats)
    )
    answers = [Answer(p, NONE, between(*p), wrong if p == (1, 2) else between(*p)) for p in pairs]
    asked = []

    def refit(tasks):
        asked.extend((answer.pair, offset, rate) for answer, offset, rate in tasks)
        return [between(*answer.pair) for answer, _, _ in tasks]

    found = judge(3, answers, 0, 0, Graph(curves=False), Trust(), refit)
    assert len(asked) == 1  # what was fitted at its rate is not fitted at it again
    pair, offset, rate = asked[-1]
    assert pair == (1, 2) and rate == pytest.approx(RATES[2] / RATES[1])
    assert offset == pytest.approx(between(1, 2).offset, abs=0.05)
    np.testing.assert_allclose(found.x, X, atol=1e-3)
    assert found.stats["pairs_relocated"] == 1


@pytest.mark.parametrize("flag, joins", [(Status.AMBIGUOUS, True), (Status.POOR_FIT, False)])
def test_summed_curves_vouch_only_for_pairs_with_a_common_motion(flag, joins):
    """Video 2 hangs on two flagged pairs whose curves peak clearly at the solution."""
    t = np.arange(-3, 3, 1 / 30)
    x = np.array([0.0, 0.5, -0.4])

    def answer(a: int, b: int) -> Answer:
        curve = np.stack([t, 100 * np.exp(-0.5 * ((t - (x[b] - x[a])) / 0.05) ** 2)], 1)
        pair = Alignment(x[b] - x[a], sigma=0.002, fps=30.0, curve=curve, flags=(flag,) if b == 2 else ())
        return Answer((a, b), NONE, pair, pair)

    found, _ = settle([answer(0, 1), answer(0, 2), answer(1, 2)], 0, Graph())
    np.testing.assert_allclose(found.x, x, atol=1e-6)
    assert found.flags[1] == () and found.flags[2] == (() if joins else (flag,))


def test_a_pair_with_forced_matches_is_aligned():
    """Aligners bear wrong matches, and judge for themselves; other doubts about matches go along with the answer."""
    xyz = wiggle(np.random.default_rng(0), 12, 100)
    a, b = (TrackSet(x, fps=30) for x in (xyz[:, :90], xyz[:, 10:]))
    every = np.stack([np.arange(12)] * 2, 1)
    for flags, kept in (((Status.FORCED,), ()), ((Status.AMBIGUOUS,), (Status.AMBIGUOUS,))):
        found = run(Job((0, 1), a, b, None, LikelihoodScan(), SplineRefine(), Matches(every, flags=flags)))
        assert found.refined.frames == pytest.approx(10, abs=0.1)
        assert found.refined.flags == kept


@pytest.mark.parametrize(
    ("sigma", "flags", "contradicted"), [(0.018, (), True), (0.018, (Status.AMBIGUOUS,), False), (0.05, (), False)]
)
def test_a_surer_pair_that_vouches_for_another_time_leaves_a_video_in_doubt(sigma, flags, contradicted):
    """Of three pairs of a video one is flagged, and one vouches for a time that the other two overrule: it is fitted
    anew at theirs, and is no witness for it. Of four phones one was 12 frames off so, flagged as coarse alone.
    """

    def told(offset: float, sigma: float, *doubts: Status) -> Alignment:
        return Alignment(offset, sigma=sigma, fps=30.0, flags=doubts)

    def refit(tasks):
        return [told(offset, 0.02) for _, offset, _ in tasks]

    late, doubt = {3: 0.5}, {(0, 3): (Status.SPREAD,)}
    answers = [
        Answer(p, NONE, *[told(late.get(p[1], 0.0), 0.02, *doubt.get(p, ()))] * 2)
        for p in itertools.combinations(range(4), 2)
    ]
    astray = told(-2.0, sigma, *flags)
    answers = [Answer(a.pair, NONE, astray, astray) if a.pair == (2, 3) else a for a in answers]
    found = judge(4, answers, 0, 0, Graph(curves=False), Trust(), refit)
    assert found.x[3] == pytest.approx(0.5, abs=0.15)
    assert (Status.INCONSISTENT in found.flags[3]) == contradicted
    assert not found.flags[1]


def rated(rates: dict[tuple[int, int], float], sigma: float = 0.008, *flagged: tuple[int, int]) -> list[Answer]:
    """Pairs of two seconds that measured these rates of b's clock, and kept 1."""
    answers = []
    for pair, rate in rates.items():
        known = {"fitted_rate": rate, "rate_sigma": sigma, "overlap": 2.0}
        flags = (Status.AMBIGUOUS,) if pair in flagged else ()
        told = Alignment(0.0, sigma=0.002, fps=30.0, stats=known, flags=flags)
        answers.append(Answer(pair, NONE, told, told))
    return answers


EVERY = list(itertools.combinations(range(4), 2))


@pytest.mark.parametrize("who", range(4))
def test_a_clock_that_runs_otherwise_does_so_in_all_its_pairs(who):
    """No pair is sure of it by itself; those without it are left alone."""
    slow = {p: 1.04 if p[1] == who else 1 / 1.04 if p[0] == who else 1.0 for p in EVERY}
    (off,) = off_rates(rated(slow, 0.018), 0 if who else 1, Trust())
    assert off.video == who and off.drift == pytest.approx(0.04, abs=1e-3)
    assert off.sigmas == pytest.approx(np.log(1.04) * np.sqrt(3) / 0.018, rel=1e-3)
    for answer in rated(slow, 0.018):
        assert (Status.RATE_MISMATCH in off.told(answer).refined.flags) == (who in answer.pair)


@pytest.mark.parametrize("off", [{2, 3}, {1, 3}, {1, 2}])
def test_two_phones_of_one_kind_that_run_alike_are_both_told(off):
    """Against the reference, where they are as many as the others; the greater part is right where there is one."""
    own = np.array([1.04 if v in off else 1.0 for v in range(4)])
    found = off_rates(rated({(i, j): own[j] / own[i] for i, j in EVERY}), 0, Trust())
    assert {r.video for r in found if r.sigmas > 3} == off
    odd = {(i, j): (1.04 if j else 1.0) / (1.04 if i else 1.0) for i, j in EVERY}
    assert [r.video for r in off_rates(rated(odd), 0, Trust())] == [0]


def test_a_rate_that_was_kept_is_no_contradiction():
    kept = rated({p: 1.04 if 3 in p else 1.0 for p in EVERY})
    kept = [replace(a, refined=replace(a.refined, rate=a.refined.stats["fitted_rate"])) for a in kept]
    assert all(3 not in (r.video,) for r in off_rates(kept, 0, Trust()))


def test_a_rate_that_may_be_is_in_sigma_and_one_that_is_not_told_is_not():
    slow = {p: 1.04 if p[1] == 3 else 1.0 for p in EVERY}
    (maybe,) = off_rates(rated(slow, 0.03), 0, Trust())
    assert 1.5 < maybe.sigmas < 3
    told = maybe.told(rated(slow, 0.03)[EVERY.index((0, 3))]).refined
    expected = maybe.drift * (maybe.sigmas - 1.5) / 1.5
    assert not told.flags and told.sigma == pytest.approx(np.hypot(0.002, expected))
    assert told.stats["common_error"] == pytest.approx(expected)  # three such pairs know it no better than one
    assert off_rates(rated(slow, 0.2), 0, Trust()) == off_rates([], 0, Trust()) == []
    (strict,) = off_rates(rated(slow, 0.05), 0, Trust(rate_sigmas=1.0))  # 1.4 sigmas
    assert strict.told(rated(slow)[EVERY.index((0, 3))]).refined.flags == (Status.RATE_MISMATCH,)
    (limited,) = off_rates(rated(slow, 0.008), 0, Trust(rate_sigmas=100.0))
    assert not limited.told(rated(slow)[EVERY.index((0, 3))]).refined.flags
    short = {p: 1.004 if p[1] == 3 else 1.0 for p in EVERY}
    assert off_rates(rated(short, 1e-4), 0, Trust()) == []  # it moves the ends by an eighth of a frame


def test_pairs_that_contradict_each_other_or_are_lost_tell_no_rate():
    contradicting = {(0, 1): 1.0, (0, 2): 1.0, (0, 3): 1.04, (1, 2): 1.0, (1, 3): 0.96, (2, 3): 1.0}
    assert off_rates(rated(contradicting), 0, Trust()) == []
    lost = {p: 1.3 if p == (0, 3) else 1.0 for p in EVERY}
    assert off_rates(rated(lost), 0, Trust()) == []
    doubtful = {p: 1.04 if 3 in p else 1.0 for p in EVERY}
    assert off_rates(rated(doubtful, 0.008, (0, 3), (1, 3), (2, 3)), 0, Trust()) == []


@pytest.mark.parametrize("late", [160, 184])
def test_a_video_without_a_frame_in_common_is_not_placed_by_motion_that_returns(late):
    """Its pairs agree, for the others are right among themselves; and of one, cut, no piece reaches far enough."""
    tracks, matches = given([*videos(LATE[:3]), video(late)])
    found = synchronize(tracks, matches=matches)
    assert [status is Status.OK for status in found.status] == [True, True, True, False]
    assert Status.AMBIGUOUS in found.flags[3]
    assert np.allclose(found.frames[:3], LATE[:3], atol=0.1)
