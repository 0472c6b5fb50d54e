"""Effects on what a file does to time: exact, told by the truth, and confined to the video that they are in."""

from __future__ import annotations

import numpy as np
import pytest

from otsync.simulate import ADVERSARIES, simulate
from otsync.simulate.effects import (
    ClockDrift,
    ClockRamp,
    ClockSway,
    Cut,
    Drop,
    Freeze,
    In,
    Loop,
    Repeats,
    Replay,
    Reverse,
    SlowMotion,
)


def filmed(*effects, seed: int = 2):
    inside = tuple(In(1, effect) for effect in effects)
    return simulate("tennis", preset="mid", videos=2, offsets=[0.0, 0.2], effects=inside, seed=seed)


@pytest.mark.parametrize(
    "effects",
    [
        (Freeze(12),),
        (Freeze(12, catches_up=True),),
        (Drop(0.4),),
        (Cut(),),
        (Repeats(24),),
        (Replay(0.7),),
        (Loop(1.0),),
        (Reverse(),),
        (SlowMotion(),),
        (ClockDrift(0.1),),
        (ClockRamp(0.04), Drop(0.4)),
        (ClockSway(), Freeze(12)),
        (ClockDrift(0.1), Freeze(12)),
        (Freeze(12, at=0.3), Drop(0.4)),
        (Drop(0.4), Cut(), Repeats(24)),
    ],
)
def test_frames_show_what_the_truth_says(effects):
    tracks, truth = filmed(*effects)
    for v in (0, 1):
        expected = truth.positions(v, truth.shown[v])
        seen = tracks[v].seen
        np.testing.assert_allclose(tracks[v].positions()[seen], expected[seen], atol=1e-6)
    np.testing.assert_allclose(truth.shown[0], tracks[0].times)
    assert not np.allclose(truth.shown[1], tracks[1].times + 0.2)


def test_a_freeze_repeats_the_frame_before_it_and_goes_on():
    tracks, truth = filmed(Freeze(10, at=0.5))
    shown = truth.shown[1]
    assert np.ptp(shown[74:85]) < 1e-9 and shown[85] - shown[84] == pytest.approx(1 / 30)
    assert shown[-1] == pytest.approx(tracks[1].times[-1] + 0.2 - 10 / 30)


def test_effects_on_one_file_add_up_in_their_order():
    told = filmed()[0][1].times + 0.2
    _, both = filmed(Freeze(10, at=0.3), Drop(1.0, at=0.7))
    late = both.shown[1] - told
    np.testing.assert_allclose(late[:44], 0, atol=1e-9)
    np.testing.assert_allclose(late[60:100], -10 / 30)
    np.testing.assert_allclose(late[110:], 1.0 - 10 / 30)
    _, backwards = filmed(Freeze(10, at=0.3), Reverse())
    _, frozen = filmed(Freeze(10, at=0.3))
    np.testing.assert_allclose(backwards.shown[1], frozen.shown[1][::-1])
    _, twice = filmed(Reverse(), Reverse())
    np.testing.assert_allclose(twice.shown[1], told)
    _, still = filmed(Freeze(10, at=0.3), Repeats(24))
    during = still.shown[1][(told > told[0] + 1.52) & (told < told[0] + 1.80)]  # the freeze begins at frame 45
    assert np.ptp(during) < 1e-9


def test_a_replay_shows_once_more_what_it_has_shown_and_goes_on():
    _, truth = filmed(Replay(0.5, at=0.6))
    shown = truth.shown[1]
    k = int(np.argmin(np.diff(shown))) + 1
    np.testing.assert_allclose(shown[k : k + 15], shown[k - 15 : k])
    np.testing.assert_allclose(np.delete(np.diff(shown), k - 1), 1 / 30)


def test_lost_frames_are_jumped_over():
    _, truth = filmed(Drop(1.0, at=0.4))
    steps = np.diff(truth.shown[1])
    assert steps.max() == pytest.approx(1 + 1 / 30) and (np.sort(steps)[:-1] == pytest.approx(1 / 30))


@pytest.mark.parametrize("motion", ADVERSARIES)
def test_motions_that_mislead_are_smooth_and_drawn_by_the_seed(motion):
    (a, b), _ = simulate(motion, preset="clean", videos=2, effects=(), seed=4)
    (c, _), _ = simulate(motion, preset="clean", videos=2, effects=(), seed=4)
    np.testing.assert_array_equal(a.positions(), c.positions())
    steps = np.abs(np.diff(b.positions(), axis=1)).max(2)
    jumps = motion in ("rain", "portals")  # every second or two, whatever the frame rate
    assert np.nanquantile(steps, 0.95 if jumps else 1.0) < 1.0


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Freeze(0.5), "Freeze.frames: expected a whole number, 1 or more; found 0.5"),
        (lambda: Freeze(5, at=2), "Freeze.at: expected a share of the clip, from 0 to 1; found 2"),
        (lambda: Drop(-1.0), "Drop.seconds: expected a finite number above 0; found -1.0"),
        (lambda: Drop(at=float("nan")), "Drop.at"),
        (lambda: Cut(at=-0.1), "Cut.at"),
        (lambda: Repeats(0), "Repeats.fps"),
        (lambda: Replay(0.0), "Replay.seconds"),
        (lambda: Replay(at=1.5), "Replay.at"),
        (lambda: Loop(0.0), "Loop.seconds"),
        (lambda: SlowMotion(factor=0), "SlowMotion.factor"),
        (lambda: SlowMotion(begin=True), "SlowMotion.begin"),
    ],
)
def test_what_cannot_happen_is_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
