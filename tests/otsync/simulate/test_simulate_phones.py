"""The textured room: what its cameras see is what geometry says, at the times that the offsets say."""

from __future__ import annotations

import av
import cv2
import numpy as np
import pytest

from otsync.io.frames import VideoFrames
from otsync.simulate.observation import stream
from otsync.simulate.phones import Hand, Tripod, film
from otsync.simulate.room import CORNERS, FURNITURE, FURNITURE_RADIUS, RoomCamera, dead_leaves, draw_room, look_at

SIZE, K = (320, 180), np.array([[260.0, 0, 160], [0, 260, 90], [0, 0, 1]])


@pytest.fixture(scope="module")
def room():
    return draw_room(3)


def eye(room, noise=0.0) -> RoomCamera:
    return RoomCamera(room, K, SIZE, np.random.default_rng(0), noise)


def pixel(w2c, x) -> np.ndarray:
    local = w2c[:3, :3] @ x + w2c[:3, 3]
    return (K @ local / local[2])[:2]


def test_two_cameras_see_the_same_wall(room):
    """Points of the back wall have one colour, from wherever they are seen."""
    camera, rng = eye(room), np.random.default_rng(1)
    poses = [look_at(np.array([x, 0.0, -2.0]), np.array([0.2, -0.6, 3.6])) for x in (-0.8, 0.9)]
    images = [cv2.GaussianBlur(camera._background(w2c)[1].astype(float), (0, 0), 2) for w2c in poses]
    points = np.stack([rng.uniform(-0.8, 1.2, 200), rng.uniform(-1.2, -0.9, 200), np.full(200, CORNERS[1][2])], 1)
    seen = []
    for image, w2c in zip(images, poses, strict=True):
        u, v = np.array([pixel(w2c, x) for x in points]).T.astype(int)
        seen.append(image[v, u])
    same = np.abs(seen[0] - seen[1]).mean()
    assert same < 0.4 * np.abs(seen[0] - seen[1][::-1]).mean()


def test_balls_are_where_they_are_said_to_be(room):
    camera, w2c = eye(room), look_at(np.array([0, 0, -2.4]), np.array([0, 0.1, 0.3]))
    _, moving = camera.film(w2c, 1.25)
    inside = 0
    for centre, radius in zip(room.places(np.array([1.25]))[:, 0], room.radii, strict=True):
        u, v = pixel(w2c, centre)
        if 0 <= u < 320 and 0 <= v < 180:
            inside += 1
            assert moving[int(v), int(u)]  # itself, or another one in front of it
        assert radius > 0.1
    assert inside >= 4 and 0.02 < moving.mean() < 0.6


def test_furniture_hides_what_is_behind_it(room):
    centre = FURNITURE[0]
    w2c = look_at(centre - np.array([0, 0, 2.0]), centre)
    depth = eye(room)._background(w2c)[2]
    assert depth[90, 160] == pytest.approx(2.0 - FURNITURE_RADIUS, abs=0.02)


def test_contrast_and_seeds():
    flat, full, other = (dead_leaves(stream(n, "x"), c).astype(float) for n, c in ((0, 0.25), (0, 1.0), (1, 1.0)))
    assert flat.std() < 0.3 * full.std() and np.abs(full - other).mean() > 10
    with pytest.raises(ValueError, match="contrast"):
        draw_room(0, contrast=2)


@pytest.mark.parametrize("held", [Tripod(), Hand()])
def test_films_are_repeatable_and_obey_their_offsets(tmp_path, held, room):
    """Frame k of a video shows the room at k / fps + its offset, and not at another time."""
    more = {"phones": 2, "walk": 0, "frames": 4, "size": SIZE, "held": held, "room": room}
    truth = film(tmp_path / "a", 3, max_offset=1.0, **more)
    again = film(tmp_path / "b", 3, max_offset=1.0, **more)
    assert (tmp_path / "a" / "phone1.mp4").read_bytes() == (tmp_path / "b" / "phone1.mp4").read_bytes()
    np.testing.assert_array_equal(truth.offsets, again.offsets)
    assert truth.offsets[0] == 0 and 0 < abs(truth.offsets[1]) <= 1 / 30 and truth.walk is None
    camera = truth.cameras[1]
    frames = VideoFrames(tmp_path / "a" / "phone1.mp4")
    assert (len(frames), frames.width, frames.height) == (4, *SIZE)
    poses = np.broadcast_to(camera.w2c, (4, 4, 4))
    lens = RoomCamera(room, camera.K, SIZE, np.random.default_rng(0), 0.0)
    want = lens.film(np.ascontiguousarray(poses[2]), 2 / 30 + truth.offsets[1])[0].astype(float)
    early = lens.film(np.ascontiguousarray(poses[2]), 2 / 30 + truth.offsets[1] - 0.2)[0].astype(float)
    got = frames[2].astype(float)
    assert np.abs(got - want).mean() < 0.8 * np.abs(got - early).mean()


def test_a_walk_passes_all_phones(tmp_path, room):
    truth = film(tmp_path, 1, phones=3, gap=50, walk=12, frames=2, size=(64, 36), room=room)
    with av.open(str(tmp_path / "walk.mp4")) as container:
        assert container.streams.video[0].frames == 12
    for camera in truth.cameras:
        assert np.linalg.norm(truth.walk.center - camera.center, axis=1).min() < 0.7
    with pytest.raises(ValueError, match="phones, frames, walk"):
        film(tmp_path, 1, phones=1)
