"""Aligners: sign, laws, gaps, clocks, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tslearn.metrics import dtw_path_from_metric

from otsync import DTW, Alignment, ConstantShift, LikelihoodScan, Matches, Refused, Status, TrackSet, align
from otsync.align.kernels import open_end_path
from otsync.align.peaks import most_frequent, peak

ALIGNERS = [DTW(), DTW(open_ends=True), DTW(cost="velocity"), ConstantShift(), ConstantShift(cost="velocity")]


def world(rng: np.random.Generator, n: int):
    """xyz(t) of n points on smooth random paths, defined at every real t: (n, len(t), 3)."""
    f, phase = rng.uniform(0.2, 1.2, (n, 5, 3)), rng.uniform(0, 6.3, (n, 5, 3))
    size, base = rng.normal(size=(n, 5, 3)) * 0.3, rng.normal(size=(n, 1, 3))
    return lambda t: base + np.einsum("nfc,nfct->ntc", size, np.sin(2 * np.pi * f[..., None] * t + phase[..., None]))


def films(seed: int, offset: float, *, n: int = 12, frames: int = 120, fps_b: float = 30.0):
    """Two videos of one world, b started ``offset`` seconds later."""
    move = world(np.random.default_rng(seed), n)
    a = TrackSet(move(np.arange(frames) / 30), fps=30)
    b = TrackSet(move(np.arange(int(frames * fps_b / 30)) / fps_b + offset), fps=fps_b)
    return a, b, Matches(np.stack([np.arange(n)] * 2, 1))


@pytest.mark.parametrize("aligner", ALIGNERS, ids=str)
@pytest.mark.parametrize("frames", [-17, 0, 9])
def test_sign_and_size_of_an_integer_offset(aligner, frames):
    """b started later: positive."""
    found = align(*films(1, frames / 30), aligner)
    assert found.frames == pytest.approx(frames, abs=0.35) and found.fps == 30


def test_the_constant_shift_is_below_the_frame():
    errors = [align(*films(s, 0.21 + s / 300), ConstantShift()).frames - 30 * (0.21 + s / 300) for s in range(8)]
    assert np.abs(errors).max() < 0.3


@given(st.integers(0, 10**6), st.floats(-0.8, 0.8), st.sampled_from(range(len(ALIGNERS))))
@settings(max_examples=25, deadline=None)
def test_swapping_the_videos_flips_the_sign(seed, offset, which):
    a, b, matches = films(seed, offset, frames=90)
    forward, backward = (align(x, y, m, ALIGNERS[which]) for x, y, m in ((a, b, matches), (b, a, matches.swapped())))
    assert forward.offset == pytest.approx(-backward.offset, abs=1e-9)


@pytest.mark.parametrize("aligner", ALIGNERS, ids=str)
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_unit_order_and_rigid_motion_change_nothing(aligner, unit):
    a, b, matches = films(2, 0.3)
    rotation = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])  # L1 is invariant under this one
    before = align(a, b, matches, aligner).offset
    moved = [replace(t, xyz=(t.xyz @ rotation.T + [3, 1, 2]) * unit) for t in (a, b)]
    order = np.random.default_rng(0).permutation(len(matches))
    assert align(*moved, Matches(matches.pairs[order]), aligner).offset == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize("aligner", ALIGNERS, ids=str)
def test_missing_samples_are_left_out_never_zeros(aligner):
    a, b, matches = films(3, 0.4)
    rng = np.random.default_rng(0)
    a, b = (
        replace(t, visible=seen, xyz=np.where(seen[..., None], t.xyz, 1e6))
        for t in (a, b)
        for seen in [np.repeat(rng.random((12, 12)) < 0.7, 10, axis=1)]
    )
    assert align(a, b, matches, aligner).frames == pytest.approx(12, abs=1.0)


@pytest.mark.parametrize("aligner", ALIGNERS, ids=str)
@pytest.mark.parametrize("fps_b", [24.0, 60.0])
def test_frame_rates_are_brought_on_one_clock(aligner, fps_b):
    found = align(*films(4, 0.35, fps_b=fps_b), aligner)
    assert found.fps == min(30, fps_b) and found.offset == pytest.approx(0.35, abs=0.6 / found.fps)


def test_dtw_is_the_papers():
    """D_geo, tslearn's path, the mode of i - j."""
    a, b, matches = films(5, 0.37)
    found = align(a, b, matches, DTW())
    cost = np.abs(a.xyz[:, :, None] - b.xyz[:, None]).sum(-1).mean(0)
    np.testing.assert_allclose(found.cost, cost)
    path, _ = dtw_path_from_metric(cost, metric="precomputed")
    np.testing.assert_array_equal(found.path, path)
    values, counts = np.unique(np.diff(found.path[:, ::-1])[:, 0], return_counts=True)
    assert found.frames == values[counts.argmax()]


def test_corner_to_corner_pays_for_large_offsets_and_open_ends_do_not():
    """The paper's failure: over the pedestal that biased depth leaves, the main diagonal is cheapest."""
    paper, open_ends = [], []
    for seed in range(8):
        a, b, matches = films(seed, 1.5)
        biased = replace(b, xyz=b.xyz + np.random.default_rng(seed).normal(size=(12, 1, 3)))
        for errors, aligner in ((paper, DTW()), (open_ends, DTW(open_ends=True))):
            errors.append(abs(align(a, biased, matches, aligner, throw=False).frames - 45))
    assert np.mean(paper) > 3 * np.mean(open_ends)


def test_open_end_path_on_a_clear_valley():
    i, j = np.mgrid[0:20, 0:15]
    path = open_end_path((i - j - 7.0) ** 2, 0.5)
    assert path.tolist() == [[k + 7, k] for k in range(13)]


def test_ties_are_symmetric():
    assert most_frequent(np.array([3, 3, 5, 5, 1])) == 4 and most_frequent(np.array([-3, -3, 3, 3])) == 0
    assert peak(np.arange(-2, 3), np.array([1.0, 0, 0, 0, 1.0])) in (-2, 2)
    assert peak(np.arange(-2, 3), np.zeros(5)) == 0


def test_peak_is_the_vertex_of_a_parabola():
    lags = np.arange(-5, 6)
    assert peak(lags, -((lags - 1.3) ** 2)) == pytest.approx(1.3)
    assert peak(lags, np.where(lags == 0, 1.0, -np.inf)) == 0


@pytest.mark.parametrize("aligner", ALIGNERS, ids=str)
def test_nothing_to_compare_is_said(aligner):
    a, b, matches = films(6, 0.0)
    hidden = replace(a, visible=np.zeros_like(a.visible))
    with pytest.raises(Refused, match="no_overlap") as caught:
        align(hidden, b, matches, aligner)
    assert np.isnan(caught.value.result.offset)
    assert align(a, b, Matches([]), aligner, throw=False).status is Status.FEW_MATCHES


def test_too_short_for_the_required_overlap_is_said():
    a, b, matches = films(7, 0.0, frames=20)
    assert align(a, b, matches, ConstantShift(), throw=False).status is Status.NO_OVERLAP
    found = align(a, b, matches, ConstantShift(min_overlap=0.5), throw=False)
    assert found.frames == pytest.approx(0, abs=0.3) and not found.status.ok  # 20 frames vouch for nothing


@pytest.mark.parametrize("aligner", ALIGNERS, ids=str)
def test_things_at_rest_tell_no_time(aligner):
    a, b, matches = films(7, 0.0)
    still = [replace(t, xyz=np.repeat(t.xyz[:, :1], 120, axis=1)) for t in (a, b)]
    found = align(*still, matches, aligner, throw=False)
    assert found.status is Status.STATIC and np.isnan(found.offset)


def test_a_clip_shorter_than_any_overlap_has_no_answer():
    a, b, matches = films(7, 0.0, frames=20)
    assert align(a, b, matches, DTW(), throw=False).status is Status.NO_OVERLAP


def test_different_declared_worlds_are_refused():
    a, b, matches = films(7, 0.0)
    with pytest.raises(ValueError, match=r"b\.frame: expected 'here' as a declares; found 'there'"):
        align(replace(a, frame="here"), replace(b, frame="there"), matches, DTW())
    assert align(replace(a, frame="here"), b, matches, DTW()).status.ok


def test_max_lag_bounds_the_search():
    a, b, matches = films(8, 1.0)
    found = align(a, b, matches, ConstantShift(max_lag=0.5), throw=False)
    assert not found.status.ok  # the best shift lies beyond
    assert abs(found.offset) <= 0.5 + 1 / 60 and np.abs(found.curve[:, 0]).max() <= 0.5 + 1e-9


def test_bad_arguments_are_refused_by_name():
    a, b, matches = films(9, 0.0)
    with pytest.raises(ValueError, match=r"matches\.pairs: expected indices of a below 3"):
        align(a.take(slice(0, 3)), b, matches)
    broken = replace(a, xyz=np.where(np.arange(120)[None, :, None] == 4, np.nan, a.xyz))
    with pytest.raises(ValueError, match=r"a\.xyz: expected finite.*track 0, frame 4"):
        align(broken, b, matches)
    with pytest.raises(ValueError, match="cost: expected 'position' or 'velocity'"):
        align(a, b, matches, DTW(cost="acceleration"))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"b\.xyz: expected 3D positions"):
        align(a, TrackSet(None, uv=np.zeros((12, 5, 2)), fps=30), matches)


def test_answers_without_flags_of_their_own_get_a_second_opinion():
    """DTW tells no doubts: its answer carries the likelihood scan's, and DISAGREE where that answers otherwise."""
    a, b, matches = films(3, 0.5)
    right = align(a, b, matches, ConstantShift())
    assert right.status is Status.OK and right.frames == pytest.approx(15, abs=0.3)
    elsewhere = align(a, b, matches, lambda a, b, m: Alignment(-0.7, fps=30.0), throw=False)
    assert elsewhere.offset == -0.7 and elsewhere.flags == (Status.DISAGREE,)
    still = [replace(t, xyz=t.xyz[:, :1] + 1e-4 * np.random.default_rng(1).normal(size=t.xyz.shape)) for t in (a, b)]
    assert not align(*still, matches, DTW(), throw=False).status.ok


def test_somebody_else_who_does_the_same_later_is_flagged_in_one_world_frame():
    """Velocities do not see where things are. Without a declared frame nothing says that places should agree."""
    a, b, matches = films(4, 0.5)
    here, there = (replace(t, xyz=t.xyz + np.array([x, 0, 0]), frame="world") for t, x in ((a, 0.0), (b, 8.0)))
    found = align(here, there, matches, throw=False)
    assert Status.AMBIGUOUS in found.flags and found.stats["apart"] > 1.2
    same = align(here, replace(b, frame="world"), matches)
    assert same.status is Status.OK and same.stats["apart"] < 0.5
    assert align(a, replace(there, frame=None), matches).status is Status.OK


@pytest.mark.parametrize("seed", range(8))
def test_a_drift_that_all_tracks_share_is_no_evidence(seed):
    """A static scene whose calibration or trackers drift alike in each video's own clock: no offset is vouched for."""
    rng = np.random.default_rng(seed)
    t, size = np.arange(120) / 30, rng.uniform(0.1, 0.3)
    turn, phase = rng.uniform(0.3, 1.2, 3), rng.uniform(0, 6.3, 3)
    drift = size * (np.sin(turn * t[:, None] + phase) - np.sin(phase)) * rng.normal(size=3)
    still = rng.normal(size=(40, 1, 3)) * [1.5, 1.5, 0.6]
    a, b = (TrackSet(still + drift + 0.004 * rng.normal(size=(40, 120, 3)), fps=30, frame="world") for _ in "ab")
    matches = Matches(np.stack([np.arange(40)] * 2, 1))
    for aligner in (LikelihoodScan(), DTW(), ConstantShift()):
        assert Status.STATIC in align(a, b, matches, aligner, throw=False).flags


def test_a_rigid_thing_that_goes_somewhere_tells_the_time():
    rng = np.random.default_rng(0)
    t = np.arange(150) / 30
    path = np.stack([np.sin(1.1 * t), np.cos(0.7 * t) + 0.3 * t, 0.2 * np.sin(3 * t)], 1)
    body = 0.3 * rng.normal(size=(40, 1, 3))
    a, b = (
        TrackSet(body + path[k : k + 120] + 0.004 * rng.normal(size=(40, 120, 3)), fps=30, frame="world")
        for k in (0, 9)
    )
    found = align(a, b, Matches(np.stack([np.arange(40)] * 2, 1)))
    assert found.status.ok and found.offset == pytest.approx(0.3, abs=0.02)
