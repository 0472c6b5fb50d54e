"""Parts of overlaps in which an answer does not hold are doubted, and right answers are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync import synchronize
from otsync.bench.trust.worlds import CLASSES, plain
from otsync.simulate import simulate
from otsync.simulate.effects import Drop, In
from otsync.sync.alike import Raw
from otsync.sync.parts import Matched, Other, broken_part, does_not_agree, unvouched
from otsync.sync.verdict import Answer
from otsync.types import Alignment, Clock, Matches, Status, TrackSet

FPS = 30.0


@pytest.mark.parametrize("name", ["ten frames dropped", "ten frames dropped, hard"])
def test_a_break_near_an_end_is_never_trusted_and_wrong(name):
    """Ten frames lost near an end: too little for the search by windows, and trusted before."""
    world = CLASSES[name](29001)
    found = synchronize(world.tracks)
    ends, _ = world.errors(found)
    assert Status.BROKEN_CLOCK in found.flags[1] or ends.max() < 1


def test_a_few_frames_lost_near_an_end_are_a_doubt():
    """Another offset suits half a second little better, but as surely as none suits any other half."""
    faults = (In(0, Drop(3 / FPS, at=0.1)),)
    world = plain(499, motion="juggle", frames=183, tracks=122, within=0.0, first=faults)
    assert Status.BROKEN_CLOCK in synchronize(world.tracks).flags[1]


@pytest.mark.parametrize("motion", ["softball", "boxes"])
def test_clean_worlds_are_not_doubted(motion):
    """Nothing but the bodies' turning keeps matched points apart there: a noise of its own kind."""
    tracks, truth = simulate(motion, preset="clean", videos=3, frames=100, seed=3, max_offset=10)
    found = synchronize([t.take(np.arange(0, len(t), 3)) for t in tracks])
    assert found.ok and np.abs(found.seconds - truth.offsets).max() * FPS < 0.1


def pair(late: float = 0.3, breaks: float | None = None, hidden: float = 0.0, seed: int = 0):
    """Two track sets of 20 points on smooth paths, the second ``late`` s later, and the pair's answer.

    breaks: share of the second clip from which on its frames are a third of a second later; hidden: share of the
    tracks that the second video does not see from there on.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(120) / FPS
    phase, speed, size = rng.uniform(0, 6, (20, 1, 3)), rng.uniform(1, 4, (20, 1, 3)), rng.uniform(0.2, 0.6, (20, 1, 3))

    def seen(at):
        noise = rng.normal(0, 0.01, (20, len(at), 3))
        return size * np.sin(speed * at[:, None] + phase) + noise

    shown = t + late
    visible = np.ones((20, len(t)), bool)
    if breaks is not None:
        behind = np.arange(len(t)) >= breaks * len(t)
        shown = shown + behind / 3
        visible[: round(20 * hidden), behind] = False
    x = seen(shown) + rng.normal(0, 0.1, (20, 1, 3))
    a, b = TrackSet(seen(t), fps=FPS, name="a"), TrackSet(x, visible, fps=FPS, name="b")
    matches = Matches(np.stack([np.arange(20)] * 2, 1), np.ones(20))
    answer = Alignment(late, fps=FPS)
    return Answer((0, 1), matches, answer, answer), a, b


@pytest.mark.parametrize("late", [-0.4, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_one_offset_holds_to_both_ends(late, seed):
    assert broken_part(*pair(late, seed=seed)) is None


@pytest.mark.parametrize("turned", [False, True])
def test_the_end_behind_a_break_is_named(turned):
    """On the first video's clock, whichever of both broke."""
    answer, a, b = pair(breaks=0.85)
    if turned:
        back = Alignment(-0.3, fps=FPS)
        answer, a, b = replace(answer, scanned=back, refined=back), b, a
    found = broken_part(answer, a, b)
    assert found is not None
    last = a.times[-1] if not turned else b.times[-1] - 0.3
    assert found[1] == pytest.approx(last) and 0.3 < found[1] - found[0] < 0.6


@pytest.mark.parametrize(
    ("share", "better", "named"), [(0.3, 0.0, True), (0.6, 0.0, False), (0.6, 5.0, True), (0.85, 5.0, False)]
)
def test_a_part_within_is_named_where_few_agree_or_fewer_do_and_another_offset_suits(monkeypatch, share, better, named):
    answer, a, b = pair()
    begins: list[float] = []

    def shares(matched, begin, length):
        begins.append(begin)
        return share if 2 <= len(begins) - 1 <= 3 else 0.9

    monkeypatch.setattr("otsync.sync.parts._share", shares)
    monkeypatch.setattr(
        "otsync.sync.parts.others", lambda matched, begin, length: iter([Other(better, better, 0.0, 0.1)])
    )
    raw = Raw.of(a, answer.matches.pairs[:, 0]), Raw.of(b, answer.matches.pairs[:, 1])
    away = a.times - a.times[0]
    assert does_not_agree(Matched(*raw, Clock(0.3), a.times, away)) == (begins[2] if named else None)


def test_where_another_offset_cannot_be_seen_positions_that_do_not_agree_tell(monkeypatch):
    """Tracks were matched at the answer: too few of those that the lost frames need are among the matches.

    The cut that the video shows tells it, too: then it is mended.
    """
    world = plain(524, preset="hard", first=(In(1, Drop(10 / 30, at=0.9)),))
    found = synchronize(world.tracks)
    assert found.breaks[1] and world.errors(found)[0].max() < 0.2
    monkeypatch.setattr("otsync.sync.mend.verb.culprit", lambda named, seen: None)
    found = synchronize(world.tracks)
    ends, _ = world.errors(found)
    assert ends.max() > 9 and Status.BROKEN_CLOCK in found.flags[1]


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("ten frames dropped, hard", 34002),
        ("ten frames dropped, hard", 35009),
        ("halves exchanged", 34009),
        ("halves exchanged", 507),
        ("played backwards", 34006),
    ],
)
def test_an_answer_that_a_part_of_the_clip_does_not_share_is_not_trusted(name, seed):
    """Trusted before, 10 and 150 frames wrong, and with no true answer: half a second and more agrees with nothing.

    Where the break is found and mended instead, so is the answer.
    """
    world = CLASSES[name](seed)
    found = synchronize(world.tracks)
    mended = bool(found.breaks[1]) and world.errors(found)[0].max() < 1
    assert mended or Status.BROKEN_CLOCK in found.flags[1]


def test_a_part_within_the_clip_that_does_not_agree_is_named():
    answer, a, b = pair()
    x = b.xyz.copy()
    x[:, 50:75] += np.linspace(0, 2, 25)[:, None] * np.random.default_rng(1).normal(size=(20, 1, 3))
    found = broken_part(answer, a, replace(b, xyz=x))
    assert found is not None and 50 / FPS - 0.3 < found[0] - 0.3 < found[1] - 0.3 < 75 / FPS + 0.3


def test_a_jump_that_could_not_be_measured_leaves_a_coarse_answer():
    """A freeze .7 s before the end, read as frames that the other video lost: 1.8 frames off at .12, and ok before."""
    world = CLASSES["freeze of 30"](35015)
    found = synchronize(world.tracks)
    error = float(world.errors(found)[0].max())
    assert error < 2 * found.sigma[1] * FPS and (error < 1 or not found.status[1].ok)


@pytest.mark.parametrize("seed", [502, 514])
def test_a_gap_in_a_mended_clock_is_not_asked_about(seed):
    """A second was lost, and the clock is mended: what lies between two samples is not known, and no doubt."""
    world = CLASSES["a second missing"](seed)
    found = synchronize(world.tracks)
    assert found.status[1].ok and world.errors(found)[0].max() < 0.1


@pytest.mark.parametrize(("late", "named"), [(2.3, True), (1.7, False)])
def test_the_end_of_a_short_overlap_must_know(monkeypatch, late, named):
    """Below two seconds another offset that suits the end as well is a doubt; above, it must suit it clearly better."""
    monkeypatch.setattr("otsync.sync.parts.others", lambda *job: iter([Other(0.05, 0.5, 0.0, 0.1)]))
    assert (broken_part(*pair(late=late)) is not None) == named
    monkeypatch.setattr("otsync.sync.parts.others", lambda *job: iter([]))
    assert (broken_part(*pair(late=late)) is not None) == named  # nothing can be asked for
    monkeypatch.setattr("otsync.sync.parts.others", lambda *job: iter([Other(-0.05, 0.5, 0.0, 0.1)]))
    assert broken_part(*pair(late=late)) is None


def test_overlaps_too_short_to_judge_are_left_alone():
    answer, a, b = pair(late=3.0)  # one second in common
    assert broken_part(answer, a, b) is None


def test_who_is_doubted_where_others_see_the_end():
    """A pair whose end does not hold, and no other sees: both its videos. Where others see it: the pair alone."""
    t = np.zeros((5, 120, 3))
    clips = [TrackSet(t, fps=FPS, name=str(n)) for n in range(3)]

    def answer(pair, offset):
        found = Alignment(offset, fps=FPS)
        return Answer(pair, Matches(np.zeros((0, 2), int), np.zeros(0)), found, found)

    answers = [answer((0, 1), 0.0), answer((0, 2), 0.0), answer((1, 2), 0.0)]
    assert unvouched({(0, 1): (3.4, 3.9)}, answers, clips) == {(0, 1)}
    answers[1:] = [answer((0, 2), -1.0), answer((1, 2), 0.0)]  # 0 and 2 share the first three seconds of 0
    assert unvouched({(0, 1): (3.4, 3.9)}, answers, clips) == {(0, 1), (0, 2)}
    answers[2] = answer((1, 2), -1.0)
    assert unvouched({(0, 1): (3.4, 3.9)}, answers, clips) == {(0, 1), (0, 2), (1, 2)}


@pytest.mark.parametrize(("end", "within", "doubted"), [(2.5, 0.5, True), (2.5, 2.0, False), (1.4, -1.0, False)])
def test_a_small_gain_at_an_end_must_be_surer_than_any_within(monkeypatch, end, within, doubted):
    def others(matched, begin, length):
        return iter([Other(0.1, 0.5, end if begin == 0 else within, 0.1)])

    monkeypatch.setattr("otsync.sync.parts.others", others)
    assert (broken_part(*pair()) is not None) == doubted
