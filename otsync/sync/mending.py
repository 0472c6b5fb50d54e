"""Clocks that break, put right: the readings of all pairs are voted on, and a mend is kept where it proves itself.

Two ways, one after the other. By motion: what the first matches tell. By windows: pairs whose doubts wrong matches make
are matched at the time that wins, and each window of what they share is matched by itself.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Protocol

import numpy as np

from ..clocks.common import nominal_fps
from ..clocks.cuts import Steps, calm, unexplained
from ..clocks.lengths import jumping, lasting
from ..compute.threads import MapLike
from ..refine.verb import refine
from ..types import Break, Clock, Status, TrackSet, mended_times
from .breaks import (
    AROUND,
    MOST,
    SIGMAS,
    Seen,
    Suspect,
    culprit,
    mended,
    remeasured,
    runs_on,
    suspects,
)
from .graph import Pair
from .pairs import Job, run, without_answered_doubt
from .places import NONE, parts_by_place
from .rematching import NOISY, asks, at_each, at_peaks, evidence_of, winner
from .verdict import NOTHING_COMMON, Answer, Verdict
from .windows import EVERY, NEAR, Pieces, Split, Windows, matches_of_parts

log = logging.getLogger("otsync")

MEASURED, SETTLED = 3, 0.02 / 30
"""How often a jump is measured anew, at most, and seconds by which it may still change."""


class Way(Protocol):
    """How breaks are looked for, and how pairs are answered anew.

    Args:
        within: s by which the offsets of parts may be off.
    """

    within: float

    def doubtful(self, answers: Sequence[Answer], tracks: Sequence[TrackSet]) -> list[Answer]:
        """The pairs that a clock breaks in, with their parts."""

    def anew(self, jobs: Sequence[Job], map: MapLike) -> dict[Pair, Answer]:
        """The answers of pairs whose tracks changed."""

    def kept(self, fresh: Iterable[Answer]) -> None:
        """These answers, of all that were made anew, stand."""

    def refused(self, pairs: Iterable[Pair]) -> bool:
        """A reading of these pairs was wrong: whether there is another one."""


class ByMotion:
    """Parts that the first matches tell of, by their motion or by their places."""

    within = AROUND

    def doubtful(self, answers: Sequence[Answer], tracks: Sequence[TrackSet]) -> list[Answer]:
        told = [_with_parts(a, tracks) for a in answers]
        return [a for a in told if len(a.scanned.parts) and not NOTHING_COMMON & set(a.scanned.flags)]

    def anew(self, jobs: Sequence[Job], map: MapLike) -> dict[Pair, Answer]:
        return _on_mended_clocks(jobs, map)

    def kept(self, fresh: Iterable[Answer]) -> None:
        pass

    def refused(self, pairs: Iterable[Pair]) -> bool:
        return False


class ByWindows:
    """Parts that windows tell of, matched by themselves.

    Args:
        told: of every pair that is looked at so, the readings of its windows that may be right, best first.
    """

    within = NEAR * EVERY

    def __init__(self, told: Mapping[Pair, list[Answer]]) -> None:
        self.told = dict(told)
        self.tried: list[list[Answer]] = []

    def doubtful(self, answers: Sequence[Answer], tracks: Sequence[TrackSet]) -> list[Answer]:
        return [readings[0] for readings in self.told.values() if len(readings[0].scanned.parts)]

    def refused(self, pairs: Iterable[Pair]) -> bool:
        for pair in pairs:
            if len(self.told.get(pair, ())) > 1:
                del self.told[pair][0]
                return True
        return False

    def anew(self, jobs: Sequence[Job], map: MapLike) -> dict[Pair, Answer]:
        own = [job for job in jobs if job.pair in self.told]
        others = [job for job in jobs if job.pair not in self.told]
        read = list(map(_at_time, [(job, self._time(job)) for job in own]))
        self.tried += read
        return {readings[0].pair: readings[0] for readings in read} | _on_mended_clocks(others, map)

    def kept(self, fresh: Iterable[Answer]) -> None:
        stands = {id(answer) for answer in fresh}
        self.told |= {r[0].pair: r for r in self.tried if id(r[0]) in stands}
        self.tried = []

    def _time(self, job: Job) -> float:
        """Where a pair is matched: what is mended is on the clock that it had before it broke."""
        answer = self.told[job.pair][0]
        parts = answer.scanned.parts
        return float(parts[0, 1] if len(parts) else answer.refined.offset)


class ByCuts:
    """Parts that pieces of videos tell of, which look cut.

    Args:
        told: of every pair that is looked at so, its answer with its parts.
    """

    within = AROUND

    def __init__(self, told: Mapping[Pair, Answer]) -> None:
        self.told = dict(told)

    def doubtful(self, answers: Sequence[Answer], tracks: Sequence[TrackSet]) -> list[Answer]:
        return list(self.told.values())

    def anew(self, jobs: Sequence[Job], map: MapLike) -> dict[Pair, Answer]:
        return _on_mended_clocks(jobs, map)

    def kept(self, fresh: Iterable[Answer]) -> None:
        for answer in fresh:
            self.told.pop(answer.pair, None)

    def refused(self, pairs: Iterable[Pair]) -> bool:
        for pair in pairs:
            self.told.pop(pair, None)
        return bool(self.told)


def mend_clocks(
    jobs: list[Job],
    verdict: Verdict,
    tracks: list[TrackSet],
    judged: Callable[[Sequence[Answer]], Verdict],
    map: MapLike,
    way: Way,
    broken: dict[int, tuple[Break, ...]],
) -> tuple[list[Job], Verdict]:
    """Videos whose clocks break are put on the clock that they had before, one break after the other.

    ``tracks`` and ``broken`` are changed in place. A mend is kept where it adds to the evidence of the video's pairs.
    """
    doubtful_mends: set[int] = set()
    fps = [nominal_fps(t) for t in tracks]
    mends = 0
    while mends < MOST:
        doubtful = {a.pair: a for a in way.doubtful(verdict.answers, tracks)}
        verdict = dataclasses.replace(verdict, answers=tuple(doubtful.get(a.pair, a) for a in verdict.answers))
        named = [
            s for a in doubtful.values() for s in suspects(a, tracks[a.pair[0]], tracks[a.pair[1]], fps, way.within)
        ]
        one = culprit(named, _seen(verdict, tracks))
        if one is None:
            break
        v = one.video
        tried = with_break(jobs, tracks, v, one.found, verdict, way, map)
        if tried is None:
            if way.refused(pair for pair in doubtful if v in pair):
                continue
            break
        mends += 1
        jobs, tracks[v], fresh, exact = tried
        way.kept(fresh.values())
        earlier = broken.get(v, ())
        broken[v] = (*earlier, on_own_clock(exact, earlier))
        verdict = judged([fresh.get(a.pair, a) for a in verdict.answers])
        if not steady_beside(fresh, tracks, v, exact):
            doubtful_mends.add(v)
    # a clock that is whole again is so against every video: one pair that still breaks speaks against the mend
    still = {v for a in verdict.answers if Status.BROKEN_CLOCK in a.refined.flags for v in a.pair}
    doubtful_mends |= still & set(broken)
    doubtful_mends |= {s.video for s in suspected(verdict, tracks, fps)}
    if doubtful_mends:
        verdict = judged([doubted(a) if doubtful_mends & set(a.pair) else a for a in verdict.answers])
    return jobs, verdict


def mend_by_cuts(
    jobs: list[Job],
    verdict: Verdict,
    tracks: list[TrackSet],
    judged: Callable[[Sequence[Answer]], Verdict],
    map: MapLike,
    broken: dict[int, tuple[Break, ...]],
) -> tuple[list[Job], Verdict]:
    """:func:`mend_clocks` by pieces, of doubtful pairs whose videos look cut and were not mended."""
    doubtful = {a.pair for a in verdict.answers if not a.refined.status.ok}
    asked = [job for job in jobs if job.pair in doubtful and not broken.keys() & set(job.pair)]
    pieces = [found for job in asked if (found := Pieces.of(job)) is not None]
    answers = list(map(run, [job for found in pieces for job in found.jobs])) if pieces else []
    joined = [p.joined(before, behind) for p, before, behind in zip(pieces, answers[::2], answers[1::2], strict=True)]
    told = {answer.pair: doubted(answer) for answer in joined if answer is not None}
    if not told:
        return jobs, verdict
    known = len(broken)
    mended_jobs, mended_verdict = mend_clocks(jobs, verdict, tracks, judged, map, ByCuts(told), broken)
    return (mended_jobs, mended_verdict) if len(broken) > known else (jobs, verdict)


def mend_by_windows(
    jobs: list[Job],
    verdict: Verdict,
    tracks: list[TrackSet],
    judged: Callable[[Sequence[Answer]], Verdict],
    map: MapLike,
    broken: dict[int, tuple[Break, ...]],
) -> tuple[list[Job], Verdict, set[Pair]]:
    """:func:`mend_clocks` by windows, of pairs whose clocks are doubtful; and those pairs that are told of so.

    Of videos that were mended before, only those that run evenly beside each break by the new matches, too: one that
    changed its speed is steady in windows.
    """
    answers = {a.pair: a for a in verdict.answers}
    asked = [job for job in jobs if asks(job, answers[job.pair], verdict) and _may_break(answers[job.pair])]
    several = at_peaks(asked, answers, map)
    tasks = [(job, several[job.pair], answers[job.pair]) for job in asked if job.pair in several]
    told = {readings[0].pair: readings for readings in map(_told, tasks) if readings}
    told = {pair: readings for pair, readings in told.items() if _even(readings[0], tracks, broken)}
    if not told:
        return jobs, verdict, set()
    verdict = judged([told[a.pair][0] if a.pair in told else a for a in verdict.answers])
    jobs, verdict = mend_clocks(jobs, verdict, tracks, judged, map, ByWindows(told), broken)
    return jobs, verdict, set(told)


def _even(answer: Answer, tracks: Sequence[TrackSet], broken: Mapping[int, tuple[Break, ...]]) -> bool:
    """Whether the mended clocks of a pair run evenly beside all of their breaks."""
    for v in set(answer.pair) & broken.keys():
        for found in broken[v]:
            late = sum(b.jump for b in broken[v] if b.at < found.at)
            if not steady_beside({answer.pair: answer}, tracks, v, dataclasses.replace(found, at=found.at + late)):
                return False
    return True


def _may_break(answer: Answer) -> bool:
    """Whether a pair's clock is doubtful, and the rest of its doubts are those that wrong matches, or a break, make."""
    flags = set(answer.refined.flags)
    return Status.BROKEN_CLOCK in flags and flags <= NOISY | {Status.BROKEN_CLOCK, Status.RATE_MISMATCH}


def _told(task: tuple[Job, list[Answer], Answer]) -> list[Answer]:
    """What windows tell of a pair, around the best of its answers at known times: readings, best first; none where it
    is not clear. The last of the task is the pair's answer by matches that were made without a time.
    """
    job, several, untimed = task
    best = max(several, key=evidence_of)
    try:
        windows = Windows.of(job, Clock(best.refined.offset, best.refined.rate))
    except Exception as error:  # as of a pair that fails: the others live
        log.warning("windows of pair %s: %s: %s", job.pair, type(error).__name__, error)
        return []
    breaks = windows.breaks()
    explained = [best.refined.offset + split.late for split in breaks]
    if winner(several, explained) is None or not (breaks or windows.steady):
        return []
    # of matches that were made without a time half are wrong: they are heard where a video may be cut
    heard = (best,) if calm(Steps.of(job.a)) and calm(Steps.of(job.b)) else (untimed, best)
    return _by(windows, best, job, *(a.scanned.stats for a in heard))


def _at_time(task: tuple[Job, float]) -> list[Answer]:
    """A pair matched at a time, and what windows tell then: readings, best first."""
    job, offset = task
    (once,) = at_each(job, (offset,))
    answer = run(once)
    if not answer.finite:
        return [doubted(answer)]
    return _by(Windows.of(job, Clock(answer.refined.offset, answer.refined.rate)), answer, job)


def _by(windows: Windows, answer: Answer, job: Job, *scans: Mapping[str, float]) -> list[Answer]:
    """The answer, freed of the scan's doubt whether its clock breaks where no window has it; else with the doubt, and
    with the parts that they tell of, as often as there are readings.

    Where motion comes back, the windows behind a gap suit two offsets: they lift no doubt that any of the ``scans``
    (their stats) has for this reason. A clock that was mended already is asked by its windows alone.
    """
    if windows.steady and not any(stats.get("returns") for stats in scans):
        return [freed(answer, job)]
    if windows.steady:  # the doubt stays, and why: witnesses ask about it
        stats = dict(answer.scanned.stats) | {"returns": 1.0}
        return [doubted(dataclasses.replace(answer, scanned=dataclasses.replace(answer.scanned, stats=stats)))]
    return [_with_split(windows, split, answer, job) for split in windows.breaks()] or [doubted(answer)]


def _with_split(windows: Windows, split: Split, answer: Answer, job: Job) -> Answer:
    parts = windows.parts(split)
    scanned = dataclasses.replace(answer.scanned, parts=parts)
    return doubted(
        dataclasses.replace(answer, matches=matches_of_parts(job, parts, answer.refined.rate), scanned=scanned)
    )


def _on_mended_clocks(jobs: Sequence[Job], map: MapLike) -> dict[Pair, Answer]:
    """Pairs' answers once more. That motion comes back is no doubt of a clock in which a break was found already."""
    out = {}
    for job, answer in zip(jobs, map(run, jobs), strict=True):
        if answer.finite and answer.scanned.stats.get("returns"):
            answer = freed(answer, job)
        out[answer.pair] = answer
    return out


def freed(answer: Answer, job: Job) -> Answer:
    """The answer without the scan's doubt whether its clock breaks; the fit's own stays."""
    flags = tuple(f for f in answer.scanned.flags if f is not Status.BROKEN_CLOCK)
    stats = dict(answer.scanned.stats) | {"returns": 0.0}
    scanned = dataclasses.replace(answer.scanned, flags=flags, parts=NONE, stats=stats)
    refined = refine(job.a, job.b, answer.matches, scanned, job.refiner, throw=False)
    return dataclasses.replace(answer, scanned=scanned, refined=without_answered_doubt(refined))


def _with_parts(answer: Answer, tracks: Sequence[TrackSet]) -> Answer:
    """The answer, with the parts that positions tell of where its clock is doubtful and motion tells of none."""
    first, second = (tracks[v] for v in answer.pair)
    if len(answer.scanned.parts) or Status.BROKEN_CLOCK not in answer.refined.flags or not answer.finite:
        return answer
    if first.xyz is None or second.xyz is None:
        return answer
    parts = parts_by_place(answer, first, second)
    return dataclasses.replace(answer, scanned=dataclasses.replace(answer.scanned, parts=parts))


def _seen(verdict: Verdict, tracks: Sequence[TrackSet]) -> list[Seen]:
    """What the pairs without any doubt see of their videos."""
    sound = [a for a in verdict.answers if a.refined.status.ok and a.finite]
    return [seen for a in sound for seen in Seen.by(a, tracks[a.pair[0]], tracks[a.pair[1]])]


def suspected(verdict: Verdict, tracks: Sequence[TrackSet], fps: Sequence[float]) -> list[Suspect]:
    """Breaks that were not mended, and that no pair which sees both sides of them speaks against.

    A pair that is ambiguous accuses nobody: what suits a part of it at another time may be motion that comes again.
    """
    doubtful = [
        a
        for a in verdict.answers
        if len(a.scanned.parts)
        and Status.BROKEN_CLOCK in a.refined.flags
        and not {*NOTHING_COMMON, Status.AMBIGUOUS} & set(a.refined.flags)
    ]
    sound = _seen(verdict, tracks)
    named = [s for a in doubtful for s in suspects(a, tracks[a.pair[0]], tracks[a.pair[1]], fps)]
    return [s for s in named if not any(seen.across(s) for seen in sound)]


def doubted(answer: Answer) -> Answer:
    """The answer with the flag of a clock that breaks otherwise than it was mended."""
    return answer.flagged(Status.BROKEN_CLOCK)


def cut_where_it_holds(
    answers: Sequence[Answer],
    filmed: Sequence[TrackSet],
    tracks: Sequence[TrackSet],
    broken: Mapping[int, tuple[Break, ...]],
) -> set[Pair]:
    """The pairs in whose overlap a video shows a clear cut that no break of its clock explains, and whose answer does
    not hold beside it. What jumps in the scene is no cut: there it holds.

    Args:
        filmed: as they were filmed, on their videos' own clocks. tracks: on the clocks of the answers.
    """
    shown = []  # (K,2) per video: the moments of the frames before and behind each cut
    for v, video in enumerate(filmed):
        steps, breaks = Steps.of(video), broken.get(v, ())
        behind = unexplained(steps, breaks)
        shown.append(mended_times(steps.times, breaks)[0][np.stack([behind - 1, behind], 1)])
    found = set()
    for answer in answers:
        a, b = answer.pair
        if not answer.finite or not len(shown[a]) + len(shown[b]):
            continue
        clock = Clock(answer.refined.offset, answer.refined.rate)
        for before, behind in (*shown[a], *clock.world(shown[b])):
            if not runs_on(answer, tracks[a], tracks[b], float(before), float(behind)):
                found.add(answer.pair)
    return found


def steady_beside(fresh: Mapping[Pair, Answer], tracks: Sequence[TrackSet], v: int, found: Break) -> bool:
    """Whether most pairs of video v agree that its mended clock runs evenly up to the break and from it on."""
    told = []
    for (i, j), answer in fresh.items():
        if not np.isfinite(answer.refined.offset) or not answer.sound:
            continue
        shown = found.at + found.jump
        moments = (shown if found.still > 0 else found.at), shown
        clock = Clock(answer.refined.offset, answer.refined.rate)
        before, behind = moments if v == i else (clock.world(m) for m in moments)
        told.append(runs_on(answer, tracks[i], tracks[j], before, behind))
    return 2 * sum(told) >= len(told)


def with_break(
    jobs: list[Job], tracks: Sequence[TrackSet], v: int, found: Break, verdict: Verdict, way: Way, map: MapLike
) -> tuple[list[Job], TrackSet, dict[Pair, Answer], Break] | None:
    """The pairs of video v done anew with its clock mended, and again while what is left of the jump is measured.

    None where that adds nothing to the evidence, or where the clock still breaks in as many pairs. That is asked of
    the last jump alone: the first one, measured by matches of two offsets, may be a frame off.
    """
    own = [a for a in verdict.answers if v in a.pair]
    before, doubts = _evidence(own), _broken(own)
    best = None
    for _ in range(MEASURED):
        better = mended(tracks[v], (found,))
        sets = [better if k == v else t for k, t in enumerate(tracks)]
        again = [dataclasses.replace(j, a=sets[j.pair[0]], b=sets[j.pair[1]]) for j in jobs]
        fresh = way.anew([j for j in again if v in j.pair], map)
        if _evidence(fresh.values()) <= before:
            break
        if _broken(fresh.values()) < doubts:
            best = again, better, fresh, found
        left = remeasured_jump(fresh, sets, v, found)
        if best is not None and found.sigma == 0:  # the video itself shows how many frames it stood still
            best = (*best[:3], confirmed(found, left))
            break
        if left is None:
            break
        frame = 1 / nominal_fps(tracks[v])
        if left.still > 0 > left.jump:
            left = lasting(found.at - found.still, -left.jump, left.sigma, frame)
        else:
            left = jumping(left.at, left.jump, left.sigma, frame)
        if best is not None and abs(left.jump - found.jump) < SETTLED:
            break
        found = left
    return best


def confirmed(found: Break, left: Break | None) -> Break:
    """A pause that was counted, and what the pairs measure after it was mended: where they contradict, by how much is
    its sigma. A performer who rests right beside a pause makes it look longer.
    """
    if left is None or abs(left.jump - found.jump) <= SIGMAS * left.sigma:
        return found
    return dataclasses.replace(found, sigma=float(np.hypot(left.sigma, left.jump - found.jump)))


def remeasured_jump(fresh: Mapping[Pair, Answer], tracks: Sequence[TrackSet], v: int, found: Break) -> Break | None:
    """The break with what all pairs say is left of its jump; None where none can."""
    told, sigmas = [], []
    for (i, j), answer in fresh.items():
        if not np.isfinite(answer.refined.offset) or not answer.sound:
            continue
        clock = Clock(answer.refined.offset, answer.refined.rate)
        shown = found.at + found.jump
        left, sigma = remeasured(answer, tracks[i], tracks[j], shown if v == i else clock.world(shown))
        if np.isfinite(sigma):
            told.append(left if v == j else -left)
            sigmas.append(sigma)
    if not told:
        return None
    sigma = float(np.median(sigmas)) / np.sqrt(len(sigmas))
    return dataclasses.replace(found, jump=found.jump + float(np.median(told)), sigma=sigma)


def _evidence(answers: Iterable[Answer]) -> float:
    return sum(a.scanned.stats.get("evidence", 0.0) for a in answers)


def _broken(answers: Iterable[Answer]) -> int:
    return sum(Status.BROKEN_CLOCK in a.refined.flags for a in answers)


def on_own_clock(found: Break, earlier: Sequence[Break]) -> Break:
    """A break that was found on a mended clock, told in the video's own time."""
    late = sum(b.jump for b in earlier if b.at + b.jump <= found.at)
    return dataclasses.replace(found, at=found.at - late)
