"""The synthetic capture is what it says: images, tracks, depth and masks of one world, each camera by its own clock."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from recon.evaluate.figures import psnr
from recon.raster import render, sh
from recon.simulate.capture import synthetic
from recon.simulate.effects import Blur, DarkCorners, Exposure, MoreNoise, Rolling, Sheen
from recon.simulate.estimates import DEPTH_NOISE, TRACK_NOISE
from recon.simulate.world import FPS, STATIC_NEAR

SMALL = {"cameras": 3, "held_out": 1, "frames": 9, "size": (80, 48)}


@pytest.fixture(scope="module")
def capture():
    return synthetic(3, **SMALL)


def seen(world, footage, t):
    """The image [h,w,3] and the alpha [h,w] that a camera without noise takes at world second t."""
    w2c, K = (torch.as_tensor(a, dtype=torch.float32)[None] for a in (footage.w2c, footage.K))

    def draw(g, near):
        colors = (sh.C0 * g.sh[:, 0] + 0.5).clamp(0, 1)
        return render(g.means, g.quats, g.scales, g.opacities, colors, w2c, K, *footage.size, near_plane=near)

    back, body = draw(world.static, STATIC_NEAR), draw(world.moving(t), 0.01)
    image = body.colors[0] + (1 - body.alphas[0]) * back.colors[0]
    return image.numpy().clip(0, 1), body.alphas[0, ..., 0].numpy()


def arrays(capture):
    yield from (a for f in (*capture.footage, *capture.held_out) for a in (f.images, f.masks, f.w2c, f.background))
    yield from (t.xyz for t in capture.tracks)
    yield from capture.depth
    yield from (capture.offsets, capture.gains, capture.world.colors, capture.world.local)


def distance(tracks, curves):
    """[N] median distance over time of each track from the nearest of the curves [M,T,3] (nearest when first seen)."""
    xyz, first = tracks.positions(), tracks.seen.argmax(1)
    rows = np.arange(len(xyz))
    apart = np.empty((len(xyz), 4))
    for t in np.unique(first):
        own = rows[first == t]
        for k, which in enumerate(cKDTree(curves[:, t]).query(xyz[own, t], k=4)[1].T):
            apart[own, k] = np.nanmedian(np.linalg.norm(xyz[own] - curves[which], axis=2), axis=1)
    return apart.min(1)


def same(a, b):
    return all(np.array_equal(x, y, equal_nan=True) for x, y in zip(arrays(a), arrays(b), strict=True))


def test_a_seed_decides_everything(capture):
    assert same(capture, synthetic(3, **SMALL))


def test_another_seed_is_another_world(capture):
    other = synthetic(4, **SMALL)
    assert not np.allclose(capture.world.positions([0.1]), other.world.positions([0.1]))
    assert not np.allclose(capture.world.colors, other.world.colors)
    assert not np.allclose(capture.offsets[1:], other.offsets[1:])
    assert not np.allclose(capture.footage[0].w2c, other.footage[0].w2c)


def test_what_it_holds(capture):
    assert [len(x) for x in (capture.footage, capture.held_out, capture.tracks, capture.depth)] == [3, 1, 3, 3]
    for footage, tracks, depth in zip(capture.footage, capture.tracks, capture.depth, strict=True):
        assert footage.images.shape == (9, 48, 80, 3) and depth.shape == (9, 48, 80) and footage.name == tracks.name
        assert tracks.frame == "world" and tracks.camera is not None and len(tracks) > 50
        assert footage.times == pytest.approx(np.arange(9) / FPS) and tracks.times == pytest.approx(footage.times)
        tracks.check("tracks")
    assert capture.offsets[0] == 0 and (np.abs(capture.offsets) * FPS <= 1).all() and (capture.gains == 1).all()
    body = capture.world.body
    assert set(body) == {0, 1} and set(capture.world.part) == set(range(12))


def test_images_are_the_world_at_the_cameras_own_time(capture):
    for v, f in enumerate(capture.footage):
        now = seen(capture.world, f, 4 / FPS + capture.offsets[v])
        assert 37 < psnr(now[0], f.images[4]) < 42  # noise of 1 %
        assert np.array_equal(f.masks[4] > 0, now[1] > 0.5)
        for wrong in (-0.25, 0.25):
            off = seen(capture.world, f, (4 + wrong) / FPS + capture.offsets[v])
            assert psnr(off[0], f.images[4]) < psnr(now[0], f.images[4]) - 0.5
    held = capture.held_out[0]
    assert psnr(seen(capture.world, held, 2 / FPS)[0], held.images[2]) > 37


def test_tracks_follow_surface_points_at_the_cameras_own_time(capture):
    for v, tracks in enumerate(capture.tracks):
        times = tracks.times + capture.offsets[v]
        xyz = tracks.positions()
        now = distance(tracks, capture.world.positions(times))
        assert np.median(now) == pytest.approx(1.54 * TRACK_NOISE, rel=0.25)  # the median length of a 3-D normal
        assert np.median(distance(tracks, capture.world.positions(times + 1 / FPS))) > 1.5 * np.median(now)
        assert np.nanmax(np.abs(tracks.uv - tracks.camera.project(xyz))) < 1e-6
        assert 0 < (~tracks.seen).mean() < 0.7 and np.isnan(xyz[~tracks.seen]).all()


def test_some_tracks_drift():
    worst = []
    for s in (0, 1):
        c = synthetic(s, cameras=1, held_out=0, frames=24, size=(80, 48), offsets=0)
        apart = distance(c.tracks[0], c.world.positions(c.tracks[0].times))
        worst.append((apart > 4 * TRACK_NOISE).mean())
    assert 0.005 < np.mean(worst) < 0.1


def test_depth_is_that_of_the_surfaces_and_of_the_room(capture):
    f, z = capture.footage[1], capture.depth[1]
    moving, still = (f.masks > 128) & (z > 0), (f.masks == 0) & (z > 0)
    assert moving.mean() > 0.05 and still.mean() > 0.5 and (z == 0).mean() < 0.2
    # lifted pixels of what moves lie among the world's points, those of the room at or above its floor
    k = 3
    row, column = np.nonzero(moving[k])
    w2c = f.w2c
    rays = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], 1) @ np.linalg.inv(f.K).T
    points = (rays * z[k, row, column, None] - w2c[:3, 3]) @ w2c[:3, :3]
    true = capture.world.positions([k / FPS + capture.offsets[1]])[:, 0]
    nearest = np.linalg.norm(points[:, None] - true[None], axis=-1).min(1)
    assert np.median(nearest) < 0.05
    # two frames of the same wall differ by the noise and by the scale of whole frames
    both = still[2] & still[6]
    ratio = z[2][both] / z[6][both]
    spread = np.std(ratio - np.median(ratio)) * np.median(z[2][both])
    assert spread == pytest.approx(2**0.5 * DEPTH_NOISE, rel=0.3)


def test_given_offsets_and_no_offsets():
    c = synthetic(0, cameras=2, held_out=0, frames=3, size=(48, 32), offsets=[0.5, -2])
    assert c.offsets * FPS == pytest.approx([0.5, -2]) and c.held_out == ()
    assert not synthetic(0, cameras=2, held_out=0, frames=3, size=(48, 32), offsets=0).offsets.any()


# ---- effects


def test_exposure_changes_colours_only(capture):
    bright = synthetic(3, **SMALL, effects=(Exposure(0.1),))
    assert np.ptp(np.log(bright.gains)) > 0.1
    for v, (a, b) in enumerate(zip(capture.footage, bright.footage, strict=True)):
        assert np.array_equal(a.masks, b.masks) and np.array_equal(capture.depth[v], bright.depth[v])
        assert np.array_equal(capture.tracks[v].xyz, bright.tracks[v].xyz, equal_nan=True)
        usable = (a.images < 200) & (a.images > 40)
        ratio = [b.images[usable[..., c], c].mean() / a.images[usable[..., c], c].mean() for c in range(3)]
        assert ratio == pytest.approx(bright.gains[v], rel=0.01)


def test_a_faster_world_is_the_same_one(capture):
    """At a pace of three all of it happens in a third of the time; rooms, colours, cameras and clocks are the same."""
    fast = synthetic(3, **SMALL, pace=3.0)
    t = np.array([0.0, 0.1, 0.25])
    np.testing.assert_allclose(fast.world.positions(t), capture.world.positions(3 * t), atol=1e-12)
    np.testing.assert_allclose(fast.world.facing(0.1), capture.world.facing(0.3), atol=1e-12)
    assert fast.offsets.tolist() == capture.offsets.tolist() and fast.gains.tolist() == capture.gains.tolist()
    assert np.array_equal(fast.footage[1].w2c, capture.footage[1].w2c)
    for pace in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="pace"):
            synthetic(3, **SMALL, pace=pace)


def test_effects_do_not_disturb_each_other(capture):
    alone = synthetic(3, **SMALL, effects=(Exposure(0.1),))
    both = synthetic(3, **SMALL, effects=(MoreNoise(0.0), Exposure(0.1)))
    assert same(alone, both)
    noisy = synthetic(3, **SMALL, effects=(MoreNoise(0.05),))
    difference = noisy.footage[0].images.astype(float) - capture.footage[0].images
    inside = (capture.footage[0].images > 60) & (capture.footage[0].images < 190)
    assert difference[inside].std() / 255 == pytest.approx(0.05, rel=0.05)


def test_blur_is_the_mean_over_the_exposure(capture):
    exposure = 1 / FPS
    blurred = synthetic(3, **SMALL, effects=(Blur(exposure, samples=5),)).footage[1]
    times = 4 / FPS + capture.offsets[1] + exposure * np.array([-0.4, -0.2, 0, 0.2, 0.4])
    mean = np.mean([seen(capture.world, blurred, t)[0] for t in times], axis=0)
    assert psnr(mean, blurred.images[4]) > 38
    assert psnr(seen(capture.world, blurred, times[2])[0], blurred.images[4]) < psnr(mean, blurred.images[4]) - 1


def test_rows_are_read_one_after_the_other(capture):
    readout = 1 / FPS
    rolled = synthetic(3, **SMALL, effects=(Rolling(readout, bands=12),)).footage[1]
    assert rolled.readout == readout and capture.footage[1].readout is None
    t = 4 / FPS + capture.offsets[1]
    whole = {
        s: np.stack(
            [seen(capture.world, rolled, t + s * readout * ((r + 0.5) / 48 - 0.5))[0][r] for r in range(0, 48, 4)]
        )
        for s in (-1, 1)
    }
    assert psnr(whole[1], rolled.images[4, ::4]) > psnr(whole[-1], rolled.images[4, ::4]) + 1


def test_depth_is_that_of_the_rows(capture):
    readout, bands = 1 / FPS, 12
    rolled = synthetic(3, **SMALL, effects=(Rolling(readout, bands=bands),)).depth[1]
    for b in (0, 5, 11):
        late = readout * ((b + 0.5) / bands - 0.5) * FPS
        shifted = synthetic(3, **{**SMALL, "offsets": capture.offsets * FPS + late}).depth[1]
        rows = slice(48 // bands * b, 48 // bands * (b + 1))
        known = (rolled[4, rows] > 0) & (shifted[4, rows] > 0)
        # the errors of whole frames and pixels are the same draws
        np.testing.assert_allclose(rolled[4, rows][known], shifted[4, rows][known], rtol=1e-3)
    assert not np.allclose(rolled, capture.depth[1], rtol=1e-3)


def test_corners_are_dark_in_images_alone(capture):
    dark = synthetic(3, **SMALL, effects=(DarkCorners(0.5),))
    np.testing.assert_array_equal(dark.depth, capture.depth)
    for plain, other in zip(capture.footage, dark.footage, strict=True):
        np.testing.assert_array_equal(plain.masks, other.masks)
        ratio = other.images.astype(float).mean((0, 3)) / np.maximum(plain.images.astype(float).mean((0, 3)), 1)
        h, w = ratio.shape
        assert ratio[h // 2, w // 2] > 0.97 and ratio[0, 0] == pytest.approx(0.5, abs=0.06)


def test_sheen_is_brightest_half_way_between_lamp_and_camera():
    lamp, eye = np.array([0.0, 0, 1]), np.array([[3.0, 0, 3.0]])
    half = np.array([np.sin(np.pi / 8), 0, np.cos(np.pi / 8)])
    normals = np.stack([half, [0.0, 0, 1], -half])
    light = Sheen(0.4, 6.0, tuple(lamp)).light(np.zeros((3, 3)), normals, eye[0])[:, 0]
    np.testing.assert_allclose(light, [0.4, 0.4 * np.cos(np.pi / 8) ** 6, 0], atol=1e-12)


def test_sheen_changes_what_moves_and_nothing_else(capture):
    shiny = synthetic(3, **SMALL, effects=(Sheen(0.4),))
    np.testing.assert_array_equal(shiny.depth, capture.depth)
    for plain, other in zip(capture.footage, shiny.footage, strict=True):
        np.testing.assert_array_equal(plain.masks, other.masks)
        brighter = other.images.astype(int) - plain.images
        still = plain.masks == 0
        assert brighter[~still].max() > 20 and brighter[~still].min() >= -1
        assert np.abs(brighter[still]).mean() < 1


def test_bad_arguments():
    with pytest.raises(ValueError, match="cameras, held_out, frames"):
        synthetic(cameras=0)
    with pytest.raises(ValueError, match="offsets: expected a bound or 2"):
        synthetic(cameras=2, offsets=[0, 1, 2])
    with pytest.raises(ValueError, match="offsets: expected a bound or 2 finite"):
        synthetic(cameras=2, offsets=[0, np.nan])
