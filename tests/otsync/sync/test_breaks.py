"""Clocks that break: which video, where, and by how much; and that videos without a break are left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync import align, match, synchronize
from otsync.align.breaks import Look, by_chance, partners
from otsync.align.likelihood import LikelihoodScan
from otsync.align.peaks import likely
from otsync.align.returns import beside_returns, like_itself, return_is_liked
from otsync.align.windows import local_curves
from otsync.bench.trust.worlds import CLASSES, plain
from otsync.clocks.common import CommonClock
from otsync.clocks.stillness import pause, stood_still
from otsync.refine.gauss_newton import Fit
from otsync.refine.splines import SplineRefine
from otsync.simulate import simulate
from otsync.simulate.effects import Drop, Freeze, In, Repeats, Replay, SlowMotion
from otsync.sync.alike import Raw
from otsync.sync.mend.breaks import Suspect, culprit, goes_back, mended, sigma_of_part
from otsync.sync.mend.proofs import confirmed
from otsync.sync.mend.ways import by_windows
from otsync.sync.mend.windows import Windows
from otsync.sync.pairs import Job, run
from otsync.sync.verb import jump_sigma
from otsync.types import Break, Clock, Offsets, Status, TrackSet, mended_frames, mended_times


def broken(effect, videos: int = 2, seed: int = 3, who: int = 1):
    from otsync.simulate import PRESETS

    late = [0.0, *(np.random.default_rng(seed).uniform(-0.6, 0.6, videos - 1))]
    effects = (In(who, effect), *PRESETS["mid"].effects)
    return simulate("basketball", preset="mid", videos=videos, offsets=late, effects=effects, seed=seed)


@pytest.mark.parametrize(
    ("effect", "jump", "still"),
    [(Freeze(15, at=0.5), -0.5, 0.5), (Freeze(30, at=0.45), -1.0, 1.0), (Drop(10 / 30, at=0.5), 1 / 3, 0.0)],
    ids=["freeze of 15", "freeze of 30", "ten frames dropped"],
)
def test_a_break_is_found_named_and_mended(effect, jump, still):
    tracks, truth = broken(effect)
    offsets = synchronize(tracks)
    assert offsets.ok and offsets.breaks[0] == ()
    (found,) = offsets.breaks[1]
    assert found.jump == pytest.approx(jump, abs=0.2 / 30) and found.still == pytest.approx(still, abs=1e-5)
    told = offsets.times(1, tracks[1].times)
    error = np.abs(told - truth.shown[1]) * 30
    away = np.abs(tracks[1].times - found.at) > still + 0.2
    assert error[[0, -1]].max() < 0.15 and np.nanmax(error[away]) < 0.15
    assert np.isnan(told).sum() == round(still * 30)
    assert any("video1" in note for note in offsets.clock_notes())


@pytest.mark.parametrize(
    ("name", "seed", "jump"),
    [
        ("a second missing", 500, 1.0),
        ("a second missing", 505, 1.0),
        ("freeze of the first", 505, -20 / 30),
        ("freeze of 30", 504, -1.0),  # a juggler, whose motion comes again
        ("halves exchanged", 511, -151 / 30),
        ("halves exchanged", 87300, -5.0),
    ],
)
def test_frames_without_a_partner_are_no_part_and_speak_against_none(name, seed, jump):
    """Some offset suits them by chance, and the edges of parts lie anywhere among them."""
    world = CLASSES[name](seed)
    offsets = synchronize(list(world.tracks))
    assert offsets.ok and world.errors(offsets)[0][0] < 0.2
    (found,) = offsets.breaks[0] + offsets.breaks[1]
    assert found.jump == pytest.approx(jump, abs=1 / 30 if jump < -2 else 0.2 / 30)


@pytest.mark.parametrize(("video", "seconds", "seed"), [(1, 1.5, 87203), (1, 0.6, 87206), (0, 1.0, 87205)])
def test_the_video_that_shows_something_again_is_the_one_that_goes_back(video, seconds, seed):
    """It was said that the other one had lost frames: right at both ends, and up to 45 frames off in the middle."""
    world = plain(seed, frames=180, within=20, first=(In(video, Replay(seconds, at=0.6)),))
    offsets = synchronize(list(world.tracks))
    (found,) = offsets.breaks[video]
    assert not offsets.breaks[1 - video]
    assert found.jump == pytest.approx(-seconds, abs=0.2 / 30) and found.at == pytest.approx(107.4 / 30, abs=1.5 / 30)
    assert offsets.ok and world.errors(offsets)[1][0] < 0.2


def test_motion_that_comes_back_breaks_no_clock():
    """Of two strides either may suit a second better; a frozen stride is seen all the same."""
    world = CLASSES["strides"](301)
    offsets = synchronize(list(world.tracks))
    assert world.errors(offsets)[0][0] < 0.1 and offsets.flags[1] == (Status.AMBIGUOUS,)
    assert all(Status.BROKEN_CLOCK not in a.flags for a in offsets.alignments.values())
    world = CLASSES["strides, one frozen"](303)
    offsets = synchronize(list(world.tracks))
    (found,) = offsets.breaks[1]
    assert offsets.ok and world.errors(offsets)[0][0] < 0.15 and found.still == pytest.approx(1.0)


def told(shown, lost: int, at: int = 60, late: int = 5, noise: float = 0.1, seed: int = 0):
    """Curves of a pair whose second video lost frames, or shows them twice, with and without what comes back.

    Args:
        shown: (M,T,3) motion, of which the videos see frames from 100 on.
    """
    rng, k = np.random.default_rng([seed, 7]), np.arange(150)
    a, b = shown[:, 100 + k], shown[:, 100 + late + k + lost * (k >= at)]
    pair = CommonClock(*(x + noise * rng.normal(size=x.shape) for x in (a, b)), 30.0, 0.0)
    lags, weight, floor = np.arange(-110, 111), np.ones(len(a)), 1.5 * noise**2
    curves = local_curves(pair, lags, floor, weight)
    best = int(curves.sum(0).argmax())
    alike = like_itself(pair, lags, best, floor, weight)
    own = beside_returns(curves, alike, best)
    np.testing.assert_array_equal(own[:, best], curves[:, best])
    assert (own <= curves).all() and (own >= np.minimum(curves, curves[:, [best]])).all()
    return curves, own, best


def smooth(width: float, seed: int) -> np.ndarray:
    """Motion that wanders, of one size: white noise through a Gaussian of ``width`` frames."""
    rng = np.random.default_rng([seed, 3])
    window = np.exp(-0.5 * (np.arange(-4 * int(width), 4 * int(width) + 1) / width) ** 2)
    x = np.stack([np.convolve(w, window, "same") for w in rng.normal(size=(60, 700))])[:, 150:550]
    return (x / x.std(1, keepdims=True)).reshape(20, 3, 400).transpose(0, 2, 1)


@pytest.mark.parametrize("lost", [15, -15])
@pytest.mark.parametrize("width", [8.0, 25.0])
@pytest.mark.parametrize("seed", range(4))
def test_motion_that_does_not_come_back_hides_no_break(seed, width, lost):
    """Slow motion is like itself a little later, too; and at the ends of the overlap more of it is in common later."""
    curves, own, best = told(smooth(width, seed), lost, seed=seed)
    gain, left = (float((x - curves[:, [best]]).max()) for x in (curves, own))
    assert gain > 1 and left > 0.8 * gain


def strides(lost: int, seed: int) -> tuple[CommonClock, np.ndarray]:
    """A pair of 40 points that swing every 30 frames, each time a little otherwise; b loses frames behind its 90th."""
    rng, k = np.random.default_rng([seed, 9]), np.arange(150)
    t = np.arange(300)
    size = 1 + 0.25 * np.stack([np.interp(t, np.arange(0, 331, 30), w) for w in rng.normal(size=(40, 12))])
    phase = rng.uniform(0, 6.3, (40, 3, 1))
    shown = (size[:, None] * np.sin(2 * np.pi * t / 30 + phase)).transpose(0, 2, 1)
    a, b = shown[:, 20 + k], shown[:, 25 + k + lost * (k >= 90)]
    noisy = [x + 0.1 * rng.normal(size=x.shape) for x in (a, b)]
    return CommonClock(*noisy, 30.0, 0.0), np.arange(-100, 101)


@pytest.mark.parametrize("seed", range(6))
def test_a_lost_stride_is_liked_at_another_return(seed):
    """Behind it neither offset suits all; where nothing is lost, few matches suit another stride better anywhere."""
    for lost in (0, 30):
        pair, lags = strides(lost, seed)
        curves = local_curves(pair, lags, 0.015, np.ones(len(pair.a)))
        best = int(curves.sum(0).argmax())
        assert lags[best] == 5
        assert return_is_liked(pair, lags, curves, best, 10, 3) == (lost > 0)


@pytest.mark.parametrize("who", [0, 1])
@pytest.mark.parametrize("seconds", [0.6, 1.5])
def test_every_frame_of_a_video_that_goes_back_has_a_partner(seconds, who):
    """One that lost frames leaves some of the other's without any, and does not go back."""
    times, motion = np.arange(180) / 30, smooth(8.0, 2)
    for back in (True, False):
        shown = times - (seconds if back else -seconds) * (times >= 3)
        moments = np.interp(shown, np.arange(-60, 340) / 30, np.arange(400.0)).round().astype(int)
        raw = [Raw(times, motion[:, 60:240])] * 2
        raw[who] = Raw(times, motion[:, moments])
        # b's clock plus the offset is a's: a that goes back is late, b that does is early
        second = seconds if back == (who == 0) else -seconds
        when = 3.0 if who == 0 or not back else 3.0 - seconds / 2
        found = goes_back((raw[0], raw[1]), 0.0, second, when, (-np.inf, np.inf))
        assert found == ((who, pytest.approx(3.0, abs=1 / 30)) if back else None)


def test_a_second_that_suits_another_stride_better_breaks_no_clock():
    a, b = CLASSES["strides"](301).tracks
    alone = align(a, b, match(a, b), aligner=LikelihoodScan(), throw=False)
    assert not len(alone.parts) and Status.BROKEN_CLOCK not in alone.flags


def test_an_offset_that_most_matches_of_a_part_contradict_gives_way():
    """Some other offset suits a few of the matches behind a gap very well, and has more evidence in all."""
    rng, k = np.random.default_rng(5), np.arange(150)
    shown = smooth(8.0, 1)
    a, b = shown[:, 100 + k], shown[:, 105 + k + 15 * (k >= 70)]
    pair = CommonClock(*(x + 0.1 * rng.normal(size=x.shape) for x in (a, b)), 30.0, 0.0)
    lags, step, floor = np.arange(-60, 61), 10, 0.015
    curves = local_curves(pair, lags, floor, np.ones(len(a)))
    windows = np.arange(len(curves))
    spans = [windows[:8], windows[10:]]
    tops = [int(curves[span].sum(0).argmax()) for span in spans]
    assert [int(lags[top]) for top in tops] == [5, 20]
    by_few = int(np.flatnonzero(lags == -30)[0])
    curves[spans[1], by_few] = curves[spans[1], tops[1]] + 0.5
    look = Look(pair, lags, curves, tops[0], floor, step)
    settled, change, sound = look.settled(spans, [tops[0], by_few])
    assert sound and settled == tops
    assert change == pytest.approx(-0.5 * len(spans[1]))


def test_strides_of_which_one_is_missing_are_mended_or_doubtful():
    """The windows behind the gap are too short to lift this doubt."""
    for name, seed in (("", 57013), ("", 58012), (" late", 59100), (", four videos", 59100)):
        world = CLASSES[f"strides, one missing{name}"](seed)
        offsets = synchronize(list(world.tracks))
        sound = np.array([not flags for flags in offsets.flags[1:]])
        assert (world.errors(offsets)[0][sound] < 0.3).all(), (name, seed)


def test_of_likely_offsets_no_two_are_near():
    evidence = np.array([0.0, 5, 4, 4.5, 0, 3, 0, 2, 0])
    assert likely(evidence, 3) == [5]
    assert likely(evidence, 2) == [3, 5, 7]


@pytest.mark.parametrize("noise", [0.0, 0.03, 0.1])
@pytest.mark.parametrize("off", [-15, 0, 4, 15])
def test_what_rests_is_told_by_what_moves_otherwise(noise, off):
    """A third of the tracks moves; the others have nothing but noise. The pair may have the pause half a second off."""
    rng = np.random.default_rng(0)
    t = np.arange(90) / 30
    shown = np.where(t < 1, t, np.maximum(1.0, t - 20 / 30))
    x = np.zeros((30, 90, 3))
    x[:10, :, 0] = np.sin(4 * shown)
    x += noise * rng.normal(size=x.shape)
    assert stood_still(t, x, 1.0 + off / 30, 20 / 30) == pytest.approx(1.0, abs=0.0 if noise == 0 else 2.1 / 30)
    x[:10, :, 0] = np.sin(4 * t) + noise * rng.normal(size=(10, 90))
    assert stood_still(t, x, 1.0 + off / 30, 20 / 30) is None


def test_where_nothing_moves_or_little_is_seen_nothing_stood_still():
    rng = np.random.default_rng(1)
    t = np.arange(90) / 30
    x = 0.1 * rng.normal(size=(30, 90, 3))
    assert stood_still(t, 0 * x, 1.0, 0.5) is None
    assert stood_still(t, np.full_like(x, np.nan), 1.0, 0.5) is None
    x[:, :, 0] += np.sin(4 * np.where(t < 1, t, np.maximum(1.0, t - 0.5)))
    assert stood_still(t, x, 1.0, 0.5) is not None
    assert stood_still(t, x, 1.0, 0.05) is None  # of a frame and a half nobody can tell
    assert stood_still(t, x, 1.0, 5.0) is None  # longer than the clip
    x[:, 25:52] = np.nan
    assert stood_still(t, x, 1.0, 0.5) is None


def swinging(frozen: range, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Times, and tracks of which a third moves; all frames of ``frozen`` show what the one before them does."""
    rng = np.random.default_rng(seed)
    t = np.arange(90) / 30
    shown = t - np.clip(t - (frozen[0] - 1) / 30, 0, len(frozen) / 30)
    x = np.zeros((60, 90, 3))
    x[:20, :, 0] = np.sin(4 * shown)
    return t, x + noise * rng.normal(size=x.shape)


@given(st.integers(20, 40), st.integers(8, 30), st.sampled_from([0.0, 0.01, 0.02]), st.integers(-4, 4))
@settings(max_examples=30, deadline=None)
def test_the_frames_of_a_pause_are_counted(first, count, noise, off):
    t, x = swinging(range(first, first + count), noise)
    found = pause(t, x, t[first - 1] + off / 30, (count - off) / 30)
    if found is not None:  # where a swing turns next to it, noise may hide its end
        np.testing.assert_allclose(found, (t[first - 1], t[first + count - 1]), atol=1e-9)
    assert noise > 0 or found is not None or np.abs(np.cos(4 * t[first - 1])) < 0.5


@pytest.mark.parametrize(
    "first, count, noise, off",
    [
        (32, 26, 0.02, 0),
        (34, 10, 0.02, -2),
        (34, 14, 0.02, -4),
        (38, 16, 0.02, 0),
        (34, 24, 0.01, -2),
        (35, 8, 0.005, -2),
    ],
)
def test_a_pause_beside_which_a_swing_turns_is_not_counted_with_the_turn(first, count, noise, off):
    """Noise hides up to six frames of a turn: they rest as much as the pause does."""
    t, x = swinging(range(first, first + count), noise)
    assert pause(t, x, t[first - 1] + off / 30, (count - off) / 30) is None


@pytest.mark.parametrize(("every", "noise"), [(5, 0.0), (5, 0.01), (15, 0.0), (15, 0.01), (30, 0.0)])
def test_a_pause_of_a_file_that_repeats_frames_is_not_counted(every, noise):
    """24, 28 or 29 pictures a second in a file of 30: the frame beside the pause may be one that is shown twice. (Of 29
    the only other two may lie where things turn, and noise hides them.)
    """
    twice = [k for k in range(45 % every, 90, every) if k > 0 and not 29 < k < 45]
    t, x = swinging(range(30, 45), noise)
    assert pause(t, x, 29 / 30, 0.5) is not None
    rng = np.random.default_rng(3)
    for k in twice:
        x[:, k] = x[:, k - 1] + noise * rng.normal(size=x[:, k].shape)
    assert pause(t, x, 29 / 30, 0.5) is None


def test_a_pause_that_noise_hides_is_not_counted():
    t, x = swinging(range(30, 45), 0.3)
    assert pause(t, x, 29 / 30, 0.5) is None
    t, x = swinging(range(30, 45), 0.01)
    assert pause(t, x, 29 / 30, 0.5) is not None
    assert pause(t, x, 29 / 30, 1.0) is None  # the pair measured another length
    assert pause(t, np.full_like(x, np.nan), 29 / 30, 0.5) is None


def test_parts_by_chance_are_those_that_the_parts_beside_them_explain():
    """a has 150 frames and b too; windows every 10 frames."""
    nothing = np.zeros((1, 150, 3))
    pair = CommonClock(nothing, nothing, 30.0, 0.0)

    def left(edges: list[int], lags: list[int], agree: list[float], best: int = 99) -> list[int]:
        return by_chance(np.split(np.arange(16), edges), lags, agree, best, pair, 10)

    assert left([7, 10], [8, 24, 37], [0.9, 0.5, 0.9]) == [0, 2]  # b lost a second: a's frames there have no partner
    assert left([7, 10], [8, 24, 12], [0.9, 0.5, 0.9]) == [0, 1, 2]  # b lost less than that
    assert left([7, 10], [8, 24, 37], [0.9, 0.95, 0.9]) == [0, 1, 2]  # it agrees as well as they do
    assert left([3], [-39, 20], [0.8, 0.9]) == [1]  # b begins there
    assert left([3], [-39, 5], [0.8, 0.9]) == [0, 1]
    assert left([8], [-75, 75], [0.8, 0.9]) == [0, 1]  # halves that were exchanged: too long for chance
    assert left([8], [-75, 75], [0.4, 0.9]) == [1]
    assert left([8], [-75, 75], [0.4, 0.9], best=-75) == [0, 1]
    assert left([13], [-20, 90], [0.9, 0.8]) == [0]  # b ended there


def test_edges_of_parts_leave_out_what_has_no_partner():
    spans = np.split(np.arange(16), [6])
    assert partners(spans, [-10, 20], 0, 10) == (-5, 25) and partners(spans, [-10, 20], 1, 10) == (85, 155)
    assert partners(spans, [20, -10], 0, 10) == (-5, 55) and partners(spans, [20, -10], 1, 10) == (55, 155)


def test_of_four_videos_the_one_that_froze_is_named():
    tracks, truth = broken(Freeze(20, at=0.5), videos=4, who=2)
    offsets = synchronize(tracks)
    assert [len(b) for b in offsets.breaks] == [0, 0, 1, 0]
    assert np.abs(offsets.seconds - truth.offsets).max() * 30 < 0.15


def test_pairs_that_are_kept_on_disk_keep_their_parts(tmp_path):
    from otsync.files.cache import Cache
    from otsync.recordings.kept_pairs import KeptPairs

    tracks, _ = broken(Freeze(15, at=0.5))
    plain = synchronize(tracks)
    for _ in range(2):  # computed, then read
        kept = synchronize(tracks, map=KeptPairs(Cache(tmp_path)))
        assert kept.breaks == plain.breaks and plain.breaks[1]
        assert kept.seconds.tolist() == plain.seconds.tolist() and kept.flags == plain.flags


def test_whole_clocks_are_left_alone():
    for seed in range(3):
        tracks, _ = simulate("football", preset="mid", videos=2, max_offset=30, seed=seed)
        offsets = synchronize(tracks)
        assert offsets.breaks == ((), ()) and offsets.rates.tolist() == [1, 1]
        assert Status.BROKEN_CLOCK not in offsets.flags[1]


def test_a_wrong_rate_is_fitted_and_told():
    tracks, _ = simulate("tennis", preset="mid", videos=2, frames=300, rates=[1.0, 1.01], offsets=[0, 0.3], seed=5)
    offsets = synchronize(tracks)
    assert offsets.ok and offsets.rates[1] == pytest.approx(1.01, abs=3e-4)
    assert any("rate" in note for note in offsets.clock_notes())
    held = synchronize(tracks, rate="fixed")
    assert Status.RATE_MISMATCH in held.flags[1]


@pytest.mark.parametrize("seed", [602, 604])
def test_a_freeze_under_much_noise_is_never_trusted_and_wrong(seed):
    """Both were trusted once, fifteen frames off at one end."""
    world = CLASSES["freeze of 15, brutal"](seed)
    offsets = synchronize(world.tracks)
    ends, _ = world.errors(offsets)
    assert not offsets.status[1].ok or ends[0] < 1


@pytest.mark.parametrize("seed", [515, 564, 614])
def test_noise_that_leaves_much_unexplained_everywhere_is_no_break(seed):
    """Motion of which every second leaves most unexplained, at every offset alike."""
    world = CLASSES["hard"](seed)
    offsets = synchronize(world.tracks)
    assert offsets.status[1].ok and world.errors(offsets)[0][0] < 0.4


def test_a_rate_is_no_break():
    world = CLASSES["rate 1 %, 20 s"](501)
    offsets = synchronize(world.tracks)
    assert offsets.status[1].ok and abs(offsets.rates[1] - 1) > 0.009 and world.errors(offsets)[0][0] < 0.1


@pytest.mark.parametrize("seed", [24006, 24011])
def test_two_takes_whose_seconds_hardly_disagree_are_flagged(seed):
    """Both were trusted once: their seconds differ by a fifth and a quarter of a frame."""
    assert not synchronize(CLASSES["two takes"](seed).tracks).status[1].ok


def test_breaks_survive_the_file(tmp_path):
    known = Offsets.known(("a", "b"), np.array([0.0, 0.5]), 30)
    import dataclasses

    told = dataclasses.replace(known, breaks=((), (Break(2.0, -0.5, 0.5, 0.001), Break(3.0, 1.0))))
    told.save(tmp_path / "offsets.json")
    again = Offsets.load(tmp_path / "offsets.json")
    assert again.breaks[0] == () and again.breaks[1][0] == told.breaks[1][0]
    assert again.breaks[1][1].jump == 1.0 and np.isnan(again.breaks[1][1].sigma)
    with pytest.raises(ValueError, match="breaks"):
        dataclasses.replace(known, breaks=((),))


def test_times_behind_breaks_are_those_of_the_clock_before_them():
    times = np.arange(10) / 10
    shown, tells = mended_times(times, [Break(0.5, -0.2, 0.2)])
    assert tells.tolist() == [True, True, True, False, False, True, True, True, True, True]
    np.testing.assert_allclose(shown[tells], np.arange(8) / 10)
    index, seconds = mended_frames(times, [Break(0.5, -1.0)])  # the halves were exchanged
    assert index.tolist() == [5, 6, 7, 8, 9, 0, 1, 2, 3, 4] and (np.diff(seconds) > 0).all()
    cut = mended(TrackSet(np.zeros((2, 10, 3)) + np.arange(10)[None, :, None], timestamps=times), [Break(0.5, -1.0)])
    assert cut.xyz is not None and cut.xyz[0, :, 0].tolist() == index.tolist()


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_slow_motion_is_no_lost_frames_that_are_mended(seed):
    """Beside a break that was mended the clock must run on evenly; a slow motion begins and ends in a ramp."""
    tracks, _ = broken(SlowMotion(2.0), seed=seed)
    assert Status.BROKEN_CLOCK in synchronize(tracks).flags[1]


def test_pairs_speak_only_for_what_they_see_of_a_clock():
    """Two of three pairs of the frozen video end before its freeze: they outvoted the one that saw it, and the end was
    off by the 30 frames of the freeze, with every status ok.
    """
    world = CLASSES["freeze of 30, four videos"](28003)
    found = synchronize(world.tracks)
    ends, _ = world.errors(found)
    assert ends.max() < 0.2
    (broken,) = found.breaks[2]
    assert broken.jump == pytest.approx(-1.0) and found.ok


def fitted(seconds: float, information: float, wander: float = 0.0, sigma: float = 0.0) -> Fit:
    return Fit(
        Clock(0.0),
        np.array([[sigma**2]]),
        np.array([[sigma**2]]),
        np.ones(9),
        5,
        blur=0.1,
        wander=wander,
        information=information,
        seconds=seconds,
    )


def test_a_second_is_off_by_as_much_as_other_seconds_differ():
    late = np.array([0.01, -0.02, 0.015, 0.03])
    whole = fitted(4, information=4 * 7.0, wander=float(np.std(late)))
    assert whole.off_by(7.0) == pytest.approx(float(np.std(late, ddof=1)))
    assert whole.off_by(4 * 7.0) == pytest.approx(whole.off_by(7.0) / 2)
    assert fitted(1, 7.0, wander=0.1).off_by(7.0) == 0.0  # a single second does not differ from itself


def test_little_more_than_a_second_heeds_the_seconds_beyond_its_break():
    short, long = fitted(1, 7.0, sigma=0.003), fitted(4, 28.0, wander=0.01, sigma=0.002)
    assert sigma_of_part(short, long, 0.6) == pytest.approx(np.hypot(0.003, long.off_by(7.0)))
    assert sigma_of_part(short, long, 1.6) == pytest.approx(0.003)
    assert sigma_of_part(short, replace(long, seconds=1), 0.6) == pytest.approx(0.006)  # nothing tells
    assert sigma_of_part(long, short, 4.0) == pytest.approx(0.002)
    assert sigma_of_part(short, None, 0.6) == pytest.approx(0.003)
    assert np.isnan(sigma_of_part(None, long, 0.6))


def test_a_pause_that_one_pair_counted_is_not_averaged_with_measured_ones():
    sure = Break(4.0, -0.5, 0.5, 0.0)
    measured = [Break(3.95, -0.47, 0.47, 0.01), Break(4.02, -0.48, 0.48, 0.01)]
    found = [Suspect(1, sure, 1.0), *(Suspect(1, b, 1.0) for b in measured)]
    told = culprit(found, [])
    assert told is not None and told.found == sure and told.votes == 3
    told = culprit(found[1:], [])
    assert told is not None and told.found.jump == pytest.approx(-0.475)


def test_what_pairs_measure_against_a_counted_pause_is_its_sigma():
    """A performer who rests right beside a pause makes it look longer."""
    counted = Break(4.0, -17 / 30, 17 / 30, 0.0)
    near, far = (replace(counted, jump=-jump / 30, sigma=0.2 / 30) for jump in (16.5, 15.2))
    assert confirmed(counted, near) == counted and confirmed(counted, None) == counted
    doubted = confirmed(counted, far)
    assert doubted.jump == counted.jump and doubted.sigma * 30 == pytest.approx(np.hypot(0.2, 1.8))
    assert jump_sigma(counted, 1 / 30) == 0 and jump_sigma(doubted, 1 / 30) == doubted.sigma


def test_the_sigma_of_a_jump_is_its_own_and_large_where_nobody_knows_it():
    frame = 1 / 30
    for still in (0.0, 0.5):
        assert jump_sigma(Break(2.0, -0.5, still, 0.4 * frame), frame) == pytest.approx(0.4 * frame)
        assert jump_sigma(Break(2.0, -0.5, still, float("nan")), frame) > frame


@pytest.mark.parametrize("returns", [0.0, 1.0])
def test_windows_that_are_steady_lift_no_doubt_whether_motion_comes_back(returns):
    a, b = CLASSES["mid"](80100).tracks
    job = Job((0, 1), a, b, None, LikelihoodScan(), SplineRefine(), None)
    answer = run(job)
    even = Windows(
        Clock(answer.refined.offset), np.arange(5.0), np.arange(-3.0, 4.0), np.eye(7)[[3] * 5], np.ones(5, bool)
    )
    assert even.steady
    (said,) = by_windows(even, answer, job, {"returns": 0.0}, {"returns": returns})
    assert (Status.BROKEN_CLOCK in said.refined.flags) == bool(returns)
    assert said.scanned.stats["returns"] == returns


def test_a_break_of_a_file_that_repeats_pictures_is_as_sure_whenever_its_clock_begins():
    """Of the video that froze, frames were read at the other one's time: its pictures were not seen to repeat."""
    faults = In(1, Repeats(15.0)), In(1, Freeze(40))  # an even number: its pictures do not tell it
    world = plain(1126, motion="tennis", preset="clean", frames=154, tracks=32, within=11.0, first=faults)
    one, other = world.tracks
    later = replace(other, timestamps=other.times + 60.0, fps=None)
    (here,), (there,) = (synchronize([one, video]).breaks[1] for video in (other, later))
    assert there.at - 60.0 == pytest.approx(here.at, abs=1e-6)
    assert there.jump == pytest.approx(here.jump, abs=1e-6) and there.sigma == pytest.approx(here.sigma, abs=1e-6)


@pytest.mark.parametrize("frames, rate", [(154, 15.0), (156, 20.0)])
def test_half_a_second_behind_a_pause_of_a_file_that_repeats_pictures_is_counted(frames, rate):
    """What was measured of it, 41.8 +- .2 frames, was rounded to 42."""
    faults = In(1, Repeats(rate)), In(1, Freeze(41))
    world = plain(1124, motion="tennis", preset="clean", frames=frames, tracks=32, within=11.0, first=faults)
    offsets = synchronize(world.tracks)
    (found,) = offsets.breaks[1]
    assert found.jump * 30 == pytest.approx(-41) and found.sigma == 0
    assert offsets.status[1].ok and world.errors(offsets)[0][0] < 0.2
