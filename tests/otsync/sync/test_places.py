"""Breaks that positions tell of, in parts too short for windows of motion."""

from __future__ import annotations

import numpy as np
import pytest

from otsync import Alignment, Matches, SplineRefine, Status, TrackSet, synchronize
from otsync.bench.trust.worlds import CLASSES, drawn
from otsync.simulate.effects import Drop, In
from otsync.sync.mend.places import LEAST_JUMP, MOST_FRAMES, Part, measured, parts_by_place
from otsync.sync.verdict import Answer

N = 40


def motion(seed: int):
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(0.3, 1.2, (N, 4, 3)), rng.uniform(0, 6.3, (N, 4, 3))
    size, base = rng.normal(size=(N, 4, 3)) * 0.2, rng.normal(size=(N, 1, 3))
    return lambda t: base + np.einsum("nfc,nfct->ntc", size, np.sin(2 * np.pi * f[..., None] * t + phase[..., None]))


def pair(jump: int, at: int = 75, late: float = 1.0, noise: float = 0.01, seed: int = 0, frames: int = 150):
    """Two videos of 5 s; from frame ``at`` on the second one shows what comes ``jump`` frames later. Every track of it
    has a constant error."""
    rng = np.random.default_rng([seed, 1])
    move, k = motion(seed), np.arange(frames)
    a = move(k / 30)
    b = move(k / 30 + late + jump / 30 * (k >= at)) + 0.05 * rng.normal(size=(N, 1, 3))
    a, b = (TrackSet(x + noise * rng.normal(size=x.shape), fps=30, frame="world") for x in (a, b))
    matches = Matches(np.stack([np.arange(N)] * 2, 1))
    return a, b, Answer((0, 1), matches, Alignment(late, fps=30.0), Alignment(late, fps=30.0))


@pytest.mark.parametrize("jump", [-20, -10, 10, 25])
def test_both_offsets_and_the_moment_of_a_jump_are_found(jump):
    a, b, answer = pair(jump)
    parts = parts_by_place(answer, a, b)
    assert parts.shape == (2, 2)
    np.testing.assert_allclose(parts[:, 1] * 30, [30, 30 + jump], atol=1e-6)
    # a's frames of a gap have no partner; those that b shows twice have two
    low, high = sorted((105 + jump, 105)) if jump < 0 else (105 + jump, 105 + jump)
    assert low - 2 <= parts[1, 0] * 30 <= high + 2


def test_the_answer_may_be_that_of_the_second_part():
    a, b, answer = pair(12, at=40)
    told = Alignment(1.0 + 12 / 30, fps=30.0)
    parts = parts_by_place(Answer((0, 1), answer.matches, told, told), a, b)
    np.testing.assert_allclose(parts[:, 1] * 30, [30, 42], atol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_a_clock_that_runs_evenly_has_one_part(seed):
    a, b, answer = pair(0, seed=seed, noise=0.02)
    assert len(parts_by_place(answer, a, b)) == 0
    assert len(parts_by_place(pair(round(LEAST_JUMP * 30) - 1, seed=seed)[2], a, b)) == 0


def test_clips_that_are_long_or_have_one_frame_are_left_to_windows_of_motion():
    a, b, answer = pair(10, frames=MOST_FRAMES + 1)
    assert len(parts_by_place(answer, a, b)) == 0
    one = TrackSet(a.positions()[:, :1], fps=30, frame="world")
    assert len(parts_by_place(answer, one, b)) == 0


@pytest.mark.parametrize("truth", [0.31, 1.4, 2.13])
def test_a_short_part_is_measured_by_the_places_beside_it(truth):
    """Twelve frames, of which no fit of motion is made, at an offset that no frame coincides with."""
    rng, move, k = np.random.default_rng(7), motion(7), np.arange(150) / 30
    apart = 0.05 * rng.normal(size=(N, 1, 3))
    a = move(k) + 0.003 * rng.normal(size=(N, 150, 3))
    b = np.concatenate([move(k[:90]), move(k[90:] + truth / 30)], 1) + apart + 0.003 * rng.normal(size=(N, 150, 3))
    matches = Matches(np.stack([np.arange(N)] * 2, 1))
    curves = SplineRefine().splines(TrackSet(a, fps=30), TrackSet(b, fps=30), matches)
    known, short = Part(0.0, 2.9, 0.0), Part(3.1, 3.1 + 11.5 / 30, 0.0)
    offset, sigma = measured(*curves, known, short)
    assert offset * 30 == pytest.approx(truth, abs=max(4 * sigma * 30, 0.05))
    assert 0 < sigma * 30 < 0.2
    nowhere = measured(*curves, Part(40.0, 41.0, 0.0), short)
    assert nowhere[0] == 0.0 and np.isnan(nowhere[1])


def test_what_drifts_for_all_matches_alike_counts_in_the_sigma_of_a_short_part():
    """Their scatter does not show it; known parts that are measured in the same way do."""
    move, k, off = motion(7), np.arange(150) / 30, []
    short = Part(3.1, 3.1 + 11.5 / 30, 0.0)
    for seed in range(12):
        rng = np.random.default_rng([seed, 2])
        phase = rng.uniform(0, 6.3, (3, 3))
        drift = 0.05 * np.sin(2 * np.pi * np.outer(k, [0.4, 0.9, 1.4])[..., None] + phase).sum(1)
        a, b = (move(k) + 0.003 * rng.normal(size=(N, 150, 3)) + d for d in (0.0, drift))
        matches = Matches(np.stack([np.arange(N)] * 2, 1))
        curves = SplineRefine().splines(TrackSet(a, fps=30), TrackSet(b, fps=30), matches)
        offset, sigma = measured(*curves, Part(0.0, 2.9, 0.0), short)
        off.append(abs(offset) / sigma)
    assert max(off) < 1.5


@pytest.mark.parametrize("seed", [41010, 41012])
def test_lost_frames_near_an_end_are_named_and_mended(seed):
    """Twenty frames behind ten lost ones: motion alone measured the jump to a frame, and the mend was thrown away."""
    world = CLASSES["ten frames dropped"](seed)
    offsets = synchronize(world.tracks)
    (found,) = offsets.breaks[0] + offsets.breaks[1]
    assert abs(found.jump) * 30 == pytest.approx(10, abs=0.5)
    assert world.errors(offsets)[0][0] < min(0.2, 2 * offsets.sigma[1] * 30)
    assert set(offsets.flags[1]) <= {Status.COARSE}


def test_what_rests_where_frames_are_lost_is_not_vouched_for():
    """Hardly anything moves behind the break: nobody can tell, and the answer says so (seed 42017)."""
    tracks, _ = drawn(42017, first=(In(1, Drop(10 / 30)),))
    assert not synchronize(tracks).status[1].ok
