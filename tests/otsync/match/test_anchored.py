"""Anchored FGW: accuracy, laws, limits, and its compiled loops against plain numpy."""

from __future__ import annotations

import tracemalloc
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.sparse import issparse

from otsync import (
    AnchoredFGW,
    Camera,
    Cosine,
    FusedGromovWasserstein,
    Labels,
    Matches,
    Status,
    TrackSet,
    match,
    matcher_for,
)
from otsync.compute.indices import ascending
from otsync.compute.simd import LANES
from otsync.match.anchored import kernels
from otsync.match.anchored.cells import nearest
from otsync.match.anchored.clouds import clouds
from otsync.match.anchored.signatures import Linear, Scale, distances, lanes_of, shortlist, signatures
from otsync.match.vouch import chirality
from otsync.metrics import match_quality
from otsync.simulate import matching_world
from tests.conftest import wiggle


@pytest.fixture(scope="module")
def world():
    return matching_world(800, seed=3)


@pytest.fixture(scope="module")
def found(world):
    return AnchoredFGW()(*world[:2])


def as_set(m: Matches) -> set[tuple[int, int]]:
    return set(map(tuple, m.pairs.tolist()))


def agreement(one: Matches, other: Matches) -> float:
    return len(as_set(one) & as_set(other)) / max(len(one), len(other))


def with_gaps(tracks: TrackSet, share: float, rng) -> TrackSet:
    """Tracks that vanish for runs of 20 frames."""
    visible = tracks.seen.copy()
    starts = rng.integers(0, tracks.n_frames, (len(tracks), round(share * tracks.n_frames / 20)))
    for n, row in enumerate(starts):
        for s in row:
            visible[n, s : s + 20] = False
    xyz = tracks.xyz.copy()
    xyz[~visible] = np.nan
    return replace(tracks, xyz=xyz, visible=visible)


def test_more_precise_than_the_dense_solver_by_the_promised_margin():
    a, b, truth = matching_world(800, seed=3)
    dense = match_quality(match(a, b, FusedGromovWasserstein(), throw=False), truth)
    anchored = match_quality(match(a, b, AnchoredFGW()), truth)
    assert anchored["p50"] > dense["p50"] + 0.15 and anchored["recall"] >= dense["recall"]
    assert anchored["p50"] > 0.93 and anchored["flips"] < 0.05


def test_grouped_cells_are_as_good(world):
    a, b, truth = matching_world(4000, seed=5, frames=60)
    assert match_quality(AnchoredFGW()(a, b), truth)["p50"] > 0.95
    a, b, truth = world
    assert match_quality(AnchoredFGW(cells=300)(a, b), truth)["p50"] > 0.9


@pytest.mark.parametrize("change", ["gaps", "sizes", "no cue", "90 degrees", "half of b"])
def test_harder_worlds(change):
    rng = np.random.default_rng(0)
    options = {"sizes": {"n_b": 350}, "no cue": {"left_right": 0.0}, "90 degrees": {"angle": 90.0}}.get(change, {})
    a, b, truth = matching_world(900, seed=8, **options)
    if change == "gaps":
        a, b = with_gaps(a, 0.4, rng), with_gaps(b, 0.4, rng)
    keep = np.arange(len(b))
    if change == "half of b":
        height = np.nan_to_num(truth.surfaces[1].position[:, 2], nan=rng.uniform(0, 1.7))
        keep = np.flatnonzero(height > np.median(height))
    m = match(a, b.take(keep), AnchoredFGW())
    m = Matches(np.stack([m.pairs[:, 0], keep[m.pairs[:, 1]]], 1), m.score)
    right = truth.match_errors(m.best(len(keep) // 3), 0, 1)[0] <= 0.06 * truth.size
    assert right.mean() > (0.8 if change == "90 degrees" else 0.9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_unit_of_length_changes_nothing(world, dtype, unit):
    a, b = (replace(x, xyz=x.xyz.astype(dtype)) for x in world[:2])
    scaled = (replace(x, xyz=x.xyz * dtype(unit)) for x in (a, b))
    assert as_set(AnchoredFGW()(*scaled)) == as_set(AnchoredFGW()(a, b))


def test_a_rigid_motion_hardly_changes_anything(world, found):
    a, b, _ = world
    rotation = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1.0]])
    moved = replace(a, xyz=a.xyz.astype(float) @ rotation.T + [30, -10, 20])
    assert agreement(AnchoredFGW()(moved, b), found) > 0.95


def test_swapping_videos_and_permuting_tracks_changes_nothing(world, found):
    a, b, _ = world
    assert as_set(AnchoredFGW()(b, a).swapped()) == as_set(found)
    order, other = np.random.default_rng(0).permutation(len(a)), np.random.default_rng(1).permutation(len(b))
    m = AnchoredFGW()(a.take(order), b.take(other))
    assert {(int(order[i]), int(other[j])) for i, j in m.pairs} == as_set(found)


def test_swap_and_permutation_agree_without_the_canonical_order_too(world):
    """Other draws of anchors find the same places: what the canonical order makes exact is not a matter of luck."""
    a, b, truth = world
    one, other = AnchoredFGW(seed=0)(a, b).best(400), AnchoredFGW(seed=1)(a, b).best(400)
    partner = dict(other.pairs.tolist())
    i = np.array([i for i in one.pairs[:, 0] if int(i) in partner])
    here, there = (
        truth.surfaces[1].position[dict_values(one, i)],
        truth.surfaces[1].position[[partner[int(k)] for k in i]],
    )
    assert (np.linalg.norm(here - there, axis=1) < 0.12 * truth.size).mean() > 0.93


def dict_values(m: Matches, i: np.ndarray) -> list[int]:
    partner = dict(m.pairs.tolist())
    return [partner[int(k)] for k in i]


def test_threads_and_repetition_change_no_bit(world, found, monkeypatch):
    from threadpoolctl import threadpool_limits

    from otsync.compute.threads import get_threads, set_threads

    monkeypatch.setattr("otsync.compute.threads._threads", get_threads())  # puts it back
    for threads in (1, 2, 5):
        set_threads(threads)
        with threadpool_limits(min(threads, 2)):
            again = AnchoredFGW()(*world[:2])
        np.testing.assert_array_equal(again.pairs, found.pairs)
        np.testing.assert_array_equal(again.score, found.score)


def test_memory_and_plan_are_sparse():
    a, b, _ = matching_world(8000, seed=1, frames=20)
    tracemalloc.start()
    m = AnchoredFGW()(a, b)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8000**2 * 4  # not even one dense matrix in single precision
    assert issparse(m.plan) and m.plan.shape == (8000, 8000)
    np.testing.assert_allclose(m.plan.sum(), m.stats["mass"])
    assert m.plan.sum(1).max() <= 1 / 8000 + 1e-12 and m.plan.sum(0).max() <= 1 / 8000 + 1e-12


def test_the_plan_and_the_pairs_are_the_callers(found):
    rows, columns = found.plan.nonzero()
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == as_set(found)
    assert (np.diff(found.score) <= 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_unrelated_videos_are_told(seed):
    a, b = matching_world(500, seed=20 + seed)[0], matching_world(500, seed=30 + seed)[1]
    for matcher in (AnchoredFGW(), FusedGromovWasserstein()):
        assert Status.NO_MATCH in match(a, b, matcher, throw=False).flags


def test_a_mirrored_scene_is_told(world):
    a, b, _ = world
    assert Status.AMBIGUOUS in match(a, replace(b, xyz=b.xyz * [-1, 1, 1]), AnchoredFGW(), throw=False).flags


def test_a_symmetric_scene_is_told_and_labels_settle_it():
    """Two copies of a cloud, each the other turned by half a turn about the middle: exchanging them changes nothing."""
    rng = np.random.default_rng(1)
    half = wiggle(rng, 150, 40) * 0.3 + [1.0, 0, 0]
    xyz = np.concatenate([half, half * [-1, -1, 1]])
    features = np.tile(rng.normal(size=(150, 16)), (2, 1))

    def video() -> TrackSet:
        noise = 0.01 * rng.normal(size=xyz.shape), 0.1 * rng.normal(size=features.shape)
        return TrackSet(xyz + noise[0], features=features + noise[1], labels=np.repeat([0, 1], 150), fps=30)

    a, b = video(), video()
    assert match(a, b, AnchoredFGW(), throw=False).status is Status.AMBIGUOUS
    m = match(a, b, AnchoredFGW(costs=(Cosine(), Labels())))
    assert (m.pairs[:, 0] // 150 == m.pairs[:, 1] // 150).all() and len(m) > 250
    right = (m.pairs[:, 0] == m.pairs[:, 1]).mean()
    assert right > 0.9


def alike_bodies(seed: int, bodies: int, strangers: int, noise: float) -> tuple[TrackSet, TrackSet]:
    """A video of ``bodies`` that move alike and look alike, and one of the first of them; each shows ``strangers``."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, 60)[None, :, None]

    def body() -> tuple[np.ndarray, np.ndarray]:
        speed, phase = rng.uniform(0.5, 3, (100, 1, 1)), rng.uniform(0, 6.28, (100, 1, 3))
        middle = rng.normal(size=(100, 1, 3)) * [0.25, 0.25, 0.5]
        return middle + 0.15 * np.sin(6.28 * t * speed + phase), rng.normal(size=(100, 16))

    def video(parts: list[tuple[np.ndarray, np.ndarray]], turn: np.ndarray) -> TrackSet:
        xyz, features = (np.concatenate(x) for x in zip(*parts, strict=True))
        noisy = features + noise * rng.normal(size=features.shape)
        return TrackSet(xyz @ turn + 0.01 * rng.normal(size=xyz.shape), features=noisy, fps=30)

    def beside(n: int, step: list[float]) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(x + np.multiply(k + 1, step), f) for k, (x, f) in enumerate(body() for _ in range(n))]

    x, f = body()
    alike = [(x + np.array([3.0 * k, 0.7 * (k % 2), 0]), f) for k in range(bodies)]
    turn = np.array([[np.cos(0.7), np.sin(0.7), 0], [-np.sin(0.7), np.cos(0.7), 0], [0, 0, 1]])
    several = video(alike + beside(strangers, [0, 3.0, 0]), np.eye(3))
    return several, video([(x, f), *beside(strangers, [-4.0, 2.0, 0])], turn)


@pytest.mark.parametrize(
    ("bodies", "strangers", "noise"), [(2, 0, 0.4), (3, 0, 0.3), (4, 0, 0.4), (4, 0, 0.1), (3, 2, 0.4)]
)
def test_one_of_several_alike_bodies_is_not_taken_for_another_without_a_word(bodies, strangers, noise):
    """One video shows several alike bodies, the other one of them: each explains it, and no swap tells."""
    for seed in range(880, 884):
        several, one = alike_bodies(seed, bodies, strangers, noise)
        for videos in ((several, one), (one, several)):
            assert AnchoredFGW()(*videos).flags == (Status.AMBIGUOUS,), seed


def test_of_few_tracks_chance_does_not_tell_two_alike_bodies_that_both_videos_show():
    for seed in range(904, 910):
        rng = np.random.default_rng(seed)
        (x, f), t = (0.3 * rng.normal(size=(15, 1, 3)), rng.normal(size=(15, 16))), np.linspace(0, 6.28, 60)
        swing = 0.15 * np.sin(t[None, :, None] * rng.uniform(0.5, 3, (15, 1, 3)) + rng.uniform(0, 6.28, (15, 1, 3)))
        xyz = np.concatenate([x + swing + [1.5, 0, 0], (x + swing) * [-1, -1, 1] - [1.5, 0, 0]])

        def video(xyz: np.ndarray, f: np.ndarray, rng: np.random.Generator) -> TrackSet:
            noisy = np.tile(f, (2, 1)) + 0.4 * rng.normal(size=(30, 16))
            return TrackSet(xyz + 0.01 * rng.normal(size=xyz.shape), features=noisy, fps=30)

        assert AnchoredFGW()(video(xyz, f, rng), video(xyz[..., [1, 2, 0]], f, rng)).flags == (Status.AMBIGUOUS,), seed


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("cost", [(Cosine(weight=10.0),), (Cosine(), Labels(weight=3.0)), ()])
def test_few_or_dear_matches_leave_nothing_to_ask(cost):
    """Costs in large units leave no match below the limit; of few matches chance makes any second answer as good."""
    for seed, n_a, n_b in ((0, 60, 20), (1, 16, 8), (2, 20, 8), (3, 30, 12), (4, 30, 1), (5, 1, 30)):
        rng = np.random.default_rng(seed)
        xyz, features = wiggle(rng, n_a, 40), rng.normal(size=(n_a, 16))
        some = np.arange(min(n_b, n_a))
        labels = np.where(np.arange(n_a) < 3, 1, -1)
        a = TrackSet(xyz + 0.02 * rng.normal(size=xyz.shape), features=features, labels=labels, fps=30)
        b = TrackSet(
            xyz[some] + 0.02 * rng.normal(size=xyz[some].shape),
            features=features[some] + 1.5 * rng.normal(size=(len(some), 16)),
            labels=labels[some],
            fps=30,
        )
        found = AnchoredFGW(costs=cost)(a, b)
        assert found.stats.get("elsewhere", 0.0) < 0.5, (seed, found)


def test_tracks_that_are_hardly_ever_seen_together_ask_nothing_of_nan():
    rng = np.random.default_rng(7)
    for n in (5, 20):
        seen = rng.random((n, 60)) > 0.97
        seen[:, 0] = True
        a = TrackSet(wiggle(rng, n, 60), seen, features=rng.normal(size=(n, 8)), fps=30)
        b = TrackSet(wiggle(rng, 60, 60), features=rng.normal(size=(60, 8)), fps=30)
        with np.errstate(all="raise"):
            AnchoredFGW()(a, b)


def test_a_body_among_strangers_is_no_other_one():
    for seed in range(884, 888):
        several, one = alike_bodies(seed, 1, 2, 0.2)
        for videos in ((several, one), (one, several)):
            assert not AnchoredFGW()(*videos).flags, seed


def test_what_is_left_over_is_no_second_answer_where_it_shows_something_else():
    for seed in (10060, 10061):
        a, b, _ = matching_world(900, n_b=350, seed=seed)
        found = AnchoredFGW()(a, b)
        assert len(a) > 1.5 * len(found)  # enough is left over to be asked
        assert not found.flags


@dataclass(frozen=True)
class Plain:
    """A cost of one's own, without factors."""

    inner: Labels
    weight: float = 3.0

    def matrix(self, a, b):
        return self.inner.matrix(a, b)

    def pairs(self, a, b, i, j):
        return self.inner.pairs(a, b, i, j)


def test_a_cost_of_ones_own_is_honoured(world):
    rng = np.random.default_rng(0)
    a, b = (replace(x, labels=rng.integers(0, 2, len(x))) for x in world[:2])
    for costs, low, high in (((), 0.4, 0.6), ((Plain(Labels()),), 1.0, 1.0), ((Labels(weight=3.0),), 1.0, 1.0)):
        m = AnchoredFGW(costs=costs)(a, b)
        agree = (a.labels[m.pairs[:, 0]] == b.labels[m.pairs[:, 1]]).mean()
        assert low <= agree <= high and len(m) > 200


def test_weights_of_costs_scale_like_beta(world):
    a, b, _ = world
    half = AnchoredFGW(costs=(Cosine(weight=0.5),), beta=2.0, alpha=0.444)(a, b)
    assert agreement(half, AnchoredFGW()(a, b)) > 0.95


@pytest.mark.parametrize("soft", [False, True])
def test_labels_pairs_and_factors_equal_the_matrix(soft):
    rng = np.random.default_rng(2)
    labels = [rng.random((n, 3)) * (rng.random((n, 1)) > 0.3) if soft else rng.integers(-1, 3, n) for n in (7, 5)]
    a, b = (TrackSet(np.zeros((len(l), 1, 3)), labels=l, fps=30) for l in labels)
    M = Labels().matrix(a, b)
    for i in range(7):
        for j in range(5):
            p, q = labels[0][i], labels[1][j]
            if soft:
                known = p.sum() > 0 and q.sum() > 0
                expected = 1 - (p / p.sum()) @ (q / q.sum()) if known else 0.5
            else:
                expected = float(p != q) if min(p, q) >= 0 else 0.5
            assert M[i, j] == pytest.approx(expected)
    i, j = np.divmod(np.arange(35), 5)
    np.testing.assert_allclose(Labels().pairs(a, b, i, j), M.ravel())


def test_labels_refuse_what_they_cannot_use():
    a = TrackSet(np.zeros((2, 1, 3)), labels=np.array([0, 1]), fps=30)
    with pytest.raises(ValueError, match=r"b\.labels: expected .* found none"):
        Labels().matrix(a, replace(a, labels=None))
    with pytest.raises(ValueError, match=r"b\.labels: expected the classes"):
        Labels().matrix(a, replace(a, labels=np.ones((2, 3))))
    with pytest.raises(ValueError, match=r"weights >= 0"):
        Labels().matrix(replace(a, labels=-np.ones((2, 3))), replace(a, labels=np.ones((2, 3))))


@pytest.mark.parametrize("options", [{}, {"anchors": 20, "cells": 100}], ids=["each track a cell", "grouped"])
@pytest.mark.parametrize("which", ["a", "b"])
@pytest.mark.parametrize("more", [0, 90])
def test_what_costs_cannot_use_is_refused_by_the_callers_names(options, which, more):
    """The solver exchanges videos as it likes; errors name them as the caller does, and no other error is shown."""
    rng = np.random.default_rng(4)

    def video(n: int) -> TrackSet:
        return TrackSet(wiggle(rng, n, 20), features=rng.normal(size=(n, 8)), fps=30)

    videos = {"a": video(250 + more), "b": video(340 - more)}
    for spoilt in (None, 0.0, np.inf):
        features = None if spoilt is None else videos[which].features.copy()
        if features is not None:
            features[7] = spoilt
        with pytest.raises(ValueError, match=rf"^{which}\.features") as caught:
            AnchoredFGW(**options)(*(videos | {which: replace(videos[which], features=features)}).values())
        assert caught.value.__suppress_context__


def test_features_are_looked_at_although_nothing_tells_tracks_apart():
    seen, features = np.ones((400, 5), bool), np.ones((400, 4))
    one = TrackSet(np.zeros((400, 5, 3)), features=features, fps=30)
    assert AnchoredFGW()(one, one).flags == (Status.NO_INFORMATION,)
    seen[-1], spoilt = False, features.copy()
    spoilt[-1] = np.nan
    with pytest.raises(ValueError, match=r"^b\.features"):
        AnchoredFGW()(one, TrackSet(np.zeros((400, 5, 3)), seen, features=spoilt, fps=30))


def test_tracks_never_seen_are_never_matched(world):
    a, b, _ = world
    visible = b.seen.copy()
    visible[::2] = False
    m = match(a, replace(b, visible=visible), AnchoredFGW())
    assert len(m) > 100 and (m.pairs[:, 1] % 2 == 1).all()


@pytest.mark.parametrize("field", ["anchors", "cells", "tau", "mass", "restarts", "beta"])
def test_parameters_are_checked(field):
    with pytest.raises(ValueError, match=f"AnchoredFGW.{field}: expected"):
        AnchoredFGW(**{field: -1})


def test_the_default_goes_by_size():
    assert isinstance(matcher_for(100, 5000), FusedGromovWasserstein)
    assert isinstance(matcher_for(500, 5000), AnchoredFGW)


# --- compiled loops against numpy ---------------------------------------------------------------------------------


def test_a_camera_that_moves_in_a_long_clip_is_no_hindrance():
    """Groups of tracks are seen at moments, a moving camera has a pose for each frame."""
    a, b, truth = matching_world(250, seed=3, frames=100)
    plain = AnchoredFGW()(a, b)
    w2c = np.tile(np.eye(4), (100, 1, 1))
    w2c[:, 2, 3] = 5 + 0.01 * np.arange(100)
    lens = Camera(np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]]), w2c, 640, 360)
    moving = AnchoredFGW()(*(replace(t, camera=lens) for t in (a, b)))
    np.testing.assert_array_equal(moving.pairs, plain.pairs)
    assert match_quality(plain, truth)["p50"] > 0.8


def test_costs_that_look_at_times_see_every_frame():
    seen = []

    class Looking:
        weight = 1.0
        needs_features, needs_xyz = True, False

        def pairs(self, a, b, i, j):
            seen.append((a.n_frames, b.n_frames))
            return Cosine().pairs(a, b, i, j)

        def matrix(self, a, b):
            seen.append((a.n_frames, b.n_frames))
            return Cosine().matrix(a, b)

    AnchoredFGW(costs=(Looking(),))(*matching_world(250, seed=3, frames=100)[:2])
    assert set(seen) == {(100, 100)}


def test_no_moment_goes_on_where_frames_are_missing():
    times = np.arange(120) / 30
    times[50:] += 10.0
    cloud, _ = clouds(*[TrackSet(np.random.default_rng(0).normal(size=(9, 120, 3)), timestamps=times)] * 2)
    assert not ((cloud.times > times[49]) & (cloud.times < times[50])).any()
    assert len(cloud.times) == 17 + 24


@given(st.integers(0, 2**32 - 1), st.sampled_from([(70, 30.0, 2), (150, 30.0, 3), (60, 30.0, 1), (130, 240.0, 4)]))
def test_a_moment_is_the_mean_of_its_frames_that_show_a_track(seed, clip):
    """Of a tenth of a second, if the clip has moments enough; a track that is seen once is seen in one moment."""
    frames, fps, step = clip
    rng = np.random.default_rng(seed)
    xyz, seen = rng.normal(size=(7, frames, 3)), rng.random((7, frames)) < 0.4
    seen[:, 0] = False
    seen[0], seen[0, frames - 1] = False, True
    cloud, _ = clouds(*[TrackSet(xyz, seen, fps=fps)] * 2)
    found = cloud.columns.transpose(2, 1, 0) * cloud.size + cloud.middle
    for w, first in enumerate(range(0, frames, step)):
        part = slice(first, first + step)
        for k, n in enumerate(cloud.index):
            shown = seen[n, part]
            assert cloud.weight[w, k] == shown.any()
            if shown.any():
                np.testing.assert_allclose(found[k, w], xyz[n, part][shown].mean(0), atol=1e-5)
        assert cloud.times[w] == pytest.approx((np.arange(frames) / fps)[part].mean())
    assert len(cloud.times) == w + 1


def test_columns_poses_and_groups_equal_numpy():
    rng = np.random.default_rng(4)
    xyz, seen = rng.normal(size=(40, 9, 3)) * 7 + 100, rng.random((40, 9)) < 0.6
    seen[0] = False
    xyz[~seen] = np.nan
    a, _ = clouds(TrackSet(xyz, seen, fps=30), TrackSet(xyz, seen, fps=30))
    assert sorted(a.index.tolist()) == list(range(1, 40))
    expected = ((xyz[a.index] - a.middle) / a.size).transpose(2, 1, 0)
    np.testing.assert_allclose(a.columns, np.nan_to_num(expected), atol=1e-5)
    np.testing.assert_array_equal(a.weight.T > 0, seen[a.index])
    pose = a.poses(9).reshape(39, 9, 3)
    for n in range(39):
        times = np.flatnonzero(seen[a.index[n]])
        for t in range(9):
            at = times[np.argmin(np.abs(times - t))]
            np.testing.assert_array_equal(pose[n, t], a.columns[:, at, n])
    label = np.arange(39) % 5
    groups = a.groups(label, 5)
    with np.errstate(invalid="ignore"):
        mean = np.stack(
            [np.nanmean(np.where(a.weight > 0, a.columns, np.nan)[:, :, label == g], axis=2) for g in range(5)], 2
        )
    np.testing.assert_allclose(groups.columns, np.nan_to_num(mean), atol=1e-5)
    np.testing.assert_array_equal(groups.weight > 0, np.isfinite(mean[0]))


@pytest.mark.parametrize(("L", "D", "members"), [(6, 4, 30), (64, 64, 300), (1, 5, 7)])
def test_shortlist_equals_brute_force(L, D, members):
    rng = np.random.default_rng(5)
    sa, sb = rng.random((20, L)).astype(np.float32), rng.random((members, L)).astype(np.float32)
    sa[0, 0], sb[3, -1] = 1e9, -1e9
    ua, ub = rng.normal(size=(20, D)).astype(np.float32), rng.normal(size=(members, D)).astype(np.float32)
    group, of_b = rng.integers(0, 3, 20), rng.integers(0, 4, members)
    allowed = np.array([[0, 1], [2, -1], [3, 1]])
    linear = Linear(ua, ub, 1.0, (), None, None)
    found = shortlist((sa, sb), linear, Scale(1.0, 0.2, 0.3, 0.0), 5, (group, of_b), allowed)
    cost = np.minimum((sa[:, None] - sb[None]) ** 2 / 0.04, 1).mean(2) + 0.3 * (1 - ua @ ub.T)
    for i in range(20):
        among = np.flatnonzero(np.isin(of_b, allowed[group[i]]))
        best = among[np.argsort(cost[i, among])][:5]
        np.testing.assert_array_equal(found.index[i, : len(best)], best)
        np.testing.assert_allclose(found.cost[i, : len(best)], cost[i, best], rtol=1e-4, atol=1e-5)
        assert (found.index[i, len(best) :] == -1).all() and np.isinf(found.cost[i, len(best) :]).all()
    everyone = shortlist((sa, sb), linear, Scale(1.0, 0.2, 0.3, 0.0), 5)
    np.testing.assert_array_equal(everyone.index[:, 0], cost.argmin(1))


def test_a_group_fills_whole_vectors():
    of_b = np.random.default_rng(3).integers(0, 6, 200)
    of_b[of_b == 4] = 5  # a group without members
    start, member = lanes_of(of_b)
    assert member.shape[1] == LANES
    for g in range(6):
        inside = member[start[g] : start[g + 1]].ravel()
        np.testing.assert_array_equal(inside[inside >= 0], np.flatnonzero(of_b == g))
        assert len(inside) == -(-(of_b == g).sum() // LANES) * LANES


@pytest.mark.parametrize(("n", "marks"), [(3, 5), (LANES, 4), (77, 7), (130, 64)])
def test_distances_equal_numpy_with_and_without_gaps(n, marks):
    rng = np.random.default_rng(9)
    xyz = rng.normal(size=(n + marks, 11, 3))
    for seen in (np.ones(xyz.shape[:2], bool), rng.random(xyz.shape[:2]) < 0.8):
        seen[:, 0] = True
        cloud, _ = clouds(*[TrackSet(xyz, seen, fps=30)] * 2)
        found = distances(cloud.take(np.arange(n)), cloud.take(np.arange(n, n + marks)))
        x = np.where(cloud.weight > 0, cloud.columns, np.nan).transpose(2, 1, 0)
        expected = np.nanmax(np.linalg.norm(x[:n, None] - x[None, n:], axis=-1), axis=-1)
        np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize(("n", "m"), [(50, 7), (1, 1), (33, 40)])
def test_nearest_equals_numpy(n, m):
    rng = np.random.default_rng(6)
    points, centers = rng.normal(size=(n, 4)).astype(np.float32), rng.normal(size=(m, 4)).astype(np.float32)
    centers[m // 2] = centers[0]  # of equals the first
    np.testing.assert_array_equal(nearest(points, centers), ((points[:, None] - centers) ** 2).sum(2).argmin(1))


def test_spread_and_one_to_one():
    points = np.random.default_rng(6).normal(size=(50, 4)).astype(np.float32)
    chosen = kernels.spread_out(points, 5, 3)
    for k in range(1, 5):
        apart = ((points[:, None] - points[chosen[:k]]) ** 2).sum(2).min(1)
        assert apart[chosen[k]] == pytest.approx(apart.max())
    i, j = np.array([0, 0, 1, 2, 2]), np.array([1, 0, 1, 1, 2])
    np.testing.assert_array_equal(kernels.one_to_one(i, j, 3, 3), [0, 4])


@given(hnp.arrays(np.float32, st.integers(0, 40), elements=st.floats(width=32)))
def test_ascending_is_numpys_stable_order(values):
    known = np.where(np.isnan(values), np.float32(np.inf), values)
    np.testing.assert_array_equal(ascending(values), np.argsort(known, kind="stable"))
    with pytest.raises(TypeError, match="expected float32; found float64"):
        ascending(values.astype(float))


def test_chirality_of_a_mirror_image_is_the_complement():
    rng = np.random.default_rng(7)
    points = rng.normal(size=(60, 1, 3)) + 0.01 * rng.normal(size=(60, 5, 3))
    assert chirality(points, points) == 1 and chirality(points, points * [-1, 1, 1]) == 0
    assert np.isnan(chirality(points[:3], points[:3]))
    # flat in either video: nobody can tell
    assert np.isnan(chirality(points * [1, 1, 0], points)) and np.isnan(chirality(points, points * [1, 1, 0]))


def test_distances_that_nobody_knows_do_not_agree():
    """Track 0 is never seen together with the landmark, in either video: that is no likeness."""
    rng = np.random.default_rng(8)
    seen = np.ones((6, 8), bool)
    seen[0, 4:] = False
    seen[5, :4] = False
    tracks = TrackSet(rng.normal(size=(6, 8, 3)), seen, features=rng.normal(size=(6, 4)), fps=30)
    a, b = clouds(tracks, tracks)
    mark = np.flatnonzero(a.index == 5)
    sa, sb = signatures(a, b, (a.take(mark), b.take(mark)), Scale(1.0, 0.05, 1.0, 1.0))
    apart = np.abs(sa - sb)[:, 0]
    stranger = a.index == 0
    assert (apart[stranger] > 1e3).all() and (apart[~stranger] == 0).all()
