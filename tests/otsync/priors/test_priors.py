"""Masks, flow tracks, descriptors, depth and the cache, on drawn pictures with known answers."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from otsync.priors import (
    Cache,
    ChainedFlow,
    Daisy,
    FlowResidual,
    GivenMasks,
    LabHistogram,
    MedianBackground,
    WorkingFrames,
)
from otsync.priors.points import join_gaps
from otsync.priors.stereo import HullStereo, Rig
from otsync.priors.working import bilinear
from otsync.recordings.lift import Lift, depth_at, running_median, smooth_in_time
from otsync.recordings.tracking import Selection, Tracking, pixel_tracks
from otsync.types import Break, Camera, Video
from tests.recording_world import paths, render, ring

W, H, T = 320, 180, 36
CAMERA = Camera(np.array([[256.0, 0, 160], [0, 256, 90], [0, 0, 1]]), np.eye(4), W, H)


def texture(seed: int, size: tuple[int, int]) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (size[1], size[0], 3))
    return np.clip(127 + 2.5 * (cv2.GaussianBlur(noise, (0, 0), 2.0) - 127), 0, 255)


@pytest.fixture(scope="module")
def slide() -> tuple[list[np.ndarray], np.ndarray]:
    """A textured square slides over a textured wall by a known, sub-pixel path; and its corner (T,2)."""
    wall, patch = texture(0, (W, H)) * 0.5, texture(1, (80, 60))
    corner = np.stack([10 + 5.3 * np.arange(T), 50 + 10 * np.sin(np.arange(T) / 6)], 1)
    frames = []
    for x, y in corner:
        move = np.array([[1, 0, x], [0, 1, y]], float)
        there = cv2.warpAffine(np.ones((60, 80)), move, (W, H))[..., None]
        frames.append((wall * (1 - there) + cv2.warpAffine(patch, move, (W, H)) * there).astype(np.uint8))
    return frames, corner


def inside(corner: np.ndarray, margin: int) -> np.ndarray:
    x, y = np.arange(W)[None], np.arange(H)[:, None]
    return np.stack(
        [(x >= cx + margin) & (x < cx + 80 - margin) & (y >= cy + margin) & (y < cy + 60 - margin) for cx, cy in corner]
    )


def test_median_background_finds_what_moves(slide):
    frames, corner = slide
    found = MedianBackground()(WorkingFrames(frames, (W, H)), CAMERA)
    truth = inside(corner, 0)
    assert (found & truth).sum() / (found | truth).sum() > 0.85


def test_a_still_picture_has_no_foreground(slide):
    frames = WorkingFrames([slide[0][0]] * 10, (W, H))
    assert not MedianBackground()(frames, CAMERA).any()


def test_tracks_follow_the_square(slide):
    frames, corner = slide
    work = WorkingFrames(frames, (W, H))
    uv = ChainedFlow()(work, inside(corner, 0), 30.0)
    assert len(uv) > 30
    relative = uv - corner[None]
    drift = np.nanmax(relative, 1) - np.nanmin(relative, 1)
    life = np.isfinite(uv[..., 0]).sum(1)
    assert np.median(life) == T
    assert np.median(drift) < 2.0
    assert np.quantile(drift, 0.9) < 6.0


def test_flow_behind_a_mask_ends_tracks(slide):
    frames, corner = slide
    masks = inside(corner, 0)
    masks[12] = False
    uv = ChainedFlow()(WorkingFrames(frames, (W, H)), masks, 30.0)
    seen = np.isfinite(uv[..., 0])
    assert not seen[:, 12].any() and seen.any()
    assert not (seen[:, :12].any(1) & seen[:, 13:].any(1)).any()


def test_gaps_are_joined_where_both_velocities_lead():
    t = np.arange(40.0)
    line = np.stack([10 + 3 * t, 50 + 0 * t], 1)
    other = line + np.array([0, 30])
    uv = np.full((4, 40, 2), np.nan, np.float32)
    uv[0, :18], uv[1, 22:], uv[2, :18], uv[3, 22:] = line[:18], line[22:], other[:18], line[22:] + np.array([0, 100])
    joined = join_gaps(uv, 8, 4.0)
    assert len(joined) == 3
    assert np.isfinite(joined[0, :18]).all() and np.isfinite(joined[0, 22:]).all() and np.isnan(joined[0, 18:22]).all()
    np.testing.assert_array_equal(joined[1], uv[2])
    assert len(join_gaps(uv, 3, 4.0)) == 4


def test_a_moving_camera_and_a_moving_thing(slide):
    """The wall follows the epipolar geometry of the camera's motion; the square, which moves by itself, does not."""
    t = np.arange(8)
    poses = np.stack([np.eye(4)] * 8)
    poses[:, 0, 3] = 0.03 * t
    camera = replace(CAMERA, w2c=poses)
    wall, patch, frames, masks = texture(0, (W + 200, H + 60)), texture(1, (60, 60)), [], []
    for k in t:
        shift = 256 * 0.03 * k / 3.0
        image = cv2.warpAffine(wall, np.array([[1, 0, shift - 60], [0, 1, -20.0]]), (W, H))
        y = 20 + 6 * k
        image[y : y + 60, 120:180] = patch
        mask = np.zeros((H, W), bool)
        mask[y : y + 60, 120:180] = True
        frames.append(image.astype(np.uint8))
        masks.append(mask)
    found = FlowResidual()(WorkingFrames(frames, (W, H)), camera)
    truth = np.stack(masks)
    assert (found & truth).sum() / (found | truth).sum() > 0.6


def test_histograms_tell_colours_apart_and_missed_tracks_have_one():
    frame = np.zeros((H, W, 3), np.uint8)
    frame[:, :160], frame[:, 160:] = (200, 30, 30), (30, 30, 200)
    work = WorkingFrames([frame] * 20, (W, H))
    uv = np.full((4, 20, 2), np.nan, np.float32)
    uv[0], uv[1], uv[2] = (40, 60), (60, 100), (260, 90)
    uv[3, 1:4] = (50, 80)
    f = LabHistogram()(work, np.ones((20, H, W), bool), uv, 30.0)
    np.testing.assert_allclose(np.linalg.norm(f, axis=1), 1, atol=1e-6)
    assert f[0] @ f[1] > 0.99 and f[0] @ f[3] > 0.99 and f[0] @ f[2] < 0.1


@pytest.fixture(scope="module")
def moved() -> tuple[WorkingFrames, WorkingFrames, np.ndarray]:
    """A texture that shifts by whole pixels, the same in other light and noise, and the paths of nine of its points."""
    plain, lit = [], []
    rng = np.random.default_rng(5)
    wall = texture(3, (W + 60, H + 60))
    uv = np.zeros((9, 20, 2), np.float32)
    for k in range(20):
        x, y = 2 * k, k
        plain.append(wall[y : y + H, x : x + W].astype(np.uint8))
        lit.append(np.clip(0.5 * plain[-1] + 60 + rng.normal(0, 2, (H, W, 3)), 0, 255).astype(np.uint8))
        uv[:, k] = np.stack([80 + 40 * (np.arange(9) % 3) - x, 60 + 35 * (np.arange(9) // 3) - y], 1)
    return WorkingFrames(plain, (W, H)), WorkingFrames(lit, (W, H)), uv


def test_daisy_knows_a_point_again_in_other_light(moved):
    plain, lit, uv = moved
    masks = np.ones((20, H, W), bool)
    early, late = np.where(np.arange(20)[:, None] < 10, uv, np.nan), np.where(np.arange(20)[:, None] < 10, np.nan, uv)
    f = Daisy()(plain, masks, early, 30.0)
    assert f.shape == (9, 64)
    np.testing.assert_allclose(np.linalg.norm(f, axis=1), 1, atol=1e-6)
    for other in (Daisy()(plain, masks, late, 30.0), Daisy()(lit, masks, uv, 30.0)):
        similar = f @ other.T
        assert (similar.argmax(1) == np.arange(9)).all() and np.diag(similar).min() > 0.98
        assert similar[~np.eye(9, dtype=bool)].max() < 0.97
    lab = LabHistogram()
    assert np.diag(lab(plain, masks, uv, 30.0) @ lab(lit, masks, uv, 30.0).T).max() < 0.98  # colours do not bear it


def test_daisy_counts_in_pixels_at_640(moved):
    plain, _, uv = moved
    double = WorkingFrames(
        [cv2.resize(f, (2 * W, 2 * H), interpolation=cv2.INTER_CUBIC) for f in plain], (2 * W, 2 * H)
    )
    masks = np.ones((20, 1, 1), bool)
    similar = Daisy()(plain, masks, uv, 30.0) @ Daisy()(double, masks, 2 * uv + 0.5, 30.0).T
    assert (similar.argmax(1) == np.arange(9)).all() and np.diag(similar).min() > 0.9


def test_daisy_of_short_lives_borders_and_nothing_at_all(moved):
    plain, _, uv = moved
    masks = np.ones((20, H, W), bool)
    brief = np.full((3, 20, 2), np.nan, np.float32)
    brief[0, 8:11] = uv[4, 8:11]  # between two samples
    brief[1] = (-3.0, H + 2.0)  # tracks may leave the image by a little
    f = Daisy()(plain, masks, brief, 30.0)
    assert np.isfinite(f).all() and f[0] @ Daisy()(plain, masks, uv, 30.0)[4] > 0.98
    np.testing.assert_allclose(f[2], 1 / 8)  # never seen
    flat = Daisy()(WorkingFrames([np.full((H, W, 3), 90, np.uint8)] * 20, (W, H)), masks, uv, 30.0)
    np.testing.assert_allclose(flat, 1 / 8)
    assert Daisy(rings=2, spokes=8, directions=6)(plain, masks, uv, 30.0).shape == (9, 102)


def test_daisy_in_the_slot(slide, tmp_path):
    frames, corner = slide
    video, masks = Video(frames, CAMERA, fps=30), list(inside(corner, 6))
    lab, daisy = Tracking()(video, masks, Cache(tmp_path)), Tracking(features=Daisy())(video, masks, Cache(tmp_path))
    np.testing.assert_array_equal(daisy["uv"], lab["uv"])
    assert daisy["features"].shape == (len(daisy["uv"]), 64) and lab["features"].shape[1] == 64
    np.testing.assert_allclose(np.linalg.norm(daisy["features"], axis=1), 1, atol=1e-5)
    assert not np.allclose(daisy["features"], lab["features"])
    assert len(list(tmp_path.glob("tracks-*.npz"))) == 2


def test_daisy_says_what_it_needs(moved, monkeypatch):
    monkeypatch.delattr(cv2, "xfeatures2d")
    with pytest.raises(ValueError, match="Daisy: needs OpenCV's contributed modules"):
        Daisy()(moved[0], [], moved[2], 30.0)


def test_working_frames_reduce_and_map_back():
    frames = WorkingFrames([np.zeros((720, 1280, 3), np.uint8)] * 2, (1280, 720))
    assert frames[0].shape == (360, 640, 3)
    np.testing.assert_allclose(frames.to_full(np.array([[0.0, 0.0], [639, 359]])), [[1, 1], [1279, 719]])
    with pytest.raises(ValueError, match="frame 1"):
        WorkingFrames([np.zeros((4, 4, 3), np.uint8), np.zeros((5, 4, 3), np.uint8)], (4, 4))[1]


def test_bilinear_is_exact_on_planes():
    y, x = np.mgrid[0:20, 0:30].astype(np.float32)
    at = np.random.default_rng(0).uniform(1, 18, (50, 2))
    np.testing.assert_allclose(bilinear(2 * x + 3 * y, at), 2 * at[:, 0] + 3 * at[:, 1], rtol=1e-5)


def test_selection_keeps_the_long_the_moving_and_the_separate():
    t = np.arange(60.0)
    move, at = np.stack([2 * t, 0 * t], 1), np.array
    uv = np.stack(
        [move + at([10, 10]), move + at([12, 11]), move + at([10, 100]), 0 * move + at([200, 50]), move + at([10, 150])]
    )
    uv[2, 50:] = np.nan
    uv[4, 10:] = np.nan
    assert Selection()(uv, 640, 30.0).tolist() == [0, 2]
    assert Selection(count=1)(uv, 640, 30.0).tolist() == [0]


def test_cache_keeps_by_content_and_mends_what_is_broken(tmp_path):
    calls = []

    def compute():
        calls.append(1)
        return {"x": np.arange(4)}

    cache = Cache(tmp_path)
    for _ in range(2):
        np.testing.assert_array_equal(cache.arrays("s", (1, "a"), compute)["x"], np.arange(4))
    assert len(calls) == 1
    cache.arrays("s", (2, "a"), compute)
    assert len(calls) == 2
    path = cache.path("s", (1, "a"))
    path.write_bytes(path.read_bytes()[:40])
    np.testing.assert_array_equal(cache.arrays("s", (1, "a"), compute)["x"], np.arange(4))
    assert len(calls) == 3
    Cache(None).arrays("s", (1, "a"), compute)
    assert len(calls) == 4


def test_tracking_is_kept_by_the_pixels(slide, tmp_path):
    frames, corner = slide
    video = Video(frames, CAMERA, 30.0, name="v")
    tracking, cache = Tracking(masker=GivenMasks(list(inside(corner, 0)))), Cache(tmp_path)
    first = tracking(video, None, cache)
    written = {p.name: p.stat().st_mtime_ns for p in tmp_path.iterdir()}
    again = tracking(video, None, cache)
    np.testing.assert_array_equal(first["uv"], again["uv"])
    assert written == {p.name: p.stat().st_mtime_ns for p in tmp_path.iterdir()}
    other = Video([f.copy() for f in frames[:-1]] + [frames[0]], CAMERA, 30.0, name="v")
    tracking(other, None, cache)
    assert len(list(tmp_path.iterdir())) > len(written)


def test_masks_are_kept_by_what_they_hold(slide, tmp_path):
    """Given with the video, or put into the slot: other masks are never taken for them."""
    frames, corner = slide
    video, cache = Video(frames, CAMERA, 30.0, name="v"), Cache(tmp_path)
    some, others = list(inside(corner, 0)), list(inside(corner, 5))
    for given in (some, others):
        for masks in (Tracking().masks(video, given, cache), Tracking(GivenMasks(given)).masks(video, None, cache)):
            np.testing.assert_array_equal(np.stack(list(masks)), given)


def test_lift_inverts_projection_and_drops_jumps():
    camera = ring(3, width=640, height=360)[1]
    xyz = paths(np.arange(60) / 30, 10, 4)
    z = camera.to_camera(xyz)[..., 2]
    tracks = pixel_tracks(camera.project(xyz), None, camera, fps=30.0, frame="world")
    exact = Lift(smooth=0.0)(tracks, z)
    assert exact.seen.mean() > 0.9
    assert np.abs(exact.xyz - xyz)[exact.seen].max() < 1e-9
    assert exact.frame == "world" and (exact.sigma[exact.seen] > 0).all()
    spoiled = z.copy()
    spoiled[:, 30] *= 1.3
    spoiled[2] = 0
    found = Lift(smooth=0.0)(tracks, spoiled)
    assert len(found) == 9
    assert not found.seen[:, 30].any()
    assert np.abs(found.xyz - np.delete(xyz, 2, 0))[found.seen].max() < 1e-9


def test_smoothing_is_symmetric_and_masked():
    x = np.zeros((1, 41, 3))
    x[0, 20] = 1
    out = smooth_in_time(x, 1.5)
    np.testing.assert_allclose(out, out[:, ::-1], atol=1e-15)
    x[0, 5] = np.nan
    assert np.isnan(smooth_in_time(x, 1.5)[0, 5]).all()
    ramp = np.repeat(np.arange(41.0)[None, :, None], 3, 2)
    np.testing.assert_allclose(smooth_in_time(ramp, 1.5)[:, 5:-5], ramp[:, 5:-5], atol=1e-12)


def test_running_median_against_numpy():
    z = np.random.default_rng(0).normal(size=(3, 30))
    z[0, 4:9] = np.nan
    out = running_median(z, 2)
    for n in range(3):
        for t in range(30):
            window = z[n, max(0, t - 2) : t + 3]
            known = window[np.isfinite(window)]
            expected = np.median(known) if known.size else np.nan
            np.testing.assert_allclose(out[n, t], expected)


def test_depth_at_keeps_off_edges_and_holes():
    uv = np.array([[[10.5, 10.5]], [[20.5, 10.5]], [[30.5, 10.5]]])
    depth = np.full((H, W), 2.0)
    depth[:, 20:] = 3.0
    depth[10, 31] = 0
    tracks = pixel_tracks(uv, None, CAMERA, fps=30.0)
    np.testing.assert_array_equal(depth_at([depth], tracks, uv)[:, 0], [2, 0, 0])


def test_depth_is_unknown_in_frames_without_a_map():
    uv = np.array([[[10.5, 10.5], [11.5, 10.5]]])
    tracks = pixel_tracks(uv, None, CAMERA, fps=30.0)
    np.testing.assert_array_equal(depth_at([None, np.full((H, W), 2.0)], tracks, uv), [[0, 2]])


def rig_of_balls(moments: int):
    """Eight cameras around two balls that rest; per video pixels of points on the nearer one, and their depth."""
    cameras = ring(8)
    centres = np.array([[[0.3, 0.0, 0.1]], [[-0.4, 0.1, -0.2]]])
    colours = np.array([[200.0, 60, 60], [60, 90, 210]])
    videos, masks, uv, true = [], [], [], []
    for v, camera in enumerate(cameras):
        image = render(camera, centres[:, 0], colours, 0.3, v)
        y, x = np.mgrid[0:180, 0:320] + 0.5
        mask, local = np.zeros((180, 320), bool), camera.to_camera(centres)[:, 0]
        points, depths = [], []
        for b in range(2):
            p = camera.K @ local[b] / local[b][2]
            mask |= (x - p[0]) ** 2 + (y - p[1]) ** 2 < (camera.K[0, 0] * 0.3 / local[b][2]) ** 2
        nearest = int(np.argmin(local[:, 2]))
        for du in (-8, 0, 8):
            point = (camera.K @ local[nearest] / local[nearest][2])[:2] + np.array([du, 3])
            ray = np.linalg.inv(camera.K) @ np.append(point, 1)
            # first root of |z ray - centre| = r
            a, bb, c = ray @ ray, -2 * ray @ local[nearest], local[nearest] @ local[nearest] - 0.09
            points.append(point)
            depths.append((-bb - np.sqrt(bb**2 - 4 * a * c)) / (2 * a))
        videos.append(Video([image] * moments, camera, 30.0, name=str(v)))
        masks.append(np.stack([mask] * moments))
        uv.append(np.repeat(np.array(points)[:, None], moments, 1))
        true.append(np.array(depths))
    return Rig.at(videos, masks, np.zeros(8)), uv, true


def test_hull_and_stereo_find_the_balls():
    rig, uv, true = rig_of_balls(2)
    found = HullStereo()(rig, uv)
    error = np.concatenate([np.abs(z[:, 0] / t - 1)[z[:, 0] > 0] for z, t in zip(found, true, strict=True)])
    assert len(error) >= 16
    assert np.median(error) < 0.02
    with pytest.raises(ValueError, match="visual hull is empty"):
        HullStereo()(replace(rig, masks=tuple(np.zeros_like(m) for m in rig.masks)), uv)
    with pytest.raises(ValueError, match="static"):
        moving = replace(rig.cameras[0], w2c=np.stack([rig.cameras[0].w2c] * 2))
        HullStereo()(replace(rig, cameras=(moving, *rig.cameras[1:])), uv)


def test_stereo_of_every_second_moment_fills_in_what_lies_between():
    """The rig of balls once more, five moments of it, tracks unseen in the third, the last and the second."""
    rig, uv, _ = rig_of_balls(5)
    uv[0][0, 2], uv[1][1, 4], uv[2][0, 1] = np.nan, np.nan, np.nan
    all_of_them, some = HullStereo()(rig, uv), HullStereo(every=2)(rig, uv)
    for whole, half, x in zip(all_of_them, some, uv, strict=True):
        np.testing.assert_array_equal(half[:, ::2], whole[:, ::2])
        between = half[:, 1::2]
        known = (whole[:, :-1:2] > 0) & (whole[:, 2::2] > 0) & np.isfinite(x[:, 1::2, 0])
        np.testing.assert_allclose(between[known], 0.5 * (whole[:, :-1:2] + whole[:, 2::2])[known], rtol=1e-6)
        assert not between[~known].any() and not half[np.isnan(x[..., 0])].any()
    assert (some[0][:, 1::2] > 0).any() and some[0][0, 1] == 0 and some[1][1, 3] == 0
    with pytest.raises(ValueError, match="every"):
        HullStereo(every=0)


def test_the_rig_pairs_frames_of_one_moment():
    videos = [Video([np.zeros((H, W, 3), np.uint8)] * 10, CAMERA, 30.0, name=str(v)) for v in range(2)]
    masks = [np.zeros((10, H, W), bool)] * 2
    index = Rig.at(videos, masks, np.array([0.0, 4 / 30])).index
    both = index[(index >= 0).all(1)]
    np.testing.assert_array_equal(both[:, 0] - both[:, 1], 4)
    assert len(both) == 6 and len(index) == 14
    half = Rig.at(videos, masks, np.array([0.0, 4.4 / 30])).index
    both = half[(half >= 0).all(1)]
    np.testing.assert_array_equal(both[:, 0] - both[:, 1], 4)


def test_the_rig_pairs_what_a_broken_video_shows():
    """Frames 4 to 6 repeat frame 3; two frames are lost before the other one's frame 6."""
    videos = [Video([np.zeros((H, W, 3), np.uint8)] * 10, CAMERA, 30.0, name=str(v)) for v in range(2)]
    masks = [np.zeros((10, H, W), bool)] * 2
    breaks = [(Break(6 / 30, -3 / 30, 3 / 30),), (Break(6 / 30, 2 / 30),)]
    index = Rig.at(videos, masks, np.zeros(2), breaks=breaks).index
    both = index[(index >= 0).all(1)]
    np.testing.assert_array_equal(both, [[0, 0], [1, 1], [2, 2], [6, 3], [7, 4], [8, 5]])
