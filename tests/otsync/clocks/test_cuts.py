"""Cuts that a video shows by itself, and the breaks that explain them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync import Matches, Status, synchronize
from otsync.align.likelihood import LikelihoodScan
from otsync.bench.trust.worlds import CLASSES, times_given
from otsync.clocks.cuts import BLOCK, CLEAR_PATH, Steps, calm, unexplained
from otsync.refine.splines import SplineRefine
from otsync.sync.mend.breaks import mended
from otsync.sync.mend.proofs import cut_where_it_holds
from otsync.sync.mend.windows import Pieces
from otsync.sync.pairs import Job, run
from otsync.sync.verdict import Answer
from otsync.types import Alignment, Break, TrackSet
from tests.otsync.refine.test_common_error import smooth

FPS = 30.0


def cuts(tracks: TrackSet) -> np.ndarray:
    """The moments of the frames behind the cuts."""
    steps = Steps.of(tracks)
    return steps.times[steps.cuts()]


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


def steps_of(frames: int, *jolts: tuple[int, float]) -> Steps:
    """Steps of a video in which nothing but these happens."""
    told = np.ones(frames - 1)
    for before, size in jolts:
        told[before - 1] = size
    return Steps(np.arange(frames) / FPS, told)


def test_a_break_explains_the_cut_beside_it_alone():
    steps = steps_of(90, (30, 4.0), (60, 3.0))
    np.testing.assert_array_equal(unexplained(steps, ()), [30, 60])
    np.testing.assert_array_equal(unexplained(steps, [Break(1.1, 0.5)]), [60])
    assert len(unexplained(steps, [Break(1.1, 0.5), Break(1.9, 0.2)])) == 0
    assert len(unexplained(steps_of(90), ())) == 0


def test_the_sharpest_and_the_nearest_cut():
    steps = steps_of(300, (60, 1.7), (75, 4.0))
    assert steps.sharpest() == (75 / FPS, 4.0)
    assert steps.cut_near(2.0, 0.2) == 2.0 and steps.cut_near(2.2, 0.5) == 2.5 and steps.cut_near(1.0, 0.5) is None
    assert calm(steps_of(90)) and calm(steps_of(90, (40, 1.2))) and not calm(steps_of(90, (40, 1.35)))
    nothing = Steps.of(TrackSet(moving(90)[:2], fps=FPS))
    assert nothing.sharpest() == (0.0, 0.0) and calm(nothing) and len(nothing.cuts()) == 0


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_a_jolt_has_no_unit_and_noise_alone_is_calm(noise):
    x = moving(noise=noise, seed=3)
    steps = Steps.of(TrackSet(np.delete(x, np.arange(50, 65), axis=1), fps=FPS))
    scaled = Steps.of(TrackSet(1e3 * np.delete(x, np.arange(50, 65), axis=1), fps=FPS))
    np.testing.assert_allclose(steps.jolts, scaled.jolts)
    assert calm(Steps.of(TrackSet(x, fps=FPS))) and steps.sharpest()[1] > 2
    whole = Steps.of(TrackSet(x, fps=FPS)).jolts
    assert np.isnan(whole[[0, 3, -1, -4]]).all() and np.isfinite(whole[4:-4]).all()


def test_a_clock_that_is_mended_elsewhere_than_its_video_is_cut_is_not_trusted():
    """Video 1 froze for a second and caught up; that the other one lacks .77 s there was trusted, 23 frames off."""
    world = CLASSES["freeze that catches up"](80118)
    assert Status.BROKEN_CLOCK in synchronize(list(world.tracks)).flags[1]


@pytest.mark.parametrize("name", ["ten frames dropped", pytest.param("a second missing", marks=pytest.mark.slow)])
def test_a_clock_that_is_mended_where_its_video_is_cut_is_trusted(name):
    world = CLASSES[name](80103)
    found = synchronize(list(world.tracks))
    assert len(cuts(world.tracks[1])) == 1 and found.ok and len(found.breaks[1]) == 1
    assert world.errors(found)[1].max() < 0.2


def test_a_cut_speaks_where_the_answer_does_not_hold_beside_it():
    x = moving(240)
    lacking = np.delete(x, np.arange(100, 115), axis=1)
    even, cut = TrackSet(x, fps=FPS), TrackSet(lacking, fps=FPS)
    same = Matches(np.stack([np.arange(len(x))] * 2, 1), np.zeros(len(x)))

    def said(offset: float, filmed=(even, cut), tracks=None, broken=None) -> bool:
        told = Alignment(offset, fps=FPS)
        return bool(cut_where_it_holds([Answer((0, 1), same, told, told)], filmed, tracks or filmed, broken or {}))

    assert said(0.0) and said(0.5)  # right on one side of it
    assert said(0.0, (cut, even)) and said(-0.5, (cut, even))
    assert not said(0.0, (cut, cut))  # the scene jumped, for both
    assert not said(0.0, (even, even)) and not said(float("nan"))
    assert not said(-20.0) and not said(20.0)  # nobody else was filming
    lost = (Break(100 / FPS, 0.5),)
    assert not said(0.0, tracks=(even, mended(cut, lost)), broken={1: lost})
    elsewhere = (Break(150 / FPS, 0.5),)
    assert said(0.0, tracks=(even, mended(cut, elsewhere)), broken={1: elsewhere})
    times = np.delete(np.arange(240), np.arange(100, 115)) / FPS
    told = TrackSet(lacking, fps=FPS, timestamps=times)
    assert not said(0.0, (even, told)) and not said(0.0, (told, even))  # its own times say what it lacks
    assert said(0.5, (even, told)) and said(-0.5, (told, even))
    wrong = TrackSet(lacking, fps=FPS, timestamps=times - 0.3 * (times > 107 / FPS))
    assert said(0.0, (even, wrong)) and said(0.0, (wrong, even))
    # right behind the gap alone, and the gap so long that the frames before it lie far from those behind it
    long = TrackSet(lacking, fps=FPS, timestamps=times + 0.3 * (times > 107 / FPS))
    assert said(-0.3, (even, long)) and said(0.3, (long, even))


@pytest.mark.parametrize("preset", ["mid", pytest.param("hard", marks=pytest.mark.slow)])
def test_frames_that_a_file_says_are_missing_are_no_doubt(preset):
    """All but one in eight of such worlds were flagged as broken clocks, whose remedy is to give the true times."""
    for seed in (604, 605):
        world = times_given(seed, preset=preset, within=15)
        found = synchronize(list(world.tracks))
        assert found.ok and not any(found.breaks) and world.errors(found)[1].max() < 0.1


def test_times_that_say_too_little_of_what_is_missing_are_put_right_or_doubted():
    for seed, named in ((602, False), (604, True)):
        world = times_given(seed, off=-0.3, within=15)
        found = synchronize(list(world.tracks))
        if named:
            assert found.ok and found.breaks[1][0].jump == pytest.approx(0.3, abs=0.1 / FPS)
        else:
            assert Status.BROKEN_CLOCK in found.flags[1]


def jobs_of(name: str, seed: int) -> Job:
    """The work on the first two videos of a world."""
    a, b = CLASSES[name](seed).tracks[:2]
    return Job((0, 1), a, b, None, LikelihoodScan(), SplineRefine(), None)


def in_pieces(job: Job) -> Answer | None:
    """What the pieces tell of a pair; None where none may be cut, or they leave a doubt."""
    pieces = Pieces.of(job)
    return None if pieces is None else pieces.joined(*(run(piece) for piece in pieces.jobs))


def test_the_pieces_of_a_video_that_is_cut_tell_an_offset_each():
    told = in_pieces(jobs_of("ten frames dropped", 80101))
    assert told is not None
    (_, before), (at, behind) = told.scanned.parts
    assert behind - before == pytest.approx(10 / FPS, abs=0.5 / FPS)
    assert at == pytest.approx(64 / FPS + before, abs=0.05)


def test_halves_that_were_exchanged_are_told_in_the_order_of_what_they_show():
    told = in_pieces(jobs_of("halves exchanged", 80108))
    assert told is not None
    (_, before), (_, behind) = told.scanned.parts
    assert behind - before == pytest.approx(5.0, abs=0.5 / FPS)


@pytest.mark.parametrize(("name", "seed"), [("mid", 80100), ("a second missing", 80102)])
def test_a_video_without_a_cut_has_no_pieces_nor_one_whose_pieces_tell_nothing(name, seed):
    assert in_pieces(jobs_of(name, seed)) is None


def test_things_that_jump_by_themselves_are_no_cut():
    for seed in range(80100, 80104):
        for tracks in CLASSES["things that jump"](seed).tracks:
            assert calm(Steps.of(tracks))


@pytest.mark.parametrize(
    ("name", "seed", "video", "still"),
    [
        ("freeze of 15", 80101, 1, True),  # the other one was said to lack frames
        # by a length that nobody knew
        pytest.param("ten frames dropped, hard", 80104, 1, False, marks=pytest.mark.slow),
        ("ten frames dropped, hard", 80117, 1, False),  # told by its pieces alone
    ],
)
def test_what_a_video_shows_by_itself_says_which_clock_broke_and_where(name, seed, video, still):
    world = CLASSES[name](seed)
    found = synchronize(list(world.tracks))
    assert found.ok and not found.breaks[1 - video]
    (broke,) = found.breaks[video]
    assert (broke.still > 0) == still and world.errors(found)[1].max() < 0.15


def test_a_cut_that_holds_is_heard_whatever_else_says(monkeypatch):
    tracks = list(CLASSES["mid"](80100).tracks)
    assert synchronize(tracks).ok
    monkeypatch.setattr("otsync.sync.verb.cut_where_it_holds", lambda answers, filmed, tracks, broken: {(0, 1)})
    assert Status.BROKEN_CLOCK in synchronize(tracks).flags[1]


def test_cuts_are_sought_in_what_was_filmed(monkeypatch):
    """Not on a clock that was mended, where their moments are others."""
    asked = []

    def spy(answers, filmed, tracks, broken):
        asked.append((filmed[1].times, tracks[1].times, broken))
        return cut_where_it_holds(answers, filmed, tracks, broken)

    monkeypatch.setattr("otsync.sync.verb.cut_where_it_holds", spy)
    world = CLASSES["a second missing"](80103)
    synchronize(list(world.tracks))
    ((filmed, mended_clock, broken),) = asked
    np.testing.assert_array_equal(filmed, world.tracks[1].times)
    assert len(broken[1]) == 1 and mended_clock[-1] > filmed[-1] + 0.9


def in_a_hand(shown: np.ndarray, seed: int = 0) -> TrackSet:
    """A video of nothing but one point, of a hand that shakes; ``shown``: the frames of the world."""
    from tests.otsync.epipolar.test_epipolar import moving_poses
    from tests.recording_world import ring

    still = ring(4, width=640, height=360)[seed % 4]
    poses = moving_poses(still, shown / 30 + seed)
    return TrackSet(None, uv=np.full((1, len(shown), 2), 50.0), camera=replace(still, w2c=poses), fps=30.0)


@pytest.mark.parametrize("lost", [3, 4, 10])
@pytest.mark.parametrize("seed", range(4))
def test_a_hand_that_shakes_shows_where_frames_are_missing(seed, lost):
    whole = np.arange(90.0)
    assert not len(Steps.of_camera(in_a_hand(whole, seed)).cuts(CLEAR_PATH))
    steps = Steps.of_camera(in_a_hand(np.delete(whole, np.arange(40, 40 + lost)), seed))
    assert steps.cuts(CLEAR_PATH).tolist() == [40]


def test_a_hand_that_only_turns_shows_it_too():
    tracks = in_a_hand(np.delete(np.arange(90.0), np.arange(40, 44)))
    w2c = tracks.camera.w2c.copy()
    w2c[:, :3, 3] = -np.einsum("tij,j->ti", w2c[:, :3, :3], tracks.camera.center[0])
    steps = Steps.of_camera(replace(tracks, camera=replace(tracks.camera, w2c=w2c)))
    assert steps.cuts(CLEAR_PATH).tolist() == [40]


def test_frames_that_are_known_to_be_missing_are_no_cut():
    lost = np.delete(np.arange(90.0), np.r_[20:24, 60:64])
    told = replace(in_a_hand(lost), fps=None, timestamps=lost / 30)
    assert not len(Steps.of_camera(told).cuts(CLEAR_PATH))
    wrong = replace(told, timestamps=(lost - 4 * (lost >= 24)) / 30)  # the second gap alone
    assert Steps.of_camera(wrong).cuts(CLEAR_PATH).tolist() == [20]


def test_of_a_camera_that_stands_still_nothing_is_known():
    tracks = in_a_hand(np.arange(90.0))
    still = replace(tracks.camera, w2c=tracks.camera.w2c[0])
    repeated = replace(tracks.camera, w2c=np.repeat(tracks.camera.w2c[:1], 90, 0))
    for camera in (still, repeated, None):
        assert np.isnan(Steps.of_camera(replace(tracks, camera=camera, uv=tracks.uv)).jolts).all()
