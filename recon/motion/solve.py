"""The nodes' curves by robust sparse least squares, and their rotations by Kabsch's alignment of neighbourhoods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from recon.motion.paths import HermiteSpline

FRAME = 1 / 30  # seconds: the study's frame, in which its weights are given
TOLERANCE = 1e-7  # of the energy norm, relative to the solution's own
MAX_ITERATIONS = 2000
RIDGE = 1e-9  # towards the mean of a node's samples: decides nothing but keeps blocks invertible


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


@dataclass(frozen=True, eq=False)
class Priors:
    """The quadratic terms beside the data: always [P,P] on each node alone, and laplacian [M,M] ⊗ velocity [P,P]."""

    always: Float[np.ndarray, "P P"]
    laplacian: sparse.csr_array
    velocity: Float[np.ndarray, "P P"]

    @classmethod
    def of(
        cls,
        path: HermiteSpline,
        edges: Int[np.ndarray, "E 2"],
        ties: Float[np.ndarray, " E"],
        n_nodes: int,
        grid: Float[np.ndarray, " G"],
        smooth: Smoothness,
    ) -> Priors:
        """ties [E] of the edges [E,2] (one listed both ways counts twice); grid: see :func:`solve_curves`."""
        P = path.count
        step = grid[1] - grid[0] if len(grid) > 1 else FRAME
        rates = (path.design(grid + step / 2) - path.design(grid - step / 2)) * (FRAME / step)
        first, second = np.diff(np.eye(P), axis=0), np.diff(np.eye(P), 2, axis=0)
        always = smooth.acceleration * second.T @ second + smooth.still * first.T @ first + RIDGE * np.eye(P)
        i, j = edges.T
        w = smooth.velocity * ties
        entries = np.concatenate([w, w, -w, -w]), (np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i]))
        laplacian = sparse.csr_array(sparse.coo_array(entries, shape=(n_nodes, n_nodes)))
        return cls(always, laplacian, rates.T @ rates * (step / FRAME))


def solve_curves(
    path: HermiteSpline,
    observed: Sequence[Observations],
    priors: Priors,
    *,
    robust: float,
    rounds: int,
) -> Float[np.ndarray, "P M 3"]:
    """Knots of M curves that minimise, by iteratively reweighted least squares with Cauchy's weights,

        Σ ρ(‖x_m(t) - sample‖) + λ_v Σ_(i,j) tie ‖ẋ_i - ẋ_j‖² + λ_a Σ ‖Δ² knots‖² + λ_s Σ ‖Δ knots‖².

    Velocities are compared at evenly spaced world seconds, the `grid` of the priors. robust: the distance at which a
    sample counts half; rounds: of reweighting. Everything is equivariant under rigid motions and, with `robust`, under
    the scale of the world. Every node needs a sample.
    """
    n_nodes, P = priors.laplacian.shape[0], path.count
    centre = np.zeros((n_nodes, 3))
    for o in observed:
        centre[o.node] = np.nanmean(o.xyz, axis=1)
    designs = [path.design(o.times) for o in observed]
    samples = [np.nan_to_num(o.xyz - centre[o.node, None]) for o in observed]
    present = [np.isfinite(o.xyz[..., 0]) * (_frame_of(o.times) / FRAME) for o in observed]
    weights = present
    knots = np.zeros((n_nodes, P, 3))
    for _ in range(rounds):
        blocks, right = np.tile(priors.always, (n_nodes, 1, 1)), np.zeros((n_nodes, P, 3))
        for o, B, w, x in zip(observed, designs, weights, samples, strict=True):
            outer = (B[:, :, None] * B[:, None]).reshape(len(B), -1)
            blocks[o.node] += (w @ outer).reshape(-1, P, P)
            right[o.node] += B.T @ (w[..., None] * x)
        knots = _conjugate_gradients(blocks, priors, right, knots)
        weights = [
            w / (1 + (np.linalg.norm(B @ knots[o.node] - x, axis=2) / robust) ** 2)
            for o, B, w, x in zip(observed, designs, present, samples, strict=True)
        ]
    return (knots + centre[:, None]).transpose(1, 0, 2)


def _frame_of(times: np.ndarray) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else FRAME


def _conjugate_gradients(
    blocks: Float[np.ndarray, "M P P"], priors: Priors, right: Float[np.ndarray, "M P 3"], x: np.ndarray
) -> Float[np.ndarray, "M P 3"]:
    """Solve (diag(blocks) + laplacian ⊗ velocity) x = right from the guess `x`, the three coordinates side by side.

    Preconditioned by each node's own block. Some forty iterations where a direct factorisation fills in: 600 nodes of
    15 knots take .1 s instead of 1.2 s.
    """
    M, P = blocks.shape[:2]
    own = sparse.block_diag(list(blocks), format="csr")  # banded: most of a block is zero
    inverse = np.linalg.inv(blocks + priors.laplacian.diagonal()[:, None, None] * priors.velocity)

    def system(x: np.ndarray) -> np.ndarray:
        coupled = priors.velocity @ (priors.laplacian @ x.reshape(M, P * 3)).reshape(M, P, 3)
        return (own @ x.reshape(M * P, 3)).reshape(M, P, 3) + coupled

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.einsum("mpk,mpk->k", a, b)

    residual = right - system(x)
    towards = step = inverse @ residual
    energy = dot(residual, towards)
    enough = TOLERANCE**2 * dot(right, inverse @ right)
    for _ in range(MAX_ITERATIONS):
        if (energy <= enough).all():
            break
        image = system(step)
        length = energy / np.maximum(dot(step, image), 1e-300)  # nought over nought where a coordinate is solved
        x = x + length * step
        residual = residual - length * image
        towards = inverse @ residual
        energy, before = dot(residual, towards), energy
        step = towards + energy / np.maximum(before, 1e-300) * step
    return x


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
            moment = np.swapaxes(edges[p], 1, 2) @ reference + pull * previous
            U, _, Vt = np.linalg.svd(moment)
            U[..., 2] *= np.linalg.det(U @ Vt)[:, None]
            rotations[p] = previous = U @ Vt
    return rotations
