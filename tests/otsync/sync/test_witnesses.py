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


@pytest.mark.parametrize(("preset", "seed"), [("mid", 41001), ("hard", 41001), ("hard", 41003), ("hard", 41007)])
def test_one_of_two_performers_that_is_shown_late_is_flagged(preset, seed):
    """Trusted before, 8 frames off at sigma .03 to .2."""
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
    answer = Alignment(0.0, sigma=0.001, fps=FPS)
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
