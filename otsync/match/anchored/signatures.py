"""What a track looks like from landmarks: signatures, and the truncated cost of a pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

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

    def rest(self, i: Int[np.ndarray, " P"], j: Int[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
        """What the compiled part leaves out."""
        a, b, i, j = self.a.source, self.b.source, self.a.index[i], self.b.index[j]
        return sum((cost.weight * cost.pairs(a, b, i, j) for cost in self.others), start=np.zeros(len(i)))


def distances(cloud: Cloud, landmarks: Cloud) -> Float[np.ndarray, "N L"]:
    """D_track of every track to every landmark of its video, nan where never seen together."""
    from ...costs.kernels import max_distance_block

    out = np.empty((len(cloud), len(landmarks)), np.float32)
    gaps, n = cloud.gaps or landmarks.gaps, len(landmarks)

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
        order = np.argsort(cost, kind="stable")
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
    member = np.argsort(of_b, kind="stable")
    start = np.searchsorted(of_b[member], np.arange(int(of_b.max(initial=0)) + 2))
    index = np.full((len(sa), keep), -1, np.int64)
    cost = np.full((len(sa), keep), np.inf, np.float32)
    tau2 = np.float32(scale.tau**2)
    run(
        kernels.shortlist,
        len(sa),
        sa,
        sb,
        linear.ua,
        linear.ub,
        tau2,
        np.float32(scale.beta) * tau2,
        np.float32(linear.offset),
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
