"""One offset for a whole video, without depth: lost and repeated frames are seen in windows of all pairs."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from otsync import Matches, Status, TrackSet, synchronize
from otsync.epipolar.refine import EpipolarRefine
from otsync.epipolar.scan import EpipolarScan
from otsync.epipolar.steady import unsteady
from otsync.match.candidates import Candidates
from tests.recording_world import paths, ring

FPS, LATE = 30.0, (0.0, 6.0, -4.0, 9.0)


def filmed(shown: list[np.ndarray], seed: int = 0) -> list[TrackSet]:
    """A video for each camera of a ring; ``shown``: the world's frame numbers that its frames show."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(40, 12))
    sets = []
    for v, (camera, frames) in enumerate(zip(ring(4, width=640, height=360), shown, strict=False)):
        uv = camera.project(paths(frames / FPS, 40, seed + 5)) + rng.normal(0, 0.3, (40, len(frames), 2))
        noisy = features + 0.5 * rng.normal(size=features.shape)
        sets.append(TrackSet(None, uv=uv, camera=camera, fps=FPS, frame="world", features=noisy, name=f"video{v}"))
    return sets


def solved(tracks: list[TrackSet]):
    found = synchronize(
        tracks, matcher=Candidates(8, None), aligner=EpipolarScan(), refiner=EpipolarRefine(), rematch=0
    )
    return found


@pytest.mark.parametrize("videos", [2, 4])
@pytest.mark.parametrize("late", [10, -10], ids=["runs ahead", "falls behind"])
def test_a_video_that_breaks_is_named_and_the_others_are_trusted(videos, late):
    """By ten frames, within a second: no picture shows that."""
    shown = [np.arange(120.0) + v for v in LATE[:videos]]
    shown[1] = shown[1] + late * np.clip((np.arange(120) - 45) / 30, 0, 1)
    offsets = solved(filmed(shown))
    assert Status.BROKEN_CLOCK in offsets.flags[1] and not any(offsets.breaks)
    if videos == 4:
        assert offsets.status[2].ok and abs(offsets.seconds[2] * FPS - LATE[2]) < 0.3


@pytest.mark.parametrize("seed", range(3))
def test_videos_that_run_on_are_left_alone(seed):
    tracks = filmed([np.arange(120) + late for late in LATE[:3]], seed)
    # a part in which one of them sees nothing
    visible = np.ones((40, 120), bool)
    visible[:, 30:60] = False
    offsets = solved([*tracks[:2], replace(tracks[2], visible=visible)])
    assert not any(Status.BROKEN_CLOCK in flags for flags in offsets.flags)
    assert np.abs(offsets.seconds * FPS - LATE[:3]).max() < 0.3


def test_cameras_of_other_rates_are_compared_on_one_clock():
    tracks = filmed([np.arange(120) + late for late in LATE[:3]])
    slow = filmed([np.arange(120.0)] * 2 + [np.arange(0, 120, 30 / 25) + LATE[2]])[2]
    offsets = solved([*tracks[:2], replace(slow, fps=25.0)])
    assert np.abs(offsets.seconds * FPS - LATE[:3]).max() < 0.5
    assert not any(Status.BROKEN_CLOCK in flags for flags in offsets.flags)


class Told:
    """A scan whose pairs say of offsets 12 frames later and earlier, in the first two windows, what a table says."""

    def __init__(self, nats: dict[int, tuple[float, float]]):
        self.nats, self.asked = nats, Counter[int]()  # by the number of matches of a pair

    def evidence(self, part, xb, F, pairs, lags, fps, unit, weight):
        self.asked[len(pairs)] += 1
        away = lags - lags[len(lags) // 2]
        later, earlier = self.nats[len(pairs)]
        told = np.where(away == 12, later, np.where(away == -12, earlier, 0.0))
        return told * (self.asked[len(pairs)] <= 2)


@pytest.mark.parametrize(
    "nats, breaks", [((150.0, 75, 10), True), ((150.0, 75, -20), True), ((110.0, -180, 155), False)]
)
def test_a_clock_breaks_where_its_pairs_agree_that_it_does(nats, breaks):
    """As much evidence in the sum, from pairs of which some speak as strongly against it, is that of a few things."""
    tracks = filmed([np.arange(120.0)] * 4)
    pairs = [(0, 3), (1, 3), (2, 3), (0, 1), (0, 2), (1, 2)]
    matches = {pair: Matches(np.stack([np.arange(10 + n)] * 2, 1)) for n, pair in enumerate(pairs)}
    # the others are sure of each other
    told = [(x, 0.0) for x in nats] + [(-200.0, -200.0)] * 3
    found = unsteady(Told({10 + n: x for n, x in enumerate(told)}), tracks, matches, np.zeros(4))
    assert found == [3] * breaks


class InWindows:
    """A scan of which each window in turn says of offsets 12 frames later what a list says."""

    def __init__(self, nats: list[float]):
        self.nats = iter(nats)

    def evidence(self, part, xb, F, pairs, lags, fps, unit, weight):
        return next(self.nats) * np.clip(1 - np.abs(lags - lags[len(lags) // 2] - 12) / 8, 0, 1)


@pytest.mark.parametrize(
    "nats, breaks",
    [
        ([60.0, 60, -90, -90, -90], True),
        ([-90.0, -90, -90, 60, 60], True),
        ([90.0, -20, -90, -90, -90], False),  # what happened in one window alone
        ([-90.0, 60, 60, -90, -90], False),  # in the middle, as a rhythm suits it
        ([60.0, 60, -90, 0, 0], True),
    ],
)
def test_a_clock_that_broke_is_off_up_to_an_end(nats, breaks):
    tracks = filmed([np.arange(105.0)] * 2)
    same = Matches(np.stack([np.arange(10)] * 2, 1))
    assert unsteady(InWindows(nats), tracks, {(0, 1): same}, np.zeros(2)) == [1] * breaks
