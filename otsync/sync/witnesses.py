"""Whether all parts of a scene tell one time: every neighbourhood of matches answers for itself, and so does the rest.

A fit of all matches gives those that disagree less weight, a whole performer too: where one of two is shown late (by a
screen, by another tracker), it settles on either, and says that it fits well. A fit of one neighbourhood alone goes
where that one leads. Matches that were made anew for the answer may all be of the performer that it is right for; then
the tracks that the answer leaves over have a sound answer of their own, elsewhere.

A late performer may also be taken for a clock that breaks: before the break the answer is right for one, behind it for
the other. Of a clock that breaks, the seconds on either side tell one time alone. So what the answer leaves over on one
side is asked for the time of the other side.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..clocks.common import readable, strongest, thinned, within
from ..compute.threads import MapLike
from ..refine.common_motion import common_motion
from ..refine.gauss_newton import fit_clock, neighbours
from ..refine.slot import Refiner
from ..refine.splines import SplineRefine
from ..refine.unrefined import Unrefined
from ..types import Alignment, Break, Clock, Matches, Status, TrackSet
from .graph import Pair
from .mend.breaks import Seen
from .mend.windows import EVERY, NEAR, Windows
from .pairs import Job, run
from .rematching import at_each, evidence_of
from .verdict import Answer

GROUPS, FEWEST = 6, 5
"""Neighbourhoods that are asked, and matches of one at least."""

OF_EACH = 3
"""Pairs of every video that are asked first: all, of up to four videos. Of many, all would take as long as the rest."""

TOLD_BY = 1.5
"""Neighbourhoods of equal information that one must fall into by itself: fewer matches agree with themselves."""

ITERATIONS = 20

FLOOR, OF_BLUR = 0.3 / 30, 0.1
"""Seconds, and share of the fit's blur, by which a neighbourhood may be off whatever its sigma says: its errors are in
common."""

ALIKE = 0.45
"""Common motion that a neighbourhood must have at the time that it tells: wrong matches go anywhere, and some say that
they know it well. Of performers that are late, neighbourhoods that are off by more than 7 units have .50 and more; of
right answers of real cameras six of 72 had one, with .34 at most (a limb matched with another one)."""

EXPLAINED = 0.25
"""Weight of a match in the fit, of the largest, from which the answer explains its tracks."""

REST = 12
"""Tracks of both videos that must be left over to be asked."""

ROUNDS = 3
"""How often what is left over is asked: where most of it is of the performer that the answer is right for, the others
are too few to be heard before it is gone (seed 56017 of "one of two late, hard": at the third time)."""

SIGMAS = 3.0
"""Standard deviations, and :data:`FLOOR` beside them, by which the answer of the rest must differ to be another one. Of
140 right answers (mid, hard, brutal, like people, flock, both seen by one, short clips; seeds 41000-41019) none is
contradicted so, and of 72 pairs of real cameras none. Of 20 pairs in which one of several performers is late, 13 are;
of one of these no neighbourhood told (seeds 51000-51019)."""

PARTLY = frozenset({Status.BROKEN_CLOCK})
"""Doubts that the rest may leave: its tracks may tell two times, and then some seconds suit the other one better, by
the scan or by the fit (2.8 units unsteady: seed 56014)."""

COMPETES = 0.5
"""Share of the best time's evidence from which another one of the rest competes."""

AS_MUCH, SURE = 0.7, 1.0 / 30
"""Share of the evidence for its own time that another time must have among what is left over, and seconds to which it
must be known, and within which it must stay. Where the late performer of "one of two late, hard" was taken for a break
(seeds 60008, 66004), the four sides have .95 and more, known to .5 frame. Of 13 mended clocks under hard noise (66000
to 66009) the share is .45 at most where an answer stays at the other side's time; most go back to their own. Where the
answer was the late performer's for all the clip (50005, 59007) the other's time has 1.4 and 1.5."""

OF_SIDE = 0.15
"""Share of the evidence of the whole answer that another time must have among what is left over beside a break, to be
the time of a performer: one side may be short, and then some time suits it by chance. Of performers who are late where
frames are lost it is .24 and more ("one of two late, frames lost", seeds 67000 to 67019); of 120 right answers beside
a break one has another time there, with .10 (53011 of "a second missing", of which two thirds of a second are left)."""

BEARABLE = frozenset({Status.NO_MATCH, Status.AMBIGUOUS, Status.SPREAD, *PARTLY})
"""Doubts that a side's rest may leave: it is short."""


def surest(answers: Mapping[Pair, Answer], jobs: Sequence[Job]) -> list[Job]:
    """The work on the :data:`OF_EACH` pairs of every video that have the most evidence."""
    best = sorted(jobs, key=lambda job: -evidence_of(answers[job.pair]))
    left = Counter[int]()
    chosen = set()
    for job in best:
        if any(left[v] < OF_EACH for v in job.pair):
            chosen.add(job.pair)
            left.update(job.pair)
    return [job for job in jobs if job.pair in chosen]


def contradicted(
    answers: Mapping[Pair, Answer],
    jobs: Sequence[Job],
    broken: Mapping[int, tuple[Break, ...]],
    rest: bool,
    limit: float,
    map: MapLike,
) -> set[Pair]:
    """The pairs of ``jobs`` of which a part of the scene tells another time than their answer.

    Args:
        broken: the breaks that were mended, of which each side is asked for the time of the other one.
        rest: whether the tracks that an answer does not explain are matched once more, and asked, too; and those that
            these leave. limit: of what :func:`parted` tells.
    """
    own = [(answers[job.pair], job) for job in jobs]
    doubted = {job.pair for job, off in zip(jobs, map(parted, own), strict=True) if off > limit}
    if not rest:
        return doubted
    shared = {job.pair: Seen.by(answers[job.pair], job.a, job.b)[1] for job in jobs}
    middle = {pair: (seen.begin + seen.end) / 2 for pair, seen in shared.items()}
    slots = {job.pair: job for job in jobs}
    explained = own
    for _ in range(ROUNDS):
        unexplained = map(left_over, [(answer, job) for answer, job in explained if job.pair not in doubted])
        others = [job for job in unexplained if job is not None]
        if not others:
            break
        again, found = other_answers(others, answers, map)
        doubted |= {a.pair for a in found if elsewhere(a, answers[a.pair], middle[a.pair])}
        # what the rest has at the answer's own time leaves a rest, too, which is matched without a time once more
        both = zip(found, again, strict=True)
        explained = list({a.pair: (a, slots[a.pair].on(job)) for a, job in both if a.refined.status.ok}.values())
    undoubted = [job for job in jobs if job.pair not in doubted]
    beside = [side for job in undoubted for side in sides(answers[job.pair], job, broken)]
    tried = iter(list(map(run, [again for side in beside for again in side.tries()])))
    doubted |= {side.rest.pair for side in beside if side.tells_both(next(tried), next(tried))}
    unsaid = [side.rest for side in beside if side.rest.pair not in doubted]
    _, found = other_answers(unsaid, answers, map)
    heard = [a for a in found if evidence_of(a) >= OF_SIDE * evidence_of(answers[a.pair])]
    return doubted | {a.pair for a in heard if elsewhere(a, answers[a.pair], middle[a.pair])}


def other_answers(rests: Sequence[Job], answers: Mapping[Pair, Answer], map: MapLike) -> tuple[list[Job], list[Answer]]:
    """The work on what is left over, at every time that may have been seen there, and its answers."""
    times = map(times_to_ask, [(job, answers[job.pair]) for job in rests]) if rests else ()
    again = [job for rest, t in zip(rests, times, strict=True) for job in at_each(fitted_where_sound(rest), t)]
    return again, list(map(run, again)) if again else []


def parted(task: tuple[Answer, Job]) -> float:
    """How far the neighbourhood that contradicts a pair's answer most is from it, in units of how well it is known."""
    answer, job = task
    a, b = job.a, job.b
    refiner = SplineRefine()
    matches = strongest(answer.matches, readable(refiner.limit, a, b))
    first, second = refiner.splines(a, b, matches)
    weight = None if matches.weight is None else matches.shares
    clock = Clock(answer.refined.offset, answer.refined.rate)
    floor = math.hypot(FLOOR, OF_BLUR * answer.refined.stats.get("blur", 0.0))
    window = refiner.windows[0]
    group = neighbours(first.mean + second.mean, GROUPS)
    worst = 0.0
    for k in range(GROUPS):
        some = np.flatnonzero(group == k)
        if len(some) < FEWEST:
            continue
        own = None if weight is None else weight[some]
        curves = first.take(some), second.take(some)
        fit = fit_clock(*curves, clock, window, weight=own, iterations=ITERATIONS)
        if fit is None or fit.witnesses < TOLD_BY:
            continue
        scatter = math.sqrt(max(float(fit.covariance[0, 0]), 0.0))
        off = abs(fit.clock.offset - clock.offset) / math.hypot(scatter, floor)
        if off > worst and common_motion(*curves, fit.clock, fit.weights, window) >= ALIKE:
            worst = off
    return worst


def left_over(task: tuple[Answer, Job]) -> Job | None:
    """The work on the tracks that a pair's answer does not explain; None where these are few, or in no common frame."""
    answer, job = task
    a, b = job.a, job.b
    if a.xyz is None or b.xyz is None or a.frame is None or a.frame != b.frame:
        return None
    refiner = SplineRefine()
    matches = strongest(answer.matches, readable(refiner.limit, a, b))
    weight = None if matches.weight is None else matches.shares
    clock = Clock(answer.refined.offset, answer.refined.rate)
    fit = fit_clock(*refiner.splines(a, b, matches), clock, refiner.windows[0], weight=weight, iterations=1)
    if fit is None:
        return None
    explained = matches.pairs[fit.weights >= EXPLAINED * fit.weights.max()]
    rest = [np.setdiff1d(np.arange(len(t)), column) for t, column in zip((a, b), explained.T, strict=True)]
    if min(map(len, rest)) < REST:
        return None
    # of a long clip every few frames tell as much, and take less
    return dataclasses.replace(job, a=thinned(a).take(rest[0]), b=thinned(b).take(rest[1]))


def times_to_ask(task: tuple[Job, Answer]) -> list[float]:
    """Offsets, s, at which what is left over of a pair's answer may have been seen.

    Those that compete in its scan, of matches that were made without a time; and since these tell nothing under noise
    of a performer who is few, those at which matches that are made there have :data:`AS_MUCH` of the evidence that
    they have at the answer's own time.
    """
    job, answer = task
    scan = run(dataclasses.replace(job, refiner=Unrefined()))
    scanned = competing(scan.scanned) if scan.finite else []
    clock = Clock(answer.refined.offset, answer.refined.rate)
    beside = [clock.offset + late for late in Windows.of(job, clock, whole=True).rivals(AS_MUCH)]
    return [*scanned, *(t for t in beside if all(abs(t - other) > NEAR * EVERY for other in scanned))]


def fitted_where_sound(job: Job) -> Job:
    """The work, without fits that can say nothing."""
    return dataclasses.replace(job, refiner=WhereSound(job.refiner))


@dataclass(frozen=True)
class WhereSound(Refiner):
    """Fits only what the scan leaves no doubt of: an answer that keeps its flags says nothing here."""

    refiner: Refiner

    @property
    def needs_xyz(self) -> bool:  # type: ignore[override]
        return self.refiner.needs_xyz

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment) -> Alignment:
        # features that look unrelated are no doubt of an answer in space: see without_answered_doubt
        doubtful = set(alignment.flags) - {Status.NO_MATCH, *PARTLY}
        return alignment if doubtful else self.refiner(a, b, matches, alignment)


def competing(scan: Alignment) -> list[float]:
    """Offsets of the peaks that come near the best one, s; the answer's where an aligner tells no others."""
    if scan.curve is None or not len(scan.hypotheses):
        return [scan.offset]
    score = scan.curve[:, 1]
    rise = scan.hypotheses[:, 1] - float(np.median(score[np.isfinite(score)]))
    return list(scan.hypotheses[rise >= COMPETES * rise.max(), 0].tolist())


def elsewhere(rest: Answer, answer: Answer, middle: float) -> bool:
    """Whether the rest has an answer that is another one, without doubts but :data:`PARTLY`.

    Args:
        middle: s of the second video's clock at which they are compared: their rates may differ.
    """
    at, here = (Clock(a.refined.offset, a.refined.rate).world(middle) for a in (rest, answer))
    sigma = math.hypot(rest.refined.sigma, answer.refined.sigma)
    sound = rest.finite and set(rest.refined.flags) <= PARTLY
    return bool(sound and abs(at - here) > SIGMAS * sigma + FLOOR)


@dataclass(frozen=True, eq=False)
class Side:
    """What a pair's answer leaves over on one side of a break.

    Args:
        rest: the work on it. own, other: s, the offsets of this side and of the other one.
    """

    rest: Job
    own: float
    other: float

    def tries(self) -> list[Job]:
        """The work on it at its own time and at the other side's."""
        return at_each(self.rest, (self.own, self.other))

    def tells_both(self, own: Answer, other: Answer) -> bool:
        """Whether things of the other side's time are seen on this side, too, by the answers to :meth:`tries`."""
        refined = other.refined
        stays = abs(refined.offset - self.other) <= SURE < abs(refined.offset - self.own)
        sure = refined.sigma <= SURE and set(refined.flags) <= BEARABLE
        placed = refined.stats.get("apart", math.inf) < 1
        return bool(stays and sure and placed and evidence_of(other) >= AS_MUCH * evidence_of(own))


def sides(answer: Answer, job: Job, broken: Mapping[int, tuple[Break, ...]]) -> list[Side]:
    """Both sides of every break of a pair's videos, whose clocks are mended, where enough is left over."""
    clock = Clock(answer.refined.offset, answer.refined.rate)
    found = []
    for v in job.pair:
        second = v == job.pair[1]
        moments, late = [], 0.0
        for one in sorted(broken.get(v, ()), key=lambda one: one.at):
            late += one.jump
            shown = one.at + late  # the first frame behind the break, on the mended clock
            moments.append((clock.world(shown) if second else shown, one.jump if second else -one.jump))
        ends = [-math.inf, *(at for at, _ in moments), math.inf]
        for k, (at, jump) in enumerate(moments):
            for begin, end, more in ((ends[k], at, jump), (at, ends[k + 2], -jump)):
                a, b = within(job.a, begin, end), within(job.b, clock.own(begin), clock.own(end))
                rest = left_over((answer, dataclasses.replace(job, a=a, b=b)))
                if rest is not None:
                    found.append(Side(rest, clock.offset, clock.offset + more))
    return found
