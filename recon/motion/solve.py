"""The nodes' curves by robust sparse least squares, and their rotations by Kabsch's alignment of neighbourhoods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from recon.motion.paths import Path

FRAME = 1 / 30  # seconds: the study's frame, in which its weights are given
TOLERANCE, ROUGH = 1e-7, 1e-4  # of the energy norm, relative to that of the solution; ROUGH between reweightings
MAX_ITERATIONS = 2000
LEAST_INERTIA = 0.05  # squared units: with less, a neighbourhood hardly tells how it turns
RIDGE = 1e-9  # towards the mean of a node's samples: decides nothing, but keeps blocks invertible
STEADY = 1e-3  # weight, in squared units, with which a rotation is drawn to the one before


@dataclass(frozen=True)
class Smoothness:
    """Weights of the solve, against a data term in which a sample per 1/30 s has weight 1.

    velocity: of neighbours that should move as parts of one body, per 1/30 s. acceleration: of second differences of
    the knots. still: of first differences; where nothing else decides, a motion comes to rest within some fifteen
    knots.
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
class Coupling:
    """Neighbours among M nodes, and the world seconds at which their velocities are compared.

    edges [E,2] with weights `ties` [E] (an edge listed both ways counts twice); grid [G] evenly spaced; seen [M,G]:
    where a node's velocity is known from samples; unit: spacing of the nodes, world units.
    """

    edges: Int[np.ndarray, "E 2"]
    ties: Float[np.ndarray, " E"]
    grid: Float[np.ndarray, " G"]
    seen: Bool[np.ndarray, "M G"]
    unit: float

    @property
    def n_nodes(self) -> int:
        return len(self.seen)

    def incidence(self) -> sparse.csr_array:
        """[M,E]: 1 where an edge begins, -1 where it ends."""
        i, j = self.edges.T
        e = np.arange(len(self.edges))
        entries = np.repeat([1.0, -1.0], len(e)), (np.concatenate([i, j]), np.concatenate([e, e]))
        return sparse.csr_array(sparse.coo_array(entries, shape=(self.n_nodes, len(e))))


def solve_curves(
    path: Path,
    observed: Sequence[Observations],
    coupling: Coupling,
    smooth: Smoothness,
    *,
    robust: float,
    rounds: int,
) -> Float[np.ndarray, "P M 3"]:
    """Knots of M curves that minimise, by iteratively reweighted least squares with Cauchy's weights,

        Σ ρ(‖x_m(t) - sample‖) + λ_v Σ_(i,j) tie ‖ẋ_i - ẋ_j - ω × (x_i - x_j)‖² + λ_a Σ ‖Δ² knots‖² + λ_s Σ ‖Δ knots‖².

    ω(t) is the edge's angular velocity, from the seen neighbours' motion in the round before (0 in the first), so that
    hidden nodes turn with their body instead of going straight on: with two bodies whose tracks live for 24 of 36
    frames points are followed to 0.7 cm over ten frames, without ω to 1.8 cm.
    robust: the distance at which a sample counts half; rounds: of reweighting. Everything is equivariant under rigid
    motions and, with `robust` and the unit, under the scale of the world. Every node needs a sample.
    """
    n_nodes, P, grid = coupling.n_nodes, path.count, coupling.grid
    centre = np.zeros((n_nodes, 3))
    for o in observed:
        centre[o.node] = np.nanmean(o.xyz, axis=1)
    designs = [path.design(o.times) for o in observed]
    samples = [np.nan_to_num(o.xyz - centre[o.node, None]) for o in observed]
    present = [np.isfinite(o.xyz[..., 0]) * (_frame_of(o.times) / FRAME) for o in observed]
    step = grid[1] - grid[0] if len(grid) > 1 else FRAME
    place, rate = path.design(grid), (path.design(grid + step / 2) - path.design(grid - step / 2)) * (FRAME / step)
    first, second = np.diff(np.eye(P), axis=0), np.diff(np.eye(P), 2, axis=0)
    always = smooth.acceleration * second.T @ second + smooth.still * first.T @ first + RIDGE * np.eye(P)
    incidence, pulls = coupling.incidence(), smooth.velocity * (step / FRAME) * coupling.ties
    laplacian = sparse.csr_array(incidence @ sparse.diags_array(pulls) @ incidence.T)
    weights, knots, turning = present, np.zeros((n_nodes, P, 3)), np.zeros((n_nodes, P, 3))
    for k in range(rounds):
        blocks, right = np.tile(always, (n_nodes, 1, 1)), turning.copy()
        for o, B, w, x in zip(observed, designs, weights, samples, strict=True):
            outer = (B[:, :, None] * B[:, None]).reshape(len(B), -1)
            blocks[o.node] += (w @ outer).reshape(-1, P, P)
            right[o.node] += B.T @ (w[..., None] * x)
        tolerance = ROUGH if k < rounds - 1 else TOLERANCE
        knots = _conjugate_gradients(blocks, laplacian, rate.T @ rate, right, knots, tolerance)
        if k < rounds - 1:
            weights = [
                w / (1 + (np.linalg.norm(B @ knots[o.node] - x, axis=2) / robust) ** 2)
                for o, B, w, x in zip(observed, designs, present, samples, strict=True)
            ]
            turning = _turning(coupling, incidence, pulls, place @ knots + centre[:, None], rate @ knots, rate)
    return (knots + centre[:, None]).transpose(1, 0, 2)


def angular_velocities(
    coupling: Coupling, places: Float[np.ndarray, "M G 3"], rates: Float[np.ndarray, "M G 3"]
) -> Float[np.ndarray, "M G 3"]:
    """How each node's neighbourhood turns: ω of the rigid motion nearest to the velocities of its seen nodes.

    Least squares over each node and its neighbours, by their ties: Σ a ‖ẋ - v - ω × x‖². Radians per unit of time of
    `rates`, world axes; 0 where too few nodes are seen.
    """
    i, j = coupling.edges.T
    M, G = coupling.seen.shape
    every = np.arange(M)
    ties = np.concatenate([coupling.ties, coupling.ties, np.ones(M)])
    among = sparse.csr_array(
        sparse.coo_array((ties, (np.concatenate([i, j, every]), np.concatenate([j, i, every]))), shape=(M, M))
    )
    x = places - places.reshape(-1, 3).mean(0)
    squares = (x[..., :, None] * x[..., None, :]).reshape(M, G, 9)
    fields = np.concatenate([np.ones((M, G, 1)), x, rates, squares, np.cross(x, rates)], 2) * coupling.seen[..., None]
    sums = (among @ fields.reshape(M, -1)).reshape(M, G, -1)
    n, sx, sv, sxx, sxv = np.split(sums, [1, 4, 7, 16], axis=2)
    n = np.maximum(n, 1e-12)
    spread = sxx.reshape(M, G, 3, 3) - sx[..., :, None] * sx[..., None, :] / n[..., None]
    inertia = np.trace(spread, axis1=2, axis2=3)[..., None, None] * np.eye(3) - spread
    momentum = sxv - np.cross(sx, sv) / n
    return np.linalg.solve(inertia + LEAST_INERTIA * coupling.unit**2 * np.eye(3), momentum[..., None])[..., 0]


def _turning(
    coupling: Coupling,
    incidence: sparse.csr_array,
    pulls: Float[np.ndarray, " E"],
    places: Float[np.ndarray, "M G 3"],
    rates: Float[np.ndarray, "M G 3"],
    design: Float[np.ndarray, "G P"],
) -> Float[np.ndarray, "M P 3"]:
    """The right-hand side for velocities of neighbours that differ by ω × (x_i - x_j)."""
    omega = angular_velocities(coupling, places, rates)
    right = np.zeros((len(places), design.shape[1], 3))
    chunk = max(1, 2**20 // len(design))
    for begin in range(0, len(coupling.edges), chunk):
        part = slice(begin, begin + chunk)
        i, j = coupling.edges[part].T
        apart = np.cross((omega[i] + omega[j]) / 2, places[i] - places[j]) * pulls[part, None, None]
        asked = (design.T @ apart).reshape(len(i), -1)
        right += (incidence[:, part] @ asked).reshape(right.shape)
    return right


def _frame_of(times: np.ndarray) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else FRAME


def _conjugate_gradients(
    blocks: Float[np.ndarray, "M P P"],
    laplacian: sparse.csr_array,
    velocity: Float[np.ndarray, "P P"],
    right: Float[np.ndarray, "M P 3"],
    x: Float[np.ndarray, "M P 3"],
    tolerance: float,
) -> Float[np.ndarray, "M P 3"]:
    """Solve (diag(blocks) + laplacian ⊗ velocity) x = right from the guess `x`, the three coordinates side by side.

    Preconditioned by each node's own block. It takes some forty iterations, where a direct factorisation would fill in:
    600 nodes of 15 knots take .1 s instead of 1.2 s.
    """
    M, P = blocks.shape[:2]
    own = sparse.block_diag(list(blocks), format="csr")  # banded: most of a block is zero
    inverse = np.linalg.inv(blocks + laplacian.diagonal()[:, None, None] * velocity)

    def system(x: np.ndarray) -> np.ndarray:
        coupled = velocity @ (laplacian @ x.reshape(M, P * 3)).reshape(M, P, 3)
        return (own @ x.reshape(M * P, 3)).reshape(M, P, 3) + coupled

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.einsum("mpk,mpk->k", a, b)

    residual = right - system(x)
    towards = step = inverse @ residual
    energy = dot(residual, towards)
    enough = tolerance**2 * dot(right, inverse @ right)
    for _ in range(MAX_ITERATIONS):
        if (energy <= enough).all():
            break
        image = system(step)
        length = energy / np.maximum(dot(step, image), 1e-300)  # 0 / 0 where a coordinate is solved
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

    Each is drawn very weakly towards the one before it (outwards from the middle). That decides what the neighbours
    leave open: the turn about a line of them, and everything for a node on its own.
    """
    P, M = positions.shape[:2]
    edges = positions[:, neighbours] - positions[:, :, None]  # [P,M,K,3]
    middle = P // 2
    reference = weights[..., None] * edges[middle]
    pull = STEADY * unit**2 * np.maximum(weights.sum(1), 1e-6)[:, None, None]
    rotations = np.tile(np.eye(3), (P, M, 1, 1))
    for order in (range(middle + 1, P), range(middle - 1, -1, -1)):
        previous = rotations[middle]
        for p in order:
            moment = np.swapaxes(edges[p], 1, 2) @ reference + pull * previous
            U, _, Vt = np.linalg.svd(moment)
            U[..., 2] *= np.linalg.det(U @ Vt)[:, None]
            rotations[p] = previous = U @ Vt
    return rotations
