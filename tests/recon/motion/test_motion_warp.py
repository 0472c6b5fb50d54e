"""Carrying Gaussians with nodes: kernels against the definition, the definition against its laws."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from otsync.compute.threads import get_threads, set_threads
from recon.motion import Binding, HermiteSpline, Sampled, Scaffold, fused
from recon.motion import warp as warping
from recon.rotations import conjugate, product, quaternions, rotation_matrices, unit
from tests.recon.motion.worlds import leaves, random_gaussians, random_scaffold

BLENDS = ["linear", "dual-quaternion"]


def definition(scaffold, means, quats, t, clocks=None):
    """The warp in torch whatever the dtype."""
    wide = scaffold.with_parameters({k: v.double() for k, v in scaffold.parameters().items()})
    positions, node_quats = wide.nodes(t, clocks)
    return warping.blend(scaffold.binding, positions, node_quats, means.double(), quats.double(), scaffold.blend)


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("videos", [0, 3])
@pytest.mark.parametrize("turn", [0.3, 2.0])
def test_the_kernels_are_the_definition(blend, videos, turn):
    """Values and every gradient against float64. With much turning neighbours lie in opposite hemispheres."""
    scaffold = random_scaffold(gaussians=300, blend=blend, videos=videos, turn=turn)
    gaussians = random_gaussians(300)
    g = [torch.from_numpy(np.random.default_rng(2).normal(size=(300, d))) for d in (3, 4)]
    found = []
    for carry in (Scaffold.warp, definition):
        knots, (means, quats) = leaves(scaffold.parameters()), (x.clone().requires_grad_() for x in gaussians)
        t = torch.tensor(0.43, dtype=torch.float64, requires_grad=True)
        clocks = torch.tensor([0.02, -0.05, 0.01], dtype=torch.float64, requires_grad=True) if videos else None
        out = carry(scaffold.with_parameters(knots), means, quats, t, clocks)
        loss = sum((x.double() * y).sum() for x, y in zip(out, g, strict=True))
        asked = [means, quats, t, *knots.values()] + ([clocks] if videos else [])
        found.append([*(x.detach() for x in out), *torch.autograd.grad(loss, asked)])
    if turn > 1:
        bound = scaffold.binding
        turns = product(scaffold.nodes(0.43)[1][bound.nodes], conjugate(bound.quats[bound.rest[:, None], bound.nodes]))
        assert ((turns * turns[:, :1]).sum(-1) < 0).any()
    # where opposite rotations nearly cancel, gradients are large and float32 is what it is
    for a, b in zip(*found, strict=True):
        scale = b.abs().amax().clamp_min(1)
        worst = ((a - b).abs() / scale).flatten()
        assert worst.quantile(0.98) < 2e-5 and worst.max() < 2e-3


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("videos", [0, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["kernels", "torch"])
def test_several_moments_at_once_are_each_of_them(blend, videos, dtype):
    """Values and gradients of poses and of what they carry."""
    scaffold = random_scaffold(gaussians=40, blend=blend, videos=videos, turn=1.0, dtype=dtype)
    knots = leaves(scaffold.parameters())
    scaffold, gaussians = scaffold.with_parameters(knots), random_gaussians(40, dtype)
    t = torch.tensor([0.43, -3.0, 0.1], dtype=torch.float64, requires_grad=True)
    clocks = torch.tensor([0.02, -0.05, 0.01], dtype=torch.float64, requires_grad=True) if videos else None
    asked = [t, *knots.values()] + ([clocks] if videos else [])
    g, found = [np.random.default_rng(d).normal(size=(3, n, d)) for n, d in ((40, 3), (40, 4))], []
    for at_once in (True, False):
        if at_once:
            out = [*scaffold.warp(*gaussians, t, clocks), *scaffold.nodes(t, clocks)]
        else:
            each = [(*scaffold.warp(*gaussians, s, clocks), *scaffold.nodes(s, clocks)) for s in t]
            out = [torch.stack(parts) for parts in zip(*each, strict=True)]
        loss = sum((x.double() * torch.from_numpy(y)).sum() for x, y in zip(out[:2], g, strict=True))
        found.append([*(x.detach() for x in out), *torch.autograd.grad(loss, asked)])
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    for a, b in zip(*found, strict=True):
        assert float((a - b).abs().max()) <= tolerance * float(b.abs().max())


@pytest.mark.parametrize("blend", BLENDS)
def test_gradcheck_of_the_definition(blend):
    scaffold = random_scaffold(nodes=6, gaussians=2, knots=5, blend=blend, videos=2, dtype=torch.float64)
    means, quats = (x.requires_grad_() for x in random_gaussians(2, torch.float64))
    knots = leaves(scaffold.parameters())
    t = torch.tensor(0.37, dtype=torch.float64, requires_grad=True)
    clocks = torch.tensor([0.02, -0.03], dtype=torch.float64, requires_grad=True)

    def carry(m, q, t, clocks, p, r):
        return scaffold.with_parameters({"knots": p, "knot_quats": r}).warp(m, q, t, clocks)

    assert torch.autograd.gradcheck(carry, (means, quats, t, clocks, *knots.values()))


def test_poses_by_kernels_are_those_of_torch():
    scaffold = random_scaffold(videos=3)
    found = []
    for dtype in (torch.float32, torch.float64):
        knots = leaves({k: v.to(dtype) for k, v in scaffold.parameters().items()})
        t = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
        p, q = scaffold.with_parameters(knots).nodes(t)
        loss = (p * torch.arange(3)).sum() + (q * torch.arange(4)).square().sum()
        found.append([p.detach(), q.detach(), *torch.autograd.grad(loss, [t, *knots.values()])])
    for a, b in zip(*found, strict=True):
        assert torch.allclose(a.double(), b, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("blend", BLENDS)
def test_results_do_not_depend_on_the_threads(blend):
    scaffold = random_scaffold(nodes=300, gaussians=5000, blend=blend)
    gaussians = random_gaussians(5000)

    def run(threads):
        set_threads(threads)
        knots, (means, quats) = leaves(scaffold.parameters()), (x.clone().requires_grad_() for x in gaussians)
        t = torch.tensor(0.43, dtype=torch.float64, requires_grad=True)
        x, q = scaffold.with_parameters(knots).warp(means, quats, t)
        (x.square().sum() + q.sum()).backward()
        return [x, q, means.grad, quats.grad, t.grad, *(k.grad for k in knots.values())]

    before = get_threads()
    try:
        alone, together = run(1), run(3)
    finally:
        set_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(alone, together, strict=True))


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_moves_at_the_rest(blend, dtype):
    scaffold = random_scaffold(rests=(0.2,), blend=blend, dtype=dtype)
    scaffold = replace(scaffold, binding=Binding.empty(len(scaffold), scaffold.knots))
    points, quats = random_gaussians(50, dtype)
    bound = scaffold.bind(points[:30], 0.15).bind(points[30:], 0.52)
    for part, t in ((slice(0, 30), 0.15), (slice(30, 50), 0.52)):
        x, q = bound.warp(points, quats, t)
        assert torch.allclose(x[part], points[part], atol=1e-5 if dtype == torch.float32 else 1e-12)
        assert torch.allclose(q[part], quats[part], atol=1e-5 if dtype == torch.float32 else 1e-12)


@pytest.mark.parametrize("blend", BLENDS)
def test_nodes_that_move_rigidly_carry_gaussians_rigidly(blend):
    """All nodes turn and shift together, far past 180 degrees: every Gaussian does the same, wherever it is bound."""
    rng = np.random.default_rng(0)
    P, M = 16, 30
    turns = Rotation.from_rotvec(np.radians(25) * np.arange(P)[:, None] * np.array([0.6, 0.0, 0.8]))
    shifts = rng.normal(size=(P, 3))
    base, own = rng.normal(size=(M, 3)), Rotation.random(M, random_state=3)
    knots = np.stack([r.apply(base) + s for r, s in zip(turns, shifts, strict=True)])
    quats = np.stack([quaternions((r * own).as_matrix()) for r in turns])  # arbitrary signs: the warp must not care
    scaffold = Scaffold(
        HermiteSpline(0.0, 1.0, P),
        torch.from_numpy(knots),
        torch.from_numpy(quats),
        torch.from_numpy(np.stack([rng.permutation(np.delete(np.arange(M), m))[:10] for m in range(M)])),
        torch.ones(M, 10, dtype=torch.float64),
        1.0,
        Binding.empty(M, torch.from_numpy(knots)),
        blend=blend,
    )
    points, orientation = random_gaussians(40, torch.float64)
    for dtype, atol in ((torch.float64, 1e-9), (torch.float32, 2e-5)):
        cast = replace(
            scaffold,
            knots=scaffold.knots.to(dtype),
            knot_quats=scaffold.knot_quats.to(dtype),
            edge_weights=scaffold.edge_weights.to(dtype),
            binding=Binding.empty(M, scaffold.knots.to(dtype)),
        )
        bound = cast.bind(points.to(dtype), 4.0)
        for p in (0, 7, 15):  # at knots the splined nodes are rigid to each other
            x, q = bound.warp(points.to(dtype), orientation.to(dtype), float(p))
            relative = turns[p] * turns[4].inv()
            want = relative.apply(points.numpy() - shifts[4]) + shifts[p]
            assert np.abs(x.numpy() - want).max() < atol
            R = rotation_matrices(unit(orientation)).numpy()
            assert np.abs(rotation_matrices(unit(q)).numpy() - relative.as_matrix() @ R).max() < atol
            assert torch.allclose(q.norm(dim=1), orientation.norm(dim=1).to(dtype), atol=1e-5)


def test_between_two_poses_dual_quaternions_stay_rigid_where_linear_blending_shrinks():
    """A point half-way between a still node and one turned by 120 degrees about it: the candy wrapper."""
    turned = quaternions(Rotation.from_rotvec([0, 0, np.radians(120)]).as_matrix())
    knots = torch.zeros(4, 2, 3, dtype=torch.float64)
    quats = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(4, 2, 1)
    binding = Binding(
        torch.zeros(1, dtype=torch.int64),
        torch.tensor([[0, 1, 0, 0, 0, 0, 0, 0]]),
        torch.tensor([[0.5, 0.5, 0, 0, 0, 0, 0, 0]], dtype=torch.float64),
        torch.zeros(1, dtype=torch.float64),
        knots[:1],
        quats[:1],
    )
    quats = quats.clone()
    quats[1:, 1] = torch.from_numpy(turned)
    mean, upright = torch.tensor([[1.0, 0, 0.3]], dtype=torch.float64), torch.tensor([[1.0, 0, 0, 0]]).double()
    radius = {}
    for blend in BLENDS:
        tie = (torch.zeros(2, 1, dtype=torch.int64), torch.ones(2, 1, dtype=torch.float64))
        scaffold = Scaffold(HermiteSpline(0.0, 1.0, 4), knots, quats, *tie, 1.0, binding, blend=blend)
        x, q = scaffold.warp(mean, upright, 1.0)
        radius[blend] = float(x[0, :2].norm())
        assert torch.allclose(q[0], torch.from_numpy(quaternions(Rotation.from_rotvec([0, 0, np.pi / 3]).as_matrix())))
    assert radius["dual-quaternion"] == pytest.approx(1.0) and radius["linear"] == pytest.approx(0.5)


def test_rows_are_taken_for_pruning_and_duplication():
    scaffold = random_scaffold()
    means, quats = random_gaussians(200)
    x, q = scaffold.warp(means, quats, 0.3)
    mask = np.arange(200) % 3 == 0
    for index in (mask, torch.from_numpy(mask), np.array([5, 5, 199]), torch.tensor([0])):
        part = scaffold.take(index)
        found = part.warp(means[index], quats[index], 0.3)
        assert torch.equal(found[0], x[index]) and torch.equal(found[1], q[index])
    none = scaffold.take(np.zeros(200, bool))
    empty, _ = none.warp(means[:0], quats[:0], torch.tensor(0.3, dtype=torch.float64, requires_grad=True))
    assert empty.shape == (0, 3)
    empty.sum().backward()
    with pytest.raises(ValueError, match="means"):
        scaffold.warp(means[:3], quats[:3], 0.3)


def test_a_scaffold_per_video_is_evaluated_on_its_own_clock():
    """conventions.md: a spline on video u's own clock is asked, for a frame of v, at t_v + offset_v - offset_u."""
    scaffold = random_scaffold(videos=3, gaussians=0, rests=())
    scaffold = replace(scaffold, rates=torch.ones(3, dtype=torch.float64))
    offsets = torch.tensor([0.0, 0.1, -0.2], dtype=torch.float64)
    t_v, v = 0.3, 1
    positions, _ = scaffold.nodes(t_v + offsets[v], offsets)
    for u in range(3):
        mine = scaffold.clock == u
        want = scaffold.path.at(scaffold.knots, t_v + float(offsets[v] - offsets[u]))[mine]
        assert torch.allclose(positions[mine], want, atol=1e-6)
    # where no clocks are given, those of building
    assert torch.equal(scaffold.nodes(0.2)[0], scaffold.nodes(0.2, scaffold.offsets)[0])
    with pytest.raises(ValueError, match="clocks"):
        scaffold.nodes(0.2, offsets[:2])
    # a later start: the same own second comes later in world time
    later = scaffold.nodes(0.2 + 0.5, offsets + 0.5)[0]
    assert torch.allclose(later, scaffold.nodes(0.2, offsets)[0], atol=1e-6)


def test_points_of_a_video_are_bound_to_its_own_nodes():
    scaffold = random_scaffold(videos=2, gaussians=0, rests=())
    points = np.random.default_rng(0).normal(size=(60, 3))
    bound = scaffold.bind(points, 0.2, video=1)
    assert (scaffold.clock[bound.binding.nodes] == 1).all()
    anyone = scaffold.bind(points, 0.2)
    assert set(scaffold.clock[anyone.binding.nodes[:, 0]].tolist()) == {0, 1}
    with pytest.raises(ValueError, match="video"):
        scaffold.bind(points, 0.2, video=7)


def test_binding_weights():
    """Sum one, none on masked edges, the nearest node first and heaviest; far points follow their nearest node."""
    scaffold = random_scaffold(gaussians=0, rests=())
    points = np.concatenate([np.random.default_rng(0).normal(size=(100, 3)), [[1e4, 0, 0]]])
    bound = scaffold.bind(points, 0.2).binding
    positions = scaffold.nodes(0.2)[0]
    assert torch.allclose(bound.weights.sum(1), torch.ones(101))
    away = torch.cdist(torch.from_numpy(points).float(), positions, compute_mode="donot_use_mm_for_euclid_dist")
    assert torch.equal(bound.nodes[:100, 0], away[:100].argmin(1))
    assert (bound.weights.argmax(1) == 0).all() and bound.weights.isfinite().all()
    masked = scaffold.edge_weights[bound.nodes[:, 0], :7] == 0
    assert (bound.weights[:, 1:][masked] == 0).all()
    with pytest.raises(ValueError, match="points"):
        scaffold.bind(np.full((2, 3), np.nan), 0.2)


def test_equal_rests_are_kept_once():
    scaffold = random_scaffold(gaussians=0, rests=())
    points = np.random.default_rng(0).normal(size=(10, 3))
    twice = scaffold.bind(points, 0.2).bind(points, 0.2).bind(points, 0.3)
    assert len(twice.binding.times) == 2 and twice.binding.rest.tolist() == [0] * 20 + [1] * 10
    assert len(twice.binding) == 30 and twice.rest_positions.shape == (2, len(scaffold), 3)


def test_the_sampled_scaffold_stands_still_between_samples():
    scaffold = random_scaffold(rests=(0.2,))
    path = Sampled.of(0.0, 0.9, 1 / 30)
    sampled = scaffold.on(path)
    means, quats = random_gaussians(200)
    for k in (3, 11):
        at = path.times[k]
        a, b = scaffold.warp(means, quats, at), sampled.warp(means, quats, at + 0.01)
        assert torch.allclose(a[0], b[0], atol=1e-5) and torch.allclose(a[1], b[1], atol=1e-5)
    t = torch.tensor(0.31, dtype=torch.float64, requires_grad=True)
    x, _ = sampled.warp(means, quats, t)
    x.sum().backward()
    assert t.grad == 0  # "w/o spline": time has no gradient, offsets cannot be refined


def test_what_does_not_fit_is_refused():
    scaffold = random_scaffold()
    with pytest.raises(ValueError, match="blend"):
        replace(scaffold, blend="cubic")
    with pytest.raises(ValueError, match="knot_quats"):
        replace(scaffold, knot_quats=scaffold.knot_quats[:, :3])
    with pytest.raises(ValueError, match="offsets, rates"):
        replace(scaffold, clock=torch.zeros(len(scaffold), dtype=torch.int64))


def test_float32_on_the_cpu_is_what_the_kernels_take():
    assert fused.applies(torch.zeros(1), torch.ones(2)) and not fused.applies(torch.zeros(1), torch.zeros(1).double())


@pytest.mark.slow
def test_a_processor_without_avx_carries_the_same(tmp_path):
    """Compiled for the least x86-64 there is: a row of eight lanes twice instead of sixteen once."""
    env = {**os.environ, "NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(tmp_path)}
    code = "from otsync.compute.simd import LANES; assert LANES == 8, LANES; import pytest; "
    code += f"raise SystemExit(pytest.main(['-q', '-x', '-m', 'not slow', {str(Path(__file__))!r}]))"
    root = Path(__file__).parents[3]
    result = subprocess.run([sys.executable, "-c", code], env=env, cwd=root, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout[-3000:]
