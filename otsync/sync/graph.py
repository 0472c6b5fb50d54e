"""Many videos at once: which pairs to compare, and offsets of the videos from offsets of the pairs.

Offsets here are world seconds: an edge (a, b) measures ``x[b] - x[a]``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..types import Alignment
from ..types.checks import check_whole

Pair = tuple[int, int]

UNKNOWN_SIGMA = 0.5 / 30
"""Seconds, of a pair whose algorithm gives none: an answer on the frame grid."""

FLAGGED = 3.0
"""Factor on the sigma of a pair that does not vouch for its answer."""

CAUCHY = 2.5
"""Residuals beyond this many sigmas count for less."""

WORTH = 4.0
"""Degrees of freedom that the variances of edges count for, as they are said, beside what the cycles show."""

UNSEEN = 2.0
"""Times the variance that cycles show, of all: what is a video's own fits into every cycle."""

OPEN = 2.5
"""Most that the cycles can show, in squares of sigma a degree of freedom: one wrong edge is not all."""

L1_FLOOR = 0.3
"""Sigmas below which the L1 weight grows no further."""


@dataclass(frozen=True)
class Graph:
    """Which pairs are compared, and how their answers become one.

    Args:
        extra: pairs of every video besides the one with the reference. 0: the star of the paper.
        complete: up to so many videos all pairs are compared (unless ``extra`` is 0).
        curves: settle contradictions and flagged pairs by the sum of the pairs' whole score curves, where aligners
            give one. A pair's highest peak may be wrong; the peaks of many pairs agree only at the truth.
        starts: random spanning trees that the search over summed curves starts from, besides the obvious ones.
        seed: of the choice of pairs and trees.
    """

    extra: int = 4
    complete: int = 10
    curves: bool = True
    starts: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("extra", "complete", "starts"):
            check_whole(f"Graph.{name}", getattr(self, name), 0)
        for name, switch, off in (("complete", "extra", 0), ("starts", "curves", False)):
            if getattr(self, switch) == off and getattr(self, name) != type(self).__dataclass_fields__[name].default:
                raise ValueError(
                    f"Graph.{name}, Graph.{switch}: expected one of them; {name} is not used with {switch}={off}. "
                    "Leave it out."
                )

    def pairs(self, n: int, centre: int) -> list[Pair]:
        """Sorted pairs (a, b) with a < b: a star around ``centre`` and rings that add ``extra`` pairs a video."""
        if self.extra and n <= self.complete:
            return [(i, j) for i in range(n) for j in range(i + 1, n)]
        found = {(min(centre, v), max(centre, v)) for v in range(n) if v != centre}
        ring = np.random.default_rng(self.seed).permutation([v for v in range(n) if v != centre])
        for s in range(1, (self.extra + 1) // 2 + 1):
            # strides 1, 4, 9, ...: neighbours of neighbours are far apart, cycles are long and short
            for i in range(n - 1):
                a, b = int(ring[i]), int(ring[(i + s * s) % (n - 1)])
                if a != b:
                    found.add((min(a, b), max(a, b)))
        return sorted(found)


@dataclass(frozen=True, eq=False)
class Edge:
    """One pair's answer as the graph sees it.

    Args:
        a, b: videos. offset: world seconds, of b relative to a. sigma: seconds.
        trusted: whether the pair itself vouches for it.
        curve: (K,2) offset in seconds and score, or None.
        common: seconds, the part of sigma that is known to be the two videos' own, as far as the pair tells.
        tentative: share of the pair's own variance that is for the cycles to judge: see :func:`judged_by_cycles`.
        doubt: factor that sigma holds because the pair does not vouch for itself: a suspicion, which is for the
            cycles to judge.
    """

    a: int
    b: int
    offset: float
    sigma: float
    trusted: bool
    curve: Float[np.ndarray, "K 2"] | None = None
    common: float = 0.0
    tentative: float = 0.0
    doubt: float = 1.0

    @classmethod
    def of(cls, a: int, b: int, offset: float, pair: Alignment, curve: np.ndarray | None = None) -> Edge:
        """Of a pair's answer; ``offset`` in world seconds. One that does not vouch for itself has FLAGGED its sigma."""
        sigma = pair.sigma if math.isfinite(pair.sigma) and pair.sigma > 0 else UNKNOWN_SIGMA
        doubt = 1.0 if pair.status.ok else FLAGGED
        return cls(
            a,
            b,
            offset,
            sigma=doubt * sigma,
            trusted=pair.status.ok,
            curve=curve,
            common=min(pair.stats.get("common_error", 0.0), sigma),
            tentative=pair.stats.get("tentative", 0.0),
            doubt=doubt,
        )

    @property
    def measured(self) -> float:
        """Share of sigma² that is neither tentative nor doubt."""
        return (1 - self.tentative) / self.doubt**2


@dataclass(frozen=True, eq=False)
class Solution:
    """Offsets of V videos. x: (V,) seconds, 0 for the anchor; sigma: (V,); residual: (E,) x_b - x_a - offset."""

    x: Float[np.ndarray, " V"]
    sigma: Float[np.ndarray, " V"]
    residual: Float[np.ndarray, " E"]


def components(n: int, edges: Sequence[Edge] | Sequence[Pair]) -> Int[np.ndarray, " V"]:
    """The smallest index of each video's connected component."""
    from scipy.sparse.csgraph import connected_components

    labels = connected_components(_adjacency(n, edges), directed=False)[1]
    smallest = np.full(n, n)
    np.minimum.at(smallest, labels, np.arange(n))
    return smallest[labels]


def _adjacency(n: int, edges: Sequence[Edge] | Sequence[Pair], weight: Any = None) -> Any:
    """The graph as scipy's sparse matrix; weights must not be 0, which would be no edge."""
    from scipy.sparse import coo_array

    # int32: older trees of scipy take no other index
    ends = np.array([(e.a, e.b) if isinstance(e, Edge) else e for e in edges], np.int32).reshape(-1, 2)
    values = np.ones(len(ends)) if weight is None else np.asarray(weight, float)
    return coo_array((values, (ends[:, 0], ends[:, 1])), shape=(n, n)).tocsr()


def solve(n: int, edges: Sequence[Edge], anchor: int, start: np.ndarray | None = None, shared: float = 0.0) -> Solution:
    """Robust synchronisation: weighted L1 by reweighting, then Cauchy from there (from ``start`` when given).

    Videos that no edge links to ``anchor`` stay at nan. ``shared``: of an edge's variance, the share that is its two
    videos' own, each half of it: what is wrong with a video's tracks is in all its edges alike, fits into every cycle,
    and no number of edges averages it out. What an edge tells of that (``Edge.common``) counts where it is more.
    """
    near = components(n, edges) if edges else np.arange(n)
    inside = near == near[anchor]
    free = np.flatnonzero(inside & (np.arange(n) != anchor))
    x, sigma = np.full(n, np.nan), np.full(n, np.nan)
    x[anchor] = sigma[anchor] = 0.0
    used = [e for e in edges if inside[e.a]]
    if not len(free):
        return Solution(x, sigma, np.full(len(edges), np.nan))
    column = np.full(n, -1)
    column[free] = np.arange(len(free))
    A = np.zeros((len(used), len(free)))
    for row, e in enumerate(used):
        if column[e.b] >= 0:
            A[row, column[e.b]] += 1
        if column[e.a] >= 0:
            A[row, column[e.a]] -= 1
    d, s = np.array([e.offset for e in used]), np.array([e.sigma for e in used])
    y = _reweighted(A, d, s, np.linalg.lstsq(A / s[:, None], d / s, rcond=None)[0], _l1)[0] if start is None else None
    first = y if y is not None else np.asarray(start)[free] - np.asarray(start)[anchor]
    y, normal = _reweighted(A, d, s, first, _cauchy)
    x[free] = y
    alone = np.diag(np.linalg.inv(normal))  # as if no two edges had anything in common
    own = np.maximum(shared * _usual_variance(n, used), _common_variance(n, used))
    told = float(np.median([min(e.common / e.sigma, 1.0) ** 2 for e in used]))
    together = (1 - max(shared, told)) * alone + own[free] + own[anchor]
    sigma[free] = np.sqrt(np.maximum(alone, together))
    judged = judged_by_cycles((A @ y - d) / s, len(free))
    sigma[free] *= np.sqrt(1 + float(np.average([1 - e.measured for e in used], weights=s**-2)) * (judged**2 - 1))
    return Solution(x, sigma, np.array([x[e.b] - x[e.a] - e.offset for e in edges]))


def judged_by_cycles(residual: Float[np.ndarray, " E"], free: int) -> float:
    """By how much sigmas are to be multiplied, by what the edges contradict each other (Birge's ratio).

    A part of an edge's variance is no scatter that was measured but what errors in common are taken to be, which no
    residual of a pair shows: smooth bodies that turn beneath their tracks are off by more, real people by less. Cycles
    show it, the surer the more there are; so they judge that part. From pixels, 36 films of the first (seeds 77000 to
    77017 and 79500 to 79517) had 59 and 90 % of their offsets within one and two sigmas without this, with it 65 and
    94; fifteen cameras of the second were off by a quarter of their sigmas.

    Args:
        residual: of each edge, in its sigmas. free: number of offsets that were solved for.
    """
    cycles = len(residual) - free
    shown = min(float(np.square(residual).sum()), OPEN * cycles)
    return float(np.sqrt((WORTH + UNSEEN * shown) / (WORTH + cycles)))


def _usual_variance(n: int, edges: Sequence[Edge]) -> Float[np.ndarray, " V"]:
    """Half of the median variance of every video's edges, without what a doubt makes of it; 0 without an edge."""
    around: list[list[float]] = [[] for _ in range(n)]
    for e in edges:
        for v in (e.a, e.b):
            around[v].append((e.sigma / e.doubt) ** 2 / 2)
    return np.array([float(np.median(v)) if v else 0.0 for v in around])


def _common_variance(n: int, edges: Sequence[Edge]) -> Float[np.ndarray, " V"]:
    """Half of the mean variance that every video's edges know to have in common; 0 without an edge.

    Each counts by its weight in the answer: what an edge has in common reaches the answer no further than the edge
    itself. (One of four videos' six pairs knew its offset to 4 frames; all four were said to be off by 1.)
    """
    total, weights = np.zeros((2, n))
    for e in edges:
        for v in (e.a, e.b):
            total[v] += e.common**2 / 2 / e.sigma**2
            weights[v] += 1 / e.sigma**2
    return np.divide(total, weights, out=np.zeros(n), where=weights > 0)


def _l1(r: np.ndarray) -> np.ndarray:
    return 1 / np.maximum(np.abs(r), L1_FLOOR)


def _cauchy(r: np.ndarray) -> np.ndarray:
    return 1 / (1 + (r / CAUCHY) ** 2)


def _reweighted(A, d, s, x, weight, iterations: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Iteratively reweighted least squares of A x = d with sigmas s; the answer and its normal matrix."""
    for _ in range(iterations):
        w = weight((A @ x - d) / s) / s**2
        normal = A.T @ (A * w[:, None])
        new = np.linalg.solve(normal, A.T @ (w * d))
        done = np.abs(new - x).max() < 1e-9
        x = new
        if done:
            break
    return x, normal


class CurveSum:
    """The pairs' score curves as one function of all offsets, and its ascent one video at a time.

    Curves count from their median, which is what an offset without overlap scores.
    """

    def __init__(self, n: int, edges: Sequence[Edge], step: float):
        self.n, self.step = n, step
        self.edges = [e for e in edges if e.curve is not None and np.isfinite(e.curve[:, 1]).any()]
        self.curves = [_levelled(e.curve) for e in self.edges]
        self.around: list[list[int]] = [[] for _ in range(n)]
        for k, e in enumerate(self.edges):
            self.around[e.a].append(k)
            self.around[e.b].append(k)

    def total(self, x: Float[np.ndarray, " V"]) -> float:
        return float(
            sum(
                np.interp(x[e.b] - x[e.a], *c, left=0.0, right=0.0)
                for e, c in zip(self.edges, self.curves, strict=True)
            )
        )

    def of_video(self, v: int, x: Float[np.ndarray, " V"]) -> tuple[np.ndarray, np.ndarray]:
        """Candidates for x[v] and what they score with the others held; candidates lie on a grid through x[v]."""
        low, high = np.inf, -np.inf
        for k in self.around[v]:
            e, (t, _) = self.edges[k], self.curves[k]
            ends = x[e.a] + t[[0, -1]] if e.b == v else x[e.b] - t[[-1, 0]]
            low, high = min(low, ends[0]), max(high, ends[1])
        if not low < high:
            return np.array([x[v]]), np.zeros(1)
        candidates = x[v] + self.step * np.arange(np.ceil((low - x[v]) / self.step), (high - x[v]) / self.step + 1)
        score = np.zeros(len(candidates))
        for k in self.around[v]:
            e, c = self.edges[k], self.curves[k]
            offset = candidates - x[e.a] if e.b == v else x[e.b] - candidates
            score += np.interp(offset, *c, left=0.0, right=0.0)
        return candidates, score

    def standing(self, v: int, x: Float[np.ndarray, " V"]) -> tuple[float, float]:
        """What x[v] scores with the others held, and the best local maximum more than four steps away from it."""
        candidates, score = self.of_video(v, x)
        here = int(np.argmin(np.abs(candidates - x[v])))
        near = slice(max(here - 1, 0), here + 2)
        padded = np.pad(score, 1, constant_values=-np.inf)
        top = (score >= padded[:-2]) & (score >= padded[2:]) & (np.abs(candidates - x[v]) > 4.5 * self.step)
        return float(score[near].max()), float(score[top].max(initial=0.0))

    def ascend(self, x: Float[np.ndarray, " V"], fixed: int, sweeps: int = 20) -> Float[np.ndarray, " V"]:
        """Coordinate ascent from x; the video ``fixed`` stays."""
        x = x.copy()
        for _ in range(sweeps):
            before = x.copy()
            for v in range(self.n):
                if v != fixed and self.around[v]:
                    candidates, score = self.of_video(v, x)
                    best = int(np.argmax(score))
                    if score[best] > np.interp(x[v], candidates, score) + 1e-9:
                        x[v] = candidates[best]
            if np.array_equal(x, before):
                break
        return x

    def search(self, starts: Sequence[np.ndarray], fixed: int) -> Float[np.ndarray, " V"]:
        """The ascent with the largest total; the earliest on ties."""
        found = [self.ascend(x, fixed) for x in starts]
        return max(found, key=self.total)


def _levelled(curve: Float[np.ndarray, "K 2"] | None) -> tuple[np.ndarray, np.ndarray]:
    assert curve is not None
    t, c = curve.T
    finite = np.isfinite(c)
    level = float(np.median(c[finite]))
    return t, np.where(finite, c, level) - level


def spanning_trees(
    n: int, edges: Sequence[Edge], weight: Sequence[float], anchor: int, count: int, seed: int
) -> list[Float[np.ndarray, " V"]]:
    """Offsets along maximum spanning trees of ``weight``: the first as it is, the others with random factors."""
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    rng = np.random.default_rng(seed)
    offset = {(e.a, e.b): e.offset for e in edges} | {(e.b, e.a): -e.offset for e in edges}
    starts = []
    for k in range(count):
        w = np.asarray(weight, float) * (1.0 if k == 0 else rng.uniform(0.2, 1.0, len(edges)))
        place = np.empty(len(edges))  # 1 for the heaviest, ties in the given order: no weight is 0
        place[np.lexsort((np.arange(len(edges)), -w))] = np.arange(1, len(edges) + 1)
        tree = minimum_spanning_tree(_adjacency(n, edges, place))
        order, parent = breadth_first_order(tree, anchor, directed=False)
        x = np.zeros(n)
        for v in order[1:].tolist():
            x[v] = x[parent[v]] + offset[int(parent[v]), v]
        starts.append(x)
    return starts


def cycle_errors(edges: Sequence[Edge]) -> Float[np.ndarray, " C"]:
    """|sum of offsets| around every triangle of edges, s."""
    offset = {(e.a, e.b): e.offset for e in edges} | {(e.b, e.a): -e.offset for e in edges}
    near: dict[int, set[int]] = {}
    for a, b in offset:
        near.setdefault(a, set()).add(b)
    sums = [
        abs(offset[a, b] + offset[b, c] + offset[c, a])
        for a in sorted(near)
        for b in sorted(near[a])
        if b > a
        for c in sorted(near[a] & near[b])
        if c > b
    ]
    return np.array(sums)


def agreeing(edges: Sequence[Edge], residual: Float[np.ndarray, " E"], least: float) -> Bool[np.ndarray, " E"]:
    """Edges within four sigmas, or ``least`` seconds, of the solution."""
    sigma = np.array([e.sigma for e in edges])
    return np.abs(residual) <= np.maximum(least, 4 * sigma)
