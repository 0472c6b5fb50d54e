"""Frames at other times of the scene tell a clock that is off by many frames: laws on a ball that moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from recon.fit.lags import FIRST, FRAMES, LAGS, Lagged, displaced, lagged
from recon.fit.uncertainty import FRAMES as VOTES
from recon.fit.uncertainty import cast, scattered

STEP = 1 / 30
LENGTH = 60
COLUMNS = torch.arange(120.0)


def ball(seconds: float) -> Tensor:
    """[1,w,3] pixels: a ball of five columns that crosses the image in two seconds."""
    at = 110 * seconds / (LENGTH * STEP)
    return torch.exp(-(((COLUMNS - at) / 5) ** 2))[None, :, None].expand(1, -1, 3)


def asked(shown: Sequence[Sequence[int]], noise: float = 0.0, still: float = 0.0) -> list[Lagged]:
    """Videos that show these frames of the ball, and say that they show one after another."""

    def target(v: int, k: int) -> Tensor:
        rng = np.random.default_rng((v, k))
        return ball(shown[v][k] * STEP) + torch.tensor(rng.normal(size=(1, 120, 3)) * noise) + still

    def look(v: int, k: int, later: float) -> Tensor:
        return ball(k * STEP + later)

    keys = np.array([(v, k) for v, own in enumerate(shown) for k in range(len(own))]).reshape(-1, 2)
    votes = cast(look, target, keys, len(shown), STEP)
    return lagged(look, target, lambda v, k: k * STEP, votes, STEP)


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
@given(seed=st.integers(0, 99), noise=st.floats(0.0, 0.3), still=st.floats(0.0, 0.5))
def test_frames_of_their_own_time_are_left_alone(seed, noise, still):
    """However badly they are shown."""
    assert displaced(asked([EVEN, EVEN], noise, still)) == []


def test_the_frames_that_are_shown_worst_are_asked():
    """A few of many, which frames at even distances would miss."""
    shown = [*range(40), *range(47, 39, -1), *range(48, LENGTH)]
    found = asked([EVEN, shown])
    off = [k for k in scattered(LENGTH, VOTES).tolist() if abs(shown[k] - k) >= 3]
    assert off and {*off} <= {*found[1].frames.tolist()} and len(found[1].frames) == FRAMES
    assert displaced(found) == [1]


def test_a_video_that_is_shown_well_costs_little():
    assert [len(one.frames) for one in asked([EVEN, EVEN[::-1]])] == [FIRST, FRAMES]


def test_a_scene_has_no_time_before_its_first_frame():
    (one,) = asked([EVEN])
    at = one.frames[:, None] + one.lags
    assert (np.isfinite(one.errors) == ((at >= 0) & (at < LENGTH))).all()
    assert one.errors.shape == (FIRST, 2 * len(LAGS) + 1)


@pytest.mark.parametrize("length", [0, 1])
def test_a_video_of_less_than_two_frames_says_nothing(length):
    shown = asked([EVEN, EVEN[:length]])
    assert shown[1].errors.shape == (0, 2 * len(LAGS) + 1) and displaced(shown) == []


def test_where_nothing_is_filmed_nothing_is_told():
    assert displaced(asked([])) == []


def test_where_nothing_moves_no_time_is_better():
    still = np.zeros((FRAMES, 3))
    assert displaced([Lagged(np.arange(FRAMES), np.array([-1, 0, 1]), still)]) == []


@pytest.mark.parametrize(("others", "said"), [(1.0, []), (1.4, []), (1.8, [1])])
def test_where_the_others_are_sure_less_is_asked(others, said):
    """A tenth better at another time: of a poor fit that is chance."""

    def at_another(share: float) -> Lagged:
        return Lagged(np.arange(FRAMES), np.array([-1, 0, 1]), np.array([[2.0 * share, 2.0, np.nan]] * FRAMES))

    assert displaced([at_another(others), at_another(0.9), at_another(others)]) == said
