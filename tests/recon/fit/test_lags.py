"""Frames at other times of the scene tell a clock that is off by many frames: laws on a ball that moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from recon.fit.lags import FIRST, FRAMES, LAGS, LEAST, Lagged, OtherTimes, displaced, lagged
from recon.fit.uncertainty import FRAMES as VOTES
from recon.fit.uncertainty import cast, scattered

STEP = 1 / 30
LENGTH = 60
COLUMNS = torch.arange(120.0)


def ball(seconds: float) -> Tensor:
    """[1,w,3] pixels: a ball of five columns that crosses the image in two seconds."""
    at = 110 * seconds / (LENGTH * STEP)
    return torch.exp(-(((COLUMNS - at) / 5) ** 2))[None, :, None].expand(1, -1, 3)


POST = (COLUMNS >= 50) & (COLUMNS < 75)


def asked(
    shown: Sequence[Sequence[int]], noise: float = 0.0, seed: int = 0, post: Sequence[int] = (), fps: float = 30
) -> list[Lagged]:
    """Videos that show these frames of the ball, and say that they show one after another.

    In some a grey post stands before it, of which the scene does not know that it hides the ball; there the frames are
    cut to where the ball is, or would be.
    """
    step = 1 / fps

    def cut(image: Tensor, v: int, k: int) -> Tensor:
        at = 110 * shown[v][k] / (LENGTH * STEP) * step
        return image[:, (COLUMNS - at).abs() < 15] if v in post else image

    def behind(v: int) -> Tensor:
        return (0.3 * POST * (v in post))[None, :, None].expand(1, -1, 3)

    def target(v: int, k: int) -> Tensor:
        rng = np.random.default_rng((seed, v, k))
        hidden = (POST * (v in post))[None, :, None] > 0
        image = torch.where(hidden, behind(v), ball(shown[v][k] * step))
        return cut(image + torch.tensor(rng.normal(size=(1, 120, 3)) * noise), v, k)

    def look(v: int, k: int, later: float) -> Tensor:
        there = ball(k * step + later)
        return cut(there + (1 - there) * behind(v), v, k)

    keys = np.array([(v, k) for v, own in enumerate(shown) for k in range(len(own))]).reshape(-1, 2)
    votes = cast(look, target, keys, len(shown), step)
    return lagged(OtherTimes(look, lambda v, k: cut(behind(v), v, k), target, lambda v, k: k * step, step), votes)


EVEN = list(range(LENGTH))


@pytest.mark.parametrize(
    "shown",
    [
        [*range(30), *range(30)],
        [*range(20), *range(39, 19, -1), *range(40, 60)],
        EVEN[::-1],
        [*range(20), *[20] * 15, *range(20, 45)],
        [*range(30), *range(40, 60)],
    ],
    ids=["a second twice", "backwards within", "backwards", "stands still", "lost"],
)
def test_whose_clock_is_off_by_many_frames_is_told(shown):
    assert displaced(asked([EVEN, shown, EVEN], noise=0.02)) == [1]


@settings(max_examples=25)
@given(seed=st.integers(0, 99), noise=st.floats(0.0, 0.3))
def test_frames_of_their_own_time_are_left_alone(seed, noise):
    """However badly they are shown."""
    assert displaced(asked([EVEN, EVEN], noise, seed)) == []


def test_what_stands_before_the_scene_tells_no_time():
    """Where the scene draws the ball over the post, any time at which the ball is elsewhere is shown better."""
    shown = asked([EVEN, EVEN], post=[1])
    own, other = shown[1].errors[:, shown[1].lags == 0][:, 0], np.nanmin(shown[1].errors, 1)
    assert (other < 0.5 * own).sum() >= LEAST and displaced(shown) == []
    assert displaced(asked([EVEN, [*range(30), *range(30)]], post=[1])) == [1]


@pytest.mark.parametrize("fps", [12.5, 60, 240])
def test_lags_are_seconds_and_a_frame_at_least(fps):
    count = int(2 * fps)
    late = [min(k + int(0.8 * fps), count - 1) for k in range(count)]
    shown = asked([list(range(count)), late, list(range(count))], fps=fps)
    assert displaced(shown) == [1] and np.abs(shown[0].lags[shown[0].lags != 0]).min() >= 1 / fps - 1e-12


def test_the_frames_that_are_shown_worst_are_asked():
    """A few of many, which frames at even distances would miss."""
    shown = [*range(40), *range(47, 39, -1), *range(48, LENGTH)]
    found = asked([EVEN, shown])
    off = [k for k in scattered(LENGTH, VOTES).tolist() if abs(shown[k] - k) >= 3]
    assert off and {*off} <= {*found[1].frames.tolist()} and len(found[1].frames) == FRAMES
    assert displaced(found) == [1]


def test_a_video_that_is_shown_well_costs_little():
    assert [len(one.frames) for one in asked([EVEN, EVEN[::-1]])] == [FIRST, FRAMES]


def test_a_scene_has_no_time_before_its_first_frame_or_after_its_last_one():
    for shown in (EVEN[::-1], [*range(45), *range(59, 44, -1)]):
        one = asked([EVEN, shown])[1]
        at = one.frames[:, None] * STEP + one.lags
        inside = (at >= 0) & (at <= scattered(LENGTH, VOTES)[-1] * STEP) | (one.lags == 0)
        assert (np.isfinite(one.errors) == inside).all() and not inside.all()
        assert one.errors.shape == (FRAMES, 2 * len(LAGS) + 1)


@pytest.mark.parametrize("length", [0, 1])
def test_a_video_of_less_than_two_frames_says_nothing(length):
    shown = asked([EVEN, EVEN[:length]])
    assert shown[1].errors.shape == (0, 2 * len(LAGS) + 1) and displaced(shown) == []


def test_where_nothing_is_filmed_nothing_is_told():
    assert displaced(asked([])) == []


def at_another_time(*shares: float) -> Lagged:
    """Frames that are shown with such shares of their error at another time, and as many that are not."""
    errors = np.array([[2.0 * share, 2.0, np.nan] for share in (*shares, *[1.5] * 4)])
    return Lagged(np.arange(len(errors)), np.array([-1.0, 0.0, 1.0]), errors, np.full(len(errors), 9.0))


@pytest.mark.parametrize(
    ("shares", "said"), [((0.1,), []), ((0.1, 0.9), []), ((0.7, 0.7), [0]), ((0.1, 0.7, 0.9), [0])]
)
def test_two_frames_must_be_shown_far_better(shares, said):
    assert displaced([at_another_time(*shares), at_another_time()]) == said


def test_where_nothing_moves_no_time_is_better():
    still = np.zeros((FRAMES, 3))
    assert displaced([Lagged(np.arange(FRAMES), np.array([-1.0, 0.0, 1.0]), still, still[:, 0])]) == []
