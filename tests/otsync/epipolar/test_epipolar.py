"""Two-view geometry, the epipolar scan, its continuous fit, and positions as costs, on exact tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync import Alignment, Matches, Status, TrackSet, synchronize
from otsync.align.peaks import separate_peaks
from otsync.costs.positions import CurveDistance, MedianPosition, SynchronousDistance, capped, scene_scale
from otsync.epipolar.poses import Moves, Rays, Views, not_turned
from otsync.epipolar.refine import COMMON_ERRORS, EpipolarRefine
from otsync.epipolar.residuals import APART_BY, Residuals, Step, detrended
from otsync.epipolar.scan import TRACK_CAP, EpipolarScan, Told, mixture, residuals_by_lag
from otsync.geometry import common_target, fundamental, fundamentals, sampson, undistort, view_angle
from otsync.match.candidates import Candidates
from otsync.sync.graph import judged_by_cycles
from otsync.types import Camera
from tests.recording_world import paths, ring

FPS = 30.0


def filmed(camera: Camera, xyz: np.ndarray, **more) -> TrackSet:
    uv = camera.project(xyz)
    return TrackSet(None, uv=uv, camera=camera, fps=FPS, frame="world", **more)


def world(offset: float, frames: int = 120, n: int = 40, seed: int = 0, apart: int = 1):
    """Two cameras; b started ``offset`` frames later; feature k belongs to track k, with a little noise."""
    rng = np.random.default_rng(seed)
    a, b = ring(4, width=640, height=360)[0 :: apart + 1][:2]
    features = rng.normal(size=(n, 12))
    t = np.arange(frames) / FPS
    sets = []
    for camera, start, name in ((a, 0.0, "a"), (b, offset, "b")):
        noisy = features + 0.5 * rng.normal(size=features.shape)
        sets.append(filmed(camera, paths(t + start / FPS, n, seed + 5), features=noisy, name=name))
    return sets


def test_points_of_one_world_meet_the_epipolar_constraint():
    rng = np.random.default_rng(0)
    a, b = ring(4)[:2]
    x = rng.normal(size=(50, 1, 3)) * 0.4
    xa, xb = a.project(x)[:, 0], b.project(x)[:, 0]
    F = fundamental(a, b)
    ha, hb = (np.concatenate([p, np.ones((50, 1))], 1) for p in (xa, xb))
    assert np.abs(np.einsum("ni,ij,nj->n", hb, F, ha)).max() < 1e-9
    assert np.abs(sampson(F, xa, xb)).max() < 1e-6
    np.testing.assert_allclose(sampson(F, xa, xb + 3.0), sampson(F.T, xb + 3.0, xa), atol=1e-9)


def test_sampson_is_the_distance_that_a_point_was_moved_across_its_line():
    a, b = ring(4)[:2]
    x = np.zeros((1, 1, 3))
    xa, xb = a.project(x)[0], b.project(x)[0]
    F = fundamental(a, b)
    line = F @ np.append(xa[0], 1)
    across = line[:2] / np.linalg.norm(line[:2])
    moved = sampson(F, xa, xb + 0.01 * across)
    # the correction is shared by both images: never more than the move, at least 1/sqrt 2 of it for like cameras
    assert 0.6 * 0.01 < abs(float(moved[0])) <= 0.01 + 1e-9
    assert np.sign(moved[0]) == np.sign(sampson(F, xa, xb + 0.02 * across)[0])


def test_undistort_inverts_the_lens():
    import cv2

    camera = replace(ring(2)[0], distortion=np.array([-0.2, 0.05, 0.001, -0.002, 0.0]))
    x = np.random.default_rng(0).normal(size=(30, 1, 3)) * 0.3
    rvec = cv2.Rodrigues(camera.w2c[:3, :3])[0]
    seen = cv2.projectPoints(x[:, 0], rvec, camera.w2c[:3, 3], camera.K, camera.distortion)[0][:, 0]
    np.testing.assert_allclose(undistort(camera, seen), camera.project(x)[:, 0], atol=0.02)
    assert np.isnan(undistort(camera, np.full((2, 2), np.nan))).all()


def test_cameras_of_a_ring_look_at_its_middle():
    cameras = ring(5)
    np.testing.assert_allclose(common_target(cameras), 0, atol=1e-6)
    assert view_angle(cameras[0], cameras[0], np.zeros(3)) < 1e-3
    assert 30 < view_angle(cameras[0], cameras[1], np.zeros(3)) < 40


@pytest.mark.parametrize("offset", [0.0, 13.0, -27.0, 40.0, 7.5, -3.3])
def test_offset_from_pixels_alone(offset):
    a, b = world(offset)
    matches = Candidates(8, None)(a, b)
    scanned = EpipolarScan()(a, b, matches)
    assert abs(scanned.frames - offset) < 1.1  # noiseless residuals saturate the mixture around the peak
    refined = EpipolarRefine()(a, b, matches, scanned)
    assert abs(refined.frames - offset) < 0.05
    assert refined.status.ok
    assert refined.sigma * FPS < 0.2


def test_swapping_the_videos_flips_the_sign():
    a, b = world(11.0)
    matches = Candidates(8, None)(a, b)
    there = EpipolarScan()(a, b, matches)
    back = EpipolarScan()(b, a, matches.swapped())
    assert abs(there.frames + back.frames) < 0.1
    np.testing.assert_allclose(there.hypotheses[0, 0], -back.hypotheses[0, 0], atol=0.1 / FPS)


def test_all_wrong_candidates_are_flagged():
    a, _ = world(0.0, seed=1)
    _, b = world(0.0, seed=2)
    rng = np.random.default_rng(0)
    pairs = np.stack([rng.integers(0, 40, 200), rng.integers(0, 40, 200)], 1)
    found = EpipolarScan()(a, b, Matches(pairs))
    assert not found.status.ok


def test_another_rate_and_timestamps():
    a, b = world(9.0)
    keep = np.arange(0, 120, 2)
    slow = replace(b, uv=b.uv[:, keep], visible=b.seen[:, keep], fps=15.0)
    found = EpipolarScan()(a, slow, Candidates(8, None)(a, slow))
    assert abs(found.offset * FPS - 9.0) < 1.1
    stamped = replace(b, fps=None, timestamps=5.0 + np.arange(120) / FPS)
    found = EpipolarScan()(a, stamped, Candidates(8, None)(a, stamped))
    assert abs(found.offset - (9.0 / FPS - 5.0)) < 1.1 / FPS


def test_a_camera_that_moves():
    a, b = world(6.0)
    t = np.arange(120)
    poses = []
    for k in t:
        turn = np.eye(4)
        c, s = np.cos(0.002 * k), np.sin(0.002 * k)
        turn[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        turn[:3, 3] = [0.004 * k, 0, 0]
        poses.append(turn @ b.camera.w2c)
    moving = replace(b.camera, w2c=np.stack(poses))
    assert fundamentals(a.camera, moving).shape == (1, 120, 3, 3)
    carried = filmed(moving, paths((t + 6.0) / FPS, 40, 5), features=b.features)
    matches = Candidates(8, None)(a, carried)
    scanned = EpipolarScan()(a, carried, matches)
    assert abs(EpipolarRefine()(a, carried, matches, scanned).frames - 6.0) < 0.1


def test_the_graph_takes_pixels_only():
    cameras = ring(5, width=640, height=360)
    true = np.array([0, 12, -9, 4.5, 20])
    rng = np.random.default_rng(3)
    features = rng.normal(size=(30, 12))
    t = np.arange(110)
    tracks = [
        filmed(c, paths((t + o) / FPS, 30, 9), features=features + 0.5 * rng.normal(size=features.shape), name=f"c{v}")
        for v, (c, o) in enumerate(zip(cameras, true, strict=True))
    ]
    found = synchronize(
        tracks, matcher=Candidates(8, None), aligner=EpipolarScan(), refiner=EpipolarRefine(), rematch=0
    )
    assert found.ok
    np.testing.assert_allclose(found.frames, true, atol=0.06)
    # cycles have the last word on sigma; two videos have none
    pair = synchronize(
        tracks[:2], matcher=Candidates(8, None), aligner=EpipolarScan(), refiner=EpipolarRefine(), rematch=0
    )
    assert pair.sigma[1] == pytest.approx(pair.alignments[0, 1].sigma)
    residual = [a.stats["residual"] / a.sigma for a in found.alignments.values()]
    judged = judged_by_cycles(np.array(residual), 4)
    assert judged < 1  # these pairs agree far better than they say
    assert all(a.stats["tentative"] == 1.0 for a in found.alignments.values())
    assert found.sigma[1] < pair.sigma[1]


def test_motion_and_position_must_be_of_one_candidate():
    """At lag 1 one candidate moves right and the other is in the right place; at lag 3 one of them does both."""

    class Fixed(EpipolarScan):
        def scores(self, *problem):
            motion, position = np.zeros((2, 2, 5))
            motion[0, 1], position[1, 1], motion[0, 3], position[0, 3] = 9.0, 9.0, 8.0, 8.0
            candidate, lag = np.indices((2, 5)).reshape(2, -1)
            nats = np.stack([motion.ravel(), position.ravel()])
            return Told(candidate, lag, np.ones((2, 10)), np.ones((2, 10)), nats)

    nothing, lags = np.zeros((1, 5, 2)), np.arange(5)
    total = Fixed().evidence(nothing, nothing, np.eye(3)[None, None], np.array([[0, 0], [0, 1]]), lags, 30.0, 1.0)
    assert np.argmax(total) == 3


def test_what_the_scan_needs_is_named():
    a, b = world(0.0)
    with pytest.raises(ValueError, match=r"b: expected pixels"):
        EpipolarScan()(a, replace(b, camera=None), Candidates()(a, b))
    none = EpipolarScan()(a, b, Matches(np.zeros((0, 2), int)))
    assert none.status is Status.FEW_MATCHES and np.isnan(none.offset)
    short = replace(b, uv=b.uv[:, :10], visible=b.seen[:, :10])
    assert EpipolarScan()(a, short, Candidates()(a, short)).status is Status.NO_OVERLAP


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_mixture_is_capped_floored_and_ignores_order(seed):
    rng = np.random.default_rng(seed)
    score = rng.normal(0, 20, (30, 5))
    track = rng.integers(0, 7, 30)
    total = mixture(score, track)
    n = len(np.unique(track))
    assert (total <= TRACK_CAP * n + 1e-9).all() and (total >= -1.0 * n - 1e-9).all()
    order = rng.permutation(30)
    np.testing.assert_allclose(mixture(score[order], track[order]), total)


def test_separate_peaks_are_apart_and_ordered():
    curve = np.array([0, 3, 1, 2, 0, 5, 4.5, 4.8, 0.0])
    assert separate_peaks(curve, 3) == [5, 1]
    assert separate_peaks(curve, 1) == [5, 7, 1, 3]


def test_detrending_removes_constants_and_keeps_gaps():
    x = np.random.default_rng(0).normal(size=(3, 40))
    known = np.ones((3, 40), bool)
    known[1, 10:20] = False
    out = detrended(x + 7, known, 5)
    np.testing.assert_allclose(out, detrended(x, known, 5), atol=1e-12)
    assert (out[1, 10:20] == 0).all()
    assert np.abs(detrended(np.full((1, 40), 3.0), np.ones((1, 40), bool), 5)).max() < 1e-12


def lifted(xyz: np.ndarray, **more) -> TrackSet:
    return TrackSet(xyz, fps=FPS, frame="world", **more)


def test_curve_distance_knows_no_time_and_no_unit():
    t = np.arange(90) / FPS
    x = paths(t, 12, 3)
    late = paths(t + 0.5, 12, 3)
    cost = CurveDistance().matrix(lifted(x), lifted(late))
    assert (cost.argmin(1) == np.arange(12)).mean() > 0.9
    np.testing.assert_allclose(CurveDistance().matrix(lifted(50 * x), lifted(50 * late)), cost, rtol=1e-9)
    np.testing.assert_allclose(CurveDistance().matrix(lifted(late), lifted(x)), cost.T, rtol=1e-9)
    assert cost.max() <= CurveDistance().cap


def test_curve_distance_against_brute_force():
    rng = np.random.default_rng(1)
    xa, xb = rng.normal(size=(4, 30, 3)), rng.normal(size=(5, 25, 3))
    seen = rng.random((4, 30)) < 0.7
    a, b = lifted(xa, visible=seen), lifted(xb)
    cost = CurveDistance(share=1.0, cap=1e9, samples=100, scale=1.0).matrix(a, b)
    unit = scene_scale(a, b)
    for i in range(4):
        for j in range(5):
            d = np.linalg.norm(xa[i, seen[i]][:, None] - xb[j][None], axis=2)
            np.testing.assert_allclose(cost[i, j], 0.5 * (d.min(1).mean() + d.min(0).mean()) / unit, rtol=1e-9)


def test_trimming_forgives_what_the_other_never_saw():
    t = np.arange(90) / FPS
    x = paths(t, 3, 3)
    part = np.zeros((3, 90), bool)
    part[:, :70] = True
    whole, cut = lifted(x), lifted(x, visible=part)
    loose = CurveDistance(share=0.7).matrix(cut, whole)
    strict = CurveDistance(share=1.0).matrix(cut, whole)
    assert np.diag(loose).max() < 1e-9 < np.diag(strict).min()


def test_positions_are_compared_only_in_one_declared_frame():
    x = paths(np.arange(40) / FPS, 3, 0)
    a = lifted(x)
    for frame in (None, "elsewhere"):
        for cost in (CurveDistance(), MedianPosition()):
            with pytest.raises(ValueError, match="frame"):
                cost.matrix(a, TrackSet(x, fps=FPS, frame=frame))
    np.testing.assert_allclose(np.diag(MedianPosition().matrix(a, a)), 0, atol=1e-12)


@pytest.mark.parametrize("cost", [CurveDistance(), MedianPosition(), SynchronousDistance(0.1)], ids=repr)
def test_costs_of_pairs_are_entries_of_the_matrix(cost):
    """AnchoredFGW reads costs at candidates, never as a matrix of all pairs."""
    t = np.arange(60) / FPS
    a, b = lifted(paths(t, 7, 3)), lifted(paths(t + 0.1, 5, 3))
    i, j = np.array([0, 6, 3, 3]), np.array([4, 0, 2, 1])
    np.testing.assert_array_equal(cost.pairs(a, b, i, j), cost.matrix(a, b)[i, j])


def test_unknown_distances_cost_as_much_as_any_wrong_pair():
    np.testing.assert_array_equal(capped(np.array([1.0, np.nan, 100.0]), 2.0, 3.0), [0.5, 3.0, 3.0])


def test_candidates_hold_both_sides_best_and_the_cheapest_first():
    a, b = world(0.0)
    found = Candidates(3, None)(a, b)
    cost = 1 - (a.features @ b.features.T) / np.outer(*[np.linalg.norm(f, axis=1) for f in (a.features, b.features)])
    assert set(found.pairs[:, 0]) == set(range(40)) == set(found.pairs[:, 1])
    np.testing.assert_allclose(-found.score, cost[tuple(found.pairs.T)], atol=1e-9)
    assert (np.diff(found.score) <= 0).all()
    assert len(Candidates(3, 10)(a, b)) == 10
    flat = replace(a, features=np.ones((40, 3)))
    assert Candidates()(flat, replace(b, features=np.ones((40, 3)))).status is Status.NO_INFORMATION


def test_a_moving_camera_stands_at_every_frame_where_its_pose_says():
    """Residuals at every lag against Sampson distances with the poses of the two frames that meet."""
    rng = np.random.default_rng(0)
    a, b = ring(4, width=640, height=360)[:2]
    poses = np.repeat(b.w2c[None], 20, 0)
    poses[:, 0, 3] += 0.05 * np.arange(20)
    moving = replace(b, w2c=poses)
    A, B = rng.uniform(0, 300, (2, 25, 2)), rng.uniform(0, 300, (1, 20, 2))
    A[0, 7:9] = np.nan
    F, pairs = fundamentals(a, moving), np.array([[0, 0], [1, 0]])
    turn = Moves(moving, np.arange(20) / FPS).turns(np.arange(20) / FPS) + 0.01 * rng.normal(size=(20, 4, 3))
    views = Views(Rays.of(a.K, a.w2c[None]), Rays.of(moving.K, poses), turn)
    np.testing.assert_allclose(views.F(0, 7) / np.linalg.norm(views.F(0, 7)), F[0, 7], atol=1e-12)
    told = residuals_by_lag(A, B, views, pairs, np.arange(-3, 6), 4, 10, 3)
    mean, count = np.full((2, 2, 9), np.nan), np.zeros((2, 2, 9))
    mean[:, told.candidate, told.lag], count[:, told.candidate, told.lag] = told.mean, told.count
    for m in range(2):
        for k in range(-3, 6):
            t = np.arange(max(0, k), min(25, 20 + k))
            e = np.array([sampson(F[0, s - k], A[m, [s]], B[0, [s - k]])[0] for s in t])
            assert mean[1, m, k + 3] == pytest.approx(np.nanmean(e**2))
            assert count[1, m, k + 3] == np.isfinite(e).sum()
            # beside, without what a constant distance makes of e: least squares with a ridge, in each window
            left, n = 0.0, 0
            for w in range(3):
                s = np.array([x for x in t[np.isfinite(e)] if x // 10 == w], int)
                if len(s) >= 3:
                    ha, hb = (np.append(x, np.ones((len(s), 1)), 1) for x in (A[m, s], B[0, s - k]))
                    la, lb = np.einsum("sij,sj->si", F[0, s - k], ha), np.einsum("sij,si->sj", F[0, s - k], hb)
                    size = np.sqrt((la[:, :2] ** 2).sum(1) + (lb[:, :2] ** 2).sum(1))
                    g = not_turned((la[:, :2] / size[:, None])[None], B[:, s - k], turn[s - k])[0]
                    y = e[np.isin(t, s)]
                    left += y @ y - g.T @ y @ np.linalg.solve(g.T @ g + np.eye(2) / APART_BY**2, g.T @ y)
                    n += len(s)
            assert (n < 4 and np.isnan(mean[0, m, k + 3])) or mean[0, m, k + 3] == pytest.approx(left / n)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31))
def test_only_lags_at_which_both_tracks_live_are_asked_and_none_is_forgotten(seed):
    """Every lag by itself, over the whole clip: what is left out has too few samples."""
    rng = np.random.default_rng(seed)
    frames, least, window, within = rng.integers(20, 60, 2), 5, 10, 3
    A, B = (rng.uniform(0, 300, (3, n, 2)) for n in frames)
    for x in (A, B):
        for track in x:
            begin, end = np.sort(rng.integers(0, len(track) + 1, 2))
            track[:begin], track[end:], track[rng.random(len(track)) < 0.2] = np.nan, np.nan, np.nan
    one, two = ring(4, width=640, height=360)[:2]
    F, pairs = fundamentals(one, two), np.argwhere(np.ones((3, 3)))
    views = Views(*(Rays.of(c.K, c.w2c[None]) for c in (one, two)), np.zeros((1, 4, 3)))
    lags = np.arange(-frames[1] + 5, frames[0] - 4)
    told = residuals_by_lag(A, B, views, pairs, lags, least, window, within)
    for m, k in zip(told.candidate, told.lag, strict=True):
        i, j = (np.flatnonzero(np.isfinite(x[n, :, 0])) for x, n in ((A, pairs[m, 0]), (B, pairs[m, 1])))
        assert min(i[-1], j[-1] + lags[k]) - max(i[0], j[0] + lags[k]) + 1 >= least
    where = zip(told.candidate, told.lag, strict=True)
    found = {at: (told.mean[:, e], told.count[:, e]) for e, at in enumerate(where)}
    for m, (i, j) in enumerate(pairs):
        for k, lag in enumerate(lags):
            t = np.arange(max(0, lag), min(frames[0], frames[1] + lag))
            e = sampson(F[0, 0], A[i, t], B[j, t - lag])
            raw = e[np.isfinite(e)]
            parts = [e[(t // window == w) & np.isfinite(e)] for w in range(frames[0] // window + 1)]
            parts = [p - p.mean() for p in parts if len(p) >= within]
            centred = np.concatenate([*parts, []])
            for kind, x in enumerate((centred, raw)):
                if len(x) < least:
                    assert (m, k) not in found or np.isnan(found[m, k][0][kind])
                else:
                    assert found[m, k][0][kind] == pytest.approx((x**2).mean(), rel=1e-6, abs=1e-9)
                    assert found[m, k][1][kind] == len(x)


def test_one_step_of_the_fit_goes_nearly_all_the_way():
    """A derivative that is too large by a factor would leave the rest of the way, and too small a sigma."""
    a, b = world(7.0)
    matches = Matches(np.stack([np.arange(40)] * 2, 1))
    start = Alignment((7.0 + 0.2) / FPS, fps=FPS)
    found = EpipolarRefine(iterations=1)(a, b, matches, start)
    assert abs(found.frames - 7.0) < 0.3 * 0.2


def test_detrending_reaches_as_far_back_as_ahead():
    x = np.random.default_rng(2).normal(size=(2, 30))
    known = np.random.default_rng(3).random((2, 30)) < 0.9
    np.testing.assert_allclose(detrended(x[:, ::-1], known[:, ::-1], 4), detrended(x, known, 4)[:, ::-1], atol=1e-12)


@pytest.mark.parametrize(("level", "weak"), [(0.0, False), (-100.0, True)])
def test_a_peak_that_outliers_explain_better_is_weak(level, weak):
    """The shape of the curve is the same: a sharp lone peak. Below 0 the outlier floor beats every candidate."""
    lags = np.arange(-60, 61)
    total = 80 * np.exp(-0.5 * ((lags - 7) / 2) ** 2) + np.sin(lags) + level
    pairs = np.stack([np.arange(30)] * 2, 1)
    found = EpipolarScan()._answer(lags, total, np.full(121, 4.0), 0.0, FPS, Matches(pairs, np.ones(30)))
    assert found.offset * FPS == pytest.approx(7, abs=0.3)
    assert (Status.WEAK in found.flags) == weak


def test_tracks_of_one_limb_are_not_independent():
    """Two hundred tracks in ten places, those of a place wrong alike: sigma knows of ten, not of two hundred."""
    rng = np.random.default_rng(0)
    places, each, frames = 10, 20, 150
    wrong, asked = [], []
    for _ in range(60):
        own = rng.normal(0, 0.3, places)
        middle = np.repeat(rng.uniform(0, 640, (places, 2)), each, 0) + rng.normal(0, 2, (places * each, 2))
        xa = np.repeat(middle[:, None], frames, 1)
        problem = Residuals(xa, None, np.arange(frames) / 30, None, 30.0, np.ones(places * each))
        ones = np.ones((places * each, frames))
        residual = np.repeat(own, each)[:, None] + rng.normal(0, 1, ones.shape)
        wrong.append(residual.sum() / ones.sum())
        asked.append(problem.scatter(Step(residual, ones, ones)))
    assert 0.6 < np.sqrt(np.mean(np.square(wrong))) / np.sqrt(np.mean(np.square(asked))) < 1.1


def test_sigma_never_falls_below_what_blur_predicts():
    """However many candidates agree: what whole videos err by is in no residual."""
    a, b = world(7.0)
    rng = np.random.default_rng(4)
    a, b = (replace(x, uv=x.uv + rng.normal(0, 8, x.uv.shape)) for x in (a, b))
    matches = Matches(np.stack([np.arange(40)] * 2, 1))
    found = EpipolarRefine()(a, b, matches, Alignment(7.0 / FPS, fps=FPS))
    predicted = found.stats["blur"] ** 2 / COMMON_ERRORS
    assert found.sigma > predicted > 0.5 * found.sigma


def seconds_apart(late: np.ndarray) -> tuple[TrackSet, TrackSet, Matches]:
    """Two cameras of one world; a frame of b is ``late`` s (T,) later than its clock says."""
    a, b = ring(4, width=640, height=360)[:2]
    t, rng = np.arange(len(late)) / FPS, np.random.default_rng(1)
    sets = [
        replace(made, uv=made.uv + 0.3 * rng.normal(size=made.uv.shape))
        for made in (filmed(a, paths(t, 40, 5)), filmed(b, paths(t + 0.2 + late, 40, 5)))
    ]
    return *sets, Matches(np.stack([np.arange(40)] * 2, 1))


@pytest.mark.parametrize("hurry", [0.0, 0.05, 0.1])
def test_seconds_that_say_different_offsets_are_a_broken_clock(hurry):
    a, b, matches = seconds_apart(hurry * np.sqrt(2) * np.sin(2 * np.pi * 0.25 * np.arange(150) / FPS + 0.7))
    for found in (
        EpipolarScan()(a, b, matches),
        EpipolarRefine()(a, b, matches, Alignment(0.2, fps=FPS)),
    ):
        assert (Status.BROKEN_CLOCK in found.flags) == (hurry > 0), found.flags
        assert hurry > 0 or abs(found.offset - 0.2) * FPS <= 0.5


def test_wander_is_what_the_seconds_say_by_their_information():
    """Two seconds: the first says 30 ms more than the answer and knows three times as much, the second 10 ms less."""
    ones = np.ones((1, 60))
    slope = np.where(np.arange(60) < 30, np.sqrt(3.0), 1.0)[None] * 100
    residual = -slope * np.where(np.arange(60) < 30, 0.03, -0.01)
    problem = Residuals(np.zeros((1, 60, 2)), None, np.arange(60) / FPS, None, FPS, np.ones(1))
    wander, blur = problem.wander(Step(residual, slope, ones))
    assert wander == pytest.approx(np.sqrt((3 * 0.03**2 + 0.01**2) / 4))
    assert blur == pytest.approx(wander)  # nothing else is left
    assert problem.wander(Step(residual, 0 * slope, ones)) == (0.0, 0.0)


def test_a_camera_is_known_at_every_moment():
    """At its frames, between them, and on the even clock of a video that lacks frames."""
    still, other = ring(2, width=640, height=360)
    poses = moving_poses(still, np.arange(30) / 30)
    kept = np.delete(np.arange(30), np.arange(12, 20))
    uv = np.full((3, 22, 2), 5.0)
    moving = TrackSet(
        None, uv=uv, camera=replace(still, w2c=poses[kept]), timestamps=kept / 30, frame="world", name="a"
    )
    fixed = TrackSet(None, uv=uv, camera=other, fps=30.0, frame="world", name="b")
    views, back = Views.of(moving, fixed, 30.0), Views.of(fixed, moving, 30.0)
    for k in kept:
        F = views.F(k, 0)
        true = fundamental(replace(still, w2c=poses), other, k)
        np.testing.assert_allclose(F / np.linalg.norm(F), true, atol=1e-12)
        np.testing.assert_allclose(back.F(0, k), F.T, atol=1e-9 * np.abs(F).max())
    half = (np.arange(10) + 0.5) / 30
    np.testing.assert_allclose(Moves.of(moving).at(half), moving_poses(still, half), atol=2e-3)
    np.testing.assert_allclose(Moves.of(moving).at(np.array([-1.0, 2.0])), poses[[0, -1]])
    assert len(views.a.back) == 30 and len(views.b.back) == len(views.turn) == 1
    assert len(views.within(slice(4, 9)).a.back) == 5 and len(back.within(slice(4, 9)).a.back) == 1
    few = Moves(replace(still, w2c=poses[:3]), kept[:3] / 30)
    np.testing.assert_allclose(few.at(np.array([0.04])), poses[[1]])


def test_views_of_two_cameras_that_move_grow_with_the_clip_and_not_with_its_square():
    one, two = ring(2, width=640, height=360)
    sizes = []
    for frames in (40, 80):
        t = np.arange(frames) / FPS
        sets = [
            TrackSet(None, uv=np.ones((1, frames, 2)), camera=replace(c, w2c=moving_poses(c, t)), fps=FPS, name=n)
            for c, n in ((one, "a"), (two, "b"))
        ]
        views = Views.of(*sets, FPS)
        arrays = [x for rays in (views.a, views.b) for x in vars(rays).values()]
        sizes.append(sum(x.nbytes for x in (*arrays, views.turn)))
    assert sizes[1] == 2 * sizes[0]


def moving_poses(camera: Camera, times: np.ndarray) -> np.ndarray:
    """(T,4,4) of a camera that sways by 8 cm and 2 degrees, once a second."""
    from scipy.spatial.transform import Rotation

    wave = np.sin(2 * np.pi * (times[:, None] * [1.0, 1.3, 0.8] + [0.1, 0.4, 0.7]))
    out = np.repeat(np.asarray(camera.w2c, float)[None], len(times), 0)
    out[:, :3, :3] = Rotation.from_rotvec(np.radians(2) * wave).as_matrix() @ out[:, :3, :3]
    out[:, :3, 3] = -np.einsum("tij,tj->ti", out[:, :3, :3], camera.center + 0.08 * wave[:, ::-1])
    return out


def shaken(seed: int, late: float, frames: int = 75) -> tuple[TrackSet, TrackSet, Matches]:
    """Eight opaque balls before two cameras that shake: each sees the side that faces it, for half a second a track.
    Candidates are all tracks of one ball.
    """
    phase, rate = np.random.default_rng(seed).uniform([[[0.0]], [[0.3]]], [[[6.28]], [[0.9]]], (2, 8, 3))[..., None, :]
    sets = []
    for own, (camera, shift) in enumerate(zip(ring(6, width=640, height=360)[:2], (0.0, late / FPS), strict=True)):
        t = np.arange(frames)[:, None] / FPS
        ball = 0.4 * np.sin(2 * np.pi * rate * (t + shift) + phase)
        facing = camera.center / np.linalg.norm(camera.center)
        side = facing + np.random.default_rng([seed, own]).normal(0, 0.03, (8, 10, 1, 3))
        points = ball[:, None] + 0.25 * side / np.linalg.norm(side, axis=-1, keepdims=True)
        poses = moving_poses(camera, t[:, 0] + own)
        at = (np.einsum("tij,nptj->npti", poses[:, :3, :3], points) + poses[:, :3, 3]).reshape(80, frames, 3)
        uv = (at @ camera.K.T)[..., :2] / at[..., 2:]
        begin = np.tile(np.linspace(0, frames - 15, 10), 8)[:, None]
        lives = (np.arange(frames) >= begin) & (np.arange(frames) < begin + 15)
        moving = replace(camera, w2c=poses)
        sets.append(TrackSet(None, uv=uv, visible=lives, camera=moving, fps=FPS, frame="world", name=str(own)))
    ball = np.repeat(np.arange(8), 10)
    pairs = np.argwhere(ball[:, None] == ball)
    return (*sets, Matches(pairs, np.ones(len(pairs))))


@pytest.mark.parametrize("seed", range(3))
def test_what_two_points_of_one_body_make_of_the_distance_is_taken_off_where_a_camera_shakes(seed):
    """At the true offset less is left than without the mean alone; and the offset stays right."""
    a, b, matches = shaken(seed, 7.4)
    problem = EpipolarScan().residuals(a, b, matches, 7.4 / FPS, FPS)
    e = problem.residual(7.4 / FPS)
    left, centred = problem.solve(7.4 / FPS, 20 / FPS, 1, 1.0)[1].residual, detrended(e, np.isfinite(e), 20)
    assert 0 < np.square(left).sum() < 0.5 * np.square(centred[left != 0]).sum()
    found = EpipolarRefine()(a, b, matches, Alignment(7 / FPS, fps=FPS, sigma=0.1 / FPS))
    assert found.offset * FPS == pytest.approx(7.4, abs=0.06)
