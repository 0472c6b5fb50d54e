"""Cuts that a video shows by itself, and the breaks that explain them."""

from __future__ import annotations

import numpy as np
import pytest

from otsync import Matches, Status, synchronize
from otsync.bench.trust.worlds import CLASSES
from otsync.clocks.cuts import BLOCK, cuts, unexplained
from otsync.sync.mending import cut_where_it_holds
from otsync.sync.verdict import Answer
from otsync.types import Alignment, Break, TrackSet
from tests.otsync.refine.test_common_error import smooth

FPS = 30.0


def moving(frames: int = 120, n: int = 12, noise: float = 0.002, seed: int = 0) -> np.ndarray:
    """(n, frames, 3) positions of things that move smoothly, seen with noise."""
    rng = np.random.default_rng(seed)
    return smooth(rng, n, frames, 3) + noise * rng.standard_normal((n, frames, 3))


@pytest.mark.parametrize("seed", range(6))
def test_what_runs_evenly_has_none_and_what_lacks_frames_has_one_there(seed):
    x = moving(seed=seed)
    assert len(cuts(TrackSet(x, fps=FPS))) == 0
    without = np.delete(x, np.arange(50, 65), axis=1)
    np.testing.assert_allclose(cuts(TrackSet(without, fps=FPS)), [50 / FPS])
    late = TrackSet(without, timestamps=7 + np.arange(105) / FPS)
    np.testing.assert_allclose(cuts(late), [7 + 50 / FPS])


def test_a_freeze_is_no_cut_unless_the_video_catches_up():
    x = moving()
    frozen = np.concatenate([x[:, :50], np.repeat(x[:, [50]], 15, 1), x[:, 50:]], 1)
    assert len(cuts(TrackSet(frozen, fps=FPS))) == 0
    caught_up = frozen[:, :65]
    caught_up = np.concatenate([caught_up, x[:, 65:]], 1)
    np.testing.assert_allclose(cuts(TrackSet(caught_up, fps=FPS)), [65 / FPS])


def test_one_thing_that_jumps_and_what_is_not_seen_are_no_cuts():
    x = moving()
    x[:3, 60:] += 5.0
    x[:, 80:90] = np.nan
    assert len(cuts(TrackSet(x, np.isfinite(x[..., 0]), fps=FPS))) == 0
    assert len(cuts(TrackSet(x[:4], np.isfinite(x[:4, :, 0]), fps=FPS))) == 0
    assert len(cuts(TrackSet(x[:, :5], fps=FPS))) == 0


def test_pictures_that_repeat_are_no_cuts_and_long_videos_are_read_in_parts():
    x = moving(150, noise=0.0)
    assert len(cuts(TrackSet(np.repeat(x[:, ::5], 5, axis=1), fps=FPS))) == 0  # six pictures a second in a file of 30
    long = moving(BLOCK + 60)
    for lost in (BLOCK - 1, BLOCK, BLOCK + 1):
        without = np.delete(long, np.arange(lost, lost + 15), axis=1)
        np.testing.assert_allclose(cuts(TrackSet(without, fps=FPS)), [lost / FPS])


def test_a_break_explains_the_cut_beside_it_alone():
    at = np.array([1.0, 2.0])
    np.testing.assert_array_equal(unexplained(at, ()), at)
    np.testing.assert_array_equal(unexplained(at, [Break(1.1, 0.5)]), [2.0])
    assert len(unexplained(at, [Break(1.1, 0.5), Break(1.9, 0.2)])) == 0
    assert len(unexplained(np.zeros(0), ())) == 0


def test_a_clock_that_is_mended_elsewhere_than_its_video_is_cut_is_not_trusted():
    """Video 1 froze for a second and caught up; that the other one lacks .77 s there was trusted, 23 frames off."""
    world = CLASSES["freeze that catches up"](80118)
    assert Status.BROKEN_CLOCK in synchronize(list(world.tracks)).flags[1]


@pytest.mark.parametrize("name", ["ten frames dropped", "a second missing"])
def test_a_clock_that_is_mended_where_its_video_is_cut_is_trusted(name):
    world = CLASSES[name](80103)
    found = synchronize(list(world.tracks))
    assert len(cuts(world.tracks[1])) == 1 and found.ok and len(found.breaks[1]) == 1
    assert world.errors(found)[1].max() < 0.2


def test_a_cut_speaks_where_both_videos_were_filming_and_no_break_explains_it():
    x = moving()
    even, cut = TrackSet(x, fps=FPS), TrackSet(np.delete(x, np.arange(50, 65), axis=1), fps=FPS)
    none = Matches(np.zeros((0, 2), int))

    def said(offset: float, tracks=(even, cut), broken=None) -> bool:
        told = Alignment(offset, fps=FPS)
        return cut_where_it_holds([Answer((0, 1), none, told, told)], tracks, broken or {}) == {(0, 1)}

    assert said(0.0) and said(-1.6)
    assert not said(-1.7) and not said(2.4)  # a has ended, or has not begun, when b is cut at 1.67 s
    assert said(0.0, (cut, even)) and not said(1.7, (cut, even))
    assert not said(0.0, broken={1: (Break(50 / FPS, 0.5),)}) and said(0.0, broken={0: (Break(50 / FPS, 0.5),)})
    assert not said(float("nan"))
