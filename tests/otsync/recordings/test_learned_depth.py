"""Estimated depth tied to known poses: a room of known depth, seen by an estimator that knows it up to scale, shift,
flicker and errors of its own."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from otsync.files.digest import content_key, sequence_key
from otsync.io.mend import cut
from otsync.io.scene import Scene
from otsync.priors import Cache
from otsync.priors.depth_scale import Limits
from otsync.recordings import Stages, depth_maps, synchronize_scene, with_depth
from otsync.recordings.learned_depth import TiedMaps, pose_at
from otsync.recordings.own_frames import synchronize_own_scene
from otsync.recordings.static_points import View, matched, static_points
from otsync.simulate.phones import Hand, Tripod
from otsync.simulate.room import RoomCamera, draw_room
from otsync.types import Camera, Offsets, Video

SIZE, FPS = (320, 180), 30.0
FRAMES = 24
STARTS = (0.0, 4.0, 9.0)
"""Frames by which the cameras started later than the first."""


@dataclass(frozen=True)
class Knowing:
    """An estimator that looks the depth up, and tells it wrong: in every frame by a scale, perhaps a shift, and a few
    per cent that stay in place; a part of the image is all wrong."""

    depths: dict[str, np.ndarray] = field(repr=False)
    gives: str = "relative"
    flicker: float = 0.1
    wrong: float = 0.02
    calls: list[int] = field(default_factory=list)

    @property
    def cache_key(self) -> Any:
        return ("Knowing", self.gives, self.flicker, self.wrong)

    def __call__(self, images: Any, cameras: Any) -> np.ndarray:
        self.calls.append(len(images))
        for camera, image in zip(cameras, images, strict=True):
            assert (camera.width, camera.height) == image.shape[1::-1] and camera.w2c.shape == (4, 4)
        out = []
        for image in images:
            key = content_key(image)
            rng = np.random.default_rng(int(key[:8], 16))
            z = self.depths[key].astype(float)
            y, x = np.mgrid[: z.shape[0], : z.shape[1]] / np.array(z.shape).reshape(2, 1, 1)
            z = z * (1 + self.wrong * np.sin(7 * x + 3) * np.cos(5 * y))
            z[: z.shape[0] // 4, : z.shape[1] // 5] *= 0.4
            a = 40 * np.exp(self.flicker * rng.normal())
            b = 3 * rng.normal() if self.gives == "relative" else 0.0
            out.append(z / a if self.gives == "depth" else a / z + b)
        return np.stack(out)


def clip(room: Any, held: Any, azimuth: float, start: float, seed: int, frames: int) -> tuple[Video, list, list]:
    """A video of the room, its masks and its depth."""
    rng = np.random.default_rng(seed)
    times = np.arange(frames) / FPS
    w2c = held(np.radians(azimuth), times, rng)
    K = np.array([[260.0, 0, SIZE[0] / 2], [0, 260, SIZE[1] / 2], [0, 0, 1]])
    eye = RoomCamera(room, K, SIZE, rng, noise=1.0)
    poses = np.broadcast_to(w2c, (frames, 4, 4)).copy()
    seen = [eye.film(p, float(t + start / FPS)) for p, t in zip(poses, times, strict=True)]
    depth = [eye.depth(p, float(t + start / FPS)) for p, t in zip(poses, times, strict=True)]
    video = Video([image for image, _ in seen], Camera(K, w2c, *SIZE), FPS, name=f"cam{seed}")
    return video, [mask for _, mask in seen], depth


def filmed(
    held: Any, azimuths: tuple[float, ...] = (-65, -42, -20), room: Any = None, frames: int = FRAMES
) -> tuple[Scene, list, Any]:
    """A scene with masks, the depth of every frame, and how to make an estimator that knows it."""
    room = room or draw_room(5)
    clips = [clip(room, held, a, s, n, frames) for n, (a, s) in enumerate(zip(azimuths, STARTS, strict=False))]
    scene = Scene(tuple(v for v, _, _ in clips), tuple(m for _, m, _ in clips))
    known = {content_key(i): z for v, _, d in clips for i, z in zip(v.frames, d, strict=True)}
    return scene, [d for _, _, d in clips], partial(Knowing, known)


@pytest.fixture(scope="module")
def rig() -> tuple[Scene, list, Any]:
    return filmed(Tripod())


@pytest.fixture(scope="module")
def hands() -> tuple[Scene, list, Any]:
    return filmed(Hand(), frames=12)


def off(maps: Any, truth: list, masks: Any, k: int) -> tuple[float, float]:
    """Median share by which a map is off on the background, and on what moves."""
    share = np.abs(maps[k] / truth[k] - 1)
    return float(np.median(share[~masks[k]])), float(np.median(share[masks[k]]))


def test_points_of_the_background_lie_on_it(rig, hands):
    for scene, depth, _ in (rig, hands):
        for video, truth, points in zip(
            scene.videos, depth, static_points(scene.videos, scene.masks, 320), strict=True
        ):
            assert len(points) >= 100
            first = np.maximum(points.frame, 0)
            w2c = np.broadcast_to(video.camera.w2c, (len(truth), 4, 4))[first]
            z = np.einsum("nj,nj->n", w2c[:, 2, :3], points.xyz) + w2c[:, 2, 3]
            x, y = points.uv.astype(int).T
            still = np.median(truth, 0)[None].repeat(len(truth), 0) if video.camera.w2c.ndim == 2 else np.stack(truth)
            share = np.abs(z / still[first, y, x] - 1)
            assert np.median(share) < 0.02 and (share < 0.1).mean() > 0.9
            assert np.median(share / points.sigma) < 2  # sigma tells how far they are off


def views(xyz: np.ndarray, moved: np.ndarray | float = 0.0) -> tuple[View, View]:
    """Two views of points, each with a word of its own; ``moved``: pixels by which the second one's lie off."""
    rng = np.random.default_rng(3)
    K = np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]])
    words = rng.random((len(xyz), 128))
    words = np.sqrt(words / words.sum(1, keepdims=True)).astype(np.float32)
    out = []
    for n, x in enumerate((0.0, -0.8)):
        w2c = np.eye(4)
        w2c[0, 3] = x
        camera = Camera(K, w2c, 640, 360)
        uv = camera.project(xyz[:, None])[:, 0] + n * moved
        out.append(View(n, -1, camera, uv, uv, words))
    return out[0], out[1]


def test_features_that_look_alike_count_where_they_obey_the_geometry():
    rng = np.random.default_rng(4)
    xyz = np.stack([*rng.uniform(-1, 1, (2, 300)), rng.uniform(3, 8, 300)], 1)
    good, off = np.arange(200), np.arange(200, 300)
    moved = np.zeros((300, 2))
    moved[off, 1] = 2.6  # across the lines, which run along the rows here: near enough to triangulate
    found = matched(*views(xyz, moved))
    np.testing.assert_array_equal(found[:, 0], found[:, 1])
    assert set(found[:, 0]) == set(good)
    # of views of different things what looks alike lies on its line by chance alone
    one, other = views(xyz)
    strange = replace(other, uv=rng.permutation(other.uv))
    assert len(matched(one, strange)) == 0


@pytest.mark.parametrize("gives", ["relative", "inverse", "depth"])
def test_depth_of_static_cameras_is_tied_to_their_poses(rig, gives):
    scene, depth, knowing = rig
    found = with_depth(scene, Stages(depth=knowing(gives=gives)))
    assert not found.untied and len(found.notes) == 3
    for video, truth, masks in zip(found.scene.videos, depth, scene.masks, strict=True):
        assert isinstance(video.depth, TiedMaps) and len(video.depth) == FRAMES
        ratios = []
        for k in (0, 10, 23):
            still, moves = off(video.depth, truth, masks, k)
            assert still < 0.025 and moves < 0.05
            ratios.append(np.median((video.depth[k] / truth[k])[~masks[k]]))
        assert np.ptp(ratios) < 0.01  # flicker of a tenth is gone


def test_depth_of_cameras_that_move_is_tied_frame_by_frame(hands):
    scene, depth, knowing = hands
    found = with_depth(scene, Stages(depth=knowing()))
    assert not found.untied
    for video, truth, masks in zip(found.scene.videos, depth, scene.masks, strict=True):
        for k in (0, 5, 11):
            still, moves = off(video.depth, truth, masks, k)
            assert still < 0.05 and moves < 0.08


@pytest.mark.slow
def test_a_recording_is_synchronised_by_estimated_depth_or_without_it_where_nothing_ties_it():
    scene, _, knowing = filmed(Tripod(), frames=60)
    answer = synchronize_scene(scene, stages=Stages(depth=knowing()))
    assert answer.route == "tracks"
    np.testing.assert_allclose(answer.offsets.frames, STARTS, atol=0.35)  # by the true depth: .10 at most
    untied = Stages(depth=knowing(), depth_limits=Limits(least=5000))
    heard: list[str] = []
    flat = synchronize_scene(scene, stages=untied, tell=heard.append)
    assert flat.route == "epipolar" and any("is not tied to the poses" in line for line in flat.why)
    assert any("it has no depth" in line for line in heard)
    np.testing.assert_allclose(flat.offsets.frames, STARTS, atol=0.5)


def test_maps_are_made_once_and_kept_by_prior(rig, tmp_path):
    scene, _, knowing = rig
    prior, cache = knowing(), Cache(tmp_path)
    first = with_depth(scene, Stages(depth=prior), cache=cache)
    made = len(prior.calls)
    assert sum(prior.calls) == 3 * FRAMES and max(prior.calls) == 16
    again = with_depth(scene, Stages(depth=prior), cache=cache)
    assert len(prior.calls) == made
    a, b = first.scene.videos[1].depth, again.scene.videos[1].depth
    np.testing.assert_array_equal(a[7], b[7])
    assert a.digest() == b.digest()
    other = with_depth(scene, Stages(depth=replace(prior, gives="inverse")), cache=cache)
    assert len(prior.calls) > made and other.scene.videos[1].depth.digest() != a.digest()
    same = with_depth(first.scene, Stages(depth=prior), cache=cache)
    assert same.scene is first.scene
    np.testing.assert_array_equal(np.stack(a[3:5]), np.stack([a[3], a[4]]))
    np.testing.assert_array_equal(a[-1], a[FRAMES - 1])
    with pytest.raises(IndexError):
        a[FRAMES]
    part = cut(first.scene, 5, 9)
    assert with_depth(part, Stages(depth=prior), cache=cache).scene is part
    np.testing.assert_array_equal(part.videos[1].depth[2], a[7])
    assert sequence_key(part.videos[1].depth) != a.digest()


def test_the_estimators_that_look_at_several_frames_get_them(rig):
    scene, _, knowing = rig

    class Joint(Knowing):
        together = 5

    prior = Joint(knowing().depths)
    with_depth(scene.take(("cam0", "cam1")), Stages(depth=prior))
    assert prior.calls == [5, 5, 5, 5, 4] * 2


def test_estimated_depth_goes_before_given_and_given_serves_where_nothing_ties(rig):
    scene, depth, knowing = rig
    given = [[np.full(SIZE[::-1], 7.0, np.float32)] * FRAMES for _ in depth]
    brought = replace(scene, videos=tuple(replace(v, depth=d) for v, d in zip(scene.videos, given, strict=True)))
    assert with_depth(brought, Stages()).scene is brought
    assert (
        off(with_depth(brought, Stages(depth=knowing())).scene.videos[0].depth, depth[0], scene.masks[0], 9)[0] < 0.03
    )
    strict = Stages(depth=knowing(), depth_limits=Limits(least=5000))
    heard: list[str] = []
    kept = with_depth(brought, strict, tell=heard.append)
    assert all(v.depth is d for v, d in zip(kept.scene.videos, given, strict=True))
    assert set(kept.untied) == set(scene.names)
    assert "cam0 is not tied" in heard[0] and "depth that came along is used" in heard[0]


def test_a_video_that_nothing_ties_is_named_with_the_reason():
    plain = replace(room := draw_room(5), pictures=tuple(np.full_like(p, 128) for p in room.pictures))
    scene, _, knowing = filmed(Tripod(), (-65, -42), plain, frames=6)
    bare = replace(
        scene, videos=tuple(replace(v, frames=[np.full_like(f, 128) for f in v.frames]) for v in scene.videos)
    )
    prior = knowing()
    found = with_depth(bare, Stages(depth=prior))
    assert not prior.calls  # no model looks at what nothing ties
    assert all(v.depth is None for v in found.scene.videos)
    assert "0 points of the background" in found.untied["cam0"]
    with pytest.raises(ValueError, match=r"route tracks: estimated depth of cam0 \(0 points.*Check the poses"):
        synchronize_scene(bare, route="tracks", stages=Stages(depth=prior))
    with pytest.raises(ValueError, match="expected no estimator, since without poses"):
        synchronize_own_scene(scene, stages=Stages(depth=prior))


def test_dense_maps_are_the_estimated_ones_on_what_moves(rig):
    scene, depth, knowing = rig
    V = len(scene.videos)
    seconds = np.array(STARTS) / FPS
    offsets = Offsets(
        scene.names, np.full(V, FPS), seconds, np.ones(V), np.full(V, 0.001), 0, np.zeros(V, int), ((),) * V
    )
    maps = depth_maps(scene, offsets, [[3, 20], [], [12]], width=160, stages=Stages(depth=knowing()))
    assert [m.shape for m in maps] == [(2, 90, 160), (0, 90, 160), (1, 90, 160)]
    truth = depth[0][20][::2, ::2]
    known = maps[0][1] > 0
    assert known.any() and np.median(np.abs(maps[0][1] / truth - 1)[known]) < 0.05


def test_a_camera_of_one_frame_sees_what_the_video_saw():
    w2c = np.tile(np.eye(4), (3, 1, 1))
    w2c[:, 0, 3] = [0, 1, 2]
    camera = Camera(np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]]), w2c, 640, 360)
    one = pose_at(camera, 2, (320, 180))
    assert one.w2c[0, 3] == 2 and (one.width, one.height) == (320, 180)
    np.testing.assert_allclose(one.K, [[250, 0, 160], [0, 250, 90], [0, 0, 1]])
