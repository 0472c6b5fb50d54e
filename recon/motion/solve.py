"""The nodes' curves by robust sparse least squares, and their rotations by Kabsch's alignment of neighbourhoods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded

from recon.motion.paths import WINDOW, Path

FRAME = 1 / 30  # seconds: the study's frame, in which its weights are given
TOLERANCE, ROUGH = 1e-7, 1e-4  # of the energy norm, relative to that of the solution; ROUGH between reweightings
MAX_ITERATIONS = 2000
LEAST_INERTIA = 0.05  # squared units: with less, a neighbourhood hardly tells how it turns
RIDGE = 1e-9  # towards the mean of a node's samples: decides nothing, but keeps blocks invertible
ROUNDING = 1e-12  # of the largest weight: a smaller ridge would be lost in it
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


@dataclass(frozen=True, eq=False)
class Bands:
    """M symmetric banded blocks: `diagonals[d,m,p]` is entry [p + d, p] of block m, 0 beyond its end.

    A knot shares samples with the few beside it only, so that what is kept and done grows with the knots, not with
    their square.
    """

    diagonals: Float[np.ndarray, "b M P"]

    @classmethod
    def of(cls, block: sparse.sparray, width: int) -> Self:
        """One block [P,P] with so many diagonals beside the main one."""
        rows = np.zeros((width + 1, 1, block.shape[0]))
        for d in range(min(width + 1, block.shape[0])):
            rows[d, 0, : block.shape[0] - d] = block.diagonal(-d)
        return cls(rows)

    @property
    def width(self) -> int:
        return len(self.diagonals) - 1

    def repeated(self, n: int) -> Bands:
        """So many copies of the one block."""
        return Bands(np.tile(self.diagonals, (1, n, 1)))

    def matrix(self) -> sparse.csr_array:
        """The block diagonal matrix [M·P,M·P]."""
        flat = self.diagonals.reshape(self.width + 1, -1)
        size = flat.shape[1]
        below = [(d, row[: size - d]) for d, row in enumerate(flat) if d < size]
        every = below + [(-d, row) for d, row in below[1:]]
        return sparse.diags_array([row for _, row in every], offsets=[-d for d, _ in every], format="csr")

    def factor(self) -> Float[np.ndarray, "b N"]:
        """Cholesky's factor of all blocks behind one another, which is as banded as they are."""
        return cholesky_banded(self.diagonals.reshape(self.width + 1, -1), lower=True, check_finite=False)


def solved(factor: Float[np.ndarray, "b N"], right: Float[np.ndarray, "M P 3"]) -> Float[np.ndarray, "M P 3"]:
    """What the blocks with this :meth:`Bands.factor` turn into `right`."""
    found = cho_solve_banded((factor, True), right.reshape(-1, right.shape[-1]), check_finite=False)
    return np.ascontiguousarray(found).reshape(right.shape)


@dataclass(frozen=True, eq=False)
class Products:
    """Products of the weights of two knots in every row of a design, as :class:`Bands` has them: [T,(b+1)·P]."""

    rows: sparse.csr_array
    width: int

    @classmethod
    def of(cls, design: sparse.csr_array, width: int) -> Self:
        later = [sparse.csr_array(design[:, d:]) for d in range(width + 1)]
        products = [design[:, : one.shape[1]] * one for one in later]
        for one in products:
            one.resize(design.shape)
        return cls(sparse.csr_array(sparse.hstack(products)), width)

    def weighted(self, w: Float[np.ndarray, "n T"]) -> Float[np.ndarray, "b n P"]:
        """The diagonals of Bᵀ diag(w) B for the weights of n nodes."""
        diagonals = self.width + 1
        return (w @ self.rows).reshape(len(w), diagonals, self.rows.shape[1] // diagonals).transpose(1, 0, 2)


def along(B: sparse.sparray, values: Float[np.ndarray, "M P k"]) -> Float[np.ndarray, "M S k"]:
    """B [S,P] applied to the second axis."""
    M, P, k = values.shape
    moved = B @ values.transpose(1, 0, 2).reshape(P, M * k)
    return moved.reshape(B.shape[0], M, k).transpose(1, 0, 2)


def smoothness(n: int, acceleration: float, still: float) -> Bands:
    """What n knots pay whatever is seen: for second and first differences, and :data:`RIDGE` for the knots themselves,
    or what rounding asks for beside very large weights."""
    weights = acceleration * differences(n, 2) + still * differences(n, 1)
    ridge = max(RIDGE, ROUNDING * float(weights.diagonal().max()))
    return Bands.of(sparse.csr_array(weights + ridge * sparse.eye_array(n)), WINDOW - 1)


def differences(n: int, order: int) -> sparse.csr_array:
    """DᵀD of the differences of this order of n knots."""
    D = np.diff(np.eye(order + 1), order, axis=0)[0]
    rows = sparse.diags_array([np.full(n - order, x) for x in D], offsets=list(range(order + 1)), shape=(n - order, n))
    return sparse.csr_array(rows.T @ rows)


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
    velocity = sparse.csr_array(rate.T @ rate)
    always = smoothness(P, smooth.acceleration, smooth.still)
    products = [Products.of(B, always.width) for B in designs]
    incidence, pulls = coupling.incidence(), smooth.velocity * (step / FRAME) * coupling.ties
    laplacian = sparse.csr_array(incidence @ sparse.diags_array(pulls) @ incidence.T)
    weights, knots, turning = present, np.zeros((n_nodes, P, 3)), np.zeros((n_nodes, P, 3))
    for k in range(rounds):
        blocks, right = always.repeated(n_nodes), turning.copy()
        for o, B, squares, w, x in zip(observed, designs, products, weights, samples, strict=True):
            blocks.diagonals[:, o.node] += squares.weighted(w)
            right[o.node] += along(B.T, w[..., None] * x)
        tolerance = ROUGH if k < rounds - 1 else TOLERANCE
        knots = _conjugate_gradients(blocks, laplacian, velocity, right, knots, tolerance)
        if k < rounds - 1:
            weights = [
                w / (1 + (np.linalg.norm(along(B, knots[o.node]) - x, axis=2) / robust) ** 2)
                for o, B, w, x in zip(observed, designs, present, samples, strict=True)
            ]
            turning = _turning(
                coupling, incidence, pulls, along(place, knots) + centre[:, None], along(rate, knots), rate
            )
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
    design: sparse.csr_array,
) -> Float[np.ndarray, "M P 3"]:
    """The right-hand side for velocities of neighbours that differ by ω × (x_i - x_j)."""
    omega = angular_velocities(coupling, places, rates)
    right = np.zeros((len(places), design.shape[1], 3))
    chunk = max(1, 2**20 // design.shape[0])
    for begin in range(0, len(coupling.edges), chunk):
        part = slice(begin, begin + chunk)
        i, j = coupling.edges[part].T
        apart = np.cross((omega[i] + omega[j]) / 2, places[i] - places[j]) * pulls[part, None, None]
        asked = along(design.T, apart).reshape(len(i), -1)
        right += (incidence[:, part] @ asked).reshape(right.shape)
    return right


def _frame_of(times: np.ndarray) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else FRAME


def _width(square: sparse.csr_array) -> int:
    """Diagonals beside the main one that hold `square`, and at least the products of a path's design."""
    i, j = square.nonzero()
    return max(WINDOW - 1, int(np.abs(i - j).max(initial=0)))


def _conjugate_gradients(
    blocks: Bands,
    laplacian: sparse.csr_array,
    velocity: sparse.csr_array,
    right: Float[np.ndarray, "M P 3"],
    x: Float[np.ndarray, "M P 3"],
    tolerance: float,
) -> Float[np.ndarray, "M P 3"]:
    """Solve (diag(blocks) + laplacian ⊗ velocity) x = right from the guess `x`, the three coordinates side by side.

    Preconditioned by each node's own block. It takes some forty iterations, where a direct factorisation would fill in:
    600 nodes of 15 knots take .1 s instead of 1.2 s.
    """
    M, P, k = right.shape
    own, across = blocks.matrix(), sparse.csr_array(sparse.kron(velocity, sparse.eye_array(k)))
    whole = laplacian.diagonal()[:, None] * Bands.of(velocity, _width(velocity)).diagonals
    whole[: blocks.width + 1] += blocks.diagonals
    factor = Bands(whole).factor()

    def system(x: np.ndarray) -> np.ndarray:
        coupled = (across @ (laplacian @ x.reshape(M, P * k)).T).T
        return (own @ x.reshape(M * P, k)).reshape(M, P, k) + coupled.reshape(M, P, k)

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.einsum("mpk,mpk->k", a, b)

    residual = right - system(x)
    towards = step = solved(factor, residual)
    energy = dot(residual, towards)
    enough = tolerance**2 * dot(right, solved(factor, right))
    for _ in range(MAX_ITERATIONS):
        if (energy <= enough).all():
            break
        image = system(step)
        length = energy / np.maximum(dot(step, image), 1e-300)  # 0 / 0 where a coordinate is solved
        x = x + length * step
        residual = residual - length * image
        towards = solved(factor, residual)
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
