"""What masks are made with: medians by sorting, components in a box, frames that are read once."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync.io.frames import LazyFrames
from otsync.priors import masks
from otsync.priors.masks import components, exchanges, median_of, tidy
from otsync.priors.working import WorkingFrames
from otsync.recordings.tracking import Tracking
from otsync.types import Camera, Video


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8, 13, 31, 32, 33, 50, 70])
@pytest.mark.parametrize("at_once", [7, 2**20])
def test_medians_are_those_of_numpy(n, at_once, monkeypatch):
    monkeypatch.setattr(masks, "AT_ONCE", at_once)
    for seed in range(5):
        images = np.random.default_rng(seed).integers(0, 256, (n, 3, 5, 3), dtype=np.uint8)
        assert np.array_equal(median_of(images), np.median(images, 0).astype(np.uint8))


def test_no_exchange_is_made_that_the_middle_does_not_need():
    assert exchanges(1) == [] and exchanges(2) == [(0, 1)]
    assert len(exchanges(50)) < 340  # a full sort takes 403


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.6), st.integers(0, 12))
def test_components_are_those_of_scipy(seed, share, least):
    mask = np.random.default_rng(seed).random((23, 31)) < share
    number, n = scipy.ndimage.label(mask, np.ones((3, 3)))
    ids = np.arange(1, n + 1)
    area = scipy.ndimage.sum(mask, number, ids) if n else np.zeros(0)
    middle = np.array(scipy.ndimage.center_of_mass(mask, number, ids)).reshape(-1, 2)[:, ::-1]
    found = components(mask)
    want = np.column_stack([middle, area])
    assert np.allclose(found[np.lexsort(found.T)], want[np.lexsort(want.T)])
    solid = np.kron(mask, np.ones((3, 3))) > 0  # an opening of 3 px leaves it as it is
    kept = scipy.ndimage.label(solid, np.ones((3, 3)))[0]
    sizes = np.bincount(kept.ravel())
    sizes[0] = 0
    assert np.array_equal(tidy(solid, 1.0, 9.0 * least, closing=0), (sizes > 9 * least)[kept])


class Counted(LazyFrames):
    """Frames that count how often they are read."""

    def __init__(self, images):
        self.images, self.read = images, np.zeros(len(images), int)

    def __len__(self):
        return len(self.images)

    def frame(self, k):
        self.read[k] += 1
        return self.images[k]

    def digest(self):
        return "counted"


def film(frames=40) -> np.ndarray:
    rng = np.random.default_rng(0)
    ground, thing = rng.integers(0, 90, (96, 128, 3)), rng.integers(120, 255, (40, 40, 3))
    images = np.repeat(ground[None], frames, 0).astype(np.uint8)
    for k in range(frames):
        images[k, 20:60, 10 + 2 * k : 50 + 2 * k] = thing
    return images


def test_tracking_reads_every_frame_once_and_a_few_again_for_their_colours():
    frames = Counted(film())
    camera = Camera(np.array([[100.0, 0, 64], [0, 100.0, 48], [0, 0, 1]]), np.eye(4), 128, 96)
    tracked = Tracking()(Video(frames, camera, 30.0, None, "a"))
    assert len(tracked["uv"]) > 10
    again = frames.read - 1
    assert again.min() == 0 and again.max() == 1 and again.sum() < 10, frames.read


@pytest.mark.parametrize("keep", [0, 3 * 96 * 128, 2**20])
def test_grey_images_that_are_kept_are_the_same_and_no_more_than_fit(keep):
    source = Counted(film())
    frames, plain = WorkingFrames(source, (128, 96), keep=keep), WorkingFrames(film(), (128, 96))
    for _ in range(2):
        for k in range(len(frames)):
            assert np.array_equal(frames.gray(k), plain.gray(k))
    assert source.read.sum() == 80 - min(40, keep // (96 * 128))
