"""Carrying Gaussians with nodes: the definition, in plain torch.

Two phases. Every (rest, node) pair in use has one relative rigid motion, from the node's pose at the rest to its pose
at t; every Gaussian blends those of its eight nodes. There are ten times fewer pairs than blended motions.
"""

from __future__ import annotations

import torch
from torch import Tensor

from recon.motion.binding import Binding
from recon.rotations import conjugate, product, rotation_matrices, unit

LINEAR, DUAL_QUATERNION = "linear", "dual-quaternion"
BLENDS = (LINEAR, DUAL_QUATERNION)


def blend(
    binding: Binding, positions: Tensor, quats_of_nodes: Tensor, means: Tensor, quats: Tensor, how: str
) -> tuple[Tensor, Tensor]:
    """Gaussians' means [N,3] and quats [N,4] (any length, which is kept) carried by nodes to poses [...,M,3], [...,M,4]
    (unit).

    linear (linear blend skinning): x = Σ_k w_k [R_k R_k,restᵀ (mean - p_k,rest) + p_k].
    dual-quaternion (Kavan et al. 2007): the normalised sum of the relative motions as dual quaternions, which is rigid.
    In both the orientation turns by the normalised Σ_k w_k q_k q_k,rest⁻¹, each with the sign that agrees with the
    Gaussian's first (nearest) node: q and -q are one rotation.
    """
    rest, nodes, w = binding.rest[:, None], binding.nodes, binding.weights.to(means.dtype)
    p_rest, q_rest = binding.positions.to(means.dtype)[rest, nodes], binding.quats.to(means.dtype)[rest, nodes]
    turn = product(_of(quats_of_nodes, nodes), conjugate(q_rest))  # [...,N,8,4]
    agrees = (turn * turn[..., :1, :]).sum(-1, keepdim=True).detach() >= 0
    signed = torch.where(agrees, turn, -turn)
    whole = (w[..., None] * signed).sum(-2)
    mean_turn = unit(whole)
    if how == LINEAR:
        moved = (rotation_matrices(turn) @ (means[:, None] - p_rest)[..., None])[..., 0] + _of(positions, nodes)
        return (w[..., None] * moved).sum(-2), product(mean_turn, quats)
    shift = _of(positions, nodes) - (rotation_matrices(turn) @ p_rest[..., None])[..., 0]
    dual = (w[..., None] * product(torch.nn.functional.pad(shift, (1, 0)), signed)).sum(-2)  # twice the dual part
    translation = product(dual, conjugate(whole))[..., 1:] / (whole * whole).sum(-1, keepdim=True)
    x = (rotation_matrices(mean_turn) @ means[..., None])[..., 0] + translation
    return x, product(mean_turn, quats)


def _of(poses: Tensor, nodes: Tensor) -> Tensor:
    """Those [...,N,8,D] of `poses` [...,M,D] that Gaussians hang on."""
    # plain indexing would sort its many duplicates in the backward pass on a GPU
    return poses.index_select(-2, nodes.reshape(-1)).unflatten(-2, nodes.shape)
