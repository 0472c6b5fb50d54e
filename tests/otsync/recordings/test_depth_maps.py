"""Dense depth: against the exact surfaces of drawn balls, given maps, the cache, and what cannot be measured."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

from otsync.io.scene import Scene
from otsync.priors import Cache
from otsync.priors.dense import consistent, mask_pixels, neighbourhood
from otsync.priors.stereo import HullStereo
from otsync.recordings.dense_depth import depth_maps, reduced
from otsync.recordings.stages import Stages
from otsync.types import Camera, Offsets, Video
from tests.recording_world import FPS, H, W, exact_depth, paths, render, ring

STARTS = [0, 3, 1, 2, 0, 4, 2, 1]
RADIUS = 0.3
LENS = np.array([-0.6, 0.1, 0.0, 0.0])
BENT = 2
CHOSEN = {0: [5, 6], BENT: [4, 5], 5: [2, 3]}
FRAMES = [CHOSEN.get(v, []) for v in range(8)]
SIZE = (160, 90)
STAGES = Stages(stereo=HullStereo(min_views=5))


def ideal(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Where a pinhole would see what the bent lens shows at ``pixels`` (...,2)."""
    flat = pixels.reshape(-1, 1, 2).astype(float)
    return cv2.undistortPoints(flat, camera.K, LENS, P=camera.K).reshape(pixels.shape)


def grid(width: int, height: int) -> np.ndarray:
    """(height,width,2) pixel centres of a map over the whole image, in the image's pixels."""
    x, y = (np.arange(width) + 0.5) * W / width, (np.arange(height) + 0.5) * H / height
    return np.stack(np.meshgrid(x, y), -1)


@pytest.fixture(scope="module")
def world() -> tuple[Scene, dict[int, np.ndarray]]:
    """Eight cameras that started at different frames, one that looks aside through a bent lens; and the exact depth of
    :data:`CHOSEN` at the maps' pixels."""
    frames, videos, masks, true = 8, [], [], {}
    colours = np.random.default_rng(3).integers(40, 215, (3, 3)).astype(float)
    for v, (camera, start) in enumerate(zip(ring(8), STARTS, strict=True)):
        centres = 0.8 * paths((np.arange(frames) + start) / FPS, 3, 6)
        full, small = grid(W, H), grid(*SIZE)
        if v == BENT:
            c, s = np.cos(0.2), np.sin(0.2)
            aside = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])
            camera = replace(camera, w2c=aside @ camera.w2c)
            full, small = ideal(full, camera), ideal(small, camera)
        images = [render(camera, centres[:, k], colours, RADIUS, v) for k in range(frames)]
        masks.append([exact_depth(camera, centres[:, k], RADIUS, full) > 0 for k in range(frames)])
        true[v] = np.stack([exact_depth(camera, centres[:, k], RADIUS, small) for k in FRAMES[v] or [0]])
        if v == BENT:
            x, y = (full.astype(np.float32) - 0.5).transpose(2, 0, 1)
            images = [cv2.remap(i, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for i in images]
            camera = replace(camera, distortion=LENS)
        videos.append(Video(images, camera, FPS, name=f"cam{v}"))
    return Scene(tuple(videos), tuple(masks)), true


def clocks(seconds: np.ndarray, component: np.ndarray | None = None) -> Offsets:
    V = len(seconds)
    return Offsets(
        tuple(f"cam{v}" for v in range(V)),
        np.full(V, FPS),
        seconds,
        np.ones(V),
        np.full(V, 0.001),
        0,
        np.zeros(V, int) if component is None else component,
        ((),) * V,
    )


AT = clocks(np.array(STARTS) / FPS)


@pytest.fixture(scope="module")
def measured(world) -> list[np.ndarray]:
    return depth_maps(world[0], AT, FRAMES, width=160, stages=STAGES)


def errors(maps: np.ndarray, exact: np.ndarray) -> tuple[np.ndarray, float]:
    """Relative errors of known pixels, and the share of the foreground that is known."""
    known = (maps > 0) & (exact > 0)
    return np.abs(maps[known] / exact[known] - 1), float(known.sum() / (exact > 0).sum())


@pytest.mark.parametrize("v", CHOSEN)
def test_the_balls_surfaces_are_found_through_every_lens(world, measured, v):
    error, share = errors(measured[v], world[1][v])
    assert measured[v].shape == (2, 90, 160)
    assert share > 0.85
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.9) < 0.04


@pytest.mark.parametrize("v", CHOSEN)
def test_maps_lie_on_their_pixels(world, measured, v):
    """The slopes of the surfaces tell how far a map is shifted against its image: less than half of its pixels."""
    shifts = []
    for z, exact in zip(measured[v], world[1][v], strict=True):
        slope = np.stack([(np.roll(exact, -1, a) - np.roll(exact, 1, a)) / 2 for a in (1, 0)], -1)
        smooth = (z > 0) & (exact > 0) & (np.abs(slope).max(-1) < 0.05) & (np.abs(z - exact) < 0.03 * exact)
        shifts.append(np.linalg.lstsq(slope[smooth], (z - exact)[smooth], rcond=None)[0])
    assert np.abs(np.mean(shifts, 0)).max() < 0.5


def test_nothing_is_told_beside_the_masks(world, measured):
    for v in CHOSEN:
        outside = np.stack([~mask_pixels(np.asarray(world[0].masks[v][k]), 160, 90)[0] for k in FRAMES[v]])
        assert (measured[v][outside] == 0).all()
    assert [m.shape for m in measured if len(m) == 0] == [(0, 90, 160)] * 5


def test_depth_rests_on_the_offsets(world, measured):
    late = AT.seconds + np.array([0, 2, 0, 2, 0, 2.0, 0, 2]) / FPS
    found = depth_maps(world[0], clocks(late), FRAMES, width=160, stages=STAGES)
    right, wrong = (errors(m[BENT], world[1][BENT]) for m in (measured, found))
    assert np.quantile(wrong[0], 0.9) > 1.5 * np.quantile(right[0], 0.9)


def test_a_frame_that_falls_between_the_moments_has_an_empty_map(world):
    scene, _ = world
    # the earliest frame lies more than half a step before the grid, which runs through the first video's frames
    starts = np.array(STARTS) - 0.7 * (np.arange(8) > 0)
    maps = depth_maps(scene, clocks(starts / FPS), [[7], [0], [], [], [0, 7], [], [], []], width=80, stages=STAGES)
    assert [m.shape for m in maps] == [(n, 45, 80) for n in (1, 1, 0, 0, 2, 0, 0, 0)]
    assert not maps[4][0].any()


def test_maps_are_kept_by_moment_and_do_not_depend_on_threads(world, measured, tmp_path):
    cache = Cache(tmp_path)
    with ThreadPoolExecutor(3) as pool:
        found = depth_maps(world[0], AT, FRAMES, width=160, stages=STAGES, cache=cache, map=pool.map)
    for a, b in zip(found, measured, strict=True):
        np.testing.assert_array_equal(a, b)
    kept = sorted(tmp_path.glob("dense-*"))
    assert len(kept) == len({STARTS[v] + k for v, chosen in CHOSEN.items() for k in chosen})
    before = {p: p.stat().st_mtime_ns for p in kept}
    kept[1].unlink()
    again = depth_maps(world[0], AT, FRAMES, width=160, stages=STAGES, cache=cache)
    for a, b in zip(again, measured, strict=True):
        np.testing.assert_array_equal(a, b)
    assert [p for p in kept if p.stat().st_mtime_ns != before[p]] == [kept[1]]
    lens = replace(world[0].videos[BENT].camera, distortion=0.5 * LENS)
    other = replace(
        world[0], videos=tuple(replace(x, camera=lens) if v == BENT else x for v, x in enumerate(world[0].videos))
    )
    depth_maps(other, AT, FRAMES, width=160, stages=STAGES, cache=cache)
    assert len(list(tmp_path.glob("dense-*"))) > len(kept)


def test_given_depth_is_taken(world):
    scene, _ = world
    given = np.random.default_rng(0).uniform(1, 2, (8, 2 * H, 2 * W))
    video = replace(scene.videos[0], depth=list(given))
    found = depth_maps(replace(scene, videos=(video, *scene.videos[1:])), AT, [[3]] + [[]] * 7, width=160)
    inside = mask_pixels(np.asarray(scene.masks[0][3]), *SIZE)[0]
    np.testing.assert_allclose(found[0][0], np.where(inside, given[3, 2::4, 2::4], 0), rtol=1e-6)


def test_reducing_keeps_values_and_drops_what_is_not_a_depth():
    mask = np.ones((4, 8), bool)
    mask[:, :2] = False
    depth = np.arange(1.0, 33).reshape(4, 8)
    depth[1, 7] = np.nan
    np.testing.assert_array_equal(reduced(depth, mask, 4, 2), [[0, 12, 14, 0], [0, 28, 30, 32]])
    np.testing.assert_array_equal(
        reduced(np.kron(depth, np.ones((2, 2))), mask, 4, 2), [[0, 12, 14, 0], [0, 28, 30, 32]]
    )


def test_videos_on_no_clock_have_empty_maps(world):
    seconds = AT.seconds.copy()
    seconds[5] = np.nan
    found = depth_maps(world[0], clocks(seconds), FRAMES, width=160, stages=STAGES)
    assert (found[5] == 0).all() and (found[0] > 0).any()
    apart = clocks(AT.seconds, np.array([0, 0, 0, 4, 4, 4, 4, 4]))
    assert not any((m > 0).any() for m in depth_maps(world[0], apart, FRAMES, width=160, stages=STAGES))


def test_bad_requests_are_named(world):
    scene = world[0]
    with pytest.raises(ValueError, match="frames_by_video: expected 8"):
        depth_maps(scene, AT, FRAMES[:3])
    with pytest.raises(ValueError, match="0 to 7 for cam1; found 8"):
        depth_maps(scene, AT, [[], [8], *[[]] * 6])
    with pytest.raises(ValueError, match="width"):
        depth_maps(scene, AT, FRAMES, width=0)
    few = scene.take(["cam0", "cam1"])
    with pytest.raises(ValueError, match="static cameras to measure it"):
        depth_maps(few, clocks(AT.seconds[:2]), [[1], []])
    moving = replace(scene.videos[0], camera=replace(scene.videos[0].camera, w2c=np.stack([np.eye(4)] * 8)))
    with pytest.raises(ValueError, match="cam0 move"):
        depth_maps(replace(scene, videos=(moving, *scene.videos[1:])), AT, FRAMES)


def test_neighbourhoods_name_pixels_in_row_order():
    inside = np.array([[True, False, True], [True, True, False]])
    group = neighbourhood(inside, 1)
    assert group.shape == (4, 9)
    np.testing.assert_array_equal(group[:, 0], [0, 1, 2, 3])
    assert [sorted(set(g.tolist()) - {4}) for g in group] == [[0, 2, 3], [1, 3], [0, 2, 3], [0, 1, 2, 3]]


def test_lone_and_deviating_depths_are_dropped():
    plane = np.full((20, 20), 2.0, np.float32)
    plane[:, 10:] = 3.0
    plane[5, 5] = 2.2
    plane[15:] = 0
    plane[18, 3] = 2.0
    out = consistent(plane, 2, 0.03, 0.3)
    expected = plane.copy()
    expected[5, 5] = expected[18, 3] = 0
    np.testing.assert_array_equal(out, expected)


def test_frames_without_a_given_map_have_empty_ones(world):
    """Depth that was given for some frames only: the others are unknown, whatever holds them."""
    scene, _ = world
    given = [None, np.full((H, W), 2.0), None, np.full((H, W), 3.0), *[None] * 4]
    video = replace(scene.videos[0], depth=given)
    found = depth_maps(replace(scene, videos=(video, *scene.videos[1:])), AT, [[1, 2, 3]] + [[]] * 7, width=160)[0]
    assert not found[1].any() and (found[0].max(), found[2].max()) == (2, 3) and found.dtype == np.float32
