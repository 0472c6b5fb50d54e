"""Where a step of a clock would be heard: there one is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync import synchronize
from otsync.bench.trust.worlds import CLASSES, World, at_an_end
from otsync.cli.tables import table
from otsync.report import write_report
from otsync.sync.parts import broken_part
from otsync.sync.steps import BY_MOTION, LENGTHS, heard, with_steps_heard
from otsync.sync.verdict import Answer
from otsync.types import Alignment, Matches, Offsets, Status, TrackSet

FPS, LATE = 30.0, 0.3


def pair(seed: int = 0, noise: float = 0.01, stays: float = 0.0, step: float = 0.0, left: float = 0.0, early=False):
    """Two track sets of 20 points on smooth paths, the second :data:`LATE` s later, and the pair's answer.

    stays: seconds of the first clip in which nothing moves. step: seconds that the second clip loses ``left`` s before
    its end, or behind its beginning where ``early``.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(120) / FPS
    phase, speed, size = rng.uniform(0, 6, (20, 1, 3)), rng.uniform(1, 4, (20, 1, 3)), rng.uniform(0.2, 0.6, (20, 1, 3))

    def seen(at):
        moves = np.maximum(at, stays)
        return size * np.sin(speed * moves[:, None] + phase) + rng.normal(0, noise, (20, len(at), 3))

    shown = t + LATE
    shown = shown - step * (shown < LATE + left) if early else shown + step * (shown > t[-1] - left)
    a, b = TrackSet(seen(t), fps=FPS, name="a"), TrackSet(seen(shown), fps=FPS, name="b")
    answer = Alignment(LATE, fps=FPS)
    return Answer((0, 1), Matches(np.stack([np.arange(20)] * 2, 1), np.ones(20)), answer, answer), a, b


def test_clear_motion_tells_a_step_near_both_ends():
    begin, end = heard(*pair())
    assert LATE + LENGTHS[0] - 1e-9 <= begin < LATE + 0.5
    assert 3.97 - 0.5 < end <= 3.97 - LENGTHS[0] + 1e-2


def test_where_nothing_moves_no_step_is_heard():
    begin, end = heard(*pair(stays=1.5))
    assert begin > 1.5 and end > 3.4


def test_noise_that_hides_everything_leaves_what_windows_of_motion_tell():
    begin, end = heard(*pair(noise=3.0))
    assert begin == pytest.approx(LATE + BY_MOTION) and end == pytest.approx(119 / FPS - BY_MOTION, abs=1 / FPS)


def test_of_a_short_overlap_under_noise_nothing_tells():
    answer, a, b = pair(noise=3.0)
    assert np.isnan(heard(answer, a.take(range(20)), cut(b, 75))).all()


def cut(tracks: TrackSet, frames: int) -> TrackSet:
    return TrackSet(tracks.positions()[:, :frames], fps=FPS)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 999),
    noise=st.floats(0.003, 0.08),
    frames=st.integers(4, 10),
    beyond=st.floats(0.02, 0.3),
    early=st.booleans(),
)
def test_a_step_where_one_would_be_heard_is_heard(seed, noise, frames, beyond, early):
    """The law: no step is left alone that lies further from an end than is said of the same pair without it."""
    answer, a, b = pair(seed, noise)
    begin, end = heard(answer, a, b)
    left = (begin - LATE if early else float(a.times[-1]) - end) + beyond
    assert broken_part(*pair(seed, noise, step=frames / FPS, left=left, early=early)) is not None


def test_only_sure_answers_with_depth_are_asked():
    answer, a, b = pair()
    flagged = answer.flagged(Status.WEAK)
    (same,) = with_steps_heard([flagged], [a, b], map)
    assert same is flagged
    flat = TrackSet(None, uv=a.positions()[..., :2], fps=FPS)
    (same,) = with_steps_heard([answer], [flat, b], map)
    assert same is answer
    (told,) = with_steps_heard([answer], [a, b], map)
    assert (told.refined.stats["heard_begin"], told.refined.stats["heard_end"]) == heard(answer, a, b)


def of_three(flags=((), (), ())) -> Offsets:
    """Three videos; the first sees the second from its beginning, and the third till the end."""
    known = Offsets.known(("a", "b", "c"), np.array([0.0, 1.0, 2.0]), FPS)
    pairs = {
        (0, 1): Alignment(1.0, stats={"heard_begin": 1.5, "heard_end": 4.0}),
        (1, 2): Alignment(1.0, stats={"heard_begin": 2.0, "heard_end": 5.0}),
    }
    return dataclasses.replace(known, alignments=pairs, flags=flags)


def test_a_video_has_what_any_of_its_pairs_hears(tmp_path):
    offsets = of_three()
    np.testing.assert_allclose(offsets.steps_heard, [[1.5, 4.0], [1.5, 6.0], [3.0, 6.0]])
    offsets.save(tmp_path / "offsets.json")
    np.testing.assert_allclose(Offsets.load(tmp_path / "offsets.json").steps_heard, offsets.steps_heard)


def test_a_flagged_video_and_one_of_another_group_promise_nothing():
    heard = of_three(flags=((), (), (Status.WEAK,))).steps_heard
    assert np.isnan(heard[2]).all() and np.isfinite(heard[:2]).all()
    apart = dataclasses.replace(of_three(), component=np.array([0, 0, 2])).steps_heard
    np.testing.assert_allclose(apart[:2], [[1.5, 4.0], [1.5, 4.0]])
    assert np.isnan(apart[2]).all()


def test_it_is_told_in_the_table_in_the_page_and_in_a_notebook(tmp_path):
    offsets = of_three()
    assert "1.5 to 6.0 s" in table(offsets) and "would be heard" in table(offsets)
    write_report(tmp_path / "report.html", offsets)
    page = (tmp_path / "report.html").read_text()
    assert "3.0 to 6.0 s" in page and "would be heard" in page
    assert "1.5 to 6.0 s" in offsets._repr_html_()


def test_nobody_speaks_of_steps_where_nobody_asked(tmp_path):
    known = Offsets.known(("a", "b"), np.zeros(2), FPS)
    assert "heard" not in table(known) and np.isnan(known.steps_heard).all()
    write_report(tmp_path / "report.html", known)
    assert "heard" not in (tmp_path / "report.html").read_text()


def test_an_answer_is_judged_where_a_step_would_be_heard_and_by_most_frames():
    """Ten frames off behind a step that the truth has .5 s before the end."""
    t = np.arange(150) / FPS
    shown = t + 10 / FPS * (t > 4.5)
    tracks = tuple(TrackSet(np.zeros((1, 150, 3)), fps=FPS) for _ in range(2))
    world = World(tracks, (t, shown))
    known = Offsets.known(("a", "b"), np.zeros(2), FPS)

    def told(begin: float, end: float, late: float = 0.0) -> float:
        stats = {"heard_begin": begin, "heard_end": end}
        offsets = dataclasses.replace(
            known, seconds=np.array([0.0, late]), alignments={(0, 1): Alignment(late, stats=stats)}
        )
        return float(world.where_heard(offsets)[0])

    assert world.errors(known)[0][0] > 9
    assert told(0.3, 4.2) < 0.1
    assert told(0.3, 4.9) > 9
    assert told(2.0, 3.0, late=5 / FPS) == pytest.approx(5)
    assert told(np.nan, np.nan, late=5 / FPS) == pytest.approx(5), "no part is heard: most frames tell"
    assert told(np.nan, np.nan) < 0.1


def test_frames_that_are_lost_where_noise_leaves_nothing_to_tell_are_beyond_what_is_promised():
    """The search's find: 2.9 frames off in the first half second, under hard noise, and no flag."""
    world = CLASSES["few frames lost near an end, hard"](80982)
    offsets = synchronize(world.tracks)
    assert not offsets.status[1].ok or world.errors(offsets)[0][0] <= 1 or world.where_heard(offsets)[0] < 0.5


def test_losses_at_the_ends_are_within_the_overlap():
    world = at_an_end(3, "mid")
    assert world.shown is not None and any(np.diff(s).max() > 1.5 / FPS for s in world.shown)
