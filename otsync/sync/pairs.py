"""The work on one pair of videos: match, align, refine; and refine anew from elsewhere."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..align.slot import Aligner
from ..align.verb import align
from ..compute.threads import blas_for
from ..match.slot import Matcher
from ..match.verb import match
from ..refine.slot import Rate, Refiner
from ..refine.verb import refine
from ..types import Alignment, Matches, Status, TrackSet
from .graph import Pair
from .verdict import Answer

log = logging.getLogger("otsync")

DOUBTS = frozenset({Status.NO_MATCH, Status.AMBIGUOUS})
"""Doubts about matches: the pair's answer carries them, so that nobody trusts it, and is there to be looked at."""

CLEAR = 40.0
"""Nats a match that answer a doubt about features."""


@dataclass(frozen=True, eq=False)
class Job:
    """What one pair needs, self-contained so that any executor can carry it."""

    pair: Pair
    a: TrackSet
    b: TrackSet
    matcher: Matcher | None
    aligner: Aligner
    refiner: Refiner
    matches: Matches | None

    def on(self, other: Job) -> Job:
        """The same algorithms on the tracks of another one."""
        return dataclasses.replace(self, a=other.a, b=other.b)


def run(job: Job) -> Answer:
    """Match, align and refine one pair. An exception becomes the status FAILED, told in the log."""
    with blas_for(max(len(job.a), len(job.b))):
        return _answer(job)


def _answer(job: Job) -> Answer:
    matches = Matches(np.zeros((0, 2), int), flags=(Status.FAILED,))
    try:
        given = job.matches if job.matches is not None else match(job.a, job.b, job.matcher, throw=False)
        matches = given.without_plan()
        told = set(matches.flags) - {Status.FORCED}  # aligners bear wrong matches, and judge for themselves
        if told and not (len(matches) and told <= DOUBTS):
            failed = Alignment(float("nan"), flags=matches.flags, stats=matches.stats)
            return Answer(job.pair, matches, failed, failed)
        scanned = align(job.a, job.b, matches, job.aligner, throw=False)
        scanned = dataclasses.replace(scanned, flags=(*(f for f in matches.flags if f in DOUBTS), *scanned.flags))
        refined = scanned
        if np.isfinite(scanned.offset):
            refined = refine(job.a, job.b, matches, scanned, job.refiner, throw=False)
            refined = without_answered_doubt(refined)
        return Answer(job.pair, matches, scanned, refined)
    except Exception as error:
        log.warning("pair %s: %s: %s", job.pair, type(error).__name__, error)
        failed = Alignment(float("nan"), flags=(Status.FAILED,))
        return Answer(job.pair, matches, failed, failed)


def without_answered_doubt(refined: Alignment) -> Alignment:
    """Features that look unrelated do not count against an answer in space that leaves no other doubt.

    Noisy features of one scene match little better than strangers' do; that one motion explains both videos, that the
    tracks are at one place at the answer, and that no other time suits them as well, is the stronger evidence.
    """
    stats = refined.stats
    placed = stats.get("rival_as_good") == 0.0 and stats.get("apart", math.inf) < 1.0
    told = placed and stats.get("evidence", 0.0) > CLEAR
    if refined.flags == (Status.NO_MATCH,) and told:
        return dataclasses.replace(refined, flags=())
    return refined


@dataclass(frozen=True, eq=False)
class Refit:
    """A pair to be refined anew from elsewhere."""

    a: TrackSet
    b: TrackSet
    matches: Matches
    start: Alignment
    refiner: Refiner

    @classmethod
    def of(cls, answer: Answer, offset: float, rate: float, tracks: Sequence[TrackSet], refiner: Refiner) -> Refit:
        i, j = answer.pair
        start = dataclasses.replace(answer.scanned, offset=offset, rate=rate, stats=dict(answer.scanned.stats))
        return cls(
            tracks[i],
            tracks[j],
            answer.matches,
            start,
            refiner if refiner.rate == "fixed" else refiner.with_rate("fixed"),
        )


def run_refit(job: Refit) -> Alignment:
    try:
        return refine(job.a, job.b, job.matches, job.start, job.refiner, throw=False)
    except Exception as error:
        log.warning("refitting: %s: %s", type(error).__name__, error)
        return Alignment(float("nan"), flags=(Status.FAILED,))


def with_rate(refiner: Refiner, rate: Rate | None) -> Refiner:
    """The refiner told how to treat rates; None: as it is. ValueError where it cannot fit them."""
    return refiner if rate is None or rate == refiner.rate else refiner.with_rate(rate)
