"""The plane sweep against its definition, patch by patch; and views of different sizes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync.io.scene import Scene
from otsync.priors.kernels_stereo import (
    EDGE,
    at_points,
    blocks_of,
    carve,
    choose_depth,
    correlate,
    first_hit,
    planes_of,
)
from otsync.priors.stereo import NOISE, HullStereo, boxes_to_compare, together
from otsync.recordings.dense_depth import depth_maps
from tests.otsync.priors.test_priors import rig_of_balls
from tests.otsync.recordings.test_depth_maps import AT, CHOSEN, FRAMES, STAGES, errors, measured, world

__all__ = ["measured", "world"]

HALF, STEP = 2, 0.03
K = np.array([[70.0, 0, 33], [0, 72, 25], [0, 0, 1]])
SIZES = np.array([(64, 48), (64, 48), (50, 56)])


def view(seed: int, width: int, height: int) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 1.5)


def cameras(seed: int, turn: float) -> np.ndarray:
    """(3,3,4) projections of views beside one that stands in the world's origin."""
    rng = np.random.default_rng(seed)
    R = [cv2.Rodrigues(turn * rng.normal(size=3))[0] for _ in SIZES]
    return np.stack([K @ np.column_stack([r, 0.3 * rng.normal(size=3)]) for r in R])


def sampled(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray | None:
    """Grey levels at pixels (+0.5 convention); None where one is too near to the border or beyond it."""
    h, w = image.shape
    if u.min() < EDGE or v.min() < EDGE or u.max() >= w - EDGE or v.max() >= h - EDGE:
        return None
    i, j = (u - 0.5).astype(int), (v - 0.5).astype(int)
    a, b = u - 0.5 - i, v - 0.5 - j
    top = (1 - a) * image[j, i] + a * image[j, i + 1]
    return (1 - b) * top + b * ((1 - a) * image[j + 1, i] + a * image[j + 1, i + 1])


def by_definition(image: np.ndarray, others: list[np.ndarray], P: np.ndarray, x: int, y: int, z: float) -> float:
    b, a = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    own = image[y + b, x + a].astype(float)
    rays = np.stack([x + a + 0.5, y + b + 0.5, np.ones(a.shape)], -1) @ np.linalg.inv(K).T
    scores = []
    for other, p in zip(others, P, strict=True):
        at = z * rays @ p[:, :3].T + p[:, 3]
        corners = at[[0, 0, -1, -1], [0, -1, 0, -1]]
        seen = (
            None if (corners[:, 2] < 0.1 * z).any() else sampled(other, *np.moveaxis(at[..., :2] / at[..., 2:], 2, 0))
        )
        if seen is not None:
            one, two = own - own.mean(), seen - seen.mean()
            power = ((one**2).sum() + one.size * NOISE) * ((two**2).sum() + one.size * NOISE)
            scores.append((one * two).sum() / np.sqrt(power))
    scores.sort()
    return -1.0 if not scores else scores[-1] - 0.2 if len(scores) == 1 else (scores[-1] + scores[-2]) / 2


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.0, 0.25), st.booleans(), st.booleans())
def test_the_sweep_is_the_correlation_of_every_patch(seed, turn, grey, alone):
    """Whatever the views see of a patch, for points all over the image and beyond, whose sums share their samples."""
    others = [view(seed + 1 + v, *size) for v, size in enumerate(SIZES)]
    image = others[0] if grey else view(seed, 64, 48)
    P = cameras(seed, turn)
    A, b = P[:, :, :3] @ np.linalg.inv(K), P[:, :, 3]
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, [66, 50], (30, 2))
    points[:10] = np.floor(points[:10]) + 0.5
    start = np.append(np.where(rng.uniform(size=30) < 0.1, 0.0, rng.uniform(0.8, 1.6, 30)), 0.0)
    group = np.arange(30)[:, None] if alone else np.column_stack([np.arange(30), np.full((30, 2), [30, 0])])
    low, high, owner, asked = planes_of(start, group, -0.1, 0.2, 0.05, STEP)
    boxes, own, squares = boxes_to_compare(points, low, high, owner, 30, HALF, 48, 64)
    assert (own < 0).all() == (squares.size > 0)
    area = (boxes[:, 2] - boxes[:, 1] + 1) * (boxes[:, 4] - boxes[:, 3] + 1)
    at = np.concatenate([[0], np.cumsum(area)])
    volume = correlate(image, together(others), SIZES, A, b, boxes, at, STEP, HALF, np.float32(NOISE))
    scores, begins = at_points(points, low, high, volume, boxes, at, own, squares, HALF, 48, 64)
    assert begins[-1] == len(scores)
    for m, (x, y) in enumerate(points - 0.5):
        planes = np.arange(low[m], high[m] + 1)
        assert len(planes) == begins[m + 1] - begins[m] and (len(planes) > 0) == (start[m] > 0)
        i, j = int(np.floor(x)), int(np.floor(y))
        for score, plane in zip(scores[begins[m] : begins[m + 1]], planes, strict=True):
            true = 0.0
            for k, r in ((i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)):
                whole = HALF <= k < 64 - HALF and HALF <= r < 48 - HALF
                here = by_definition(image, others, P, k, r, plane * STEP) if whole else -0.2
                true += (1 - abs(x - k)) * (1 - abs(y - r)) * max(here, -0.2)
            assert score == pytest.approx(true, abs=2e-3)
    depth, quality = choose_depth(start, group, asked, scores, begins, low, 0.05, STEP, 0.6)
    for n, points_of in enumerate(group):
        z, told = start[points_of[0]], []
        for plane in range(asked[n, 0], asked[n, 1] + 1):
            near = [m for m in points_of if start[m] > 0 and abs(start[m] - z) <= 0.05]
            told.append(np.mean([scores[begins[m] + plane - low[m]] for m in near]))
        assert (len(told) > 0) == (z > 0)
        if told:
            best = int(np.argmax(np.array(told) - 0.6 * (np.arange(*(asked[n] + [0, 1])) * STEP - z)))
            assert quality[n] == pytest.approx(told[best], abs=1e-5)
            assert abs(depth[n] / STEP - asked[n, 0] - best) <= 0.5
        else:
            assert depth[n] == 0 and quality[n] == -1


def test_a_sweep_without_a_plane_tells_no_depth():
    """Planes lie at whole steps: a sweep that is narrower than a step may miss them all."""
    start, group = np.array([1.0, 1.004, 0.0]), np.array([[0], [1]])
    low, high, _, asked = planes_of(start, group, 0.0, 0.005, 0.05, 0.012)
    assert asked[0].tolist() == [0, -1] and (high < low).tolist() == [True, False]
    begins = np.array([0, 0, 1])
    depth, quality = choose_depth(start, group, asked, np.full(1, 0.9, np.float32), begins, low, 0.05, 0.012, 0.6)
    assert depth[0] == 0 and quality[0] == -1
    assert depth[1] == pytest.approx(84 * 0.012) and quality[1] == pytest.approx(0.9)
    with pytest.raises(ValueError, match=r"HullStereo\.sweep: expected from and to, at least a step"):
        HullStereo(sweep=(0.0, 0.005))
    with pytest.raises(ValueError, match=r"HullStereo\.step"):
        HullStereo(step=0.0)


@pytest.mark.parametrize("shift", range(-12, 13, 4))
def test_one_track_of_a_video_is_measured_wherever_it_is(shift):
    """Beside the ball's outline, too, where some of the points around it miss the hull."""
    rig, uv, true = rig_of_balls(1)
    moved = [x[:1] + np.array([shift, 0.3 * shift]) for x in uv]
    found = HullStereo()(rig, moved)
    assert [z.shape for z in found] == [(1, 1)] * len(rig.frames)
    if shift == 0:
        errors = [abs(z[0, 0] / t[0] - 1) for z, t in zip(found, true, strict=True) if z[0, 0] > 0]
        assert len(errors) >= 5 and np.median(errors) < 0.02


def test_a_part_of_a_box_behind_another_view_takes_nothing_from_the_rest():
    """A view from the side, close to a plane of which it sees a part, and another part lies behind it."""
    image = view(3, 64, 48)
    turned = cv2.Rodrigues(np.array([0.0, 1.4, 0.0]))[0]
    ahead = turned @ (0.5 * np.linalg.inv(K) @ [6.5, 22.5, 1.0])
    P = np.stack([K @ np.column_stack([turned, np.array([0.0, 0.0, 0.15]) - ahead])] * 2)
    other = view(4, 64, 48)
    boxes = np.array([[10, HALF, 21, 20, 23]], np.int32)
    at = np.array([0, 20 * 4])
    A, b = P[:, :, :3] @ np.linalg.inv(K), P[:, :, 3]
    sizes = np.array([(64, 48)] * 2)
    found = correlate(image, np.stack([other] * 2), sizes, A, b, boxes, at, 0.05, HALF, np.float32(NOISE)).reshape(
        4, 20
    )
    true = [[by_definition(image, [other] * 2, P, x, y, 0.5) for x in range(HALF, 22)] for y in range(20, 24)]
    assert -1 in found and found.max() > -1
    np.testing.assert_allclose(found, true, atol=2e-3)


@pytest.mark.parametrize("full", [0.1, 0.003, 0.0001])
def test_a_ray_enters_the_hull_where_it_first_meets_it(full):
    """Through blocks that are full, and past those that are empty."""
    rng = np.random.default_rng(0)
    grid = (rng.uniform(size=(72, 66, 60)) < full).astype(np.uint8)
    low, voxel, center = np.array([-1.1, -1.0, 2.0]), 0.03, np.array([0.02, -0.03, -0.5])
    rays = np.column_stack([rng.uniform(-0.35, 0.35, (400, 2)), np.ones(400)])
    rays[0], rays[1] = [0.0, 0.0, 1.0], [0.1, 0.0, 1.0]
    step = 0.4 * voxel
    found = first_hit(grid, blocks_of(grid), low, voxel, center, rays, step, 0.2, 8.0)
    steps = np.arange(0.2, 8.0, step)
    for ray, z in zip(rays, found, strict=True):
        at = np.floor((center + steps[:, None] * ray - low) / voxel).astype(int)
        inside = ((at >= 0) & (at < grid.shape)).all(1)
        hit = np.flatnonzero([i and grid[tuple(a)] for i, a in zip(inside, at, strict=True)])
        assert z == pytest.approx(steps[hit[0]] if len(hit) else 0.0)
    assert 0 < (found > 0).mean() < 1
    assert full > 0.001 or (blocks_of(grid) == 0).mean() > 0.5


@pytest.mark.parametrize("misses", [0, 1])
def test_a_hull_counts_the_views_that_contain_a_place(misses):
    """Of views of other sizes, what lies beyond an image says nothing, though all masks are held in one array."""
    rng = np.random.default_rng(misses)
    P = cameras(5, 0.2)
    P[:, :, 3] += K @ [0.0, 0.0, 2.0]
    masks = [(rng.uniform(size=(h, w)) < 0.7).astype(np.uint8) for w, h in SIZES]
    low, voxel, dims = np.array([-0.8, -0.6, -0.4]), 0.1, np.array([16, 12, 8])
    anywhere = np.ones_like(together(masks))
    found = carve(together(masks), anywhere, SIZES, P, low, voxel, dims, 1, 2, misses, 0.1)
    middles = low + (np.argwhere(np.ones(dims)) + 0.5) * voxel
    inside, missed = np.zeros((2, len(middles)), int)
    for mask, p in zip(masks, P, strict=True):
        at = middles @ p[:, :3].T + p[:, 3]
        u, v = np.floor(at[:, :2] / at[:, 2:]).astype(int).T
        seen = (at[:, 2] >= 0.1) & (u >= 0) & (v >= 0) & (u < mask.shape[1]) & (v < mask.shape[0])
        inside += seen
        missed[seen] += mask[v[seen], u[seen]] == 0
    true = (inside >= 2) & (missed <= misses)
    assert ((inside == 2) & true).any() and 0.1 < true.mean() < 0.95
    np.testing.assert_array_equal(found.reshape(-1) > 0, true)


def test_views_of_other_sizes_tell_depth_as_well(world, measured):
    """Some cameras' images cut: what is beyond them is not seen, rather than seen to be empty."""
    scene, true = world
    videos, masks = list(scene.videos), list(scene.masks)
    for v, (width, height) in {1: (250, 180), 3: (320, 150), 6: (230, 160)}.items():
        camera = replace(videos[v].camera, width=width, height=height)
        frames = [np.ascontiguousarray(f[:height, :width]) for f in videos[v].frames]
        videos[v] = replace(videos[v], frames=frames, camera=camera)
        masks[v] = [m[:height, :width] for m in masks[v]]
    found = depth_maps(Scene(tuple(videos), tuple(masks)), AT, FRAMES, width=160, stages=STAGES)
    for v in CHOSEN:
        error, share = errors(found[v], true[v])
        assert np.median(error) < 0.01
        assert share > 0.9 * errors(measured[v], true[v])[1]
