"""Clocks that break, without depth: pictures show when, pairs tell by how much; what only looks so is left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync import Status, TrackSet, synchronize
from otsync.bench.trust.worlds import in_hands as in_hands_of_the_benchmark
from otsync.bench.trust.worlds import times_given
from otsync.epipolar.breaks import Evidence, Found, Moment, find_breaks, moments
from otsync.epipolar.refine import EpipolarRefine
from otsync.epipolar.scan import EpipolarScan
from otsync.simulate.effects import Drop, In
from otsync.types import Break, Matches
from tests.otsync.epipolar.test_epipolar import moving_poses
from tests.otsync.epipolar.test_steady import FPS, LATE, filmed, solved
from tests.recording_world import paths, ring

LOST = np.delete(np.arange(130.0), np.arange(50, 60))
"""Ten frames were lost."""

FROZEN = np.arange(120.0) - np.clip(np.arange(120) - 50, 0, 10)
"""One picture was shown for ten frames more, and the rest late."""

CAUGHT_UP = np.where((np.arange(120) > 50) & (np.arange(120) <= 60), 50.0, np.arange(120.0))
"""One picture was shown for ten frames more, in place of what came then."""


def worlds(own: np.ndarray, videos: int, seed: int = 0, who: int = 1) -> list[TrackSet]:
    """Videos of which one shows these frames."""
    return filmed([(own if v == who else np.arange(120.0)) + LATE[v] for v in range(videos)], seed)


def error(offsets, videos: int) -> float:
    return float(np.abs(offsets.seconds * FPS - LATE[:videos]).max())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("who", [0, 1, 3])
def test_frames_that_were_lost_are_named_and_the_rest_is_right(seed, who):
    offsets = solved(worlds(LOST, 4, seed, who))
    (broke,) = offsets.breaks[who]
    assert broke.jump * FPS == pytest.approx(10, abs=0.05) and broke.still == 0
    assert broke.at * FPS == pytest.approx(50) and 0 < broke.sigma * FPS < 0.3
    assert sum(map(len, offsets.breaks)) == 1 and offsets.ok and error(offsets, 4) < 0.1


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("videos", [2, 4])
def test_a_picture_that_stood_still_is_counted(videos, seed):
    offsets = solved(worlds(FROZEN, videos, seed))
    (broke,) = offsets.breaks[1]
    assert broke.still * FPS == pytest.approx(10) and broke.jump == -broke.still and broke.sigma == 0
    assert broke.at * FPS == pytest.approx(60) and offsets.ok and error(offsets, videos) < 0.1


@pytest.mark.parametrize("videos", [2, 4])
def test_one_that_caught_up_lost_nothing(videos):
    offsets = solved(worlds(CAUGHT_UP, videos))
    assert not any(offsets.breaks) and error(offsets, videos) < 0.5


def test_two_breaks_of_one_video_are_found_one_after_the_other():
    twice = np.delete(np.arange(140.0), np.r_[35:45, 90:100])
    offsets = solved(worlds(twice, 4, 1))
    assert [round(b.at * FPS) for b in offsets.breaks[1]] == [35, 80]
    assert [b.jump * FPS for b in offsets.breaks[1]] == pytest.approx([10, 10], abs=0.1)
    assert error(offsets, 4) < 0.1


def test_of_two_videos_nobody_knows_what_was_lost():
    assert Status.BROKEN_CLOCK in solved(worlds(LOST, 2)).flags[1]


def test_what_jerks_for_all_is_no_break():
    """Things that jump half a second on, in the world: every video shows a cut."""
    jerk = np.where(np.arange(140) < 70, np.arange(140.0), np.arange(140.0) + 15)
    tracks = filmed([jerk[round(late) + 10 :][:120] for late in LATE], 2)
    assert all(len(moments(t)) == 1 for t in tracks)
    offsets = solved(tracks)
    assert offsets.ok and not any(offsets.breaks) and error(offsets, 4) < 0.1


def test_moments_are_where_a_video_looks_broken():
    lost, frozen, even = (worlds(own, 2)[1] for own in (LOST, FROZEN, np.arange(120.0)))
    assert moments(lost) == [Moment(50 / FPS, 50 / FPS)] and moments(even) == []
    rest = moments(frozen)[0]
    assert (rest.start * FPS, rest.at * FPS) == pytest.approx((50, 60))
    assert rest.jumps(1 / FPS) == pytest.approx((-11.5 / FPS, -8.5 / FPS))
    late = replace(lost, visible=lost.seen & (np.arange(120) < 70))
    assert moments(late) == moments(lost)  # what is seen there is asked of the pairs


def test_a_moment_near_an_end_is_not_asked_about():
    early = np.delete(np.arange(130.0), np.arange(15, 25))
    assert moments(worlds(early, 2)[1]) == []


def test_pieces_that_nobody_else_filmed_leave_no_doubt():
    offsets, there = np.arange(9.0), np.eye(9)
    shared = np.full((2, 9), 2.0)
    told = Evidence(offsets, 40 * there[4], 30 * there[7], shared)
    assert told.doubt() == 30
    assert replace(told, shared=np.stack([shared[0], 0 * shared[1]])).doubt() == 0
    assert replace(told, shared=0 * shared).doubt() == 0
    assert replace(told, behind=told.behind - 25).doubt() == 5  # than nothing
    assert replace(told, behind=told.behind - 50).doubt() == 0
    assert told.best(0.0, 5.0) == (30.0, 4.0, 3.0)
    assert told.best(-5.0, 0.0)[0] == 0  # where it only goes back


def test_videos_without_matches_tell_nothing():
    tracks = worlds(LOST, 4)
    nothing = {(0, 1): Matches(np.zeros((0, 2), int))}
    assert find_breaks(EpipolarScan(), EpipolarRefine(), tracks, nothing, np.zeros(4)) == []


@pytest.mark.parametrize("own", [LOST, FROZEN], ids=["ten frames lost", "frozen for ten frames"])
def test_cameras_that_move_keep_their_poses_on_a_mended_clock(own):
    """Its even clock has other frames than were filmed: each with the pose that is nearest in time."""
    shown = [(own if v == 1 else np.arange(120.0)) + LATE[v] for v in range(4)]
    rng, sets = np.random.default_rng(0), []
    for v, (static, still) in enumerate(zip(filmed(shown), ring(4, width=640, height=360), strict=True)):
        poses = np.repeat(np.asarray(still.w2c)[None], 120, 0)
        poses[:, 0, 3] += 0.3 * np.sin(shown[v] / 15 + v)
        camera = replace(still, w2c=poses)
        uv = camera.project(paths(shown[v] / FPS, 40, 5)) + rng.normal(0, 0.3, (40, 120, 2))
        sets.append(replace(static, uv=uv, camera=camera))
    offsets = solved(sets)
    assert len(offsets.breaks[1]) == 1 and offsets.ok and error(offsets, 4) < 0.1


def in_hands(own: np.ndarray, seed: int, seen: slice = slice(None)) -> list[TrackSet]:
    """Three seconds of four phones in hands, of which the second one shows these frames; ``seen``: of its tracks."""
    shown = [(own if v == 1 else np.arange(90.0)) + LATE[v] for v in range(4)]
    rng, sets = np.random.default_rng(seed), []
    for v, (static, still) in enumerate(zip(filmed(shown, seed), ring(4, width=640, height=360), strict=True)):
        camera = replace(still, w2c=moving_poses(still, shown[v] / FPS + 7 * v))
        uv = camera.project(paths(shown[v] / FPS, 40, seed + 5)) + rng.normal(0, 0.3, static.uv.shape)
        visible = np.ones(uv.shape[:2], bool)
        if v == 1:
            visible[:] = False
            visible[:, seen] = True
        sets.append(replace(static, uv=uv, camera=camera, visible=visible))
    return sets


@pytest.mark.parametrize("lost", [4, 10])
@pytest.mark.parametrize("seed", range(3))
def test_frames_that_a_phone_in_a_hand_lost_are_named(seed, lost):
    offsets = solved(in_hands(np.delete(np.arange(90.0 + lost), np.arange(40, 40 + lost)), seed))
    (broke,) = offsets.breaks[1]
    assert broke.jump * FPS == pytest.approx(lost, abs=0.1) and broke.at * FPS == pytest.approx(40)
    assert offsets.ok and error(offsets, 4) < 0.15


def test_where_its_path_is_cut_and_nothing_was_seen_before_a_video_is_doubted():
    """Nobody knows what was lost; a hand that is whole is left alone."""
    lost, whole = np.delete(np.arange(94.0), np.arange(28, 32)), np.arange(90.0)
    tracks = in_hands(lost, 0, slice(26, None))
    assert moments(tracks[1])[0] == Moment(28 / FPS, 28 / FPS, sure=True)
    offsets = solved(tracks)
    assert Status.BROKEN_CLOCK in offsets.flags[1] and offsets.status[2].ok and offsets.status[3].ok
    assert solved(in_hands(whole, 0, slice(26, None))).ok


def test_both_pieces_vouch_for_one_offset_or_none_does():
    offsets = np.arange(12.0) / 30 + 1e-9  # as they are summed: no whole frames
    there = np.eye(12)
    told = Evidence(offsets, 40 * there[4], 30 * there[6], np.full((2, 12), 2.0))
    assert told.vouched() and told.doubt() == 0
    for behind in (30 * there[7], 5 * there[4], 0 * there[4]):
        assert not replace(told, behind=behind).vouched()
    three = replace(told, behind=30 * there[7])  # frames later are another time
    assert three.doubt() == 30 and three.best(0.0, 0.2)[0] == 30
    # motion that comes back suits another offset nearly as well
    assert not replace(told, before=told.before + 39 * there[1]).vouched()
    assert replace(told, before=told.before + 20 * there[1]).vouched()


@pytest.mark.parametrize("broke", [None, Break(2.0, 0.5)])
def test_a_break_that_cannot_be_mended_is_flagged(monkeypatch, broke):
    """Nor is one that is found again where it was mended."""
    monkeypatch.setattr("otsync.sync.mend.pixels.find_breaks", lambda *job: [Found(1, 30.0, 60.0, broke)])
    offsets = solved(worlds(np.arange(120.0), 4))
    assert Status.BROKEN_CLOCK in offsets.flags[1] and len(offsets.breaks[1]) == (broke is not None)


@pytest.mark.parametrize("seed", range(3))
def test_a_rate_that_is_not_the_declared_one_is_told_within_three_seconds(seed):
    """By what all pairs of a video measure; those that run as declared are trusted."""
    offsets = solved(in_hands(1.042 * np.arange(86.0), seed))
    assert Status.RATE_MISMATCH in offsets.flags[1]
    assert all(offsets.status[v].ok and abs(offsets.seconds[v] * FPS - LATE[v]) < 0.2 for v in (2, 3))


def test_poses_that_are_too_few_are_named():
    tracks = in_hands(np.arange(90.0), 0)
    short = replace(tracks[1], camera=replace(tracks[1].camera, w2c=tracks[1].camera.w2c[:80]))
    with pytest.raises(
        ValueError, match=r"tracks\[1\].camera.w2c: expected one pose, or one for each of 90 .* found 80"
    ):
        solved([tracks[0], short])


def test_frames_that_were_lost_and_said_so_are_no_doubt():
    """Also near an end, where too little is left to vouch."""
    lost = np.delete(np.arange(94.0), np.arange(8, 12))
    tracks = in_hands(lost, 0)
    tracks[1] = replace(tracks[1], fps=None, timestamps=lost / FPS)
    offsets = solved(tracks)
    assert offsets.ok and error(offsets, 4) < 0.15


@pytest.mark.parametrize("off", [0.0, -0.2, pytest.param(0.1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("seed", [600, 601])
def test_times_that_say_what_is_missing_are_heard_and_wrong_ones_doubted(seed, off):
    """One side alone liked a time 11 and 75 frames off better by 148 and 613 nats."""
    world = times_given(seed, off=off, made=in_hands_of_the_benchmark, first=(In(1, Drop(10 / FPS)),))
    found = synchronize(list(world.tracks), **world.options)
    ends, anywhere = world.errors(found)
    if off:
        assert not found.status[1].ok or max(ends[0], anywhere[0]) < 0.15
    else:
        assert found.ok and not any(found.breaks) and anywhere.max() < 0.15


def test_a_sound_gap_hides_no_break_elsewhere(monkeypatch):
    """What both sides of it vouch for is neither doubted nor mended, whatever two offsets would gain."""
    own = np.delete(np.arange(160.0), np.arange(40, 50))
    tracks = worlds(own[:120], 4)
    tracks[1] = replace(tracks[1], fps=None, timestamps=own[:120] / FPS)
    assert [m.told for m in moments(tracks[1])] == [True]
    assert [m.told for m in moments(tracks[1], (Break(40 / FPS, 10 / FPS),))] == [False]  # a mend made it
    asked = []
    monkeypatch.setattr("otsync.epipolar.breaks.Evidence.doubt", lambda self: 1e3)
    monkeypatch.setattr("otsync.epipolar.breaks.Evidence.best", lambda self, *limits: (1e3, 0.0, 0.3))
    monkeypatch.setattr("otsync.epipolar.breaks.Asked.runs_on", lambda self, *where: True)
    monkeypatch.setattr("otsync.epipolar.breaks.Asked.measured", lambda self, *where: asked.append(where))
    same = {(0, 1): Matches(np.stack([np.arange(len(tracks[0]))] * 2, 1))}
    assert not find_breaks(EpipolarScan(), EpipolarRefine(), tracks, same, np.array(LATE[:4]) / FPS) and not asked


def test_many_cuts_of_a_path_leave_room_for_what_stood_still():
    shown = np.concatenate([np.arange(k * 40, k * 40 + 36) for k in range(12)])
    shown = np.concatenate([shown[:130], np.full(10, shown[129]), shown[130:]]).astype(float)
    still = ring(4, width=640, height=360)[0]
    camera = replace(still, w2c=moving_poses(still, shown / FPS))
    uv = camera.project(paths(shown / FPS, 40, 5))
    found = moments(TrackSet(None, uv=uv, camera=camera, fps=FPS))
    assert sum(m.sure for m in found) == 6 and any(m.still > 0 for m in found)
