"""Votes of frames tell a clock that breaks: laws on votes, and fits of worlds that lost frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otsync.types import Offsets, Status
from recon.fit.leave_one_out import FEW
from recon.fit.parts import GAP, LEAST, broken, parting, tilt
from recon.fit.uncertainty import MISFIT, Votes
from recon.fit.verb import fit
from recon.simulate.capture import synthetic
from recon.simulate.recording import initial_scene
from tests.recon.worlds import filmed_anew

STEP = 1 / 30


def votes(seconds: np.ndarray, h: np.ndarray | None = None, misfit: float = 0.0) -> Votes:
    """Of frames that each tell ``seconds``, and are shown so badly that all clocks may be ``misfit`` seconds off."""
    h = np.ones(len(seconds)) if h is None else h
    return Votes(np.arange(len(seconds)), -seconds * h, h, MISFIT * misfit * h, h)


def noise(seed: int, n: int = 48, size: float = 0.02) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=n) * size * STEP


@given(
    seed=st.integers(0, 99), at=st.integers(LEAST + 2, 42), gap=st.floats(0.2, 2.0), back=st.booleans(), n=st.just(48)
)
def test_a_step_is_found_where_it_is(seed, at, gap, back, n):
    size = -gap if back else gap
    told = noise(seed, n) + np.where(np.arange(n) < at, 0.0, size * STEP)
    rng = np.random.default_rng(seed)
    found = parting(votes(told, rng.uniform(0.5, 2.0, n)))
    assert found is not None and (found.first, found.last) == (at, n - 1)
    assert found.gap / STEP == pytest.approx(size, abs=0.05) and abs(found.gap) > 4 * found.sigma


@given(seed=st.integers(0, 99), first=st.integers(6, 20), length=st.integers(10, 22), gap=st.floats(0.3, 2.0))
def test_a_part_within_is_found_where_it_is(seed, first, length, gap):
    inside = (np.arange(48) >= first) & (np.arange(48) < first + length)
    found = parting(votes(noise(seed) - gap * STEP * inside))
    assert found is not None and (found.first, found.last) == (first, first + length - 1)
    assert found.gap / STEP == pytest.approx(-gap, abs=0.05) and abs(found.gap) > 4 * found.sigma


@given(seed=st.integers(0, 999), videos=st.integers(2, 14))
def test_frames_that_agree_are_no_parts(seed, videos):
    """However long the votes of neighbours wander together, below the least gap."""
    rng = np.random.default_rng(seed)
    told = [np.convolve(noise(seed + v, 60, 0.1), np.full(6, 1 / 6), "valid")[:48] for v in range(videos)]
    assert broken([votes(t, rng.uniform(0.5, 2.0, 48)) for t in told], STEP) == []


@given(seed=st.integers(0, 99), who=st.integers(0, 4), at=st.integers(8, 40))
def test_the_one_that_breaks_is_told_from_those_it_pulls(seed, who, at):
    after = np.arange(48) >= at
    told = [noise(seed + v) + STEP * np.where(after, *((0.4, -0.4) if v == who else (-0.06, 0.06))) for v in range(5)]
    assert broken(list(map(votes, told)), STEP) == [who]


@given(seed=st.integers(0, 99), who=st.integers(0, 4), size=st.floats(0.5, 1.0), scatter=st.floats(0.0, 0.2))
def test_a_ramp_is_no_even_clock(seed, who, size, scatter):
    """Of a rate that is wrong: with an offset each, its two halves scatter."""
    rng = np.random.default_rng(seed)
    told = [noise(seed + v) for v in range(5)]
    told[who] = told[who] + STEP * (np.linspace(-size, size, 48) + rng.normal(size=48) * scatter)
    found = tilt(votes(told[who], rng.uniform(0.5, 2.0, 48)))
    assert found is not None and found.gap / STEP == pytest.approx(size, abs=0.1 + scatter)
    assert broken(list(map(votes, told)), STEP) == [who]


@given(seed=st.integers(0, 99), who=st.integers(0, 4), scatter=st.floats(0.1, 0.6))
def test_a_video_whose_frames_scatter_has_an_even_clock(seed, who, scatter):
    """However quiet the others are."""
    told = [noise(seed + v, size=scatter if v == who else 0.02) for v in range(5)]
    assert broken(list(map(votes, told)), STEP) == []


def test_what_all_videos_show_badly_is_no_clock_s():
    after = np.arange(48) >= 20
    told = [noise(v) + STEP * 0.3 * after * (-1) ** v for v in range(6)]
    assert broken(list(map(votes, told)), STEP) == []
    assert broken(list(map(votes, told[:2])), STEP) == [0, 1]  # of two nothing is usual


@pytest.mark.parametrize(("misfit", "said"), [(0.02, [0, 1]), (0.05, [])])
def test_what_is_shown_badly_parts_without_a_break(misfit, said):
    """Frames of misfit: of two videos nothing else tells it."""
    after = np.arange(48) >= 20
    told = [votes(noise(v) + STEP * 0.4 * after * (-1) ** v, misfit=misfit * STEP) for v in range(2)]
    assert broken(told, STEP) == said


@pytest.mark.parametrize("n", [10, 16, 24, 48])
@pytest.mark.parametrize(("videos", "uneven"), [(2, 1.0), (3, 1.0), (5, 1.0), (5, 2.0)])
def test_gaps_that_noise_makes_are_seldom_breaks(videos, n, uneven):
    """Of half a frame, in frames that are shown without a fault otherwise, each with a weight of its own."""
    said = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        told = [votes(rng.normal(size=n) * 0.5 * STEP, rng.lognormal(0, uneven, n)) for _ in range(videos)]
        said += len(broken(told, STEP))
    assert said <= 0.03 * 60 * videos


def test_votes_that_wander_in_every_video_are_seldom_ramps():
    """Neighbouring frames err alike, by a third of a frame; the parts of all videos are as far apart."""
    said = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        drawn = rng.normal(size=(5, 52)) * 0.3 * STEP
        told = [np.convolve(one, np.full(5, 5**-0.5), "valid") for one in drawn]
        said += len(broken([votes(t) for t in told], STEP))
    assert said <= 0.03 * 60 * 5


def test_one_frame_that_moves_has_no_slope():
    moving = np.zeros(48)
    moving[7] = 1 / 3
    assert tilt(votes(np.full(48, STEP), moving)) is None


@pytest.mark.parametrize("told", [np.zeros(0), np.zeros(2 * LEAST - 1)])
def test_few_frames_have_no_parts(told):
    assert parting(votes(told)) is None and broken([votes(told)] * 3, STEP) == []


def test_where_nothing_moves_there_are_no_parts():
    still = votes(np.zeros(48), np.zeros(48))
    assert parting(still) is None and broken([still, votes(noise(0))], STEP) == []
    late = votes(noise(1) + STEP * GAP * 3 * (np.arange(48) > 30), np.r_[np.zeros(20), np.ones(28)])
    assert broken([still, late], STEP) == [1]


def fitted(seed: int, who: int | None, shown: Sequence[int], steps: int = 500) -> Offsets:
    """The clocks that a fit finds of five videos of two seconds, one of which shows other frames than it says."""
    capture = synthetic(seed, frames=FRAMES, offsets=0.0)
    start = np.zeros(5)
    if who is not None:
        capture = filmed_anew(capture, who, shown)
        start[who] = np.mean(np.asarray(shown) - np.arange(len(shown))) / 30
    known = Offsets.known([f.name for f in capture.footage], start - start[0], 30)
    loose = replace(known, sigma=np.r_[0, np.full(4, 0.2 / 30)])
    return fit(initial_scene(capture, loose), capture.footage, loose, steps=steps).offsets


def begun(seed: int, off: float, steps: int, **world: Any) -> Offsets:
    """The clocks that a fit finds where the third one begins so many frames off, and is said to be known."""
    capture = synthetic(seed, offsets=0.0, **world)
    names = [f.name for f in capture.footage]
    start = np.zeros(len(names))
    start[2] = off / 30
    known = Offsets.known(names, start, 30)
    loose = replace(known, sigma=np.r_[0, np.full(len(names) - 1, 0.2 / 30)])
    return fit(initial_scene(capture, loose), capture.footage, loose, steps=steps).offsets


def test_a_fit_that_began_ten_frames_off_says_so():
    """Of so many videos none is left out: the frames that are shown worst tell it."""
    assert said(begun(591, 10, 60, cameras=FEW + 1, frames=24, size=(96, 64))) == [2]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [587, 588])
@pytest.mark.parametrize("off", [5, 12, 25])
def test_a_fit_that_began_far_off_says_so(seed, off):
    """It ended where it began, at a sigma of .14, and was ok."""
    assert said(begun(seed, off, 500, frames=FRAMES)) == [2]


def said(found: Offsets) -> list[int]:
    return [v for v, flags in enumerate(found.flags) if Status.BROKEN_CLOCK in flags]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [521, 522])
@pytest.mark.parametrize("who", [None, 3, 0], ids=["none", "one", "the reference"])
def test_a_fit_says_that_a_clock_breaks(seed, who):
    """Two frames lost: off by a frame at either end, at a sigma of .17, and it was ok."""
    found = said(fitted(seed, who, without(30, 2)))
    assert found == {None: [], 3: [3], 0: [1, 2, 3, 4]}[who]


FRAMES = 60


def without(at: int, lost: int, until: int = FRAMES) -> list[int]:
    """Frames of a clip of which some are lost."""
    return [k for k in range(until) if not at <= k < at + lost]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [526, 527, 528])
@pytest.mark.parametrize(
    ("shown", "steps"),
    [
        (without(30, 10), 500),
        ([*range(30), *[30] * 3, *range(30, FRAMES - 3)], 500),
        ([*without(20, 3, 40), *[40] * 3, *range(40, FRAMES)], 500),
        (np.round(np.arange(57) * 1.04).astype(int).tolist(), 500),
        (np.round(np.arange(FRAMES) * 0.96).astype(int).tolist(), 500),
        (np.round(np.arange(58) * 1.02).astype(int).tolist(), 500),
        ([*range(30), *range(30)], 500),
        ([*range(20), *range(39, 19, -1), *range(40, FRAMES)], 500),
        ([*range(20), *[20] * 15, *range(20, FRAMES - 15)], 500),
    ],
    ids=[
        "ten lost",
        "three stand still",
        "lost and later still",
        "4 % fast",
        "4 % slow",
        "2 % fast",
        "a second twice",
        "backwards within",
        "fifteen stand still",
    ],
)
def test_a_fit_says_whose_clock_is_uneven(seed, shown, steps):
    assert said(fitted(seed, 2, shown, steps)) == [2]
