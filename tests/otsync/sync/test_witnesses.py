"""A part of the scene that is shown late speaks against the answer of all; parts of one time do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync import Matches, TrackSet, synchronize
from otsync.bench.trust.worlds import plain
from otsync.simulate.effects import In, PartLate
from otsync.sync.verdict import Answer
from otsync.sync.witnesses import FEWEST, parted
from otsync.types import Alignment, Status

FPS = 30.0


@pytest.mark.parametrize(
    ("preset", "seed"), [("mid", 41001), ("mid", 41012), ("hard", 41001), ("hard", 41003), ("hard", 41007)]
)
def test_one_of_two_performers_that_is_shown_late_is_flagged(preset, seed):
    """Trusted before, 8 frames off at sigma .03 to .2; of mid 41012 the last matches are all of the late one."""
    late = (In(1, PartLate(8 / FPS)),)
    found = synchronize(plain(seed, preset=preset, classes=("basketball", "football"), first=late).tracks)
    assert Status.LAGGING in found.flags[1]


@pytest.mark.parametrize("seed", range(41000, 41003))
def test_without_it_the_same_worlds_are_trusted(seed):
    world = plain(seed, preset="mid", classes=("basketball", "football"))
    assert synchronize(world.tracks).status[1].ok


def two_groups(late: float, share: int, n: int = 24) -> tuple[Answer, TrackSet, TrackSet]:
    """Tracks at two places; of the second place's first ``share`` tracks b shows ``late`` s earlier motion."""
    rng = np.random.default_rng(0)
    t = np.arange(120) / FPS
    speed, phase = rng.uniform(2, 5, (n, 1, 3)), rng.uniform(0, 6, (n, 1, 3))
    place = np.where(np.arange(n) < n // 2, 0.0, 9.0)[:, None, None] + rng.uniform(-0.3, 0.3, (n, 1, 3))

    def shown(at: np.ndarray) -> np.ndarray:
        return place + 0.3 * np.sin(speed * at + phase) + rng.normal(0, 0.002, (n, 120, 3))

    delay = np.where((np.arange(n) >= n // 2) & (np.arange(n) < n // 2 + share), late, 0.0)[:, None, None]
    a, b = TrackSet(shown(t[:, None]), fps=FPS), TrackSet(shown(t[:, None] - delay), fps=FPS)
    matches = Matches(np.stack([np.arange(n)] * 2, 1), np.ones(n))
    answer = Alignment(0.0, sigma=0.001, fps=FPS, stats={"blur": 0.004})
    return Answer((0, 1), matches, answer, answer), a, b


def test_a_neighbourhood_is_measured_by_itself():
    assert parted(*two_groups(0.0, 12)) < 1
    assert parted(*two_groups(5 / FPS, 12)) > 7


def test_exchanging_the_videos_changes_nothing():
    answer, a, b = two_groups(5 / FPS, 12)
    assert parted(answer, b, a) == pytest.approx(parted(answer, a, b), rel=0.02)


def test_too_few_matches_are_no_witnesses():
    answer, a, b = two_groups(5 / FPS, 12)
    few = answer.matches.pairs[: 12 + FEWEST - 1]
    fewer = replace(answer, matches=Matches(few, np.ones(len(few))))
    assert parted(fewer, a, b) < 1


def test_first_matches_are_heard_where_the_last_ones_all_agree():
    answer, a, b = two_groups(5 / FPS, 12)
    first, agreeing = answer.matches, Matches(answer.matches.pairs[:12], np.ones(12))
    told = replace(answer, matches=agreeing)
    assert parted(told, a, b) < 1
    assert parted(told, a, b, first) > 7


def test_first_matches_that_are_wrong_are_not_heard():
    """Tracks of the second place matched at random: what they tell, they do not fit."""
    answer, a, b = two_groups(0.0, 12)
    pairs = answer.matches.pairs.copy()
    pairs[12:, 1] = np.roll(pairs[12:, 1], 5)
    wrong = Matches(pairs, np.ones(24))
    told = replace(answer, matches=Matches(pairs[:12], np.ones(12)))
    assert parted(replace(answer, matches=wrong), a, b) > 1
    assert parted(told, a, b, wrong) < 1
