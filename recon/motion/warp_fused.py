"""The warp as one autograd node over compiled kernels: float32 on the CPU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from recon.motion import warp_kernels as kernels
from recon.motion.binding import NODES, Binding
from recon.motion.paths import Path
from recon.raster.cpu.threads import for_each, get_threads, ranges


@dataclass(frozen=True, eq=False)
class Rig:
    """What a warp needs that is no tensor of the graph: constants of the scaffold.

    clock int32 [M]: which of the V own times each node lives on. rates float64 [V].
    """

    path: Path
    binding: Binding
    clock: np.ndarray
    dual: bool


def warp(
    means: Tensor, quats: Tensor, times: Tensor, knots: Tensor, knot_quats: Tensor, rig: Rig
) -> tuple[Tensor, Tensor]:
    """As :func:`recon.motion.warp.blend` after the nodes' poses at own times float64 [V]; differentiable in all five."""
    return _Warp.apply(means, quats, times, knots, knot_quats, rig)


def _array(t: Tensor) -> np.ndarray:
    return t.detach().contiguous().numpy()


def _flat(t: Tensor) -> np.ndarray:
    return _array(t).reshape(-1)


def _parts(n: int, least: int) -> list[tuple[int, int]]:
    """Pieces for the threads. Every output has one owner, so that any cut gives the same result."""
    return ranges(n, max(least, -(-n // (2 * get_threads())) if get_threads() > 1 else n))


class _Warp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, times, knots, knot_quats, rig):
        n, layout, bound = len(means), rig.binding.layout, rig.binding
        first, weights, slopes = rig.path.basis(times.detach().numpy())
        curves = (_array(knots), _array(knot_quats), rig.clock)
        pairs = (*bound.pair_rests, layout.node_starts)
        rows = np.zeros(len(layout.node) * kernels.ROW, np.float32)
        for_each(kernels.relative, _parts(knots.shape[1], 64), curves, (first, weights), pairs, rig.dual, rows)
        slots = (layout.of_slot, _array(bound.weights))
        signed, total = np.empty((n, NODES), np.float32), np.empty(n * kernels.ROW, np.float32)
        moved = np.empty(3 * n, np.float32), np.empty(4 * n, np.float32)
        gaussians = _flat(means), _flat(quats)
        for_each(kernels.carry, _parts(n, 1024), slots, rows, rig.dual, *gaussians, signed, total, *moved)
        ctx.save_for_backward(means, quats, knots, knot_quats)
        ctx.rig, ctx.basis, ctx.kept = rig, (first, weights, slopes), (signed, total)
        return torch.from_numpy(moved[0]).view(n, 3), torch.from_numpy(moved[1]).view(n, 4)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_means, g_quats):
        means, quats, knots, knot_quats = (_array(t) for t in ctx.saved_tensors)
        (first, weights, slopes), (signed, total), rig = ctx.basis, ctx.kept, ctx.rig
        n, m, layout, bound, dual = len(means), knots.shape[1], rig.binding.layout, rig.binding, rig.dual
        outgoing = np.empty(3 * n, np.float32), np.empty(4 * n, np.float32)
        g_total = np.zeros(n * kernels.ROW, np.float32)
        incoming = (_flat(g_means), _flat(g_quats))
        for_each(
            kernels.lift,
            _parts(n, 1024),
            total,
            dual,
            means.reshape(-1),
            quats.reshape(-1),
            incoming,
            outgoing,
            g_total,
        )
        g_rows = np.empty(len(layout.node) * kernels.ROW, np.float32)
        using = (layout.starts, layout.slots, _array(bound.weights), signed)
        for_each(kernels.gather, _parts(len(layout.node), 256), *using, dual, g_total, g_rows)
        g_knots, g_knot_quats = np.zeros_like(knots), np.zeros_like(knot_quats)
        g_times = np.empty(m)
        curves = (knots, knot_quats, rig.clock)
        pairs = (*bound.pair_rests, layout.node_starts)
        outputs = (g_knots, g_knot_quats, g_times)
        for_each(kernels.lower, _parts(m, 64), curves, (first, weights), slopes, pairs, dual, g_rows, *outputs)
        g_own = np.bincount(rig.clock, g_times, minlength=len(first))
        gaussians = (torch.from_numpy(a).view(n, -1) for a in outgoing)
        return *gaussians, *(torch.from_numpy(a) for a in (g_own, g_knots, g_knot_quats)), None
