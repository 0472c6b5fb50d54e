"""Worlds: the clock and camera conventions, what is random and what is not, the preset table, the truth."""

from __future__ import annotations

import doctest
import subprocess
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from otsync.simulate import MOTIONS, PRESETS, FeatureModel, Rig, Similarity, effects, matching_world, simulate
from otsync.simulate.body import Parts, euler, forward_kinematics, human, sample_surface, thing
from otsync.simulate.motions import Actor, Gesture, Wander, event_times
from otsync.simulate.observation import IDENTITY, stream

MOVING = ["boxes", "juggle", "softball", "tennis", "basketball", "football"]


def same(a, b):
    return all(
        np.array_equal(getattr(a, f), getattr(b, f), equal_nan=f != "visible")
        for f in ("xyz", "visible", "features", "uv")
    ) and np.array_equal(a.camera.w2c, b.camera.w2c)


# ---------------------------------------------------------------- clocks and cameras


@pytest.mark.parametrize("motion", MOTIONS)
def test_tracks_follow_the_world_at_rate_times_t_plus_offset(motion):
    stamps = np.sort(np.random.default_rng(0).uniform(0, 2, 40))
    tracks, truth = simulate(
        motion,
        videos=3,
        frames=[50, 60, stamps],
        fps=[30, 25, 50],
        offsets=[0.0, -0.7123, 1.31],
        rates=[1, 1.01, 0.98],
        effects=(),
        seed=5,
    )
    for v, t in enumerate([np.arange(50) / 30, np.arange(60) / 25, stamps]):
        assert tracks[v].visible.all()
        np.testing.assert_allclose(tracks[v].times, t)
        world = truth.rates[v] * t + truth.offsets[v]
        np.testing.assert_allclose(tracks[v].xyz, truth.positions(v, world), atol=1e-9)
    assert truth.offset(0, 1) == pytest.approx(-0.7123)
    assert truth.offset(2, 1) == pytest.approx(-0.7123 - 1.31)


def test_a_positive_offset_starts_later():
    """Frame k of a video that starts three frames late shows what the reference shows at k + 3."""
    tracks, truth = simulate("tennis", offsets=[0.0, 0.1], effects=(), seed=1)
    late = truth.positions(1, tracks[0].times)
    np.testing.assert_allclose(tracks[1].xyz[:, :-3], late[:, 3:], atol=1e-9)


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_world_is_continuous_at_every_real_time(motion):
    _, truth = simulate(motion, frames=2, tracks=60, effects=(), seed=2)
    t = np.sort(np.random.default_rng(1).uniform(-30, 60, 4000))
    step = 1e-4
    speed = np.linalg.norm(truth.positions(0, t + step) - truth.positions(0, t), axis=2) / step
    assert np.isfinite(speed).all()
    assert speed.max() < 25


@pytest.mark.parametrize("motion", MOVING)
def test_speeds_are_those_of_people(motion):
    speeds = []
    for seed in range(4):
        tracks, truth = simulate(motion, videos=1, effects=(), seed=seed)
        body = truth.scene.parts.figure[truth.surfaces[0].part]
        speeds.append(np.linalg.norm(np.diff(tracks[0].xyz[body], axis=1), axis=2) * 30)
    speed = np.concatenate(speeds)
    assert 0.05 < np.median(speed) < 1.6
    assert 0.4 < np.quantile(speed, 0.95) < 4.5
    assert speed.max() < 14


def test_static_moves_less_than_the_noise():
    tracks, _ = simulate("static", effects=(), seed=3)
    assert np.ptp(tracks[0].xyz, axis=1).max() < 0.02
    assert np.std(tracks[0].xyz, axis=1).max() < 0.006


def test_juggling_repeats_itself():
    """The hands come back after one cycle far better than after half of one."""
    _, truth = simulate("juggle", frames=2, tracks=400, effects=(), seed=4)
    t = np.arange(0, 6, 1 / 30)
    hands = truth.positions(0, t)[np.isin(truth.scene.parts.kind[truth.surfaces[0].part], (4, 5))].mean(0)
    z = hands[:, 2] - hands[:, 2].mean()
    x = truth.positions(0, t)[truth.surfaces[0].part == 5].mean(0)[:, 2]
    x = x - x.mean()
    lags = np.arange(5, 60)
    corr = np.array([np.corrcoef(x[:-k], x[k:])[0, 1] for k in lags])
    best = lags[corr.argmax()]
    assert corr.max() > 0.8
    assert 30 / 1.75 < best < 3.2 * 30 / 1.1
    assert np.isfinite(z).all()


def test_drawn_offsets_stay_within_the_largest():
    both = set()
    for seed in range(40):
        _, truth = simulate("boxes", videos=5, frames=3, fps=10, tracks=5, max_offset=7, seed=seed)
        assert truth.offsets[0] == 0
        assert np.ptp(truth.offsets) <= 0.7
        both.add(np.sign(truth.offsets[1]))
        assert len(set(np.round(truth.offsets * 10 % 1, 6))) > 2  # sub-frame
    assert both == {-1.0, 1.0}


def test_pixels_and_camera_agree_with_positions():
    tracks, truth = simulate("football", preset="hard", videos=3, seed=6)
    for v, t in enumerate(tracks):
        np.testing.assert_allclose(t.camera.project(t.xyz), t.uv, atol=1e-6)
        back = truth.frames[v].inverse()(np.nan_to_num(t.xyz))
        true = Rig().camera(truth.scene, v, truth.seed)
        np.testing.assert_allclose(true.project(back)[t.visible], t.uv[t.visible], atol=1e-6)


def test_depth_errors_leave_the_pixels_alone():
    along = (effects.DepthBias(0.1), effects.DepthDrift(0.05), effects.DepthJitter(0.03), effects.CameraDepthDrift(0.1))
    exact, _ = simulate("juggle", effects=(), seed=1)
    noisy, _ = simulate("juggle", effects=along, seed=1)
    np.testing.assert_allclose(noisy[0].uv, exact[0].uv, atol=1e-6)
    assert np.abs(noisy[0].xyz - exact[0].xyz).max() > 0.1
    lateral, _ = simulate("juggle", effects=(effects.LateralJitter(0.01),), seed=1)
    assert np.abs(lateral[0].uv - exact[0].uv).max() > 2


def test_tilted_cameras_see_the_scene_elsewhere_in_the_image():
    level, tilted = (simulate("juggle", videos=6, effects=(), rig=Rig(tilt=t), seed=1)[0] for t in (0.0, 12.0))
    up = []
    for a, b in zip(level, tilted, strict=True):
        np.testing.assert_allclose(a.camera.center, b.camera.center, atol=1e-9)
        np.testing.assert_allclose(a.camera.w2c[0, :3], b.camera.w2c[0, :3], atol=1e-9)  # about the image's horizontal
        up.append(np.degrees(np.arcsin(b.camera.w2c[2, 2]) - np.arcsin(a.camera.w2c[2, 2])))
    assert np.abs(up).max() <= 12 and min(up) < -2 and max(up) > 2


def test_cameras_stand_on_a_circle_and_look_at_the_scene():
    tracks, _ = simulate("juggle", videos=4, effects=(), rig=Rig(angle=30, spread=0, distance=5), seed=0)
    centers = np.array([t.camera.center for t in tracks])
    np.testing.assert_allclose(np.linalg.norm(centers[:, :2], axis=1), 5)
    turn = np.degrees(np.diff(np.unwrap(np.arctan2(centers[:, 1], centers[:, 0]))))
    np.testing.assert_allclose(turn, 30)
    for t in tracks:
        np.testing.assert_allclose(t.camera.project(np.array([[[0.0, 0, 1]]]))[0, 0], t.camera.K[:2, 2], atol=1e-9)
        head, feet = t.camera.project(np.array([[[0.0, 0, 1.7], [0, 0, 0]]]))[0]
        assert head[1] < feet[1]  # y points down
        assert ((t.uv > 0) & (t.uv < [1280, 720])).mean() > 0.99


def test_a_video_sees_what_faces_it():
    tracks, _ = simulate("boxes", tracks=300, effects=(effects.Occlusion(),), seed=2)
    assert np.mean([t.visible.mean() for t in tracks]) > 0.8
    assert not tracks[0].visible.all()
    a, b = (simulate("static", tracks=300, effects=(), rig=Rig(angle=180), seed=2)[1].surfaces[v] for v in (0, 1))
    # opposite cameras see opposite sides of the chest
    chest = [s.local[s.part == 1].mean(0) for s in (a, b)]
    assert np.dot(chest[0][:2], chest[1][:2]) < 0


# ---------------------------------------------------------------- randomness


def test_same_seed_same_bits_whatever_the_number_of_videos():
    few, truth = simulate("basketball", preset="brutal", videos=2, seed=11)
    many, more = simulate("basketball", preset="brutal", videos=5, seed=11)
    other, _ = simulate("basketball", preset="brutal", videos=2, seed=12)
    assert same(few[0], many[0]) and same(few[1], many[1])
    assert not same(few[0], other[0])
    assert truth.offsets[1] == more.offsets[1]
    assert np.array_equal(truth.matches(0, 1).pairs, more.matches(0, 1).pairs)


@dataclass(frozen=True)
class Spy:
    """Notes what its stream would give."""

    heard: list

    def __call__(self, obs, rng):
        self.heard.append(rng.random(5).tolist())
        return obs


def test_the_absence_of_an_effect_changes_no_bit_of_the_others():
    heard: list = []
    every = PRESETS["brutal"].effects
    variants = [(), every, every[:3], every[3:], every[::-1]]
    for some in variants:
        simulate("boxes", videos=2, effects=(*some, Spy(heard)), seed=3)
    assert all(h == heard[i % 2] for i, h in enumerate(heard))
    assert heard[0] != heard[1]
    # an effect does the same wherever it stands, when what it works on is the same
    exact, _ = simulate("boxes", effects=(), seed=3)
    gaps, _ = simulate("boxes", effects=(effects.Gaps(0.3),), seed=3)
    later, _ = simulate("boxes", effects=(effects.LateralJitter(0.01), effects.Gaps(0.3)), seed=3)
    assert np.array_equal(gaps[0].visible, later[0].visible)
    seen = gaps[0].visible
    assert np.array_equal(gaps[0].xyz[seen], exact[0].xyz[seen])


@pytest.mark.parametrize(
    "nothing",
    [
        effects.DepthBias(0),
        effects.DepthDrift(0),
        effects.CameraDepthDrift(0),
        effects.DepthJitter(0),
        effects.LateralJitter(0),
        effects.PositionNoise(0),
        effects.SlowDrift(0),
        effects.LimbDrift(0),
        effects.Gaps(0),
        effects.RayCompression(1, 1),
        effects.IdentitySwitch(0),
        effects.Smoothing(0),
        effects.Outliers(0),
        effects.Hallucination(0),
        effects.ClockDrift(0),
        effects.ClockRamp(0),
        effects.ClockSway(0),
    ],
    ids=lambda e: type(e).__name__,
)
def test_an_effect_of_no_strength_changes_no_bit(nothing):
    assert isinstance(nothing, effects.Effect)
    exact, _ = simulate("tennis", effects=(), seed=8)
    tracks, _ = simulate("tennis", effects=(nothing,), seed=8)
    assert all(same(a, b) for a, b in zip(exact, tracks, strict=True))


def test_repeated_effects_draw_anew():
    once, _ = simulate("boxes", effects=(effects.SlowDrift(0.1),), seed=1)
    twice, _ = simulate("boxes", effects=(effects.SlowDrift(0.1),) * 2, seed=1)
    exact, _ = simulate("boxes", effects=(), seed=1)
    first, both = once[0].xyz - exact[0].xyz, twice[0].xyz - exact[0].xyz
    assert abs(np.corrcoef(first.ravel(), (both - first).ravel())[0, 1]) < 0.2


# ---------------------------------------------------------------- presets and truth

#: bias, drift, camera drift, jitter, lateral, slow drift, frame, gaps, wrong, matches, features of the promised levels
TABLE = {
    "clean": (0.005, 0.002, 0, 0.001, 0.001, 0.002, (0, 0, 0), 0, 0, 120, 0.15),
    "mid": (0.02, 0.008, 0.004, 0.005, 0.003, 0.008, (0.01, 1, 0.03), 0.20, 0.15, 100, 0.35),
    "hard": (0.04, 0.02, 0.01, 0.012, 0.006, 0.015, (0.02, 1.5, 0.06), 0.35, 0.4, 60, 0.6),
    "brutal": (0.05, 0.025, 0.012, 0.015, 0.008, 0.02, (0.03, 2, 0.09), 0.15, 0.4, 60, 0.6),
}


@pytest.mark.parametrize("name", TABLE)
def test_presets_are_the_table(name):
    p = PRESETS[name]
    have = {type(e): e for e in p.effects}
    assert len(have) == len(p.effects)
    bias, drift, shared, jitter, lateral, slow, frame, gaps, wrong, n, noise = TABLE[name]
    want = {
        effects.DepthBias(bias),
        effects.DepthDrift(drift, 1.0),
        effects.CameraDepthDrift(shared, 1.2),
        effects.DepthJitter(jitter),
        effects.LateralJitter(lateral),
        effects.SlowDrift(slow, 1.2),
        effects.Gaps(gaps),
        effects.CameraFrame(*frame),
    }
    if name == "clean":
        want -= {effects.CameraDepthDrift(0, 1.2), effects.Gaps(0), effects.CameraFrame(0, 0, 0)}
    if name == "brutal":
        want |= {
            effects.RayCompression(0.5, 1.0),
            effects.LimbDrift(0.05, 0.8),
            effects.IdentitySwitch(0.3),
            effects.Hallucination(0.3),
            effects.Smoothing(2.5 / 30, 0.6, 1.4),
        }
    assert set(p.effects) == want
    assert (p.wrong, p.matches, p.features) == (wrong, n, FeatureModel(noise=noise))
    gap = have.get(effects.Gaps)
    assert gap is None or (gap.shortest, gap.longest) == (8 / 30, 45 / 30)


@pytest.mark.parametrize("preset", PRESETS)
def test_matches_are_the_nearest_of_the_limb_or_of_another_limb(preset):
    tracks, truth = simulate("basketball", preset=preset, videos=3, seed=9)
    m = truth.matches(0, 2)
    a, b = truth.surfaces[0], truth.surfaces[2]
    assert abs(len(m) - PRESETS[preset].matches) <= 0.1 * PRESETS[preset].matches
    assert len(np.unique(m.pairs[:, 0])) == len(m)
    assert np.ptp(m.score) == 0
    wrong = 0
    for i, j in m.pairs:
        if a.part[i] != b.part[j]:
            wrong += 1
            continue
        distance = np.linalg.norm(b.position - a.position[i], axis=1)
        distance[b.part != a.part[i]] = np.inf
        assert j == distance.argmin() and distance[j] <= 0.15
    assert wrong == round(PRESETS[preset].wrong * len(m))
    m.check("m", len(tracks[0]), len(tracks[2]))


def test_matches_mirror_and_follow_their_arguments():
    _, truth = simulate("tennis", preset="mid", videos=2, seed=1)
    m = truth.matches(0, 1, wrong=0.5, n=30)
    assert len(m) == 30
    parts = [s.part for s in truth.surfaces]
    assert (parts[0][m.pairs[:, 0]] != parts[1][m.pairs[:, 1]]).sum() == 15
    assert np.array_equal(truth.matches(1, 0, wrong=0.5, n=30).pairs, m.pairs[:, ::-1])
    assert np.array_equal(truth.matches(0, 1, wrong=0.5, n=30).pairs, m.pairs)
    assert not np.array_equal(truth.matches(0, 1, wrong=0.5, n=30, seed=99).pairs, m.pairs)
    assert len(truth.matches(0, 1, n=0)) == 0
    right, all_wrong = truth.matches(0, 1, wrong=0), truth.matches(0, 1, wrong=1)
    assert (parts[0][right.pairs[:, 0]] == parts[1][right.pairs[:, 1]]).all()
    assert (parts[0][all_wrong.pairs[:, 0]] != parts[1][all_wrong.pairs[:, 1]]).all()


def test_features_know_the_limb_but_hardly_the_side():
    tracks, truth = simulate("boxes", preset="clean", tracks=400, seed=2)
    F = [t.features for t in tracks]
    for f in F:
        np.testing.assert_allclose(np.linalg.norm(f, axis=1), 1)
    similarity = (F[0] - F[0].mean(0)) @ (F[1] - F[1].mean(0)).T
    a, b = truth.surfaces
    d = np.linalg.norm(a.position[:, None] - b.position, axis=2)
    mirror = np.linalg.norm(a.mirrored[:, None] - b.position, axis=2)
    near, flipped, far = d < 0.05, (mirror < 0.05) & (d > 0.3), (d > 0.6) & (mirror > 0.6)
    assert similarity[near].mean() > similarity[flipped].mean() > similarity[far].mean() + 0.2
    assert similarity[near].mean() - similarity[flipped].mean() < 0.1
    assert PRESETS["clean"].features.dim == F[0].shape[1] == 128


# ---------------------------------------------------------------- the matching world


def test_matching_world_is_what_the_study_describes():
    a, b, truth = matching_world(1000, seed=1, n_b=700, frames=60)
    assert (len(a), len(b), a.n_frames) == (1000, 700, 60)
    assert a.xyz.dtype == a.features.dtype == np.float32
    assert a.frame is b.frame is None
    parts: Parts = truth.scene.parts
    assert len(parts) == 17 and parts.figure.sum() == 15
    for t, s in zip((a, b), truth.surfaces, strict=True):
        assert (s.part < 0).sum() == round(0.2 * len(t))
        v = truth.surfaces.index(s)
        back = truth.frames[v].inverse()(t.xyz)
        error = back - truth.positions(v, t.times)
        real = s.part >= 0
        assert np.std(error[real]) == pytest.approx(0.01 * truth.size, rel=0.03)
        still = np.std(t.xyz, axis=1).max(1) < 1e-4
        assert still.sum() == round(0.1 * len(t)) and not real[still].any()
    # frames differ, and are rigid
    assert np.linalg.norm(truth.frames[0].t - truth.frames[1].t) > 0.1
    assert truth.frames[0].scale == 1
    np.testing.assert_allclose(truth.frames[0].R @ truth.frames[0].R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(truth.frames[0].R) == pytest.approx(1)


def test_matching_world_floaters_copy_features():
    a, _, _ = matching_world(500, seed=2, frames=20)
    unique = np.unique(a.features.round(5), axis=0)
    assert len(unique) >= 440
    assert 500 - len(unique) > 35  # half of 20 % are copies


def test_matching_world_without_a_side_cue_is_symmetric():
    """Without noise, view and cue, a point and its mirror image look alike."""
    quiet = FeatureModel(view=0, shift=0, noise=0, person=0)
    a, _, truth = matching_world(400, seed=3, left_right=0.0, outliers=0.0, features=quiet, frames=5, shared_frame=True)
    c, _, _ = matching_world(400, seed=3, left_right=0.5, outliers=0.0, features=quiet, frames=5)
    s = truth.surfaces[0]
    mirror = np.linalg.norm(s.mirrored[:, None] - s.position, axis=2)
    i, j = np.nonzero(mirror < 0.02)
    kind = truth.scene.parts.kind[s.part]
    far = (np.abs(s.position[i, 0]) > 0.1) & (kind[i] == kind[j]) & (s.object[i] == 0)
    i, j = i[far], j[far]
    assert len(i) > 5
    assert (a.features[i] * a.features[j]).sum(1).min() > 0.98
    assert (c.features[i] * c.features[j]).sum(1).max() < 0.95
    assert a.frame == "world"


# ---------------------------------------------------------------- bodies, motions, maths


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_euler_is_scipys(angles):
    np.testing.assert_allclose(euler(np.array(angles)), Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-12)


def test_limbs_are_rigid_and_joined():
    _, truth = simulate("tennis", frames=2, tracks=5, effects=(), seed=0)
    R, p = truth.scene.pose(np.linspace(-2, 8, 50))
    np.testing.assert_allclose(R @ R.swapaxes(-1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    elbow = p[3] + np.einsum("tij,j->ti", R[3], [0, 0, -0.28 * np.linalg.norm(p[4] - p[3], axis=1)[0] / 0.28])
    np.testing.assert_allclose(elbow, p[4], atol=1e-9)
    rest = human(0)
    tall = np.ptp(rest.rest_position[:, 2])
    assert 1.3 < tall < 1.6  # joints from ankle to neck
    np.testing.assert_allclose(rest.rest_position[3:9] * [-1, 1, 1], rest.rest_position[9:15], atol=1e-12)


def test_size_scales_the_whole_figure():
    angles, root = np.zeros((1, 15, 3)), np.zeros((1, 3))
    one, big = (forward_kinematics(angles, root, np.zeros(1), size)[1] for size in (1.0, 1.2))
    np.testing.assert_allclose(big, 1.2 * one)
    assert np.linalg.norm(one[7] - one[6]) == pytest.approx(0.42)


def test_lasting_gestures_add_up_however_long_ago():
    still = Wander(np.random.default_rng(0), 45, 0.0, 0.1, 1), Wander(np.random.default_rng(0), 2, 0.0, 0.1, 1)
    nod = Gesture(2, 0, 0.3, delay=0.0, width=0.2, lasting=True), Gesture(1, 0, 0.5, delay=0.0, width=0.2)
    actor = Actor(np.zeros((15, 3)), still[0], still[1], still[0], events=np.array([1.0, 5.0, 9.0]), gestures=nod)
    R = actor(np.array([40.0]))[0]
    np.testing.assert_allclose(R[2, 0], Rotation.from_euler("x", -0.9).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(R[1, 0], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(actor(np.array([0.0, 5.0, 40.0]))[0][:, -1], R[:, 0], atol=1e-9)
    np.testing.assert_allclose(actor(np.array([5.0]))[0][1, 0], Rotation.from_euler("x", -0.5).as_matrix(), atol=1e-9)


def test_surface_points_lie_on_the_surface_evenly():
    ball, box = thing(0, 0, (0.3, 0.3, 0.3)), thing(1, 1, (0.1, 0.2, 0.3), box=True)
    rng = np.random.default_rng(0)
    _, x, n = sample_surface(ball, 20_000, rng)
    np.testing.assert_allclose(np.linalg.norm(x, axis=1), 0.3)
    np.testing.assert_allclose(x, 0.3 * n, atol=1e-12)
    np.testing.assert_allclose(np.cov(x.T), 0.03 * np.eye(3), atol=0.002)
    _, x, n = sample_surface(box, 30_000, rng)
    on = np.abs(np.abs(x) - [0.1, 0.2, 0.3]) < 1e-12
    assert (on.sum(1) == 1).all() and (np.abs(n) == on).all() and (np.sign(x[on]) == n[on]).all()
    np.testing.assert_allclose(on.mean(0), [6 / 11, 3 / 11, 2 / 11], atol=0.01)
    parts = human(0)
    part, x, n = sample_surface(parts, 5000, rng)
    forearm = part == 4
    axis = np.clip(x[forearm][:, 2], -0.24, -0.02)
    away = x[forearm] - np.c_[np.zeros((forearm.sum(), 2)), axis]
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.04, atol=1e-9)
    np.testing.assert_allclose(away, 0.04 * n[forearm], atol=1e-9)


def test_wander_has_the_scale_and_derivative_it_says():
    w = Wander(np.random.default_rng(3), 4, np.array([0.1, 1, 2, 0]), 0.2, 2.0)
    t = np.linspace(0, 4000, 200_001)
    np.testing.assert_allclose(w(t).std(0), [0.1, 1, 2, 0], rtol=0.02)
    t = np.linspace(0, 3, 50)
    np.testing.assert_allclose(w.speed(t), (w(t + 1e-6) - w(t - 1e-6)) / 2e-6, atol=1e-5)


def test_events_recur_on_both_sides():
    e = event_times(np.random.default_rng(0), (2, 3), (4, 5))
    gaps = np.diff(e)
    assert ((gaps >= 4) & (gaps <= 5)).all()
    assert ((e >= 2) & (e <= 3)).sum() == 1
    assert e[0] < -50 and e[-1] > 60


@settings(max_examples=25)
@given(st.integers(0, 1000))
def test_similarities_compose_and_invert(seed):
    rng = np.random.default_rng(seed)
    f, g = (
        Similarity(rng.uniform(0.5, 2), Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3))
        for _ in range(2)
    )
    x = rng.normal(size=(4, 3, 3))
    np.testing.assert_allclose(f.after(g)(x), f(g(x)), atol=1e-12)
    np.testing.assert_allclose(f.inverse()(f(x)), x, atol=1e-12)
    assert np.array_equal(IDENTITY(x), x)


def test_streams_depend_on_every_word_of_their_key():
    draws = {stream(s, *k).random() for s in (0, 1) for k in ((), (0,), (1,), ("a",), (0, "a"), ("a", 0), (0, "b"))}
    assert len(draws) == 14


def test_importing_the_simulator_loads_nothing_heavy():
    code = "import sys, otsync.simulate, otsync.metrics; print(*{m.split('.')[0] for m in sys.modules})"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "scipy" in out and not {"torch", "ot", "tslearn", "numba", "matplotlib"} & set(out)


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"motion": "ballet"}, "motion"),
        ({"preset": "easy"}, "preset"),
        ({"videos": 0}, "videos"),
        ({"frames": 0}, "frames"),
        ({"frames": 2.5}, "frames"),
        ({"frames": [10]}, "frames"),
        ({"frames": [10, [0.0, 0.0]]}, "frames"),
        ({"frames": [10, [0.0, np.nan]]}, "frames"),
        ({"fps": 0}, "fps"),
        ({"fps": [30, np.nan]}, "fps"),
        ({"fps": [30]}, "fps"),
        ({"tracks": 0}, "tracks"),
        ({"tracks": [5]}, "tracks"),
        ({"offsets": [0, np.inf]}, "offsets"),
        ({"offsets": [0]}, "offsets"),
        ({"rates": [1, 0]}, "rates"),
        ({"max_offset": -1}, "max_offset"),
        ({"seed": -1}, "seed"),
    ],
)
def test_bad_arguments_are_named(arguments, name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        simulate(**{"motion": "boxes", **arguments})


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda t: t.matches(0, 0), "a, b"),
        (lambda t: t.matches(0, 1, wrong=1.5), "wrong"),
        (lambda t: t.matches(0, 1, n=-1), "n"),
        (lambda t: matching_world(0), "n"),
        (lambda t: matching_world(10, n_b=0), "n_b"),
        (lambda t: matching_world(10, outliers=1), "outliers"),
    ],
)
def test_bad_questions_are_named(call, name):
    _, truth = simulate("static", frames=3, tracks=9, seed=0)
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        call(truth)


def test_the_examples_in_the_docstrings_run():
    for module in ("world", "matching"):
        failed, tried = doctest.testmod(sys.modules[f"otsync.simulate.{module}"])
        assert tried and not failed


def test_a_scene_of_your_own_and_a_changed_preset():
    _, truth = simulate("boxes", seed=0)
    level = replace(PRESETS["mid"], features=None, matches=20)
    tracks, again = simulate(truth.scene, preset=level, seed=1)
    assert tracks[0].features is None and len(tracks[0]) == 32
    assert again.scene is truth.scene and len(again.matches(0, 1)) <= 20
