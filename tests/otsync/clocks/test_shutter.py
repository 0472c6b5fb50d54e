"""Rolling shutters undone: laws of the interpolation, its noise, and that every verb undoes them once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync import Camera, TrackSet, align, match, refine, synchronize
from otsync.clocks.shutter import at_frame_times, rows
from otsync.epipolar.refine import EpipolarRefine
from otsync.epipolar.scan import EpipolarScan
from otsync.files.digest import content_key
from otsync.geometry import distort, undistort
from otsync.recordings.lift import Lift
from otsync.simulate import simulate
from otsync.simulate.effects import LateralJitter, RollingShutter

FPS, W, H = 30.0, 640, 360
K = np.array([[500.0, 0, W / 2], [0, 500.0, H / 2], [0, 0, 1]])


def camera(readout: float | None = 0.02, w2c: np.ndarray | None = None, **more) -> Camera:
    return Camera(K, np.eye(4) if w2c is None else w2c, W, H, readout=readout, **more)


def clip(seed: int, frames: int = 12, n: int = 6, share: float = 0.3):
    """Uneven timestamps about 1/30 s apart, and who is seen when."""
    rng = np.random.default_rng(seed)
    t = rng.uniform(-5, 5) + np.cumsum(rng.uniform(0.8, 1.6, frames)) / FPS
    return rng, t, rng.random((n, frames)) >= share


def at_rows(row: np.ndarray) -> np.ndarray:
    """Pixels (N,T,2) that lie at ``row``, from -1/2 to 1/2 of the height."""
    return np.stack([np.full_like(row, W / 2), (row + 0.5) * H], 2)


@pytest.mark.parametrize("who", [None, camera(None), camera(0.0)])
def test_what_is_absent_costs_nothing(who):
    tracks = TrackSet(np.zeros((2, 5, 3)), fps=FPS, camera=who)
    assert at_frame_times(tracks) is tracks


def test_twice_is_once():
    tracks = TrackSet(np.random.default_rng(0).normal([0, 0, 5], 1, (3, 9, 3)), fps=FPS, camera=camera())
    once = at_frame_times(tracks)
    assert once.camera.readout is None and tracks.camera.readout == 0.02
    assert at_frame_times(once) is once


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(0, 1), single=st.booleans())
def test_what_moves_evenly_is_recovered_exactly_and_what_is_not_seen_is_left_alone(seed, share, single):
    """At any readout, on any clock, with any rows and gaps; junk where nothing is visible changes nothing.

    Readouts up to the shortest frame: beyond it neighbours are read at nearly one time, and tell nothing of motion.
    """
    rng, t, seen = clip(seed)
    readout = share * float(np.diff(t).min())
    row = np.clip(0.4 * rng.uniform(-1, 1, (6, 1)) + 0.2 * rng.uniform(-1, 1, seen.shape), -0.5, 0.5)
    p, v = rng.normal(size=(2, 6, 1, 3))
    if single:
        p, v = p.astype(np.float32), v.astype(np.float32)
    taken = (t - t[0] + readout * row)[..., None]
    junk = rng.choice([np.nan, np.inf, 1e30], seen.shape)[..., None]
    xyz = np.where(seen[..., None], p + v * taken, junk).astype(p.dtype)
    tracks = TrackSet(xyz, seen, timestamps=t, uv=np.where(seen[..., None], at_rows(row), junk), camera=camera(readout))
    done = at_frame_times(tracks)
    want = p + v * (t - t[0])[:, None]
    several = seen & (seen.sum(1, keepdims=True) > 1)
    atol = 1e-5 if single else 1e-12
    assert done.xyz.dtype == p.dtype and np.array_equal(done.seen, seen)
    np.testing.assert_allclose(done.xyz[several], want[several], atol=atol, rtol=0)
    for before, after in ((tracks.xyz, done.xyz), (tracks.uv, done.uv)):
        assert np.array_equal(before[~several], after[~several], equal_nan=True)
    shifted = at_frame_times(replace(tracks, timestamps=t + 3.7))
    np.testing.assert_allclose(shifted.xyz[seen], done.xyz[seen], atol=atol, rtol=0)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(0.01, 1))
def test_pixels_that_move_across_the_rows_are_recovered_exactly(seed, share):
    rng, t, seen = clip(seed, share=0.1)
    readout = share * float(np.median(np.diff(t)))
    start, speed = rng.uniform(0.3, 0.7, (6, 1)) * H, rng.uniform(-0.4, 0.4, (6, 1)) * H
    now = t - t[0]
    # the row v(s) = start + speed s is read at s = t + readout (v(s)/H - 1/2)
    taken = (now + readout * (start / H - 0.5)) / (1 - readout * speed / H)
    at = [np.stack([200 + 90 * s + 0 * start, start + speed * s], 2) for s in (taken, now)]
    seen[:, :2] = True
    done = at_frame_times(TrackSet(None, seen, timestamps=t, uv=at[0], camera=camera(readout)))
    np.testing.assert_allclose(done.uv[seen], at[1][seen], atol=1e-9, rtol=0)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(0, 1))
def test_constant_acceleration_is_recovered_exactly_between_neighbours(seed, share):
    rng, t, seen = clip(seed)
    readout = share * float(np.median(np.diff(t)))
    row = np.repeat(rng.uniform(-0.5, 0.5, (6, 1)), len(t), 1)
    p, v, a = rng.normal(size=(3, 6, 1, 3))

    def path(s):
        return p + v * s + a * s**2

    taken, now = (t - t[0] + readout * row)[..., None], (t - t[0])[None, :, None]
    done = at_frame_times(TrackSet(path(taken), seen, timestamps=t, uv=at_rows(row), camera=camera(readout)))
    between = seen & (np.cumsum(seen, 1) > 1) & (np.cumsum(seen, 1) < seen.sum(1, keepdims=True))
    np.testing.assert_allclose(done.xyz[between], path(now)[between], atol=1e-12, rtol=0)


def gains(row: np.ndarray, readout: float) -> np.ndarray:
    """How much white noise of the samples of one track, at ``row`` (T,), is amplified in each: (T,)."""
    T = len(row)
    impulses = np.repeat(np.eye(T)[..., None], 3, 2)
    tracks = TrackSet(impulses, fps=FPS, uv=at_rows(np.tile(row, (T, 1))), camera=camera(readout))
    weights = at_frame_times(tracks).xyz[..., 0]
    np.testing.assert_allclose(weights.sum(0), 1, atol=1e-12)
    return np.linalg.norm(weights, axis=0)


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_noise_is_not_amplified_but_at_ends(share):
    readout = share / FPS
    for row in np.linspace(-0.5, 0.5, 11):
        still = gains(np.full(9, row), readout)
        assert still[1:-1].min() > 0.84 and still[1:-1].max() <= 1 + 1e-12
        assert still.max() <= np.hypot(1 + share / 2, share / 2) + 1e-12  # 1.58 for a whole frame
    rng = np.random.default_rng(0)
    for step in 0.05 * rng.uniform(-1, 1, (50, 9)):
        crossing = np.clip(rng.uniform(-0.5, 0.5) + np.cumsum(step), -0.5, 0.5)
        assert gains(crossing, readout)[1:-1].max() <= 1.06


def test_a_track_that_leaps_across_the_image_does_not_blow_up():
    row = np.where(np.arange(20) % 2, 0.5, -0.5)
    assert gains(row, 1 / FPS).max() < 2.2
    assert gains(-row, 1 / FPS).max() < 2.2


def test_rows_come_from_positions_where_no_pixels_are_given():
    rng = np.random.default_rng(1)
    xyz = rng.normal(size=(5, 20, 3)) * 0.3 + [0, 0, 3]
    who = camera(0.03)
    bare = TrackSet(xyz, fps=FPS, camera=who)
    both = replace(bare, uv=who.project(xyz))
    np.testing.assert_array_equal(rows(bare, who), rows(both, who))
    np.testing.assert_array_equal(at_frame_times(bare).xyz, at_frame_times(both).xyz)


def test_rows_are_those_of_the_distorted_image():
    lens = camera(0.03, distortion=np.array([-0.3, 0.1, 0.001, -0.002, 0.0]))
    uv = np.random.default_rng(2).uniform([20, 20], [W - 20, H - 20], (4, 10, 2))
    tracks = TrackSet(None, uv=uv, fps=FPS, camera=lens)
    seen = distort(lens, uv)[..., 1]
    assert np.abs(seen - uv[..., 1]).max() > 3
    np.testing.assert_allclose(rows(tracks, lens), np.clip(seen / H - 0.5, -0.5, 0.5))
    np.testing.assert_allclose(undistort(lens, distort(lens, uv)), uv, atol=0.05)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_distortion_is_opencvs(count):
    import cv2

    rng = np.random.default_rng(count)
    lens = camera(distortion=rng.uniform(-0.05, 0.05, count))
    uv = rng.uniform([0, 0], [W, H], (40, 2))
    ideal = np.concatenate([uv, np.ones((40, 1))], 1) @ np.linalg.inv(K).T
    want = cv2.projectPoints(ideal, np.zeros(3), np.zeros(3), K, lens.distortion)[0][:, 0]
    np.testing.assert_allclose(distort(lens, uv), want, atol=1e-9)
    assert np.isnan(distort(lens, np.full((2, 2), np.nan))).all()
    assert distort(camera(), uv) is uv


def test_a_moving_cameras_wobble_is_undone():
    """Points that stand still, filmed while driving past: each row lifted with its frame's pose puts them elsewhere."""
    rng = np.random.default_rng(3)
    middle = np.array([0, 0, 4])
    points = middle + rng.uniform(-1, 1, (8, 3))
    t, readout = np.arange(15) / FPS, 0.03
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))

    def w2c(seconds: np.ndarray) -> np.ndarray:
        pose = np.tile(np.eye(4), (*seconds.shape, 1, 1))
        pose[..., :3, :3] = turn
        pose[..., :3, 3] = middle - turn @ middle - seconds[..., None] * [2.0, 0.5, 0.0]
        return pose

    who = camera(readout, w2c(t))
    taken = np.broadcast_to(t, (8, 15))
    for _ in range(30):
        poses = w2c(taken)
        local = np.einsum("ntij,nj->nti", poses[..., :3, :3], points) + poses[..., :3, 3]
        uv = (local[..., :2] / local[..., 2:]) @ K[:2, :2].T + K[:2, 2]
        taken = t + readout * (uv[..., 1] / H - 0.5)
    lifted = TrackSet(who.to_world(local), fps=FPS, uv=uv, camera=who)
    assert np.abs(lifted.xyz - points[:, None]).max() > 0.01
    done = at_frame_times(lifted)
    np.testing.assert_allclose(done.xyz, np.repeat(points[:, None], 15, 1), atol=1e-9)
    # the pixels are those that the frame's own pose sees
    np.testing.assert_allclose(done.uv, who.project(np.repeat(points[:, None], 15, 1)), atol=1e-6)


def test_to_world_inverts_to_camera():
    tracks, _ = simulate("boxes", videos=1, tracks=5, frames=4, effects=())
    one = tracks[0].camera
    moving = replace(one, w2c=np.repeat(one.w2c[None], 4, 0))
    for who in (one, moving):
        np.testing.assert_allclose(who.to_world(who.to_camera(tracks[0].xyz)), tracks[0].xyz, atol=1e-12)


def test_a_readout_longer_than_a_frame_is_refused():
    tracks = TrackSet(np.ones((2, 5, 3)), features=np.eye(2), fps=FPS, camera=camera(20.0), name="left")
    with pytest.raises(ValueError, match=r"camera.readout of 'left'.*0.0333.*20.*milliseconds"):
        at_frame_times(tracks)
    with pytest.raises(ValueError, match=r"camera.readout"):
        synchronize([tracks, tracks])


def test_no_track_one_frame_and_points_behind_the_camera_pass():
    none = at_frame_times(TrackSet(np.ones((0, 5, 3)), fps=FPS, camera=camera()))
    assert len(none) == 0 and none.camera.readout is None
    one = at_frame_times(TrackSet(np.ones((2, 1, 3)), fps=FPS, camera=camera()))
    assert one.camera.readout is None and (one.xyz == 1).all()
    behind = TrackSet(np.ones((2, 5, 3)) * [1, 1, -1], fps=FPS, camera=camera())
    assert (at_frame_times(behind).xyz == behind.xyz).all()


def test_simulated_rows_come_back_to_the_frame():
    world = {"motion": "football", "videos": 1, "tracks": 200, "seed": 5}
    (exact,), _ = simulate(effects=(), **world)
    (rolled,), _ = simulate(effects=(RollingShutter(0.03),), **world)
    done = at_frame_times(rolled)
    for field, visible in (("xyz", 0.02), ("uv", 5.0)):
        before, after = (np.abs(getattr(t, field) - getattr(exact, field)) for t in (rolled, done))
        assert before.max() > visible
        assert np.median(after) < 0.03 * np.median(before) and after.mean() < 0.05 * before.mean()


def undeclared(tracks: TrackSet) -> TrackSet:
    return replace(tracks, camera=replace(tracks.camera, readout=None))


def rolling_pair(seed: int = 3):
    effects = (RollingShutter((0.01, 0.03)), LateralJitter(0.003))
    tracks, truth = simulate("tennis", effects=effects, offsets=[0, 0.37], tracks=60, frames=100, seed=seed)
    return tracks, truth


def test_every_verb_undoes_it_and_none_twice():
    tracks, truth = rolling_pair()
    done = [at_frame_times(t) for t in tracks]
    given = truth.matches(0, 1)
    assert np.array_equal(match(*tracks, throw=False).pairs, match(*done, throw=False).pairs)
    raw, clean = align(*tracks, given, throw=False), align(*done, given, throw=False)
    assert raw.offset == clean.offset and np.array_equal(raw.curve, clean.curve)
    assert refine(*tracks, given, raw, throw=False).offset == refine(*done, given, clean, throw=False).offset
    assert np.array_equal(synchronize(tracks).seconds, synchronize(done).seconds)
    assert content_key(tracks[0]) != content_key(replace(tracks[0], camera=done[0].camera))


def test_lifting_takes_the_images_pixels_and_returns_frames():
    """Depth and pixels of every row at its time; what comes back is the moving point at the frames' times."""
    (exact,), _ = simulate("juggle", videos=1, tracks=60, effects=(), seed=4)
    (rolled,), _ = simulate("juggle", videos=1, tracks=60, effects=(RollingShutter(0.03),), seed=4)
    depth = rolled.camera.to_camera(rolled.xyz)[..., 2]
    lifted = Lift(smooth=0, jump=1.0)(replace(rolled, xyz=None), depth)
    assert lifted.camera.readout is None and len(lifted) == len(exact)
    before, after = (np.abs(t.xyz - exact.xyz).mean() for t in (rolled, lifted))
    assert after < 0.05 * before


def test_the_epipolar_route_sees_frames():
    """Pixels alone, cameras whose rows are read over 5 to 30 ms: the answer is that of global shutters."""
    declared, ignored = [], []
    for seed in range(4):
        world = {"offsets": [0, 0.21], "tracks": 60, "frames": 100, "seed": seed}
        rolled, truth = simulate("tennis", effects=(RollingShutter((0.005, 0.03)),), **world)
        exact, _ = simulate("tennis", effects=(), **world)
        answers = []
        for tracks in (exact, rolled, [undeclared(t) for t in rolled]):
            a, b = (replace(t, xyz=None) for t in tracks)
            given = truth.matches(0, 1, wrong=0.0)
            start = align(a, b, given, EpipolarScan(), throw=False)
            answers.append(refine(a, b, given, start, EpipolarRefine(), throw=False).offset * FPS)
        declared.append(abs(answers[1] - answers[0]))
        ignored.append(abs(answers[2] - answers[0]))
    assert max(declared) < 0.005 and np.mean(declared) < 0.1 * np.mean(ignored)
