"""From anchors to cells: one start of the solver, several starts, and a challenger that looks for a second answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from ...costs.linear import Cost, fill_unseen, total_cost
from ..vouch import FRAMES, chirality
from .anchors import AnchorProblem
from .cells import POSES, k_means
from .clouds import Cloud
from .signatures import Candidates, Linear, Scale, distances, shortlist, signatures

RIGHT_HANDED = 0.9
"""Chirality from which a start needs no further ones."""

UNRELATED = 1.55
"""Doubt (geometry + twice the relative linear cost) from which videos do not show the same scene. Measured over four
presets and 300 to 4000 tracks: related ones .3 to 1.35, mostly by geometry; unrelated ones 1.8 to 2.5, where features
hardly beat chance. The sum of both as the solver weighs them overlaps: clean motion of unrelated bodies can be matched
better than noisy motion of the same."""

HANDEDNESS = 0.1
"""What a wholly mirrored answer pays, in units of τ². Between views of a thin body from opposite sides the right answer
may look mirrored, so that chirality alone must not decide: there the residual does."""

AS_GOOD = 1.1
"""A second answer whose price is within this factor is as good as the first."""

SAME_PLACE = 0.3
"""Two partners of a track mean the same place when they are less than this apart (unit: the common median)."""

KEPT = 0.4
"""Share of the matches, the cheapest ones, that are landmarks of the next round."""

CHALLENGE_ROUNDS = 1
"""Rounds of the challenger: enough to see what its answer costs."""

GROUPS = 16
"""Groups of b's cells in which partners of a cell are sought."""


class Options(Protocol):
    """What of :class:`~otsync.match.AnchoredFGW`'s options is read here."""

    @property
    def anchors(self) -> int: ...
    @property
    def mass(self) -> float: ...
    @property
    def alpha(self) -> float: ...
    @property
    def landmarks(self) -> int: ...
    @property
    def rounds(self) -> int: ...
    @property
    def partners(self) -> int: ...
    @property
    def restarts(self) -> int: ...
    @property
    def costs(self) -> tuple[Cost, ...]: ...
    @property
    def seed(self) -> int: ...


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
        geometry, linear: mean of the two parts of the cheaper half's cost: in units of τ², and in units of chance
            (:class:`Scale`), 1/2 where M tells nothing.
        chirality: see :func:`otsync.vouch.chirality`; nan where it cannot tell.
    """

    i: Int[np.ndarray, " M"]
    j: Int[np.ndarray, " M"]
    cost: Float[np.ndarray, " M"]
    candidates: Candidates
    marks: tuple[Cloud, Cloud]
    geometry: float
    linear: float
    chirality: float

    @property
    def half(self) -> int:
        """How many matches are the better half."""
        return (len(self.i) + 1) // 2

    @property
    def price(self) -> float:
        """What solutions are compared by: the residual, and what looks mirrored. (GW cannot see mirror images.)"""
        return self.doubt + HANDEDNESS * (1 - (0.5 if np.isnan(self.chirality) else self.chirality))

    @property
    def doubt(self) -> float:
        """How much the answer looks like one between unrelated videos; see :data:`UNRELATED`."""
        return self.geometry + 2 * self.linear


def solve(level: Level, options: Options) -> tuple[Solution, float, int]:
    """The best of up to ``options.restarts`` starts, how near a different answer comes, and the number of starts.

    The first solution that is no mirror image and not one of unrelated videos ends the starts. Then a challenger
    is sent: a start that is pushed away from every match found. The returned share says how much of the better half
    of the matches it places elsewhere at no higher price; 0 when it returns to the same answer or pays more. Should
    it win, it is the answer.
    """
    starts: list[tuple[Solution, Start]] = []
    for r in range(max(1, options.restarts)):
        start = Start.draw(level, options, np.random.default_rng([options.seed, r]))
        starts.append((start.refine(level, options, start.anchor_matches(options), options.rounds), start))
        if starts[-1][0].chirality >= RIGHT_HANDED and starts[-1][0].doubt < UNRELATED:
            break
    best, start = min(starts, key=lambda s: s[0].price)
    if not best.doubt < UNRELATED:
        return best, 0.0, len(starts)
    rival = start.refine(level, options, start.challenge(level, options, best), CHALLENGE_ROUNDS)
    if rival.price < AS_GOOD**2 * best.price:  # worth the remaining rounds
        rival = start.refine(level, options, rival.marks, options.rounds - CHALLENGE_ROUNDS)
    if rival.price < best.price:
        best, rival = rival, best
    as_good = rival.price < AS_GOOD * best.price
    return best, disagreement(level, start.label_a, best, rival) if as_good else 0.0, len(starts) + 1


@dataclass(frozen=True, eq=False)
class Start:
    """One draw of anchors with its FGW problem."""

    label_a: Int[np.ndarray, " Na"]
    label_b: Int[np.ndarray, " Nb"]
    anchors: Level
    problem: AnchorProblem

    @classmethod
    def draw(cls, level: Level, options: Options, rng: np.random.Generator) -> Start:
        """Anchors: means of groups of cells, from a random start."""
        labels = [k_means(cloud, options.anchors, rng) for cloud in (level.a, level.b)]
        a, b = (c.groups(l, int(l.max()) + 1) for c, l in zip((level.a, level.b), labels, strict=True))
        M = total_cost(options.costs, a.source, b.source)
        Ca, Cb = (fill_unseen(distances(x, x)).astype(float) / level.scale.median for x in (a, b))
        anchors = Level(a, b, Linear.of(options.costs, a, b), level.scale)
        return cls(labels[0], labels[1], anchors, AnchorProblem(M, Ca, Cb, options.alpha))

    def anchor_matches(self, options: Options) -> tuple[Cloud, Cloud]:
        """Matched anchors by partial FGW, from the product plan and from the features' plan; the lower objective."""
        plans = (self.problem.solve(options.mass, s) for s in (None, self.problem.features_only(options.mass)))
        return self._matched(min(plans, key=self.problem.objective))

    def challenge(self, level: Level, options: Options, found: Solution) -> tuple[Cloud, Cloud]:
        """Matched anchors of the best plan that avoids the places where ``found`` puts them."""
        votes = np.zeros(self.problem.M.shape)
        np.add.at(votes, (self.label_a[found.i], self.label_b[found.j]), 1.0)
        placed = votes / np.maximum(votes.sum(1, keepdims=True), 1.0)
        # how near an anchor of b is to where this anchor's cells went: 1 there, 0 from SAME_PLACE on
        near = placed @ np.maximum(1 - self.problem.Cb / SAME_PLACE, 0.0)
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

    def refine(self, level: Level, options: Options, marks: tuple[Cloud, Cloud], rounds: int) -> Solution:
        """Cells by their signatures; the best matches are the landmarks of the next of ``rounds``."""
        every = np.arange(len(marks[0]))
        marks = spread(*marks, every, every, options.landmarks)
        for _ in range(rounds + 1):
            allowed = shortlist(self.anchors.signatures(marks), self.anchors.linear, level.scale, GROUPS).index
            found = shortlist(
                level.signatures(marks),
                level.linear,
                level.scale,
                options.partners,
                (self.label_a, self.label_b),
                allowed,
            )
            i, j, cost = found.one_to_one(len(level.b))
            best = max(min(options.landmarks, len(i)), int(KEPT * len(i)))
            marks = spread(level.a, level.b, i[:best], j[:best], options.landmarks)
        half = (len(i) + 1) // 2
        side = chirality(*(c.poses(FRAMES)[k[:half]].reshape(half, -1, 3) for c, k in ((level.a, i), (level.b, j))))
        linear = float(level.linear.cost(i[:half], j[:half]).mean())
        geometry = float(cost[:half].mean()) - level.scale.beta * linear
        relative = linear / level.scale.chance if level.scale.chance > 0 else 0.5
        return Solution(i, j, cost, found, marks, geometry, relative, side)


def spread(a: Cloud, b: Cloud, i: Int[np.ndarray, " M"], j: Int[np.ndarray, " M"], n: int) -> tuple[Cloud, Cloud]:
    """At most ``n`` of the pairs (i, j), as clouds: far from each other in a, the first one first."""
    from . import kernels

    if len(i) > n:
        chosen = kernels.spread_out(a.poses(POSES)[i], n, 0)
        i, j = i[chosen], j[chosen]
    return a.take(i), b.take(j)


def disagreement(level: Level, group: Int[np.ndarray, " Na"], one: Solution, other: Solution) -> float:
    """Share of the groups of a's cells whose partners are, on the mean, elsewhere in b in the other solution.

    Of the better halves of both. Means of groups, since in noisy scenes single matches scatter without any ambiguity.
    """
    halves = [(s.i[: s.half], s.j[: s.half]) for s in (one, other)]
    common = np.intersect1d(*(group[i] for i, _ in halves))
    if not len(common):
        return 0.0
    here, there = (_group_means(level.b, group[i], j, common) for i, j in halves)
    apart = np.linalg.norm(here.columns - there.columns, axis=0) * (here.weight * there.weight)
    return float((np.median(apart, axis=0) > SAME_PLACE * level.scale.median).mean())


def _group_means(b: Cloud, group: np.ndarray, j: np.ndarray, chosen: np.ndarray) -> Cloud:
    inside = np.isin(group, chosen)
    return b.take(j[inside]).groups(np.searchsorted(chosen, group[inside]), len(chosen))
