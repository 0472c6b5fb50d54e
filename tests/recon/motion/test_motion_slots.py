"""The other motions in the scaffold's slot, checkpoints of all of them, and changes to a scaffold's nodes."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from otsync.types import TrackSet
from recon.motion import (
    BSpline,
    HermiteSpline,
    PerGaussian,
    Sampled,
    Static,
    TrackCurves,
    build_scaffold,
    density,
    motion_from_arrays,
)
from recon.motion.solve import FRAME
from recon.rotations import rotation_matrices, unit
from tests.recon.motion.worlds import (
    FOOTPRINT,
    Bodies,
    filmed,
    following,
    leaves,
    random_gaussians,
    random_scaffold,
)


@pytest.fixture(scope="module")
def carried():
    """A scaffold of two bodies, and points bound to it at two moments."""
    sets, offsets = filmed()
    scaffold = build_scaffold(sets, offsets, footprint=FOOTPRINT, frame_step=FRAME)
    bodies = Bodies(500, seed=9)
    means = torch.from_numpy(np.concatenate([bodies.at(0.3), bodies.at(0.9)[:300]])).float()
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(800, 1)
    return scaffold.bind(means[:500], 0.3).bind(means[500:], 0.9), means, quats, (sets, offsets)


# --- motions per Gaussian, and none


def test_paths_of_their_own_are_the_same_on_another_path(carried):
    scaffold, means, quats, _ = carried
    apart = following(scaffold, means).turning()
    sampled = apart.on(Sampled.of(0.0, 1.2, FRAME))
    for t in (0.0, 0.5, 1.2):
        found, wanted = sampled.warp(means, quats, t), apart.warp(means, quats, t)
        assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(found, wanted, strict=True))
    between = sampled.warp(means, quats, 0.5 + 0.4 * FRAME)[0]
    assert torch.equal(between, sampled.warp(means, quats, 0.5)[0])  # held


def test_gaussians_turn_in_front_of_their_own_orientation():
    means, quats = random_gaussians(4, torch.float64)
    motion = PerGaussian.at_rest(HermiteSpline(0.0, 0.1, 8), 4)
    assert motion.turns(0.3) is None and motion.warp(means, quats, 0.3)[1] is quats
    motion = motion.with_parameters({"own_knots": motion.own_knots.double()}).turning()
    assert torch.allclose(motion.warp(means, quats, 0.3)[1], quats, atol=1e-12)
    q = torch.tensor([0.8, 0.6, 0.0, 0.0], dtype=torch.float64)
    turned = motion.with_parameters({"own_knots": motion.own_knots, "own_quats": (3 * q).repeat(8, 4, 1)})
    found = rotation_matrices(unit(turned.warp(means, quats, 0.3)[1]))
    assert torch.allclose(found, rotation_matrices(q) @ rotation_matrices(unit(quats)), atol=1e-12)
    assert turned.warp(means, quats, torch.tensor([0.1, 0.3]))[1].shape == (2, 4, 4)


def test_neighbours_are_the_nearest_and_stay_with_their_gaussians():
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [7, 0, 0]])
    path = HermiteSpline(0.0, 0.1, 8)
    motion = PerGaussian(path, 0 * means.repeat(8, 1, 1)).tied(means, 0.0, neighbours=2)
    assert motion.near.tolist() == [[1, 2], [0, 2], [1, 0], [2, 1]]
    part = motion.take(torch.tensor([3, 1, 1, 2]))  # without the first; the second twice
    assert part.near.tolist() == [[3, 1], [1, 3], [2, 3], [1, 3]]
    assert motion.take(torch.tensor([True, False, True, True])).near.tolist() == [[0, 1], [1, 0], [1, 2]]
    few = PerGaussian.at_rest(path, 2).tied(means[:2], 0.0, neighbours=3)
    assert few.near.tolist() == [[1, 0, 0], [0, 1, 1]]  # there are no more: the Gaussian itself
    moved = PerGaussian(path, -means.repeat(8, 1, 1) + torch.tensor([[5.0], [1], [0], [4]]))
    assert moved.tied(means, 0.4, neighbours=1).near.tolist() == [[3], [2], [1], [0]]


def lines(speeds, frames=30, seen=None) -> TrackSet:
    """Tracks that begin one unit apart along x and go straight along y."""
    t = np.arange(frames) * FRAME
    xyz = np.zeros((len(speeds), frames, 3))
    xyz[..., 0] = np.arange(len(speeds))[:, None]
    xyz[..., 1] = np.array(speeds)[:, None] * t
    return TrackSet(xyz, visible=seen, fps=30.0, name="a")


def curves_of(*sets, offsets=None, span=(0.0, 1.0)) -> TrackCurves:
    offsets = np.zeros(len(sets)) if offsets is None else np.array(offsets)
    path = HermiteSpline.of(*span, 4 * FRAME, 4 * FRAME)
    return TrackCurves.of(sets, offsets, path, robust=0.03, acceleration=0.02)


def test_gaussians_go_with_the_tracks_beside_them():
    """At their moment they are where they were put, and elsewhere where the track near them is."""
    curves = curves_of(lines([1.0, 1.0, 1.0, -2.0, -2.0, -2.0]))
    points = np.array([[0.1, 0.5, 0.0], [4.9, -1.0, 0.3]])
    motion = PerGaussian.from_tracks(curves, points, 0.5)
    means = torch.from_numpy(points).float()
    assert torch.allclose(motion.warp(means, means, 0.5)[0], means, atol=1e-6)
    for t in (0.1, 0.9):
        moved = (motion.warp(means, means, t)[0] - means).numpy()
        np.testing.assert_allclose(moved, [[0, t - 0.5, 0], [0, -2 * (t - 0.5), 0]], atol=5e-3)
    both = motion.joined(PerGaussian.from_tracks(curves, points[:1], 0.2))
    assert torch.allclose(both.warp(means[[0, 1, 0]], means, 0.2)[0][2], means[0], atol=1e-6)
    with pytest.raises(ValueError, match="other: expected a motion like"):
        motion.joined(motion.turning())


def test_a_track_that_went_astray_is_not_followed():
    curves = curves_of(lines([1.0, 30.0, 1.0]))
    points = np.array([[1.0, 15.0, 0.0]])  # on the wild one
    far = PerGaussian.from_tracks(curves, points, 0.5).warp(torch.zeros(1, 3), torch.zeros(1, 4), 0.9)[0]
    assert float(far[0, 1]) == pytest.approx(0.4, abs=0.02)


def test_beyond_its_ends_a_track_comes_to_rest():
    seen = np.zeros((3, 30), bool)
    seen[:, 8:20] = True
    curves = curves_of(lines([1.0] * 3, seen=seen))
    assert curves.first == pytest.approx(8 * FRAME) and curves.last == pytest.approx(19 * FRAME)
    motion = PerGaussian.from_tracks(curves, np.zeros((1, 3)), 14 * FRAME)

    def speed(t):
        a, b = (motion.warp(torch.zeros(1, 3), torch.zeros(1, 4), s)[0] for s in (t, t + FRAME))
        return float((b - a).norm() / FRAME)

    assert speed(14 * FRAME) == pytest.approx(1.0, abs=0.02) and speed(20 * FRAME) > 0.5
    assert speed(0.0) < 0.5 and speed(1.1) < 0.25  # a third is left after eight frames


def test_tracks_of_several_clocks_and_one_that_was_never_seen():
    late = lines([1.0, 1.0, 1.0])
    nothing = replace(late, visible=np.zeros((3, 30), bool), name="b")
    curves = curves_of(late, nothing, offsets=[0.2, 0.0], span=(0.0, 1.2))
    assert len(curves) == 3 and curves.first == pytest.approx(0.2)
    before = PerGaussian.from_tracks(curves, np.zeros((1, 3)), 0.0)  # when none is seen, all may be followed
    assert float(before.warp(torch.zeros(1, 3), torch.zeros(1, 4), 1.0)[0][0, 1]) > 0.7
    with pytest.raises(ValueError, match="tracks: expected at least one visible sample"):
        curves_of(nothing)


def test_paths_of_their_own_are_learnt_and_taken():
    path = HermiteSpline(0.0, 0.1, 8)
    motion = PerGaussian(path, torch.randn(8, 6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    means = torch.randn(6, 3, dtype=torch.float64)
    t = torch.tensor(0.33, dtype=torch.float64, requires_grad=True)
    knots = motion.own_knots.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda k, s: motion.with_parameters({"own_knots": k}).warp(means, means, s)[0], (knots, t)
    )
    part = motion.take(torch.tensor([4, 4, 0]))
    assert torch.equal(part.warp(means[[4, 4, 0]], means, 0.5)[0], motion.warp(means, means, 0.5)[0][[4, 4, 0]])


def test_nothing_moves_and_nothing_is_computed():
    means, quats = random_gaussians(5)
    motion = Static()
    assert motion.parameters() == {} and motion.take(np.arange(2)) is motion and motion.with_parameters({}) is motion
    x, q = motion.warp(means, quats, 0.3)
    assert x is means and q is quats


# --- checkpoints


@pytest.mark.parametrize("videos", [0, 2])
def test_motions_survive_their_arrays(videos, tmp_path):
    scaffold = random_scaffold(videos=videos, blend="dual-quaternion")
    path = HermiteSpline(0.0, 0.1, 8)
    gaussians = random_gaussians(200)
    own = PerGaussian(path, torch.randn(8, 200, 3))
    whole = replace(own.turning().tied(gaussians[0], 0.1), own_quats=torch.randn(8, 200, 4))
    assert "own_quats" not in own.arrays() and "near" not in own.arrays()  # files of before have neither
    for motion in (scaffold, scaffold.on(Sampled(0.0, FRAME, 30)), own, whole, Static()):
        np.savez(tmp_path / "motion.npz", **motion.arrays())
        with np.load(tmp_path / "motion.npz", allow_pickle=False) as file:
            again = motion_from_arrays(dict(file))
        assert type(again) is type(motion)
        if motion is whole:
            assert torch.equal(again.near, whole.near)
        for a, b in zip(again.warp(*gaussians, 0.31), motion.warp(*gaussians, 0.31), strict=True):
            assert torch.equal(a, b)
        if motion is scaffold:
            for f in fields(scaffold.binding):
                assert torch.equal(getattr(again.binding, f.name), getattr(scaffold.binding, f.name))


def test_arrays_that_are_no_motion_are_refused():
    arrays = random_scaffold().arrays()
    for broken in ({}, {"kind": np.array("os")}, {k: v for k, v in arrays.items() if k != "knots"}):
        with pytest.raises(ValueError, match=r"arrays|kind: expected"):
            motion_from_arrays(broken)
    with pytest.raises(ValueError, match="knots"):
        motion_from_arrays(arrays | {"knots": arrays["knots"][1:]})


def test_learnable_tensors_are_replaced_not_copied():
    scaffold = random_scaffold()
    knots = leaves(scaffold.parameters())
    other = scaffold.with_parameters(knots)
    assert set(knots) == {"knots", "knot_quats"} and other.knots is knots["knots"]
    assert other.binding is scaffold.binding  # its layout is computed once
    assert other.to("cpu").knots is knots["knots"]


# --- more nodes, fewer nodes


def test_nodes_grow_where_gaussians_pull(carried):
    scaffold, means, quats, _ = carried
    pull = 0.1 + 0 * means[:, 0]
    high = means[:, 1] > 0.45
    pull[high] = 1.0
    change = density.grow(scaffold, means, pull, most=20)
    grown, new = change.scaffold, change.source < 0
    assert 0 < int(new.sum()) <= 20 and torch.equal(change.source[~new], torch.arange(len(scaffold)))
    assert torch.equal(grown.knots[:, ~new], scaffold.knots)
    place = grown.nodes(0.3)[0][new]
    assert (place[:, 1] > 0.3).all()  # about where it was asked for
    nearest = torch.cdist(place, scaffold.nodes(0.3)[0]).amin(1)
    assert (nearest > 0.3 * scaffold.unit).all()
    # the others are carried on as before
    for t, most in ((0.3, 2e-2), (0.6, 2e-2), (0.9, 2e-2)):
        away = (grown.warp(means, quats, t)[0] - scaffold.warp(means, quats, t)[0]).norm(dim=1)
        assert away.quantile(0.95) < most and away.median() < 2e-3
    bound = grown.binding
    assert (bound.weights.sum(1) - 1).abs().max() < 1e-5 and torch.equal(bound.rest, scaffold.binding.rest)
    assert (bound.nodes[:, 0] >= len(scaffold)).any()
    q = unit(grown.knot_quats)
    assert ((q[1:] * q[:-1]).sum(-1) > 0).all()


@pytest.mark.parametrize("kind", [HermiteSpline, BSpline])
def test_a_rigid_motion_is_not_changed_by_growing(kind):
    from scipy.spatial.transform import Rotation

    from recon.rotations import continuous, quaternions

    rng = np.random.default_rng(0)
    scaffold = random_scaffold(gaussians=0, rests=(), dtype=torch.float64)
    swing = 0.8 * np.sin(1.3 * np.arange(8))  # unevenly: knots of an even turn are turned as its curve is
    turns = Rotation.from_rotvec(swing[:, None] * np.array([0, 0.6, 0.8]))
    cloud = rng.normal(size=(40, 3))
    path = kind(0.0, 4 * FRAME, 8)
    knots = torch.from_numpy(path.through(np.stack([r.apply(cloud) for r in turns])))
    quats = torch.from_numpy(path.through(continuous(quaternions(turns.as_matrix()))))[:, None].repeat(1, 40, 1)
    scaffold = replace(scaffold, path=path, knots=knots, knot_quats=quats)
    means = rng.normal(size=(300, 3))
    bound = scaffold.bind(means[:150], 8 * FRAME).bind(means[150:], 20 * FRAME)
    pull, points = torch.from_numpy(rng.exponential(size=300) ** 3), torch.from_numpy(means)
    change = density.grow(bound, points, pull)
    assert len(change.scaffold) > 40
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(300, 1)
    for t in (0.0, 12 * FRAME, 28 * FRAME):
        a, b = bound.warp(points, upright, t), change.scaffold.warp(points, upright, t)
        assert torch.allclose(a[0], b[0], atol=1e-9)
        assert torch.allclose(rotation_matrices(unit(a[1])), rotation_matrices(unit(b[1])), atol=1e-9)


def test_gradients_of_nodes_are_means_over_their_gaussians():
    scaffold = random_scaffold()
    pull = torch.rand(200)
    found = density.node_gradients(scaffold, pull)
    bound = scaffold.binding
    for m in (0, 17):
        share = (bound.weights * (bound.nodes == m)).sum(1)
        assert float(found[m]) == pytest.approx(float((share * pull).sum() / share.sum()), rel=1e-4)
    assert torch.equal(density.grow(scaffold, random_gaussians(200)[0], 0 * pull).source, torch.arange(len(scaffold)))
    with pytest.raises(ValueError, match="gradients"):
        density.grow(scaffold, random_gaussians(200)[0], pull[:5])


def test_nodes_without_gaussians_are_pruned(carried):
    scaffold, means, quats, _ = carried
    left = np.flatnonzero(means[:, 0].numpy() < 0)
    part = scaffold.take(left)
    change = density.prune(part)
    pruned = change.scaffold
    assert len(pruned) < 0.8 * len(scaffold) and len(change.source) == len(pruned)
    assert torch.equal(pruned.knots, scaffold.knots[:, change.source])
    largest = torch.zeros(len(pruned)).scatter_reduce(
        0, pruned.binding.nodes.ravel(), pruned.binding.weights.ravel(), "amax"
    )
    assert (largest >= 0.02).all() and (pruned.binding.weights.sum(1) - 1).abs().max() < 1e-5
    away = pruned.warp(means[left], quats[left], 0.6)[0] - part.warp(means[left], quats[left], 0.6)[0]
    assert away.norm(dim=1).max() < 5e-3
    every = density.prune(pruned)
    assert len(every.scaffold) == len(pruned)
    assert len(density.prune(scaffold.take(left[:0])).scaffold) == len(scaffold)
    with pytest.raises(ValueError, match="least"):
        density.prune(scaffold, least=0.5)


def test_a_change_of_one_videos_nodes_stays_with_it():
    scaffold = random_scaffold(gaussians=0, rests=(), videos=2)
    points = np.random.default_rng(0).normal(size=(200, 3))
    bound = scaffold.bind(points[:100], 0.2, video=0).bind(points[100:], 0.2, video=1)
    pull = torch.cat([torch.full((100,), 0.1), torch.full((100,), 1.0)])
    pull[::7] *= 30
    grown = density.grow(bound, torch.from_numpy(points).float(), pull).scaffold
    assert len(grown) > len(scaffold)
    owner = grown.clock[grown.binding.nodes]
    assert (owner[:100] == 0).all() and (owner[100:] == 1).all()
    tied = grown.edge_weights > 0
    assert (grown.clock[grown.edges] == grown.clock[:, None])[tied].all()
    assert len(density.prune(grown).scaffold.clock) == len(density.prune(grown).scaffold)


def test_neighbours_found_anew_are_those_of_building(carried):
    scaffold = carried[0]
    again = density.retie(scaffold)
    same = [len(set(a) & set(b)) for a, b in zip(again.edges.tolist(), scaffold.edges.tolist(), strict=True)]
    assert np.mean(same) > 7.5
    bound = density.rebind(scaffold, carried[1]).binding
    assert torch.equal(bound.nodes, scaffold.binding.nodes)
    assert torch.allclose(bound.weights, scaffold.binding.weights, atol=1e-5)
