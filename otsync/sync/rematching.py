"""Matching once more: at the times of clocks that are known, and at each of those that compete for a pair."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ..align.evidence import APART
from ..compute.threads import MapLike
from ..costs.epipolar import EpipolarDistance
from ..costs.linear import Cosine
from ..costs.positions import SynchronousDistance
from ..match.slot import Matcher
from ..match.synchronous import SynchronousMatching
from ..match.unbalanced import UnbalancedOT
from ..types import Clock, Status
from .graph import Pair
from .method import with_costs
from .pairs import Job, run
from .verdict import Answer, Verdict

NOISY = frozenset(
    {
        Status.AMBIGUOUS,
        Status.WEAK,
        Status.DISAGREE,
        Status.ALIAS,
        Status.MOVED,
        Status.NO_MATCH,
        Status.SPREAD,
        Status.POOR_FIT,
    }
)
"""Doubts that wrong matches make: of those that were made without any time half are wrong where tracks are noisy.

A clock that breaks, a rate, things at rest are not among them: matches that were made at one time agree with it.
"""

CLEARLY = 0.3
"""Share of its evidence by which the time that wins must be ahead of every other."""


def contested(jobs: Sequence[Job], verdict: Verdict, map: MapLike) -> dict[Pair, Answer]:
    """The pairs of doubtful videos whose doubts are :data:`NOISY`, decided by matches made at each time that competes.

    Every peak of a pair's scan gets matches of its own, an answer from these, and their evidence (nats a match times
    matches). At the right time partners are at one place and move alike, and their evidence grows; wrong times keep
    what chance gives, or lead to the right one. Where the same things happen twice, both times have as much, and the
    doubt stays. So do all doubts that the winner's own matches raise.
    """
    answers = {a.pair: a for a in verdict.answers}
    asked = [job for job in jobs if asks(job, answers[job.pair], verdict) and noisy(answers[job.pair])]
    winners = {pair: winner(several) for pair, several in at_peaks(asked, answers, map).items()}
    return {pair: best for pair, best in winners.items() if best is not None}


def at_peaks(jobs: Sequence[Job], answers: Mapping[Pair, Answer], map: MapLike) -> dict[Pair, list[Answer]]:
    """The answers of pairs at each peak of their scans, by matches that are made there; without those that fail."""
    tasks = [again for job in jobs for again in at_each(job, answers[job.pair].scanned.hypotheses[:, 0])]
    found: dict[Pair, list[Answer]] = {}
    for answer in map(run, tasks) if tasks else ():
        if answer.finite:
            found.setdefault(answer.pair, []).append(answer)
    return found


def asks(job: Job, answer: Answer, verdict: Verdict) -> bool:
    """Whether one of a pair's videos is doubtful, and several times can be tried in a common frame."""
    placed = job.a.xyz is not None and job.b.xyz is not None and job.a.frame is not None and job.a.frame == job.b.frame
    doubtful = any(verdict.flags[v] for v in job.pair)
    several = "evidence" in answer.scanned.stats and len(answer.scanned.hypotheses) > 0
    return bool(placed and doubtful and several)


def noisy(answer: Answer) -> bool:
    """Whether nothing speaks against a pair that better matches might not mend."""
    return set(answer.refined.flags) <= NOISY


def winner(several: Sequence[Answer], explained: Sequence[float] = ()) -> Answer | None:
    """The answer with the most evidence, where it is clearly ahead of all at other times; all have an offset.

    Args:
        explained: offsets, s, that are no rivals: parts of a clock that breaks have them.
    """
    total = [evidence_of(a) for a in several]
    best = int(np.argmax(total))
    known = (several[best].refined.offset, *explained)
    others = [e for a, e in zip(several, total, strict=True) if all(abs(a.refined.offset - at) > APART for at in known)]
    clear = total[best] * (1 - CLEARLY) >= max(others, default=0.0)
    return several[best] if clear and total[best] > 0 else None


def evidence_of(answer: Answer) -> float:
    """Nats of all matches together."""
    return answer.scanned.stats.get("evidence", 0.0) * len(answer.matches)


def at_each(job: Job, times: Iterable[float]) -> list[Job]:
    """The work on a pair, to be matched once more at each of some offsets, s."""
    return [dataclasses.replace(job, matcher=at_known_times(job.matcher, Clock(float(t), 1.0))) for t in times]


def rematching(jobs: Sequence[Job], verdict: Verdict) -> list[Job]:
    """The pairs between trusted videos of one component, to be matched at their synchronised times."""
    again = []
    for job in jobs:
        i, j = job.pair
        if verdict.flags[i] or verdict.flags[j] or verdict.component[i] != verdict.component[j]:
            continue
        # t_a = (r_b t_b + x_b - x_a) / r_a
        clock = Clock(
            float((verdict.x[j] - verdict.x[i]) / verdict.rates[i]), float(verdict.rates[j] / verdict.rates[i])
        )
        flat = job.a.xyz is None or job.b.xyz is None
        again.append(dataclasses.replace(job, matcher=at_known_times(job.matcher, clock, flat)))
    return again


def at_known_times(matcher: Matcher | None, clock: Clock, flat: bool = False) -> Matcher:
    """What matches a pair once more: as the matcher says, else mutual nearest neighbours at equal times.

    ``flat``: the tracks are pixels only, which epipolar distances compare.
    """
    told = None if matcher is None else matcher.at(clock)
    if told is not None and flat and told.needs_xyz:
        pixels = EpipolarDistance(clock=clock)
        costs = tuple(pixels if isinstance(c, SynchronousDistance) else c for c in told.costs)
        told = Matcher.of(with_costs(told, costs))
    if told is not None and not (flat and told.needs_xyz):
        return told
    costs = (Cosine(),) if matcher is None else matcher.costs
    if flat:
        return UnbalancedOT(costs=(*costs, EpipolarDistance(clock=clock)))
    return SynchronousMatching(clock.offset, clock.rate, costs)
