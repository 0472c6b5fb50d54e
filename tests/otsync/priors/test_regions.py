"""Optical flow in boxes around what moves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync.priors.flow import DISFlow
from otsync.priors.regions import boxes, flow_where


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 95), st.integers(0, 63), st.integers(1, 20), st.integers(1, 20)), max_size=6),
    st.integers(0, 9),
    st.integers(1, 40),
)
def test_boxes_are_disjoint_lie_in_the_image_and_hold_all_that_moves_with_its_margin(things, margin, least):
    moves = np.zeros((64, 96), bool)
    for x, y, w, h in things:
        moves[y : y + h, x : x + w] = True
    found = boxes(moves, margin, least)
    covered = np.zeros(moves.shape, int)
    for x, y, w, h in found:
        assert 0 <= x < x + w <= 96 and 0 <= y < y + h <= 64
        assert w >= min(least, 96) and h >= min(least, 64)
        covered[y : y + h, x : x + w] += 1
    assert covered.max(initial=0) <= 1
    for y, x in np.argwhere(moves):
        around = covered[max(0, y - margin) : y + margin + 1, max(0, x - margin) : x + margin + 1]
        assert around.min() == 1
    assert len(found) == 0 or moves.any()


def moved(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two grey images in which one textured square has moved by (5, 2) over a still, textured ground, and the mask."""
    import cv2

    rng = np.random.default_rng(seed)
    ground, thing = (
        cv2.GaussianBlur(rng.uniform(0, 255, s).astype(np.float32), (0, 0), 2) for s in ((240, 320), (60, 60))
    )
    images, mask = [], np.zeros((240, 320), bool)
    for dx, dy in ((0, 0), (5, 2)):
        image = 0.3 * ground
        image[100 + dy : 160 + dy, 40 + dx : 100 + dx] = 80 + thing
        mask[100 + dy : 160 + dy, 40 + dx : 100 + dx] = True
        images.append(np.clip(image, 0, 255).astype(np.uint8))
    return images[0], images[1], mask


def test_flow_of_a_box_is_that_of_the_whole_image_and_nothing_elsewhere():
    before, after, mask = moved()
    here = DISFlow().pair(before, after)
    there, back = flow_where(DISFlow(), before, after, mask, 0.5)
    inside = np.s_[110:150, 50:90]
    assert np.median(np.abs(there[inside] - [5, 2])) < 0.1 and np.median(np.abs(back[inside] + [5, 2])) < 0.1
    assert np.median(np.abs(there[inside] - here[0][inside])) < 0.1
    assert not there[:, 250:].any() and not back[:, 250:].any()


class Whole:
    """A flow that says how large the images are that it is given."""

    def __init__(self, whole: bool):
        self.whole, self.sizes = whole, []

    def pair(self, before, after):
        self.sizes.append(before.shape)
        return (np.zeros((*before.shape[:2], 2), np.float32),) * 2


@pytest.mark.parametrize("colour", [False, True])
def test_a_network_that_wants_context_gets_the_whole_image(colour):
    before, after, mask = moved()
    if colour:
        before, after = (np.repeat(x[..., None], 3, 2) for x in (before, after))
    whole, parts = Whole(True), Whole(False)
    for flow in (whole, parts):
        flow_where(flow, before, after, mask, 0.5)
    assert whole.sizes == [before.shape] and parts.sizes[0][0] < 240
    everywhere = Whole(False)
    flow_where(everywhere, before, after, np.ones_like(mask), 0.5)
    assert everywhere.sizes == [before.shape]
    nothing = Whole(False)
    flow_where(nothing, before, after, np.zeros_like(mask), 0.5)
    assert nothing.sizes == []


def test_tracks_in_boxes_go_where_those_of_the_whole_image_go():
    import cv2

    from otsync.priors.points import ChainedFlow
    from otsync.priors.working import WorkingFrames

    rng = np.random.default_rng(0)
    ground, thing = (
        cv2.GaussianBlur(rng.uniform(0, 255, s).astype(np.float32), (0, 0), 2) for s in ((240, 320), (60, 60))
    )
    images, masks = [], []
    for k in range(12):
        x, y = 40 + 4 * k, 90 + 2 * k
        image, mask = 0.3 * ground, np.zeros((240, 320), bool)
        image[y : y + 60, x : x + 60] = 80 + thing
        mask[y : y + 60, x : x + 60] = True
        images.append(np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, 2))
        masks.append(mask)
    for part in (False, True):
        uv = ChainedFlow(boxes=part)(WorkingFrames(images, (320, 240)), masks, 30.0)
        whole = uv[np.isfinite(uv[..., 0]).all(1)]
        assert len(whole) > 20, part
        assert np.median(np.abs((whole[:, -1] - whole[:, 0]) - [44, 22])) < 0.5, part
