"""Footage at working size: averages, cameras, masks, backgrounds, boxes, frames that cannot be read; depth maps."""

from __future__ import annotations

import logging
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from otsync.types import Camera, Video
from recon.footage.depth import background_depth, depth_at, working_depth
from recon.footage.footage import Lens, boxes_of, footage_of, median_background

K = np.array([[100.0, 0, 33], [0, 110, 25], [0, 0, 1]])


def camera(width=64, height=48, w2c=None, **lens):
    return Camera(K, np.eye(4) if w2c is None else w2c, width, height, **lens)


def clip(frames=6, width=64, height=48, seed=0):
    return list(np.random.default_rng(seed).integers(0, 256, (frames, height, width, 3), dtype=np.uint8))


def video(frames=None, cam=None, **kwargs):
    return Video(clip() if frames is None else frames, cam or camera(), **{"fps": 30, "name": "left", **kwargs})


# ---- size and camera


def test_working_pixels_are_means_of_blocks():
    f = footage_of(video(), width=16)
    means = np.stack(clip()).reshape(6, 12, 4, 16, 4, 3).astype(float).mean((2, 4))
    assert f.images.dtype == np.uint8 and f.images.shape == (6, 12, 16, 3)
    assert np.abs(f.images - means).max() <= 0.5 + 1e-4


@settings(max_examples=25, deadline=None)
@given(width=st.integers(2, 64), level=st.integers(0, 255), seed=st.integers(0, 99))
def test_any_size_keeps_constants_and_the_mean(width, level, seed):
    lens = Lens.of(camera(), width)
    assert (lens.shrink(np.full((48, 64), level, np.uint8)) == level).all()
    image = np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    assert np.abs(lens.shrink(image).mean((0, 1)) - image.mean((0, 1))).max() < 0.5 + 1e-3


@settings(max_examples=25, deadline=None)
@given(width=st.integers(8, 64), x=st.floats(-0.3, 0.3), y=st.floats(-0.2, 0.2))
def test_points_land_where_the_smaller_image_shows_them(width, x, y):
    cam = camera()
    lens = Lens.of(cam, width)
    full = cam.project(np.array([[[x, y, 1.0]]]))[0, 0]
    small = Camera(lens.K, np.eye(4), *lens.size).project(np.array([[[x, y, 1.0]]]))[0, 0]
    assert small == pytest.approx(full * np.array(lens.size) / (64, 48), abs=1e-9)


def test_narrow_videos_stay_as_they_are():
    f = footage_of(video(), width=320)
    assert np.array_equal(f.images, np.stack(clip())) and np.array_equal(f.K, K) and f.size == (64, 48)
    assert f.camera.width == 64 and f.nbytes == f.images.nbytes


def test_a_part_of_a_moving_camera_keeps_its_times_and_poses():
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    f = footage_of(video(cam=camera(w2c=poses)), width=32, frames=slice(1, 6, 2))
    assert f.times == pytest.approx(np.array([1, 3, 5]) / 30) and len(f) == 3
    assert f.pose(2)[0, 3] == 5 and f.w2c.shape == (3, 4, 4) and f.background is None
    with pytest.raises(ValueError, match="frames: expected some of the 6"):
        footage_of(video(), frames=slice(9, None))
    with pytest.raises(ValueError, match="width: expected"):
        footage_of(video(), width=0)


def test_lenses_are_undone():
    cv2 = pytest.importorskip("cv2")
    cam = Camera(
        np.array([[300.0, 0, 161], [0, 300, 122], [0, 0, 1]]), np.eye(4), 320, 240, np.array([-0.3, 0.1, 0, 0])
    )
    points = np.array([[-0.3, -0.2, 1], [0.25, -0.15, 1], [0.1, 0.2, 1], [-0.35, 0.1, 1]])
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    where, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), cam.K - half, cam.distortion)
    image = np.zeros((240, 320, 3), np.uint8)
    for x, y in where[:, 0]:  # a blob around each distorted position, in OpenCV's pixels
        v, u = np.mgrid[:240, :320]
        image[np.hypot(u - x, v - y) < 3] = 255
    f = footage_of(Video([image], cam, fps=30), width=320)
    for expected in f.camera.project(points[:, None])[:, 0]:
        v, u = np.mgrid[:240, :320] + 0.5
        weight = f.images[0, ..., 0] * (np.hypot(u - expected[0], v - expected[1]) < 8)
        found = (u * weight).sum() / weight.sum(), (v * weight).sum() / weight.sum()
        assert found == pytest.approx(tuple(expected), abs=0.3)
    assert f.images[0].min() == 0 and Lens.of(cam, 320).shrink(np.full((240, 320, 3), 9, np.uint8)).min() == 9


def test_lenses_without_opencv_are_a_clear_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ValueError, match="undoing it needs OpenCV"):
        footage_of(video(cam=camera(distortion=np.array([0.1, 0, 0, 0]))))


# ---- masks, background, boxes


def moving_square():
    """A bright square passes before a texture, from frame 0 to 7."""
    wall = np.random.default_rng(3).integers(0, 120, (48, 64, 3), dtype=np.uint8)
    frames, masks = [], []
    for k in range(8):
        mask = np.zeros((48, 64), bool)
        mask[20:30, 6 + 6 * k : 14 + 6 * k] = True
        frames.append(np.where(mask[..., None], np.uint8(250), wall))
        masks.append(mask)
    return wall, frames, masks


@pytest.mark.parametrize("kind", ["bool", "0 to 1", "0 to 255", "float", "half size"])
def test_masks_of_every_kind_say_the_same(kind):
    _, frames, masks = moving_square()
    given = {
        "bool": masks,
        "0 to 1": [m.astype(np.uint8) for m in masks],
        "float": [m.astype(np.float32) for m in masks],
        "0 to 255": [m.astype(np.uint8) * 255 for m in masks],
        "half size": [m[::2, ::2] for m in masks],
    }[kind]
    f = footage_of(video(frames), given, width=32)
    assert np.array_equal(f.masks, footage_of(video(frames), masks, width=32).masks)
    assert f.masks.dtype == np.uint8 and f.masks.max() == 255
    # soft at the edges: the area is kept
    assert f.masks.mean((1, 2)) / 255 == pytest.approx(np.mean(masks, (1, 2)), abs=1e-3)


def test_the_background_is_what_was_behind():
    wall, frames, masks = moving_square()
    f = footage_of(video(frames), masks, width=64)
    assert np.array_equal(f.background, wall) and f.background_seen.all()


def test_two_glimpses_are_a_background_and_no_ghost():
    """Something dark stands before a wall for six of eight frames: a plain median would show it."""
    frames, masks = np.full((8, 48, 64, 3), 180, np.uint8), np.zeros((8, 48, 64), bool)
    frames[:6, 20:30, 20:30], masks[:6, 20:30, 20:30] = 30, True
    f = footage_of(video(list(frames)), list(masks), width=64)
    assert (f.background == 180).all() and f.background_seen.all()
    assert not footage_of(video(list(frames[:7])), list(masks[:7]), width=64).background_seen[22:28, 22:28].any()


def test_background_that_was_never_seen_is_marked():
    wall, frames, masks = moving_square()
    for frame, mask in zip(frames, masks, strict=True):
        frame[40:44, 30:36] = 200
        mask[40:44, 30:36] = True
    f = footage_of(video(frames), masks, width=64)
    assert not f.background_seen[40:44, 30:36].any() and (f.background[40:44, 30:36] == 200).all()
    far = np.ones_like(f.background_seen)
    far[38:46, 28:38] = False
    assert f.background_seen[far].all() and np.array_equal(f.background[far], wall[far])


def test_one_frame_is_a_background_where_nothing_moves():
    _, frames, masks = moving_square()
    background, seen = median_background(frames[0][None], (255 * masks[0][None]).astype(np.uint8))
    assert np.array_equal(background[seen], frames[0][seen]) and not seen[20:30, 6:14].any() and seen[40:].all()


def test_even_counts_take_the_mean_of_the_middle():
    images = np.array([10, 20, 40, 90], np.uint8).reshape(4, 1, 1, 1) * np.ones((1, 4, 4, 3), np.uint8)
    masks = np.zeros((4, 4, 4), np.uint8)
    assert (median_background(images, masks)[0] == 30).all()
    masks[3] = 255
    assert (median_background(images, masks)[0] == 20).all()


def test_boxes_hold_what_moves_with_a_margin():
    masks = np.zeros((3, 180, 320), np.uint8)
    masks[0, 50:60, 100:130] = 255
    masks[1, 0:5, 315:320] = 255
    masks[2, 90, 90] = 60  # less than foreground
    bad = np.zeros(3, bool)
    assert boxes_of(masks, bad, (320, 180)).tolist() == [[90, 40, 140, 70], [305, 0, 320, 15], [0, 0, 0, 0]]
    assert boxes_of(None, np.array([False, True]), (320, 180)).tolist() == [[0, 0, 320, 180], [0, 0, 0, 0]]


def test_nothing_moves_and_no_masks_are_different_things():
    none = footage_of(video(), [np.zeros((48, 64), bool)] * 6)
    assert not none.boxes.any() and none.background is not None and none.background_seen.all()
    unknown = footage_of(video())
    assert unknown.masks is None and unknown.background is None and (unknown.boxes == [0, 0, 64, 48]).all()


# ---- frames that cannot be used


class Broken(list):
    """A sequence of frames some of which do not decode."""

    def __init__(self, frames, broken):
        super().__init__(frames)
        self.broken = broken

    def __getitem__(self, k):
        if k in self.broken:
            raise self.broken[k]
        return super().__getitem__(k)


def test_bad_frames_are_left_out_and_named(caplog):
    _, frames, masks = moving_square()
    floats = [f.astype(np.float32) / 255 for f in frames]
    floats[2][3, 4, 0] = np.nan
    floats[5] = floats[5][:40]
    source = Broken(floats, {0: ValueError("left/0.jpg: truncated"), 7: FileNotFoundError("left/7.jpg")})
    with caplog.at_level(logging.WARNING):
        f = footage_of(video(source), masks)
    assert np.flatnonzero(f.bad).tolist() == [0, 2, 5, 7]
    assert not f.images[f.bad].any() and not f.boxes[f.bad].any() and not f.masks[f.bad].any() and f.boxes[1].any()
    assert np.array_equal(f.images[1], frames[1])  # floats in 0..1 are uint8 again
    for k, why in ((0, "truncated"), (2, "NaN"), (5, "64 x 48"), (7, "7.jpg")):
        assert any(f"'left', frame {k} " in r.getMessage() and why in r.getMessage() for r in caplog.records)
    assert f.nearest(0.0) == 1 and f.nearest(2.2 / 30) in (1, 3)


def test_no_usable_frame_is_an_error():
    with pytest.raises(ValueError, match=r"'left': expected frames that can be read.*found none.*64 x 48"):
        footage_of(video(clip(width=30)))
    with pytest.raises(ValueError, match=r"floats in 0\.\.1"):
        footage_of(video([f.astype(float) for f in clip()]))
    with pytest.raises(ValueError, match="uint8, or floats"):
        footage_of(video([f.astype(np.int32) for f in clip()]))
    with pytest.raises(ValueError, match="masks of 'left': expected 6"):
        footage_of(video(), [np.zeros((48, 64), bool)] * 5)


def test_an_unreadable_mask_costs_its_frame():
    masks = [np.zeros((48, 64), bool)] * 6
    masks[3] = np.zeros((48, 64, 3), bool)
    assert np.flatnonzero(footage_of(video(), masks).bad).tolist() == [3]


# ---- depth


def test_depth_is_picked_never_averaged():
    z = np.ones((48, 64), np.float32)
    z[:, 32:] = 7
    z[0, 0] = np.nan
    at = working_depth(video(depth=[z] * 6), width=16, frames=slice(2, None))
    small = at(1)
    assert small.shape == (12, 16) and set(np.unique(small)) == {1.0, 7.0} and (small[:, 8:] == 7).all()
    f = footage_of(video(), width=16)
    assert np.array_equal(depth_at([z] * 6, f, 0), small)  # maps of any size are brought to the working size
    assert np.array_equal(depth_at(lambda k: z, f, 3), small) and depth_at([None] * 6, f, 0) is None


def test_unknown_depth_is_zero():
    f = footage_of(video(), width=64)
    z = np.full((48, 64), 2.0)
    z[0, :4] = np.nan, np.inf, -1, 0
    found = depth_at([z] * 6, f, 0)
    assert (found[0, :4] == 0).all() and (found[1:] == 2).all()


def test_missing_depth_names_the_video():
    f = footage_of(video(), width=64)
    for call in (lambda: depth_at(None, f, 0), lambda: working_depth(video())):
        with pytest.raises(ValueError, match="depth of 'left': expected depth maps"):
            call()
    with pytest.raises(ValueError, match=r"depth of 'left': expected 6 maps.*found 2"):
        depth_at([np.ones((48, 64))] * 2, f, 0)
    with pytest.raises(ValueError, match="depth of 'left', frame 1: expected a map"):
        depth_at([np.ones(5)] * 6, f, 1)


def test_background_depth_ignores_what_moves():
    _, frames, masks = moving_square()
    f = footage_of(video(frames), masks, width=64)
    maps = [np.where(mask, 1.0, 5.0) for mask in masks]
    maps[4] = None
    z, count = background_depth(maps, f)
    assert (z == 5).all() and count.max() == 7 and count[25, 10] < 7
    assert not background_depth([None] * 8, f)[0].any()


@pytest.mark.slow
def test_a_real_recording(data):
    from otsync.io import open_scene

    scene = open_scene(data / "panoptic_basketball")
    f = footage_of(scene.videos[1], scene.masks[1], frames=slice(0, 60))
    assert f.size == (320, 180) and not f.bad.any() and f.background_seen.mean() > 0.99
    assert f.K[0, 0] == pytest.approx(scene.videos[1].camera.K[0, 0] / 2)
    assert (f.boxes[:, 2] > f.boxes[:, 0]).all()


def test_a_camera_that_moves_is_between_its_frames_and_beyond_them():
    """Turning evenly about one axis and going along a line it is where it must be at any time."""
    times = np.array([0.0, 0.1, 0.3, 0.4])

    def w2c(t):
        c2w = np.eye(4)
        c2w[:3, :3] = Rotation.from_rotvec(t * np.array([0.3, -0.8, 0.5])).as_matrix()
        c2w[:3, 3] = [1 + 2 * t, -t, 0.5]
        return np.linalg.inv(c2w)

    video = Video(
        [np.zeros((8, 8, 3), np.uint8)] * 4,
        Camera(np.eye(3), np.stack([w2c(t) for t in times]), 8, 8),
        timestamps=times,
    )
    footage = footage_of(video, width=8)
    for frame, later in ((0, 0.03), (1, 0.15), (1, -0.04), (2, 0.0), (3, 0.02), (0, -0.02)):
        np.testing.assert_allclose(footage.pose_after(frame, later), w2c(times[frame] + later), atol=1e-9)
    still = replace(footage, w2c=footage.w2c[0])
    np.testing.assert_array_equal(still.pose_after(2, 0.05), still.w2c)
