"""Effects: each does to positions, visibility and clocks what its docstring says, by the amount it says."""

from __future__ import annotations

import numpy as np
import pytest

from otsync.simulate import effects, simulate
from otsync.simulate.effects.noise import smooth_noise


def with_and_without(*some, motion="softball", **world):
    exact, truth = simulate(motion, effects=(), **world)
    worse, after = simulate(motion, effects=some, **world)
    return exact[0], worse[0], truth, after


def rays(tracks):
    ray = tracks.xyz - tracks.camera.center
    return ray, np.linalg.norm(ray, axis=2, keepdims=True)


def along_and_across(exact, worse):
    """Relative error of depth (N,T), and what remains (N,T,3)."""
    ray, depth = rays(exact)
    error = worse.xyz - exact.xyz
    along = (error * ray).sum(2) / depth[..., 0] ** 2
    return along, error - along[..., None] * ray


def test_smooth_noise_has_unit_variance_and_the_stated_correlation():
    t = np.sort(np.random.default_rng(0).uniform(0, 6, 120))  # any times
    x = smooth_noise((20_000,), t, 1.2, np.random.default_rng(1), np.float64)
    np.testing.assert_allclose(x.std(0), 1, atol=0.03)
    want = np.exp(-0.5 * ((t[:, None] - t) / 1.2) ** 2)
    np.testing.assert_allclose(np.cov(x.T), want, atol=0.04)


def test_depth_bias_is_constant_along_the_ray():
    exact, worse, *_ = with_and_without(effects.DepthBias(0.03), tracks=2000, frames=10)
    along, across = along_and_across(exact, worse)
    assert np.abs(across).max() < 1e-12
    assert np.ptp(along, axis=1).max() < 1e-12
    assert along.std() == pytest.approx(0.03, rel=0.06)


def test_depth_drifts_and_jitter():
    exact, worse, *_ = with_and_without(effects.DepthDrift(0.02, 1.0), tracks=600)
    along, across = along_and_across(exact, worse)
    assert np.abs(across).max() < 1e-12
    assert along.std() == pytest.approx(0.02, rel=0.1)
    lag = np.mean(along[:, :-30] * along[:, 30:]) / np.mean(along**2)
    assert lag == pytest.approx(np.exp(-0.5), abs=0.08)
    exact, worse, *_ = with_and_without(effects.CameraDepthDrift(0.02), tracks=30)
    along, _ = along_and_across(exact, worse)
    assert np.ptp(along, axis=0).max() < 1e-12 and along[0].std() > 1e-3
    exact, worse, *_ = with_and_without(effects.DepthJitter(0.01), tracks=300)
    along, across = along_and_across(exact, worse)
    assert np.abs(across).max() < 1e-12
    assert along.std() == pytest.approx(0.01, rel=0.03)
    assert abs(np.mean(along[:, 1:] * along[:, :-1])) < 0.03 * np.mean(along**2)


def test_lateral_jitter_is_across_the_ray():
    exact, worse, *_ = with_and_without(effects.LateralJitter(0.005), tracks=300)
    along, across = along_and_across(exact, worse)
    assert np.abs(along).max() < 1e-9
    assert np.sqrt((across**2).sum(2).mean() / 2) == pytest.approx(0.005, rel=0.02)


def test_drifts_of_tracks_and_limbs():
    exact, worse, *_ = with_and_without(effects.SlowDrift(0.02, 1.2), tracks=500)
    error = worse.xyz - exact.xyz
    np.testing.assert_allclose(error.std((0, 1)), 0.02, rtol=0.1)
    assert np.abs(np.diff(error, axis=1)).max() < 0.01
    exact, worse, truth, _ = with_and_without(effects.LimbDrift(0.05, 0.8), tracks=200, motion="basketball")
    error, part = worse.xyz - exact.xyz, truth.surfaces[0].part
    means = []
    for p in np.unique(part):
        assert np.ptp(error[part == p], axis=0).max() < 1e-12
        means.append(error[part == p][0])
    assert np.std(means) == pytest.approx(0.05, rel=0.2)


def test_ray_compression_keeps_a_factor_of_the_depth_motion():
    exact, worse, truth, _ = with_and_without(effects.RayCompression(0.5, 0.9), tracks=200, motion="boxes")
    before, after = rays(exact)[1][..., 0], rays(worse)[1][..., 0]
    _, across = along_and_across(exact, worse)
    assert np.abs(across).max() < 1e-9
    part = truth.surfaces[0].part
    moved = before - before.mean(1, keepdims=True)
    factor = ((after - after.mean(1, keepdims=True)) * moved).sum(1) / (moved**2).sum(1)
    assert (factor > 0.5 - 1e-9).all() and (factor < 0.9 + 1e-9).all()
    for p in np.unique(part):
        assert np.ptp(factor[part == p]) < 1e-9
    assert np.ptp(factor) > 0.1


def test_identity_switches_once_to_another_part():
    exact, worse, truth, _ = with_and_without(effects.IdentitySwitch(0.3), tracks=400)
    changed = (worse.xyz != exact.xyz).any(2)
    switched = changed.any(1)
    assert switched.mean() == pytest.approx(0.3, abs=0.07)
    part = truth.surfaces[0].part
    for i in np.flatnonzero(switched):
        k = changed[i].argmax()
        assert 30 <= k < 120 and changed[i, k:].all()
        others = np.flatnonzero((exact.xyz[:, k:] == worse.xyz[i, k:]).all((1, 2)))
        assert len(others) == 1 and part[others[0]] != part[i]


def test_smoothing_is_a_gaussian_filter():
    exact, worse, *_ = with_and_without(effects.Smoothing(0.1, 1, 1), tracks=20)
    from scipy.ndimage import gaussian_filter1d

    want = gaussian_filter1d(exact.xyz, 3.0, axis=1, truncate=12)
    np.testing.assert_allclose(worse.xyz[:, 40:-40], want[:, 40:-40], atol=1e-9)
    # hidden samples have no say
    _, smooth, *_ = with_and_without(effects.Gaps(0.3), effects.Smoothing(0.1, 1, 1), tracks=20)
    assert np.isfinite(smooth.xyz[smooth.visible]).all() and not smooth.visible.all()


@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_gaps_take_their_share_in_runs_of_the_stated_length(fps):
    _, worse, *_ = with_and_without(effects.Gaps(0.35), tracks=1500, frames=int(10 * fps), fps=fps)
    hidden = ~worse.visible
    assert hidden.mean() == pytest.approx(0.35, abs=0.015)
    np.testing.assert_allclose(hidden.mean(0), 0.35, atol=0.05)  # also at the ends
    edges = np.diff(np.pad(hidden, ((0, 0), (1, 1))).astype(int), axis=1)
    starts, ends = np.nonzero(edges == 1), np.nonzero(edges == -1)
    inside = (starts[1] > 0) & (ends[1] < hidden.shape[1])
    runs = (ends[1] - starts[1])[inside] / fps
    assert runs.min() >= 8 / 30 - 1 / fps
    assert np.quantile(runs, 0.5) == pytest.approx(26.5 / 30, abs=0.1)
    assert np.isnan(worse.xyz[hidden]).all() and np.isfinite(worse.xyz[~hidden]).all()
    assert worse.visible.any(1).all()


def test_short_clips_keep_every_track():
    _, worse, *_ = with_and_without(effects.Gaps(0.6), tracks=300, frames=12)
    assert worse.visible.any(1).all()
    one, _ = simulate("boxes", effects=(effects.Gaps(0.5),), frames=1, tracks=5)
    assert one[0].visible.all()


def test_hallucinations_go_straight_and_are_reported_as_seen():
    exact, worse, *_ = with_and_without(effects.Hallucination(0.3), tracks=400)
    invented = (worse.xyz != exact.xyz).any(2)
    assert worse.visible.all()
    assert invented.mean() == pytest.approx(0.3, abs=0.03)
    for i in np.flatnonzero(invented.any(1))[:50]:
        known = np.flatnonzero(~invented[i])
        for axis in range(3):
            want = np.interp(np.flatnonzero(invented[i]), known, exact.xyz[i, known, axis])
            np.testing.assert_allclose(worse.xyz[i, invented[i], axis], want, atol=1e-9)
    # samples that were missing before are invented too, and no anchor of a line
    _, both, *_ = with_and_without(effects.Gaps(0.3), effects.Hallucination(0.5), tracks=400)
    assert both.visible.mean() == pytest.approx(0.85, abs=0.03)
    assert np.isfinite(both.xyz[both.visible]).all()


def test_camera_frame_is_a_similarity_of_the_stated_size():
    scales, angles, shifts = [], [], []
    exact, _ = simulate("static", effects=(), frames=2, tracks=9)
    for seed in range(150):
        tracks, truth = simulate(
            "static", videos=1, effects=(effects.CameraFrame(0.02, 1.5, 0.06),), frames=2, tracks=9, seed=seed
        )
        f = truth.frames[0]
        np.testing.assert_allclose(f(truth.positions(0, tracks[0].times)), tracks[0].xyz, atol=1e-9)
        scales.append(f.scale - 1)
        angles.append(np.degrees(np.arccos(np.clip((np.trace(f.R) - 1) / 2, -1, 1))))
        shifts.append(f.t)
    assert np.std(scales) == pytest.approx(0.02, rel=0.2)
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(1.5, rel=0.2)
    np.testing.assert_allclose(np.std(shifts, axis=0), 0.06, rtol=0.25)
    assert np.array_equal(exact[0].camera.w2c.shape, (4, 4))


def test_outliers_are_static_or_float_and_belong_to_nothing():
    exact, worse, _, after = with_and_without(effects.Outliers(0.3, background=0.25), tracks=200)
    s = after.surfaces[0]
    out = s.part < 0
    assert out.sum() == 60 and (s.object[out] == -1).all() and np.isnan(s.position[out]).all()
    still = np.ptp(worse.xyz, axis=1).max(1) == 0
    assert still.sum() == 15 and out[still].all()
    assert np.array_equal(worse.xyz[~out], exact.xyz[~out])
    floating = out & ~still
    for i in np.flatnonzero(floating):
        assert (worse.features[~out] == worse.features[i]).all(1).sum() == 1
    assert (after.matches(0, 1, wrong=0.5, n=500).pairs[:, 0][:, None] != np.flatnonzero(out)).all()


def test_rolling_shutter_shows_every_row_at_its_time():
    readout = 0.03
    exact, worse, truth, _ = with_and_without(
        effects.RollingShutter(readout), tracks=40, motion="football", offsets=[0.4, 0], rates=[1.1, 1]
    )
    row = np.clip(worse.uv[..., 1] / 720 - 0.5, -0.5, 0.5)
    for k in (3, 50, 149):
        for i in range(0, 40, 7):
            want = truth.positions(0, 0.4 + 1.1 * (exact.times[k : k + 1] + row[i, k] * readout))[i, 0]
            np.testing.assert_allclose(worse.xyz[i, k], want, atol=2e-5)
    assert np.abs(worse.xyz - exact.xyz).max() > 0.01
    assert worse.camera.readout == readout


def test_every_video_may_draw_a_readout_of_its_own():
    tracks, _ = simulate("softball", effects=(effects.RollingShutter((0.01, 0.02)),), videos=3, tracks=5, frames=4)
    drawn = [t.camera.readout for t in tracks]
    assert len(set(drawn)) == 3 and all(0.01 <= r <= 0.02 for r in drawn)


def test_clock_drift_moves_the_instants():
    exact, worse, truth, _ = with_and_without(effects.ClockDrift(0.01), tracks=60)
    # one shift of time a frame explains all tracks
    speed = (truth.positions(0, exact.times + 1e-4) - truth.positions(0, exact.times - 1e-4)) / 2e-4
    shift = ((worse.xyz - exact.xyz) * speed).sum((0, 2)) / (speed**2).sum((0, 2))
    assert 0.002 < shift.std() < 0.03
    for k in (10, 75, 140):
        want = truth.positions(0, exact.times[k : k + 1])
        near = truth.positions(0, exact.times[k : k + 1] + shift[k])
        assert np.abs(near[:, 0] - worse.xyz[:, k]).max() < 0.1 * np.abs(want[:, 0] - worse.xyz[:, k]).max() + 1e-6


def test_a_clock_that_bends_shows_what_is_later_at_both_ends():
    exact, worse, _, truth = with_and_without(effects.ClockRamp(0.04), tracks=30)
    late = 0.04 / 8 * (exact.times[-1] - exact.times[0])
    off = truth.shown[0] - exact.times
    np.testing.assert_allclose([off[0], off[-1]], late)
    assert np.all(np.diff(off, 2) > 0) and abs(off[len(off) // 2]) < 1e-5
    np.testing.assert_allclose(worse.xyz, truth.positions(0, truth.shown[0]), atol=1e-5)


def test_a_clock_that_sways_is_ahead_and_behind_in_turn():
    exact, worse, _, truth = with_and_without(effects.ClockSway(0.02, 1.0), tracks=30)
    off = truth.shown[0] - exact.times
    assert np.ptp(off) == pytest.approx(0.04, rel=0.02)
    np.testing.assert_allclose(off[30:], off[:-30], atol=1e-9)
    np.testing.assert_allclose(worse.xyz, truth.positions(0, truth.shown[0]), atol=1e-5)


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        (effects.ClockRamp, {"change": float("nan")}),
        (effects.ClockRamp, {"change": 3.0}),
        (effects.ClockSway, {"period": 0.0}),
        (effects.ClockSway, {"size": 1.0, "period": 0.5}),
        (effects.ClockSway, {"size": float("inf")}),
        (effects.LatePoses, {"late": float("nan")}),
        (effects.LatePoses, {"settles": 0.0}),
    ],
)
def test_what_cannot_happen_is_refused(effect, values):
    with pytest.raises(ValueError, match=next(iter(values))):
        effect(**values)


def test_what_a_camera_follows_is_put_where_it_pointed_before():
    exact, worse, _, _ = with_and_without(effects.LatePoses(0.1, settles=0.002), tracks=1)
    before, now = exact.xyz[0] - exact.camera.center, worse.xyz[0] - exact.camera.center
    np.testing.assert_allclose(np.linalg.norm(now, axis=1), np.linalg.norm(before, axis=1), rtol=1e-5)
    pointed = before / np.linalg.norm(before, axis=1, keepdims=True)
    np.testing.assert_allclose(now[3:] / np.linalg.norm(now[3:], axis=1, keepdims=True), pointed[:-3], atol=1e-4)


def test_poses_that_come_late_turn_all_tracks_alike_about_the_camera():
    exact, worse, _, _ = with_and_without(effects.LatePoses(0.2), tracks=30)
    before, now = exact.xyz - exact.camera.center, worse.xyz - exact.camera.center
    assert np.abs(now - before).max() > 0.01
    np.testing.assert_allclose(
        np.einsum("itk,jtk->tij", now, now), np.einsum("itk,jtk->tij", before, before), atol=1e-3
    )


def test_dropped_frames_keep_their_times():
    exact, worse, truth, _ = with_and_without(effects.DroppedFrames(0.2), tracks=30)
    assert 100 < worse.n_frames < 140
    assert np.isin(worse.times, exact.times).all() and worse.times[0] == 0
    np.testing.assert_allclose(worse.xyz, truth.positions(0, worse.times), atol=1e-9)
    assert worse.fps == 30


def test_occlusion_hides_what_is_turned_away():
    exact, worse, truth, _ = with_and_without(effects.Occlusion(), tracks=200, motion="boxes", seed=3)
    s, parts = truth.surfaces[0], truth.scene.parts
    R, p = truth.scene.pose(exact.times)
    # the middle of the head against its surface: hidden points lie on the far half
    head = np.flatnonzero(s.part == 2)
    middle = p[2] + np.einsum("tij,j->ti", R[2], 0.5 * (parts.start[2] + parts.end[2]))
    out = ((exact.xyz[head] - middle) * (exact.camera.center - exact.xyz[head])).sum(2)
    assert out[worse.visible[head]].mean() > 0
    hidden = ~worse.visible[head]
    assert not hidden.any() or out[hidden].mean() < 0


def test_brutal_worlds_are_finite_where_visible():
    for seed in range(3):
        for t in simulate("basketball", preset="brutal", videos=3, seed=seed)[0]:
            t.check("tracks", features=True)


def test_the_benchmark_of_absent_effects_runs():
    from otsync.bench.effects import effect_costs

    rows = effect_costs(tracks=20, repeats=1)
    assert [r["effects"] for r in rows[:2]] == ["none", "absent"] and rows[-1]["effects"] == "all"
    assert all(r["ms"] > 0 for r in rows)
