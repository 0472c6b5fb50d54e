"""The nodes' curves by robust sparse least squares, and their rotations by Kabsch's alignment of neighbourhoods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import splu

from recon.motion.paths import HermiteSpline

FRAME = 1 / 30  # seconds: the study's frame, in which its weights are given


@dataclass(frozen=True)
class Smoothness:
    """Weights of the solve, against a data term in which a sample per 1/30 s has weight 1.

    velocity: of a neighbour's velocity being the same, per 1/30 s. acceleration: of second differences of the knots.
    still: of first differences: only where nothing else speaks, a motion comes to rest within some fifteen knots.
    """

    velocity: float = 0.3
    acceleration: float = 0.02
    still: float = 1e-4


@dataclass(frozen=True, eq=False)
class Observations:
    """Samples of n nodes that share frames: world seconds [T], positions [n,T,3] (nan where unseen), node indices."""

    times: Float[np.ndarray, " T"]
    xyz: Float[np.ndarray, "n T 3"]
    node: Int[np.ndarray, " n"]


def solve_curves(
    path: HermiteSpline,
    observed: Sequence[Observations],
    edges: Int[np.ndarray, "E 2"],
    ties: Float[np.ndarray, " E"],
    n_nodes: int,
    *,
    grid: Float[np.ndarray, " G"],
    robust: float,
    rounds: int,
    smooth: Smoothness,
) -> Float[np.ndarray, "P M 3"]:
    """Knots of M curves that minimise, by iteratively reweighted least squares with Cauchy's weights,

        Σ ρ(‖x_m(t) - sample‖) + λ_v Σ_(i,j) tie ‖ẋ_i - ẋ_j‖² + λ_a Σ ‖Δ² knots‖² + λ_s Σ ‖Δ knots‖².

    ties [E] of the edges [E,2]; an edge listed both ways counts twice. grid: world seconds, evenly spaced, at which
    velocities are compared. robust: the distance at which a sample counts half. Everything is equivariant under rigid
    motions and, with `robust`, under the scale of the world.
    """
    P = path.count
    centre = np.zeros((n_nodes, 3))
    for o in observed:
        centre[o.node] = np.nanmean(o.xyz, axis=1)
    designs = [path.design(o.times) for o in observed]
    step = grid[1] - grid[0] if len(grid) > 1 else FRAME
    velocity = (path.design(grid + step / 2) - path.design(grid - step / 2)) * (FRAME / step)
    V = velocity.T @ velocity * (step / FRAME)
    differences, curvature = np.diff(np.eye(P), axis=0), np.diff(np.eye(P), 2, axis=0)
    always = smooth.acceleration * curvature.T @ curvature + smooth.still * differences.T @ differences
    i, j = edges.T
    w = smooth.velocity * ties
    laplacian = sparse.coo_array(
        (np.concatenate([w, w, -w, -w]), (np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i]))),
        shape=(n_nodes, n_nodes),
    )
    coupling = sparse.kron(laplacian.tocsr(), sparse.csr_array(V), format="csr")
    weights = [np.where(np.isfinite(o.xyz[..., 0]), _frames(o.times) / FRAME, 0.0) for o in observed]
    factor = [np.ones_like(u) for u in weights]
    samples = [np.nan_to_num(o.xyz - centre[o.node, None]) for o in observed]
    knots = np.zeros((n_nodes, P, 3))
    for _ in range(rounds):
        blocks, right = np.tile(always, (n_nodes, 1, 1)), np.zeros((n_nodes, P, 3))
        for o, B, u, f, x in zip(observed, designs, weights, factor, samples, strict=True):
            blocks[o.node] += np.einsum("nt,ta,tb->nab", u * f, B, B, optimize=True)
            right[o.node] += np.einsum("nt,ta,ntk->nak", u * f, B, x, optimize=True)
        system = sparse.block_diag(list(blocks), format="csr") + coupling
        knots = splu(system.tocsc()).solve(right.reshape(-1, 3)).reshape(n_nodes, P, 3)
        residuals = [
            np.linalg.norm(np.einsum("ta,nak->ntk", B, knots[o.node]) - x, axis=2)
            for o, B, x in zip(observed, designs, samples, strict=True)
        ]
        factor = [1 / (1 + (r / robust) ** 2) for r in residuals]
    return (knots + centre[:, None]).transpose(1, 0, 2)


def _frames(times: np.ndarray) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else FRAME


def neighbourhood_rotations(
    positions: Float[np.ndarray, "P M 3"],
    neighbours: Int[np.ndarray, "M K"],
    weights: Float[np.ndarray, "M K"],
    unit: float,
) -> Float[np.ndarray, "P M 3 3"]:
    """Rotations of M nodes at P times relative to the middle one, by Kabsch's alignment of the edges to neighbours.

    Each is pulled very weakly towards the one before (outwards from the middle), which decides what the neighbours do
    not: the turn about a line of them, everything for a node on its own.
    """
    P, M = positions.shape[:2]
    edges = positions[:, neighbours] - positions[:, :, None]  # [P,M,K,3]
    middle = P // 2
    reference = weights[..., None] * edges[middle]
    pull = 1e-3 * unit**2 * np.maximum(weights.sum(1), 1e-6)[:, None, None]
    rotations = np.tile(np.eye(3), (P, M, 1, 1))
    for order in (range(middle + 1, P), range(middle - 1, -1, -1)):
        previous = rotations[middle]
        for p in order:
            moment = np.einsum("mki,mkj->mij", edges[p], reference, optimize=True) + pull * previous
            U, _, Vt = np.linalg.svd(moment)
            U[..., 2] *= np.linalg.det(U @ Vt)[:, None]
            rotations[p] = previous = U @ Vt
    return rotations
