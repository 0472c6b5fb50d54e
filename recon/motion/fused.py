"""Warp, poses of nodes and motion losses as single autograd nodes over compiled kernels: float32 on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from otsync.compute.threads import for_each, get_threads, ranges
from recon.motion import pose_kernels
from recon.motion import warp_kernels as kernels
from recon.motion.binding import NODES, Binding
from recon.motion.paths import Path

LEAST_NODES, LEAST_GAUSSIANS, LEAST_PAIRS = 64, 1024, 256  # from which another thread is worth its start


@dataclass(frozen=True, eq=False)
class Rig:
    """The constants of a scaffold. clock int32 [M]: which of the V own times is each node's."""

    path: Path
    binding: Binding
    clock: np.ndarray
    dual: bool


def applies(*tensors: Tensor) -> bool:
    """Whether the kernels take these tensors; else the definitions in torch do."""
    return all(x.dtype == torch.float32 and x.device.type == "cpu" for x in tensors)


def warp(
    means: Tensor, quats: Tensor, times: Tensor, knots: Tensor, knot_quats: Tensor, rig: Rig
) -> tuple[Tensor, Tensor]:
    """As :func:`recon.motion.warp.blend` with the nodes at own times float64 [V]; differentiable in all five."""
    return _Warp.apply(means, quats, times, knots, knot_quats, rig)


def poses(times: Tensor, knots: Tensor, knot_quats: Tensor, path: Path, clock: np.ndarray) -> tuple[Tensor, Tensor]:
    """Positions [M,3] and unit quaternions [M,4] of nodes at own times float64 [V]; differentiable in all three."""
    return _Poses.apply(times, knots, knot_quats, path, clock)


def penalty(knots: Tensor, knot_quats: Tensor, compute: Callable[..., float]) -> Tensor:
    """A scalar of the knots: `compute(knots, quats, g_knots, g_quats)` returns it and adds up its gradient."""
    return _Penalty.apply(knots, knot_quats, compute)


def _array(t: Tensor) -> np.ndarray:
    return t.detach().contiguous().numpy()


def _flat(t: Tensor) -> np.ndarray:
    return _array(t).reshape(-1)


def _parts(n: int, least: int) -> list[tuple[int, int]]:
    """Pieces for the threads. Every output has one owner, so that any cut gives the same result."""
    return ranges(n, max(least, -(-n // (2 * get_threads()))) if get_threads() > 1 else max(n, 1))


class _Warp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, times, knots, knot_quats, rig):
        n, layout, bound = len(means), rig.binding.layout, rig.binding
        first, weights, slopes = rig.path.basis(times.detach().numpy())
        curves, moment = (_array(knots), _array(knot_quats), rig.clock), (first, weights)
        pairs = (*bound.pair_rests, layout.node_starts)
        rows = np.zeros(len(layout.node) * kernels.ROW, np.float32)
        for_each(kernels.relative, _parts(knots.shape[1], LEAST_NODES), curves, moment, pairs, rig.dual, rows)
        slots = (layout.of_slot, _array(bound.weights))
        signed, total = np.empty((n, NODES), np.float32), np.empty(n * kernels.ROW, np.float32)
        moved = np.empty(3 * n, np.float32), np.empty(4 * n, np.float32)
        gaussians = _flat(means), _flat(quats)
        for_each(kernels.carry, _parts(n, LEAST_GAUSSIANS), slots, rows, rig.dual, *gaussians, signed, total, *moved)
        ctx.save_for_backward(means, quats, knots, knot_quats)
        ctx.rig, ctx.basis, ctx.kept = rig, (moment, slopes), (signed, total)
        return torch.from_numpy(moved[0]).view(n, 3), torch.from_numpy(moved[1]).view(n, 4)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_means, g_quats):
        means, quats, knots, knot_quats = (_array(t) for t in ctx.saved_tensors)
        (moment, slopes), (signed, total), rig = ctx.basis, ctx.kept, ctx.rig
        n, m, layout, bound, dual = len(means), knots.shape[1], rig.binding.layout, rig.binding, rig.dual
        outgoing = np.empty(3 * n, np.float32), np.empty(4 * n, np.float32)
        g_total = np.zeros(n * kernels.ROW, np.float32)
        gaussians, incoming = (means.reshape(-1), quats.reshape(-1)), (_flat(g_means), _flat(g_quats))
        for_each(kernels.lift, _parts(n, LEAST_GAUSSIANS), total, dual, *gaussians, incoming, outgoing, g_total)
        g_rows = np.empty(len(layout.node) * kernels.ROW, np.float32)
        using = (layout.starts, layout.slots, _array(bound.weights), signed)
        for_each(kernels.gather, _parts(len(layout.node), LEAST_PAIRS), *using, dual, g_total, g_rows)
        curves, pairs = (knots, knot_quats, rig.clock), (*bound.pair_rests, layout.node_starts)
        outputs = np.zeros_like(knots), np.zeros_like(knot_quats), np.empty(m)
        for_each(kernels.lower, _parts(m, LEAST_NODES), curves, moment, slopes, pairs, dual, g_rows, *outputs)
        g_own = np.bincount(rig.clock, outputs[2], minlength=len(slopes))
        of_gaussians = (torch.from_numpy(a).view(n, d) for a, d in zip(outgoing, (3, 4), strict=True))
        return *of_gaussians, *(torch.from_numpy(a) for a in (g_own, *outputs[:2])), None


class _Poses(torch.autograd.Function):
    @staticmethod
    def forward(ctx, times, knots, knot_quats, path, clock):
        first, weights, slopes = path.basis(times.detach().numpy())
        m = knots.shape[1]
        positions, quats = np.empty((m, 3), np.float32), np.empty((m, 4), np.float32)
        curves = (_array(knots), _array(knot_quats), clock)
        pose_kernels.poses(0, m, curves, (first, weights), positions, quats)
        ctx.save_for_backward(knots, knot_quats)
        ctx.clock, ctx.basis = clock, ((first, weights), slopes)
        return torch.from_numpy(positions), torch.from_numpy(quats)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_positions, g_quats):
        knots, knot_quats = (_array(t) for t in ctx.saved_tensors)
        moment, slopes = ctx.basis
        outputs = np.zeros_like(knots), np.zeros_like(knot_quats), np.empty(knots.shape[1])
        incoming = (_array(g_positions), _array(g_quats))
        curves = (knots, knot_quats, ctx.clock)
        pose_kernels.poses_backward(0, knots.shape[1], curves, moment, slopes, incoming, *outputs)
        g_own = np.bincount(ctx.clock, outputs[2], minlength=len(slopes))
        return *(torch.from_numpy(a) for a in (g_own, *outputs[:2])), None, None


class _Penalty(torch.autograd.Function):
    @staticmethod
    def forward(ctx, knots, knot_quats, compute):
        gradients = np.zeros(knots.shape, np.float32), np.zeros(knot_quats.shape, np.float32)
        value = compute(_array(knots), _array(knot_quats), *gradients)
        ctx.gradients = tuple(torch.from_numpy(g) for g in gradients)
        return knots.new_tensor(value)

    @staticmethod
    @once_differentiable
    def backward(ctx, g):
        return *(g * gradient for gradient in ctx.gradients), None
