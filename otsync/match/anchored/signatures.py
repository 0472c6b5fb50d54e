"""What a track looks like from landmarks: signatures, and the truncated cost of a pair."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from ...compute.indices import ascending
from ...costs.linear import Cost, Factored
from .clouds import Cloud, run

UNKNOWN = 1e9
"""Stands for a distance that was never seen, + in a and - in b: it costs as much as a wrong one."""

RANK = 64
"""Dimensions that features are reduced to in the inner loops."""


@dataclass(frozen=True, eq=False)
class Scale:
    """Units of the truncated cost.

    Args:
        median: common median of D_track, the unit of signatures. tau: where the cost is truncated, in that unit.
        beta: weight of the linear cost relative to τ².
        chance: mean M of random pairs; 0 when M is the same for all pairs, and tells nothing.
    """

    median: float
    tau: float
    beta: float
    chance: float


@dataclass(frozen=True, eq=False)
class Linear:
    """The ``costs`` for compiled loops: ``offset - ua_i·ub_j`` plus what only the cost objects can tell."""

    ua: Float[np.ndarray, "Na D"]
    ub: Float[np.ndarray, "Nb D"]
    offset: float
    others: tuple[Cost, ...]
    a: Cloud
    b: Cloud

    @classmethod
    def of(cls, costs: tuple[Cost, ...], a: Cloud, b: Cloud) -> Linear:
        factored = [c for c in costs if isinstance(c, Factored)]
        others = tuple(c for c in costs if not isinstance(c, Factored))
        us, vs = [np.zeros((len(a), 1), np.float32)], [np.zeros((len(b), 1), np.float32)]
        for cost in factored:
            u, v = cost.factors(a.source, b.source)
            root = np.sqrt(cost.weight)  # on both sides, so that the basis weighs both videos alike
            us.append((root * u[a.index]).astype(np.float32))
            vs.append((root * v[b.index]).astype(np.float32))
        return cls(np.hstack(us), np.hstack(vs), float(sum(c.weight for c in factored)), others, a, b)

    @cached_property
    def least(self) -> float:
        """What the compiled part is nowhere below, by Cauchy and Schwarz."""
        return self.offset - math.prod(float(np.linalg.norm(u, axis=1).max(initial=0.0)) for u in (self.ua, self.ub))

    def basis(self) -> Float[np.ndarray, "D R"]:
        """Orthonormal directions that keep what the rows of both sets say: their leading singular vectors."""
        both = np.concatenate([self.ua, self.ub]).astype(float)
        _, vectors = np.linalg.eigh(both.T @ both)
        return vectors[:, ::-1][:, :RANK].astype(np.float32)

    def reduced(self, basis: Float[np.ndarray, "D R"]) -> Linear:
        """The same in fewer dimensions."""
        if basis.shape[0] == basis.shape[1]:
            return self
        # summed in float64: on some processors BLAS's float32 sums depend on how many threads share them
        exact = basis.astype(float)
        ua, ub = ((u.astype(float) @ exact).astype(np.float32) for u in (self.ua, self.ub))
        return Linear(ua, ub, self.offset, self.others, self.a, self.b)

    def cost(self, i: Int[np.ndarray, " P"], j: Int[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
        """M of the pairs."""
        return self.offset - np.einsum("pd,pd->p", self.ua[i], self.ub[j]) + self.rest(i, j)

    def table(self, i: Int[np.ndarray, " P"]) -> Float[np.ndarray, "P Nb"]:
        """M of some tracks of a with all of b."""
        n = len(self.ub)
        compiled = self.offset - self.ua[i].astype(float) @ self.ub.T.astype(float)
        return compiled + self.rest(np.repeat(i, n), np.tile(np.arange(n), len(i))).reshape(len(i), n)

    def rest(self, i: Int[np.ndarray, " P"], j: Int[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
        """What the compiled part leaves out."""
        a, b, i, j = self.a.source, self.b.source, self.a.index[i], self.b.index[j]
        return sum((cost.weight * cost.pairs(a, b, i, j) for cost in self.others), start=np.zeros(len(i)))


def distances(cloud: Cloud, landmarks: Cloud) -> Float[np.ndarray, "N L"]:
    """D_track of every track to every landmark of its video, nan where never seen together."""
    from ...compute.simd import LANES
    from ...costs.kernels import max_distance_block
    from . import kernels

    gaps, n = cloud.gaps or landmarks.gaps, len(landmarks)
    if not gaps and len(cloud) >= LANES and n:
        marks, T = fours(landmarks.columns), len(cloud.weight)
        lying = np.empty((marks.shape[2], len(cloud)), np.float32)
        run(kernels.farthest, len(cloud), cloud.columns.reshape(-1), marks.reshape(-1), T, lying.reshape(-1), block=128)
        return np.ascontiguousarray(lying[:n].T)
    out = np.empty((len(cloud), n), np.float32)

    def work(i0: int, i1: int) -> None:
        max_distance_block(cloud.columns, landmarks.columns, cloud.weight, landmarks.weight, gaps, i0, i1, 0, n, out)

    run(work, len(cloud), block=128)
    return out


def signatures(
    a: Cloud, b: Cloud, landmarks: tuple[Cloud, Cloud], scale: Scale
) -> tuple[Float[np.ndarray, "Na L"], Float[np.ndarray, "Nb L"]]:
    """D_track to the landmarks in units of the common median, ready to be compared."""
    sa, sb = (distances(x, marks) / np.float32(scale.median) for x, marks in zip((a, b), landmarks, strict=True))
    sa[np.isnan(sa)] = UNKNOWN
    sb[np.isnan(sb)] = -UNKNOWN
    return sa, sb


@dataclass(frozen=True, eq=False)
class Candidates:
    """For every track of a up to K partners, cheapest first; index -1 and cost inf where there are fewer.

    Costs are in units of τ²: ``mean_k min((s_ik - s_jk)²/τ², 1) + β M_ij``.
    """

    index: Int[np.ndarray, "N K"]
    cost: Float[np.ndarray, "N K"]

    def one_to_one(self, n_b: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Greedy one-to-one pairs, cheapest first: (i, j, cost)."""
        from . import kernels

        i, k = np.nonzero(self.index >= 0)
        j, cost = self.index[i, k], self.cost[i, k]
        order = ascending(cost)
        kept = order[kernels.one_to_one(i[order], j[order], len(self.index), n_b)]
        return i[kept], j[kept], cost[kept]


def shortlist(
    signs: tuple[np.ndarray, np.ndarray],
    linear: Linear,
    scale: Scale,
    keep: int,
    groups: tuple[np.ndarray, np.ndarray] | None = None,
    allowed: Int[np.ndarray, "Ga C"] | None = None,
) -> Candidates:
    """The ``keep`` cheapest partners of every track, among the groups of b ``allowed`` for its own (None: among
    all).
    """
    from . import kernels

    sa, sb = signs
    if groups is None or allowed is None:
        groups, allowed = (np.zeros(len(sa), np.int64), np.zeros(len(sb), np.int64)), np.zeros((1, 1), np.int64)
    group, of_b = groups
    start, member = lanes_of(of_b)
    rows_a, rows_b, traits_a, traits_b = map(fours, (sa, sb, linear.ua, linear.ub))
    index = np.full((len(sa), keep), -1, np.int64)
    cost = np.full((len(sa), keep), np.inf, np.float32)
    tau2 = np.float32(scale.tau**2)
    unit = np.float32(scale.beta) * tau2
    least = linear.least - 1e-4 * (abs(linear.offset) + abs(linear.offset - linear.least))  # rounding may take it away
    run(
        kernels.shortlist,
        len(sa),
        rows_a.reshape(-1),
        in_lanes(rows_b, member),
        rows_a.shape[1],
        traits_a.reshape(-1),
        in_lanes(traits_b, member),
        traits_a.shape[1],
        sa.shape[1],
        tau2,
        unit,
        np.float32(linear.offset),
        unit * np.float32(least),
        group,
        allowed,
        start,
        member,
        index,
        cost,
        block=256,
    )
    cost /= tau2
    if linear.others:
        i, k = np.nonzero(index >= 0)
        cost[i, k] += scale.beta * linear.rest(i, index[i, k])
        order = np.argsort(cost, axis=1, kind="stable")
        index, cost = np.take_along_axis(index, order, 1), np.take_along_axis(cost, order, 1)
    return Candidates(index, cost)


def lanes_of(group: Int[np.ndarray, " M"]) -> tuple[Int[np.ndarray, " G1"], Int[np.ndarray, "E W"]]:
    """Where groups lie in blocks as wide as a vector: group g has start[g]:start[g+1]; the members of each block, -1
    for none. No block holds members of two groups.
    """
    from ...compute.simd import LANES

    order = np.argsort(group, kind="stable")
    size = np.bincount(group)
    start = np.concatenate([[0], np.cumsum(-(-size // LANES))])
    first = np.concatenate([[0], np.cumsum(size)[:-1]])  # of each group, in the order
    member = np.full(start[-1] * LANES, -1)
    member[(LANES * start[:-1] - first)[group[order]] + np.arange(len(group))] = order
    return start, member.reshape(-1, LANES)


def in_lanes(rows: Float[np.ndarray, "M L"], member: Int[np.ndarray, "E W"]) -> Float[np.ndarray, " ELW"]:
    """[E,L,W], flat: what the kernel reads at once lies side by side."""
    return np.ascontiguousarray(rows[member].transpose(0, 2, 1)).reshape(-1)


def fours(rows: Float[np.ndarray, "*N L"]) -> Float[np.ndarray, "*N M"]:
    """With as many zeros behind each row as make a multiple of four."""
    more = -rows.shape[-1] % 4
    return np.pad(rows, ((0, 0),) * (rows.ndim - 1) + ((0, more),)) if more else np.ascontiguousarray(rows)
