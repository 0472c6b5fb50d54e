"""Clocks that break, put right: the readings of all pairs are voted on, and a mend is kept where it proves itself.

Two ways, one after the other. By motion: what the first matches tell. By windows: pairs whose doubts wrong matches make
are matched at the time that wins, and each window of what they share is matched by itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

from ...clocks.common import nominal_fps
from ...clocks.lengths import jumping, lasting
from ...types import Break, Status, TrackSet
from ..graph import Pair
from ..hearing import Hearing
from ..pairs import run
from ..rematching import NOISY, asks, at_peaks
from ..verdict import Answer
from .breaks import MOST, Suspect, culprit, mended, suspects
from .proofs import confirmed, remeasured_jump, seen_of, steady_beside, suspected
from .ways import ByCuts, ByWindows, Way, readings_of
from .windows import Pieces

MEASURED, SETTLED = 6, 0.02 / 30
"""How often a jump is measured anew, at most, and seconds by which it may still change. Where little is left behind a
break each round may find half of what is left: a replay of 33 frames was 31.4 long after three rounds (seed 367 of the
search), with a sigma of .3."""


def mend_clocks(hearing: Hearing, way: Way) -> Hearing:
    """Videos whose clocks break are put on the clock that they had before, one break after the other.

    A mend is kept where it adds to the evidence of the video's pairs.
    """
    doubtful_mends: set[int] = set()
    fps = [nominal_fps(t) for t in hearing.tracks]
    mends = 0
    while mends < MOST:
        tracks = hearing.tracks
        doubtful = {a.pair: a for a in way.doubtful(hearing.answers, tracks)}
        answers = tuple(doubtful.get(a.pair, a) for a in hearing.answers)
        hearing = replace(hearing, verdict=replace(hearing.verdict, answers=answers))
        named = [
            s for a in doubtful.values() for s in suspects(a, tracks[a.pair[0]], tracks[a.pair[1]], fps, way.within)
        ]
        one = culprit(named, seen_of(hearing.verdict, tracks))
        if one is None:
            break
        tried = _with_break(hearing, one, way)
        if tried is None:
            if way.refused(pair for pair in doubtful if one.video in pair):
                continue
            break
        mends += 1
        way.kept(tried.fresh.values())
        hearing = hearing.mended(one.video, tried.tracks, tried.broke).told(tried.fresh)
        if not steady_beside(tried.fresh, hearing.tracks, one.video, tried.broke):
            doubtful_mends.add(one.video)
    # a clock that is whole again is so against every video: one pair that still breaks speaks against the mend
    still = {v for a in hearing.answers if Status.BROKEN_CLOCK in a.refined.flags for v in a.pair}
    doubtful_mends |= still & set(hearing.broken)
    doubtful_mends |= {s.video for s in suspected(hearing.verdict, hearing.tracks, fps)}
    return hearing.doubted_videos(doubtful_mends)


def mend_by_cuts(hearing: Hearing) -> Hearing:
    """:func:`mend_clocks` by pieces, of doubtful pairs whose videos look cut and were not mended."""
    doubtful = {a.pair for a in hearing.answers if not a.refined.status.ok}
    asked = [job for job in hearing.jobs if job.pair in doubtful and hearing.broken.keys().isdisjoint(job.pair)]
    pieces = [found for job in asked if (found := Pieces.of(job)) is not None]
    answers = list(hearing.map(run, [job for found in pieces for job in found.jobs])) if pieces else []
    joined = [p.joined(before, behind) for p, before, behind in zip(pieces, answers[::2], answers[1::2], strict=True)]
    told = {answer.pair: answer.doubted() for answer in joined if answer is not None}
    if not told:
        return hearing
    then = mend_clocks(hearing, ByCuts(told))
    return then if len(then.broken) > len(hearing.broken) else hearing


def mend_by_windows(hearing: Hearing) -> tuple[Hearing, set[Pair]]:
    """:func:`mend_clocks` by windows, of pairs whose clocks are doubtful; and those pairs that are told of so.

    Of videos that were mended before, only those that run evenly beside each break by the new matches, too: one that
    changed its speed is steady in windows.
    """
    answers = {a.pair: a for a in hearing.answers}
    asked = [j for j in hearing.jobs if asks(j, answers[j.pair], hearing.verdict) and _may_break(answers[j.pair])]
    several = at_peaks(asked, answers, hearing.map)
    tasks = [(job, several[job.pair], answers[job.pair]) for job in asked if job.pair in several]
    told = {readings[0].pair: readings for readings in hearing.map(readings_of, tasks) if readings}
    told = {pair: readings for pair, readings in told.items() if _even(readings[0], hearing)}
    if not told:
        return hearing, set()
    hearing = hearing.told({pair: readings[0] for pair, readings in told.items()})
    return mend_clocks(hearing, ByWindows(told)), set(told)


def _even(answer: Answer, hearing: Hearing) -> bool:
    """Whether the mended clocks of a pair run evenly beside all of their breaks."""
    for v in set(answer.pair) & hearing.broken.keys():
        breaks = hearing.broken[v]
        for found in breaks:
            late = sum(b.jump for b in breaks if b.at < found.at)
            if not steady_beside({answer.pair: answer}, hearing.tracks, v, replace(found, at=found.at + late)):
                return False
    return True


def _may_break(answer: Answer) -> bool:
    """Whether a pair's clock is doubtful, and the rest of its doubts are those that wrong matches, or a break, make."""
    flags = set(answer.refined.flags)
    return Status.BROKEN_CLOCK in flags and flags <= NOISY | {Status.BROKEN_CLOCK, Status.RATE_MISMATCH}


class Mend(NamedTuple):
    """A video on a mended clock, the answers of its pairs then, and what was mended."""

    tracks: TrackSet
    fresh: dict[Pair, Answer]
    broke: Break


def _with_break(hearing: Hearing, suspect: Suspect, way: Way) -> Mend | None:
    """The pairs of a video done anew with its clock mended, and again while what is left of the jump is measured.

    None where that adds nothing to the evidence, or where the clock still breaks in as many pairs. That is asked of
    the last jump alone: the first one, measured by matches of two offsets, may be a frame off.
    """
    v, found = suspect.video, suspect.found
    own = [a for a in hearing.answers if v in a.pair]
    before, doubts = _evidence(own), _broken(own)
    frame = 1 / nominal_fps(hearing.tracks[v])
    best = None
    for _ in range(MEASURED):
        tried = hearing.mended(v, mended(hearing.tracks[v], (found,)), found)
        fresh = way.anew(tried.of(v), hearing.map)
        if _evidence(fresh.values()) <= before:
            break
        if _broken(fresh.values()) < doubts:
            best = Mend(tried.tracks[v], fresh, found)
        left = remeasured_jump(fresh, tried.tracks, v, found)
        if best is not None and found.sigma == 0:  # the video itself shows how many frames it stood still
            best = best._replace(broke=confirmed(found, left))
            break
        if left is None:
            break
        if left.still > 0 > left.jump:
            left = lasting(found.at - found.still, -left.jump, left.sigma, frame)
        else:
            left = jumping(left.at, left.jump, left.sigma, frame)
        if best is not None and abs(left.jump - found.jump) < SETTLED:
            break
        found = left
    if best is not None and best.broke.sigma > 0:
        # what the last round would still change is an error, too
        late = found.jump - best.broke.jump
        best = best._replace(broke=replace(best.broke, sigma=math.hypot(best.broke.sigma, late)))
    return best


def _evidence(answers: Iterable[Answer]) -> float:
    return sum(a.scanned.stats.get("evidence", 0.0) for a in answers)


def _broken(answers: Iterable[Answer]) -> int:
    return sum(Status.BROKEN_CLOCK in a.refined.flags for a in answers)
