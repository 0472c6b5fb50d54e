"""From anchors to cells: one start of the solver, several starts, and a challenger that looks for a second answer."""

from __future__ import annotations

from dataclasses import dataclass, replace
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

WORTHLESS = 1.25
"""Matches of a higher cost are dropped: between related videos nearly all of them are wrong (at N = 2000 precision
rises from .70 to .87, recall stays)."""

AS_GOOD = 1.1
"""A second answer whose price is within this factor is as good as the first."""

CHANCE = 4.0
"""And one whose price is higher by so many standard errors of the difference."""

EXPLAINED = 0.5
"""Share of the better half of the matches that a second answer among what is left over must put elsewhere (whole bodies
.6 to 1; limbs of one body that look alike .25)."""

JUDGES, MOST_JUDGES = 6, 256
"""Matches that judge a second answer, at least and at most. Of two or three, chance makes any answer as good: of random
tracks without features, 16 beside 8 of them, it doubted 15 of 20 right answers."""

SAME_PLACE = 0.3
"""Two partners of a track mean the same place when they are less than this apart (unit: the common median)."""

KEPT = 0.4
"""Share of the matches, the cheapest ones, that are landmarks of the next round."""

CHALLENGE_ROUNDS = 1
"""Rounds of the challenger: enough to see what its answer costs."""

LEFT_OVER = 0.75
"""Tracks that found no good partner, as a share of those that did, from which they are asked for a second answer. Two
alike bodies of which the other video shows one leave a whole body over, 1 and more; worlds of one scene .46 to .57."""

VOTERS, LIKEST, SEEDS = 128, 8, 16
"""Of :func:`seeded`: tracks that vote, their partners, and the tracks whose partners are voted on."""

GROUPS = 12
"""Groups of b's cells in which partners of a cell are sought. With 16 of 175 anchors a match of 2000 tracks took a
fifth more time, and of its better half as many were right (worlds 10170 to 10185)."""


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

    def relative(self, i: Int[np.ndarray, " P"], j: Int[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
        """M of the pairs, in units of chance; 1/2 where it tells nothing."""
        return self.linear.cost(i, j) / self.scale.chance if self.scale.chance > 0 else np.full(len(i), 0.5)

    def take(self, i: Int[np.ndarray, " Na"], j: Int[np.ndarray, " Nb"]) -> Level:
        """The tracks i of a and j of b."""
        a, b = self.a.take(i), self.b.take(j)
        return Level(a, b, replace(self.linear, ua=self.linear.ua[i], ub=self.linear.ub[j], a=a, b=b), self.scale)


@dataclass(frozen=True, eq=False)
class Solution:
    """One-to-one matches of cells, cheapest first, and what they are worth.

    Args:
        i, j, cost: (M,) the pairs; cost in units of τ².
        candidates: of every cell of a. marks: the landmarks that they were judged by.
        geometry, linear: the two parts of the cheaper half's cost, pair by pair: in units of τ², and in units of chance
            (:class:`Scale`), 1/2 where M tells nothing.
        chirality: see :func:`otsync.vouch.chirality`; nan where it cannot tell.
    """

    i: Int[np.ndarray, " M"]
    j: Int[np.ndarray, " M"]
    cost: Float[np.ndarray, " M"]
    candidates: Candidates
    marks: tuple[Cloud, Cloud]
    geometry: Float[np.ndarray, " H"]
    linear: Float[np.ndarray, " H"]
    chirality: float

    @property
    def half(self) -> int:
        """How many matches are the better half."""
        return (len(self.i) + 1) // 2

    def pair(self, side: int) -> Int[np.ndarray, " H"]:
        """The better half's tracks of a (side 0) or of b (1)."""
        return (self.i, self.j)[side][: self.half]

    @property
    def price(self) -> float:
        """What solutions are compared by: the residual, and what looks mirrored. (GW cannot see mirror images.)"""
        return self.doubt + HANDEDNESS * (1 - (0.5 if np.isnan(self.chirality) else self.chirality))

    @property
    def doubt(self) -> float:
        """How much the answer looks like one between unrelated videos; see :data:`UNRELATED`."""
        return float(self.doubts.mean())

    @property
    def doubts(self) -> Float[np.ndarray, " H"]:
        """The same, pair by pair."""
        return self.geometry + 2 * self.linear

    def as_good_as(self, best: Solution) -> bool:
        """Whether the price is within :data:`AS_GOOD` of the best one's, or higher by what chance may make of so few
        pairs.
        """
        if not self.half:
            return False
        told = min(self.half, best.half) >= JUDGES
        chance = sum(float(s.doubts.var()) / s.half for s in (self, best)) ** 0.5 if told else 0.0
        return self.price < max(AS_GOOD * best.price, best.price + CHANCE * chance)


def solve(level: Level, options: Options) -> tuple[Solution, float, int]:
    """The best of up to ``options.restarts`` starts, how near a different answer comes, and the number of starts.

    The first solution that is no mirror image and not one of unrelated videos ends the starts. Then a challenger
    is sent: a start that is pushed away from every match found; and what is left over in either video is asked for an
    answer (:func:`among_left_over`). The returned share says how much of the better half of the matches one of these
    places elsewhere, about as well; 0 when they return to the same answer or suit worse. What has the lowest price is
    the answer. An answer of what is left over counts as a start where it suits.
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
    elsewhere = disagreement(level, start.label_a, best, rival) if rival.as_good_as(best) else 0.0
    drawn = len(starts) + 1
    for side in (0, 1):
        other, share = among_left_over(level, options, start, best, side)
        if other is not None:
            drawn, elsewhere = drawn + 1, max(elsewhere, share)
            best = min(best, other, key=lambda s: s.price)
    return best, elsewhere, drawn


def among_left_over(
    level: Level, options: Options, start: Start, found: Solution, side: int
) -> tuple[Solution | None, float]:
    """A second answer for the tracks that have a partner, among those of the other video that have none.

    It is there where one video shows two alike bodies and the other one of them. The challenger seldom finds it: at its
    fixed mass it mixes both bodies, which costs more than either.

    Args:
        side: in which video tracks are left over: 0 for a, 1 for b.

    Returns:
        The answer and what :func:`explains` says of it; None and 0 where too few tracks are left over, or where they
        explain too few of the found matches.
    """
    good = found.cost <= WORTHLESS
    chosen = [np.sort(k[good]) for k in (found.i, found.j)]
    left = np.setdiff1d(np.arange(len((level.a, level.b)[side])), chosen[side])
    if good.sum() < 4 * JUDGES or len(left) < LEFT_OVER * good.sum():
        return None, 0.0
    chosen[side] = left
    part, rng = level.take(chosen[0], chosen[1]), np.random.default_rng([options.seed, side])
    if level.scale.chance > 0:
        marks = seeded(part, rng)
    else:  # nothing but structure
        draw = Start.draw(part, options, rng)
        marks = draw.anchor_matches(options)
    share = 0.0
    for rounds, factor in ((CHALLENGE_ROUNDS, AS_GOOD**2), (options.rounds - CHALLENGE_ROUNDS, AS_GOOD)):
        rival = start.refine(level, options, marks, rounds)
        share = explains(level, rival, found, side, factor)
        if share <= EXPLAINED:
            return None, 0.0
        marks = rival.marks
    return rival, share


def explains(level: Level, rival: Solution, found: Solution, side: int, factor: float) -> float:
    """The share of the better half of the found matches that the rival puts elsewhere in video ``side``; 0 where it
    suits these worse.

    Judged by the half of them that costs least in both answers, and by the distances among these: strangers, too, find
    partners, which become landmarks, and cheaper ones the longer they are sought.
    """
    (one, here), (two, there) = ((s.pair(1 - side), s.pair(side)) for s in (found, rival))
    _, at, to = np.intersect1d(one, two, return_indices=True)
    cloud = (level.a, level.b)[side]
    moved = apart(cloud.take(here[at]), cloud.take(there[to])) > SAME_PLACE * level.scale.median
    at, to = at[moved], to[moved]
    if len(at) < 2 * JUDGES:
        return 0.0
    sure = np.argsort(found.doubts[at] + rival.doubts[to], kind="stable")[: min((len(at) + 1) // 2, MOST_JUDGES)]
    first, second = (doubts_among(level, s.i[k], s.j[k]) for s, k in ((found, at[sure]), (rival, to[sure])))
    chance = float((second - first).std(ddof=1)) / len(sure) ** 0.5
    suits = second.mean() < max(factor * float(first.mean()), float(first.mean()) + CHANCE * chance)
    return len(at) / found.half if suits else 0.0


def doubts_among(level: Level, i: Int[np.ndarray, " M"], j: Int[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """:attr:`Solution.doubts` of matches that are each other's landmarks."""
    a, b = level.a.take(i), level.b.take(j)
    off = ((distances(a, a) - distances(b, b)) / (level.scale.median * level.scale.tau)) ** 2
    off = np.minimum(np.where(np.isfinite(off), off, 1.0), 1.0)
    geometry = (off.sum(1) - np.diagonal(off)) / (len(i) - 1)
    return geometry + 2 * level.relative(i, j)


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
        geometry = cost[:half] - level.scale.beta * level.linear.cost(i[:half], j[:half])
        return Solution(i, j, cost, found, marks, geometry, level.relative(i[:half], j[:half]), side)


def seeded(level: Level, rng: np.random.Generator) -> tuple[Cloud, Cloud]:
    """Matches of one body: of the likest partners of each track, those whose distance to one pair suits best.

    Partial transport between a body and several alike ones mixes them; what is near one pair does not.
    """
    some = np.sort(rng.permutation(len(level.a))[:VOTERS])
    n = len(some)
    partner = np.argsort(level.linear.table(some), axis=1, kind="stable")[:, :LIKEST]
    seeds = np.sort(rng.permutation(n)[:SEEDS])
    a = level.a.take(some)
    known = distances(a, a)
    known = known[known > 0]  # nan is not
    unit = float(np.median(known)) if known.size else level.scale.median

    def misfit(i: np.ndarray, j: np.ndarray) -> Float[np.ndarray, "n K L"]:
        """Of every track with each of its partners, seen from the pairs (some[i], j)."""
        da, db = distances(a, a.take(i)), distances(level.b, level.b.take(j))[partner]
        off = np.minimum(((da[:, None] - db) / (level.scale.tau * unit)) ** 2, 1)
        return np.where(np.isfinite(off), off, 1.0)

    votes = misfit(np.repeat(seeds, partner.shape[1]), partner[seeds].ravel())
    off = votes[:, :, votes.min(1).sum(0).argmin()]
    chosen, order = off.argmin(1), np.argsort(off.min(1), kind="stable")
    for _ in range(2):  # from more pairs than one
        top = order[: max(8, n // 4)]
        off = misfit(top, partner[top, chosen[top]]).mean(2)
        chosen, order = off.argmin(1), np.argsort(off.min(1), kind="stable")
    order = order[: max(8, int(0.9 * n))]
    return a.take(order), level.b.take(partner[order, chosen[order]])


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
    groups = [group[s.pair(0)] for s in (one, other)]
    common = np.intersect1d(groups[0], groups[1])
    if not len(common):
        return 0.0
    here, there = (_group_means(level.b, g, s.pair(1), common) for g, s in zip(groups, (one, other), strict=True))
    return float((apart(here, there) > SAME_PLACE * level.scale.median).mean())


def apart(one: Cloud, other: Cloud) -> Float[np.ndarray, " N"]:
    """How far tracks of one video are from each other, by the median of the frames that show both; 0 without any."""
    away = np.linalg.norm(one.columns - other.columns, axis=0)
    both = (one.weight * other.weight) > 0
    if both.all():
        return np.median(away, axis=0)
    away[:, ~both.any(0)] = 0.0
    return np.nanmedian(np.where(both | ~both.any(0), away, np.nan), axis=0)


def _group_means(b: Cloud, group: np.ndarray, j: np.ndarray, chosen: np.ndarray) -> Cloud:
    inside = np.isin(group, chosen)
    return b.take(j[inside]).groups(np.searchsorted(chosen, group[inside]), len(chosen))
