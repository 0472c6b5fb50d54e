"""From anchors to cells: one start of the solver, several starts, and a challenger that looks for a second answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from ..costs import fill_unseen, total_cost
from .anchors import AnchorProblem
from .cells import POSES, k_means
from .chirality import chirality
from .clouds import Cloud
from .signatures import Candidates, Linear, Scale, distances, shortlist, signatures

if TYPE_CHECKING:
    from .solver import AnchoredFGW

RIGHT_HANDED = 0.9
"""Chirality from which a start needs no further ones: flipped solutions score .10-.32, right ones .94-.99, at 50°."""

NEAR = 0.3
"""Two partners of a track mean the same place when they are less than this apart (unit: the common median)."""

KEPT = 0.4
"""Share of the matches, the cheapest ones, that are landmarks of the next round."""

GROUPS = 16
"""Groups of b's cells in which partners of a cell are sought."""


@dataclass(frozen=True, eq=False)
class Level:
    """Two clouds with their costs, in the units of one problem."""

    a: Cloud
    b: Cloud
    linear: Linear
    scale: Scale

    def signatures(self, marks: tuple[Cloud, Cloud]) -> tuple[np.ndarray, np.ndarray]:
        return signatures(self.a, self.b, marks, self.scale)


@dataclass(frozen=True, eq=False)
class Solution:
    """One-to-one matches of cells, cheapest first, and what they are worth.

    Args:
        i, j, cost: (M,) the pairs; cost in units of τ².
        candidates: of every cell of a. marks: the landmarks that they were judged by.
        residual: mean cost of the cheaper half.
        chirality: see :func:`chirality`; nan where it cannot tell.
    """

    i: Int[np.ndarray, " M"]
    j: Int[np.ndarray, " M"]
    cost: Float[np.ndarray, " M"]
    candidates: Candidates
    marks: tuple[Cloud, Cloud]
    residual: float
    chirality: float

    @property
    def half(self) -> int:
        """How many matches are the better half."""
        return (len(self.i) + 1) // 2

    @property
    def right_handed(self) -> bool:
        """Whether it is no mirror image, as far as that can be told."""
        return not self.chirality < RIGHT_HANDED

    def key(self) -> tuple[bool, float]:
        """Order among solutions: the right-handed first, the cheapest of them; else by chirality."""
        return not self.right_handed, self.residual if self.right_handed else -self.chirality


def solve(level: Level, options: AnchoredFGW, enough: float) -> tuple[Solution, float, int]:
    """The best of up to ``options.restarts`` starts, how near a different answer comes, and the number of starts.

    The first right-handed solution of residual below ``enough`` is taken. Then a challenger is sent: a start that is
    pushed away from every match found. The returned share says how much of the better half of the matches it places
    elsewhere at no greater cost; 0 when it returns to the same answer or pays more. Should it win, it is the answer.
    """
    starts: list[tuple[Solution, Start]] = []
    for r in range(max(1, options.restarts)):
        start = Start.draw(level, options, np.random.default_rng([options.seed, r]))
        starts.append((start.refine(level, options, start.anchor_matches(options)), start))
        if starts[-1][0].right_handed and starts[-1][0].residual < enough:
            break
    best, start = min(starts, key=lambda s: s[0].key())
    if not best.residual < enough:
        return best, 0.0, len(starts)
    rival = start.refine(level, options, start.challenge(level, options, best))
    if rival.key() < best.key():
        best, rival = rival, best
    as_good = rival.residual < 1.1 * best.residual and not rival.chirality < best.chirality - 0.15
    return best, disagreement(level, best, rival) if as_good else 0.0, len(starts) + 1


@dataclass(frozen=True, eq=False)
class Start:
    """One draw of anchors with its FGW problem."""

    label_a: Int[np.ndarray, " Na"]
    label_b: Int[np.ndarray, " Nb"]
    anchors: Level
    problem: AnchorProblem

    @classmethod
    def draw(cls, level: Level, options: AnchoredFGW, rng: np.random.Generator) -> Start:
        """Anchors: means of groups of cells, from a random start."""
        labels = [k_means(cloud, options.anchors, rng) for cloud in (level.a, level.b)]
        a, b = (c.groups(l, int(l.max()) + 1) for c, l in zip((level.a, level.b), labels, strict=True))
        M = total_cost(options.costs, a.source, b.source)
        Ca, Cb = (fill_unseen(distances(x, x)).astype(float) / level.scale.median for x in (a, b))
        anchors = Level(a, b, Linear.of(options.costs, a, b), level.scale)
        return cls(labels[0], labels[1], anchors, AnchorProblem(M, Ca, Cb, options.alpha))

    def anchor_matches(self, options: AnchoredFGW) -> tuple[Cloud, Cloud]:
        """Matched anchors by partial FGW, from the product plan and from the features' plan; the lower objective."""
        plans = (self.problem.solve(options.mass, s) for s in (None, self.problem.features_only(options.mass)))
        return self._matched(min(plans, key=self.problem.objective))

    def challenge(self, level: Level, options: AnchoredFGW, found: Solution) -> tuple[Cloud, Cloud]:
        """Matched anchors of the best plan that avoids the places where ``found`` puts them."""
        votes = np.zeros(self.problem.M.shape)
        np.add.at(votes, (self.label_a[found.i], self.label_b[found.j]), 1.0)
        placed = votes / np.maximum(votes.sum(1, keepdims=True), 1.0)
        # how near an anchor of b is to where this anchor's cells went: 1 there, 0 from NEAR on
        near = placed @ np.maximum(1 - self.problem.Cb / NEAR, 0.0)
        moved = AnchorProblem(self.problem.M + near, self.problem.Ca, self.problem.Cb, self.problem.alpha)
        return self._matched(moved.solve(options.mass, moved.features_only(options.mass)))

    def _matched(self, plan: Float[np.ndarray, "na nb"]) -> tuple[Cloud, Cloud]:
        """The better nine tenths of the pairs that the plan carries, best first."""
        from scipy.optimize import linear_sum_assignment

        i, j = linear_sum_assignment(plan, maximize=True)
        carried = plan[i, j] > 1e-9
        i, j = i[carried], j[carried]
        order = np.argsort(self.problem.gradient(plan)[i, j], kind="stable")[: max(8, int(0.9 * len(i)))]
        return self.anchors.a.take(i[order]), self.anchors.b.take(j[order])

    def refine(self, level: Level, options: AnchoredFGW, marks: tuple[Cloud, Cloud]) -> Solution:
        """Cells by their signatures; the best matches are the landmarks of the next round."""
        for _ in range(options.rounds + 1):
            marks = spread(marks, options.landmarks)
            allowed = shortlist(self.anchors.signatures(marks), self.anchors.linear, level.scale, GROUPS).index
            found = shortlist(
                level.signatures(marks), level.linear, level.scale, options.partners, (self.label_a, self.label_b), allowed
            )
            i, j, cost = found.one_to_one(len(level.b))
            best = max(min(options.landmarks, len(i)), int(KEPT * len(i)))
            judged_by, marks = marks, (level.a.take(i[:best]), level.b.take(j[:best]))
        half = (len(i) + 1) // 2
        side = chirality(level.a.take(i[:half]), level.b.take(j[:half]))
        return Solution(i, j, cost, found, spread(marks, options.landmarks), float(cost[:half].mean()), side)


def spread(marks: tuple[Cloud, Cloud], n: int) -> tuple[Cloud, Cloud]:
    """At most ``n`` landmark pairs, far from each other in a, the best one first."""
    from . import kernels

    a, b = marks
    if len(a) <= n:
        return marks
    chosen = kernels.spread_out(a.poses(POSES), n, 0)
    return a.take(chosen), b.take(chosen)


def disagreement(level: Level, one: Solution, other: Solution) -> float:
    """Share of the better half of the matches of ``one`` whose partner in ``other`` is elsewhere in b."""
    partner = np.full(len(level.a), -1)
    partner[other.i] = other.j
    i, j = one.i[: one.half], one.j[: one.half]
    both = partner[i] >= 0
    if not both.any():
        return 0.0
    here, there = level.b.take(j[both]), level.b.take(partner[i[both]])
    apart = np.linalg.norm(here.columns - there.columns, axis=0) * (here.weight * there.weight)
    return float((apart.max(0) > NEAR * level.scale.median).mean())
