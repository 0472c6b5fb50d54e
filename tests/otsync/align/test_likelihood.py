"""The likelihood scan against its formula, and its laws."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest

from otsync import DTW, LikelihoodScan, Matches, Refused, Status, TrackSet, align
from otsync.align.another_time import by_sample, returning
from otsync.align.evidence import Curves, evidence, noise_floor, statistics, velocity_score
from otsync.align.peaks import separate_peaks, vertex
from otsync.align.signal import Signal
from otsync.align.windows import local_curves
from otsync.bench.hard_cases.graphs import video
from otsync.clocks.common import common_clock
from otsync.simulate import simulate
from otsync.types.trust import Trust
from tests.conftest import wiggle

ALL = Matches(np.stack([np.arange(12)] * 2, 1))


def moving_pair(lag: int, frames: int = 90, n: int = 12, noise: float = 0.0, seed: int = 0):
    """Two windows on the same smooth tracks; b starts ``lag`` frames later."""
    rng = np.random.default_rng(seed)
    world = wiggle(rng, n, frames + abs(lag))
    a, b = (world[:, s : s + frames] for s in ((0, lag) if lag >= 0 else (-lag, 0)))
    a, b = (x + noise * rng.normal(size=x.shape) for x in (a, b))
    return TrackSet(a, fps=30), TrackSet(b, fps=30)


def brute_force(a, b, k, least):
    """n, Var a + Var b, Var(a - b) of one match at one lag, by numpy."""
    lo, hi = max(0, k), min(len(a), len(b) + k)
    x, y = a[lo:hi], b[lo - k : hi - k]
    both = np.isfinite(x[:, 0]) & np.isfinite(y[:, 0])
    if both.sum() < least:
        return 0.0, 0.0, 0.0
    x, y = x[both], y[both]
    return float(both.sum()), x.var(0).sum() + y.var(0).sum(), (x - y).var(0).sum()


def with_gaps(tracks: TrackSet, seed: int) -> TrackSet:
    rng = np.random.default_rng(seed)
    seen = np.ones((len(tracks), tracks.n_frames), bool)
    for row in seen:
        start = rng.integers(0, tracks.n_frames - 20)
        row[start : start + rng.integers(5, 20)] = False
    return dataclasses.replace(tracks, visible=seen)


def brief(tracks: TrackSet, seed: int) -> TrackSet:
    """Tracks that live in a part of the clip, one in none of it."""
    rng, seen = np.random.default_rng(seed), with_gaps(tracks, seed).seen
    for row in seen:
        row[: rng.integers(0, tracks.n_frames // 3)] = False
        row[rng.integers(tracks.n_frames // 2, tracks.n_frames) :] = False
    seen[0] = False
    return dataclasses.replace(tracks, visible=seen)


@pytest.mark.parametrize("lives", [with_gaps, brief])
def test_statistics_are_those_of_numpy(lives):
    a, b = moving_pair(7, frames=60, noise=0.05)
    a, b = lives(a, 1), lives(b, 2)
    lags = np.arange(-30, 31)
    found = statistics(Signal.of(a.positions()), Signal.of(b.positions()), lags, 12)
    for m in range(len(a)):
        for n, k in enumerate(lags):
            expected = brute_force(a.positions()[m], b.positions()[m], k, 12)
            np.testing.assert_allclose([f[m, n] for f in found], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("lives", [with_gaps, brief])
def test_windows_are_the_formula(lives):
    """Σ ¼ c log((Va + Vb + e²) / (Vr + e²)) over windows of two blocks from the first common frame on."""
    a, b = moving_pair(5, frames=70, noise=0.05)
    a, b = lives(a, 3), lives(b, 4)
    pair = common_clock(a, b, ALL)
    lags = pair.lags(24, None)
    curves = evidence(pair, lags)
    floor = noise_floor(*statistics(Signal.of(pair.a), Signal.of(pair.b), lags, 12))
    block, least = 20, 10
    told = np.flatnonzero(curves.observed)  # of brief lives not all lags are
    for n in told[[0, min(20, len(told) - 1), len(told) // 2, -1]]:
        k, total = lags[n], 0.0
        first, end = max(0, k), min(70, 70 + k)
        starts = [first + (j - 1) * block for j in range(-(-(end - first) // block) + 1)]
        for m in range(len(ALL)):
            for s in starts:
                lo, hi = max(s, first), min(s + 2 * block, end)
                x, y = pair.a[m, lo:hi], pair.b[m, lo - k : hi - k]
                c, power, residual = brute_force(x, y, 0, least)
                if c:
                    total += 0.25 * c * np.log((power + floor) / (residual + floor))
        assert curves.windows[n] == pytest.approx(total / len(ALL), rel=1e-9)


@pytest.mark.parametrize("lag", [-23, -4, 0, 11, 30])
def test_finds_a_known_lag(lag):
    a, b = moving_pair(lag, noise=0.02)
    found = align(a, b, ALL, LikelihoodScan())
    assert found.status.ok
    assert found.frames == pytest.approx(lag, abs=0.25)
    assert found.hypotheses[0, 0] == pytest.approx(found.offset)
    assert (np.diff(found.hypotheses[:, 1]) <= 0).all()
    assert found.curve is not None
    assert found.curve[:, 1].max() == pytest.approx(found.hypotheses[0, 1])


def test_exchanging_the_videos_flips_the_sign():
    a, b = moving_pair(9, noise=0.05)
    a, b = with_gaps(a, 5), with_gaps(b, 6)
    there, back = (align(*x, LikelihoodScan(), throw=False) for x in ((a, b, ALL), (b, a, ALL.swapped())))
    assert there.offset == pytest.approx(-back.offset, abs=1e-9)
    np.testing.assert_allclose(there.curve[:, 1], back.curve[::-1, 1], atol=1e-8)


@pytest.mark.parametrize("scale", [1e-6, 2.0**20, 1e6])
def test_no_unit_enters(scale):
    a, b = moving_pair(9, noise=0.05)
    found = align(a, b, ALL, LikelihoodScan(), throw=False)
    other = align(*(dataclasses.replace(t, xyz=t.xyz * scale) for t in (a, b)), ALL, LikelihoodScan(), throw=False)
    np.testing.assert_allclose(other.curve[:, 1], found.curve[:, 1], rtol=1e-6, atol=1e-8)
    assert other.flags == found.flags


def test_constant_errors_of_tracks_change_nothing():
    a, b = moving_pair(9, noise=0.05)
    moved = dataclasses.replace(b, xyz=b.xyz + np.random.default_rng(1).normal(size=(12, 1, 3)))
    found, other = (align(a, x, ALL, LikelihoodScan(), throw=False) for x in (b, moved))
    np.testing.assert_allclose(other.curve[:, 1], found.curve[:, 1], rtol=1e-7, atol=1e-7)


def test_a_wrong_match_has_no_veto():
    """Matches of unrelated motion lower the peak in proportion and do not move it."""
    a, b = moving_pair(9, noise=0.02)
    stranger = TrackSet(wiggle(np.random.default_rng(99), 12, 90), fps=30)
    both = TrackSet(np.concatenate([b.xyz, stranger.xyz]), fps=30)
    pairs = np.concatenate([ALL.pairs, np.stack([np.arange(12), np.arange(12) + 12], 1)])
    found = align(a, both, Matches(pairs), LikelihoodScan(), throw=False)
    assert found.frames == pytest.approx(9, abs=0.3)


def test_many_matches_are_cut_to_the_best():
    a, b = moving_pair(9)
    pairs = np.concatenate([ALL.pairs, np.stack([np.arange(12), np.roll(np.arange(12), 5)], 1)])
    score = np.r_[np.ones(12), np.zeros(12)]
    cut = align(a, b, Matches(pairs, score), LikelihoodScan(limit=12), throw=False)
    assert cut.stats["matches"] == 12
    np.testing.assert_array_equal(cut.curve, align(a, b, ALL, LikelihoodScan(), throw=False).curve)


def test_max_lag_limits_the_search():
    a, b = moving_pair(20)
    found = align(a, b, ALL, LikelihoodScan(max_lag=19 / 30), throw=False)
    assert np.abs(found.curve[:, 0]).max() <= 19 / 30 + 1e-9
    assert Status.BORDER in found.flags and Status.BORDER not in align(a, b, ALL, throw=False).flags


def test_no_matches_and_no_overlap_are_refused():
    a, b = moving_pair(0)
    with pytest.raises(Refused, match="few_matches"):
        align(a, b, Matches(np.zeros((0, 2), int)), LikelihoodScan())
    with pytest.raises(Refused, match="no_overlap"):
        align(a, b, ALL, LikelihoodScan(min_overlap=10.0))


def test_nothing_moves_is_static():
    still = TrackSet(np.repeat(np.random.default_rng(0).normal(size=(12, 1, 3)), 90, 1), fps=30)
    found = align(still, still, ALL, LikelihoodScan(), throw=False)
    assert Status.STATIC in found.flags and Status.WEAK in found.flags


def test_periodic_motion_is_ambiguous():
    t = np.arange(120) / 30
    phase = np.random.default_rng(0).uniform(0, 6.28, (12, 1, 3))
    wave = np.sin(2 * np.pi * 1.0 * t[None, :, None] + phase)
    a, b = TrackSet(wave[:, :90], fps=30), TrackSet(wave[:, 10:100], fps=30)
    found = align(a, b, ALL, LikelihoodScan(), throw=False)
    assert Status.AMBIGUOUS in found.flags or Status.ALIAS in found.flags
    spacing = np.diff(np.sort(found.hypotheses[:, 0]))
    np.testing.assert_allclose(spacing[spacing < 1.5], 1.0, atol=0.2)


def test_a_wrong_frame_rate_is_noticed():
    (a, b), truth = simulate("tennis", preset="mid", fps=[30, 25], frames=[150, 125], offsets=[0, 0.4], seed=3)
    m = truth.matches(0, 1)
    assert align(a, b, m).frames / 25 == pytest.approx(0.4, abs=0.02)
    wrong = align(a, dataclasses.replace(b, fps=30.0), m, throw=False)
    assert Status.RATE_MISMATCH in wrong.flags
    assert wrong.stats["other_rate"] == pytest.approx(6 / 5)


def test_peaks_are_apart_and_ordered():
    lags = np.arange(-10, 11)
    score = np.zeros(21)
    score[[3, 5, 10, 17]] = 4, 5, 5, 3
    assert separate_peaks(score, 4, 3, prefer=np.abs(lags)) == [10, 5, 17]
    assert separate_peaks(score, 4, 3) == [5, 10, 17]
    assert vertex(lags, -((lags - 1.3) ** 2), 11) == pytest.approx(1.3)


def test_curves_that_peak_elsewhere_disagree_and_short_overlaps_alias():
    a, b = moving_pair(9, noise=0.05)
    pair = common_clock(a, b, ALL)
    lags = pair.lags(24, None)
    curves, scan = evidence(pair, lags), LikelihoodScan()
    top = int(np.argmax(curves.total))
    assert scan._stats(pair, lags, curves, [top])["disagreement"] <= 1 / 30
    for part in ("slow", "windows"):
        moved = dataclasses.replace(curves, **{part: np.roll(getattr(curves, part), 8)})
        assert scan._stats(pair, lags, moved, [top])["disagreement"] >= 7 / 30
    end = curves.total.copy()
    end[2] = end[top] * 0.9
    assert scan._stats(pair, lags, dataclasses.replace(curves, total=end), [top])["alias"] > 1.0


def test_the_noise_floor_is_a_quarter_of_the_typical_least_residual():
    """Of the lags at which a match was seen; a match that never was says nothing."""
    count = np.array([[0.0, 20], [30, 30], [0, 0]])
    power, residual = np.where(count > 0, 5.0, 0), np.array([[0, 0.4], [0.2, 0.8], [0, 0]])
    assert noise_floor(count, power, residual) == pytest.approx(0.25 * 0.3)


def test_as_much_evidence_per_frame_over_fewer_frames_is_a_full_rival():
    """A period later, exact repetition has the same rate of evidence over a shorter overlap."""
    a, b = moving_pair(0)
    pair = common_clock(a, b, ALL)
    lags = pair.lags(24, None)
    overlap = pair.overlap(lags)
    top, later = (int(np.flatnonzero(lags == k)[0]) for k in (0, 30))
    total = np.zeros(len(lags))
    total[top], total[later] = 90.0, 90.0 * overlap[later] / overlap[top]
    curves = Curves(total, total, total, np.full(len(lags), 12.0), np.ones(len(lags)), np.ones(len(lags)))
    assert LikelihoodScan()._stats(pair, lags, curves, [top, later])["margin"] == pytest.approx(0)


def test_weights_count_matches_as_often_as_they_say():
    """Weight 2 is being there twice, weight 0 is not being there, in velocities and in windows."""
    a, b = moving_pair(9, noise=0.05)
    pair = common_clock(a, b, ALL)
    lags, weight = pair.lags(24, None), np.r_[np.zeros(4), np.ones(4), 2 * np.ones(4)]
    weighted = velocity_score(pair, lags, 2, 12, weight)
    alone = [velocity_score(pair, lags, 2, 12, 12.0 * (np.arange(12) == m)) for m in range(12)]
    np.testing.assert_allclose(weighted, np.average(alone, axis=0, weights=weight))
    assert not np.allclose(weighted, velocity_score(pair, lags, 2, 12))


def test_a_few_matches_at_a_time_say_what_all_of_them_say(monkeypatch):
    """Long clips are read so; here every clip is long. Weights go with their matches."""
    a, b = moving_pair(7, frames=120, n=11, noise=0.01)
    matches = Matches(np.stack([np.arange(11)] * 2, 1), weight=np.linspace(0.2, 2.0, 11))
    pair = common_clock(a, b, matches)
    lags = np.arange(-30, 31)
    whole = evidence(pair, lags, matches.shares).total, local_curves(pair, lags, 0.01, matches.shares)
    parts = []

    def three_at_a_time(rows, columns):
        parts.append(rows)
        return [slice(k, k + 3) for k in range(0, rows, 3)]

    # ``otsync.align`` is a function, too, which hides the package from a path in words
    scan, windows = (sys.modules[f"otsync.align.{name}"] for name in ("evidence", "windows"))
    for module in (scan, windows):
        monkeypatch.setattr(module, "blocks", three_at_a_time)
    monkeypatch.setattr(scan, "DIRECT", 0)  # windows at the peaks alone
    long = evidence(pair, lags, matches.shares).total
    np.testing.assert_allclose(local_curves(pair, lags, 0.01, matches.shares), whole[1], rtol=1e-9, atol=1e-9)
    assert np.argmax(long) == np.argmax(whole[0])
    np.testing.assert_allclose(long.max(), whole[0].max(), rtol=1e-6)
    assert parts and set(parts) == {11}


def test_an_answer_that_may_be_another_time_is_ambiguous():
    """The second video begins when the first one has ended, and the scene nearly returns: no lag shows the rival."""
    first, later = video(12), video(208)
    same = Matches(np.stack([np.arange(len(first))] * 2, 1))
    wrong = LikelihoodScan()(first, later, same)
    assert Status.AMBIGUOUS in wrong.flags and wrong.stats["another_time"] == 1
    assert wrong.stats["margin"] > Trust().margin
    believed = LikelihoodScan(trust=Trust(returning=1.2))(first, later, same)
    assert Status.AMBIGUOUS not in believed.flags and believed.stats["another_time"] == 0
    right = LikelihoodScan()(first, video(37), same)
    assert right.status is Status.OK and 0 < right.stats["returning"] < 0.5 * right.stats["likeness"]


def test_another_time_is_told_for_aligners_that_raise_no_flags():
    first, later = video(12), video(208)
    same = Matches(np.stack([np.arange(len(first))] * 2, 1))
    found = align(first, later, same, aligner=DTW(), throw=False)
    assert Status.AMBIGUOUS in found.flags and found.stats["another_time"] == 1


@pytest.mark.parametrize("wrong", [0.5, 0.6])
def test_wrong_matches_do_not_make_a_right_answer_another_time(wrong):
    """They make two videos less alike; a video is like itself whatever it is matched to."""
    first, later = video(0), video(60)
    rng = np.random.default_rng(1)
    partner = np.arange(len(first))
    astray = rng.random(len(first)) < wrong
    partner[astray] = np.roll(partner[astray], 3)
    found = LikelihoodScan()(first, later, Matches(np.stack([np.arange(len(first)), partner], 1)))
    assert found.frames == pytest.approx(60, abs=0.2) and found.stats["another_time"] == 0


def test_ends_that_are_alike_tell_nothing_of_what_lies_between():
    rng = np.random.default_rng(7)
    steps = rng.normal(size=(12, 940, 3))
    world = np.apply_along_axis(np.convolve, 1, steps, np.hanning(41), "valid")  # never twice alike
    ease = np.clip(np.minimum(np.arange(900) - 840, 10) / 10, 0, 1)[:, None]
    world = world * (1 - ease) + ease * np.concatenate([world[:, :850], world[:, :50]], 1)  # the first 50 once more
    first, later = TrackSet(world, fps=30), TrackSet(world[:, 250:600], fps=30)
    found = LikelihoodScan()(first, later, ALL)
    assert found.status is Status.OK and found.frames == pytest.approx(250, abs=0.1)


@pytest.mark.parametrize("weighted", [False, True])
def test_what_returns_is_looked_for_out_of_reach_alone(weighted):
    """Against the definition; alike for exchanged videos, and by what is seen, not by frames."""
    world = wiggle(np.random.default_rng(4), 12, 200)
    a, b = TrackSet(world[:, :100], fps=30), TrackSet(world[:, 40:150], fps=30)
    weight = np.random.default_rng(5).uniform(0.5, 1.5, 12) if weighted else np.ones(12)
    weight /= weight.mean()
    pair = common_clock(a, b, ALL)
    reach, told = pair.lags(24, None), 0.0
    for x in (pair.a, pair.b):
        later = np.arange(15, x.shape[1] - 35)
        alike = evidence(dataclasses.replace(pair, a=x, b=x), later, weight).total / (x.shape[1] - later)
        told = max(told, *(one for k, one in zip(later, alike, strict=True) if 40 + k > reach[-1] or 40 - k < reach[0]))
    here, again = returning(pair, 40, 24, None, weight)
    assert told > 0 and again == pytest.approx(told, rel=1e-6)
    assert here == pytest.approx(float(evidence(pair, np.array([40]), weight).total[0]) / 60, rel=1e-6)
    exchanged = dataclasses.replace(pair, a=pair.b, b=pair.a)
    assert returning(exchanged, -40, 24, None, weight) == pytest.approx((here, again), rel=1e-6)
    assert returning(pair, 40, 24, 1.4, weight)[1] == 0.0  # the caller rules out what no lag shows


def test_a_few_tracks_that_are_seen_again_tell_nothing_of_the_others():
    """Tracks live for 2 of 10 s, every fifth is seen once more for 1 s: by chance one of them is like itself then."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        steps = rng.normal(size=(40, 440, 3))
        world = np.apply_along_axis(np.convolve, 1, steps, np.hanning(41), "valid") / 4
        seen = np.zeros((40, 400), bool)
        for k, begin in enumerate(rng.integers(100, 240, 40)):
            seen[k, begin : begin + 60] = True
            if k % 5 == 0:
                seen[k, :30] = True
        a, b = (
            TrackSet(world[:, s : s + 300] + 0.2 * rng.normal(size=(40, 300, 3)), visible=seen[:, s : s + 300], fps=30)
            for s in (0, 100)
        )
        found = LikelihoodScan()(a, b, Matches(np.stack([np.arange(40)] * 2, 1)))
        assert found.stats["another_time"] == 0, found.stats


def test_tracks_of_a_long_clip_that_are_never_seen_again(monkeypatch):
    """By spectra no lag shows a match in both then: nothing returns, and nothing fails."""
    monkeypatch.setattr(sys.modules["otsync.align.evidence"], "DIRECT", 0)
    world = wiggle(np.random.default_rng(0), 12, 600)
    seen = np.zeros((12, 600), bool)
    seen[:, 280:340] = True
    pair = common_clock(*(TrackSet(world[:, s : s + 400], visible=seen[:, s : s + 400], fps=30) for s in (0, 200)), ALL)
    here, again = returning(pair, 200, 24, None, np.ones(12))
    assert here > 0 and again == 0


def test_what_returns_heeds_weights_of_tracks_that_are_seen_in_turn():
    """A match of no weight adds nothing, neither to the score nor to what is seen."""
    a, b = moving_pair(20)
    gone = with_gaps(b, 3)
    pair, alone = common_clock(a, gone, ALL), common_clock(a, gone, Matches(ALL.pairs[:6]))
    weight = np.repeat([2.0, 0.0], 6)
    for one, other in zip(
        by_sample(pair, np.array([20]), weight), by_sample(alone, np.array([20]), np.ones(6)), strict=True
    ):
        assert one == pytest.approx(other, rel=0.02)
