"""Things too small for optical flow: detections that are joined, blobs, and limits that follow the size."""

from __future__ import annotations

import numpy as np
import pytest

from otsync.priors import Blobs, BySize, ChainedFlow, MedianBackground, WorkingFrames
from otsync.priors.blobs import middles
from otsync.priors.linking import Linker
from otsync.priors.masks import components, tidied, typical_area
from otsync.recordings.tracking import Selection
from otsync.types import Camera
from tests.swarm_world import Warm

SIZE = (320, 240)
CAMERA = Camera(np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), np.eye(4), *SIZE)


def ways(count: int, frames: int, seed: int = 0) -> np.ndarray:
    """(N,T,2) pixels: smooth ways through the picture."""
    rng, t = np.random.default_rng(seed), np.arange(frames)
    middle = rng.uniform(0.25, 0.75, (count, 1, 2)) * SIZE
    phase, size = rng.uniform(0, 6.3, (count, 1, 2)), rng.uniform(20, 45, (count, 1, 2))
    return middle + size * np.sin(0.08 * t[None, :, None] + phase)


def test_detections_are_joined_though_things_look_alike_and_cross():
    t = np.arange(30.0)
    one, two = np.stack([20 + 4 * t, 50 + 2 * t], 1), np.stack([140 - 4 * t, 50 + 2 * t], 1)
    found = [np.stack([one[k], two[k]])[:: 1 if k % 2 else -1] for k in range(30)]
    uv = Linker(gate=3, fastest=10)(found)
    assert len(uv) == 2
    for way in (one, two):
        assert np.abs(uv - way[None]).max((1, 2)).min() < 1e-4


def test_a_gap_is_bridged_and_stays_unseen_and_a_long_one_ends_the_track():
    t = np.arange(30.0)
    way = np.stack([20 + 4 * t, 60 + 0 * t], 1)
    lost = [way[k : k + 1] if not 12 <= k < 15 else np.zeros((0, 2)) for k in range(30)]
    uv = Linker(gate=3, fastest=10, max_gap=4)(lost)
    assert len(uv) == 1 and np.isnan(uv[0, 12:15]).all() and np.isfinite(uv[0, [11, 15]]).all()
    assert len(Linker(gate=3, fastest=10, max_gap=2)(lost)) == 2
    assert len(Linker(gate=3, fastest=3)(lost)) == 0


@pytest.mark.parametrize("across", [5.0, 10.0])
def test_blobs_are_followed_to_a_fraction_of_a_pixel(across):
    truth = ways(12, 40)
    frames = WorkingFrames(Warm(truth, SIZE, across / 4, 90.0, 2.0, 0), SIZE)
    masks = MedianBackground()(frames, CAMERA)
    uv = Blobs()(frames, masks, 30.0)
    away = np.linalg.norm(frames.to_full(uv)[:, None] - truth[None], axis=3)
    whose = np.nanmedian(away, axis=2).argmin(1)
    off = np.concatenate([a[w][np.isfinite(a[w])] for a, w in zip(away, whose, strict=True)])
    assert set(whose.tolist()) == set(range(12))
    assert np.median(off) < 0.15 and np.quantile(off, 0.9) < 0.5
    flown = BySize()(frames, masks, 30.0)
    np.testing.assert_array_equal(flown, uv)


def test_large_things_are_followed_by_flow_with_the_limits_of_people():
    changed = np.zeros((20, 240, 320), bool)
    for k in range(20):
        changed[k, 60:160, 30 + 5 * k : 90 + 5 * k] = True
        changed[k, 200:210, 300:310] = True  # 100 of 320 x 240 pixels are 400 at 640 of width: kept
        changed[k, 200:208, 20:28] = True  # 64 are 256: dropped
    masks = tidied(changed.copy(), 0.5)
    assert masks[0, 100, 60] and masks[0, 205, 305] and not masks[0, 204, 24]
    asked = []

    def flow(frames, masks, fps):
        asked.append(fps)
        return np.zeros((0, len(frames), 2))

    frames = WorkingFrames([np.zeros((240, 320, 3), np.uint8)] * 20, SIZE)
    BySize(large=flow, blobs=None)(frames, masks, 25.0)
    assert asked == [25.0] and BySize().large == ChainedFlow()


def test_small_things_stay_and_neighbours_are_not_closed_to_one():
    changed = np.zeros((10, 240, 320), bool)
    for k in range(10):
        for n in range(6):
            changed[k, 100:105, 30 + 9 * n + k : 35 + 9 * n + k] = True
    masks = tidied(changed.copy(), 0.5)
    assert len(components(masks[0])) == 6 and typical_area(masks, 0.5) == 25
    assert not tidied(changed.copy(), 0.5, min_area=300).any()
    assert not tidied(np.zeros((3, 8, 8), bool), 1.0).any()


def test_the_middle_of_a_blob_is_not_drawn_by_a_neighbour():
    uv = np.array([[[60.3, 60.2]], [[71.0, 60.2]]])
    image = Warm(uv, SIZE, 2.0, 90.0, 0.0, 0)[0][..., 0]
    at = middles(image, np.array([[60.0, 60.0, 40.0]]), 6.0)
    assert np.abs(at[0] - (59.8, 59.7)).max() < 1.5


def test_where_few_tracks_are_kept_limits_are_lowered_and_no_track_says_why():
    t = np.arange(60.0)
    wave = 30 * np.sin(t / 5)
    uv = np.stack([np.stack([50 + 8 * n + wave, 100 + wave], 1) for n in range(10)])
    assert len(Selection(enough=0)(uv, 640, 30.0)) == 5
    assert len(Selection()(uv, 640, 30.0)) == 10
    brief = uv.copy()
    brief[:, 15:] = np.nan
    assert len(Selection(enough=0)(brief, 640, 30.0)) == 0 and len(Selection()(brief, 640, 30.0)) > 0
    uv[:, 5:] = np.nan
    told = Selection().told(uv, 640, 30.0)
    assert "10 tracks, of which 10 live for less than 0.40 s (min_life)" in told
    still = np.broadcast_to(np.array([5.0, 5.0]), (3, 60, 2))
    assert "3 move by less than 3 px (extent)" in Selection().told(still, 640, 30.0)
    assert Selection().told(np.zeros((0, 60, 2)), 640, 30.0) == "no track at all"
    with pytest.raises(ValueError, match=r"Selection.apart: expected a number >= 0"):
        Selection(apart=-1)
