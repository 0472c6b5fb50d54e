"""How breaks of clocks are looked for: by motion, by windows, by pieces of videos that look cut."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

from ...clocks.cuts import Steps, calm
from ...compute.threads import MapLike
from ...refine.verb import refine
from ...types import Clock, Status, TrackSet
from ..graph import Pair
from ..pairs import Job, run, without_answered_doubt
from ..rematching import at_each, evidence_of, winner
from ..verdict import NOTHING_COMMON, Answer
from .breaks import AROUND
from .places import NONE, parts_by_place
from .windows import EVERY, NEAR, Split, Windows, matches_of_parts

log = logging.getLogger("otsync")


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
        self.told = {pair: list(readings) for pair, readings in told.items()}
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


def readings_of(task: tuple[Job, list[Answer], Answer]) -> list[Answer]:
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
    return by_windows(windows, best, job, *(a.scanned.stats for a in heard))


def _at_time(task: tuple[Job, float]) -> list[Answer]:
    """A pair matched at a time, and what windows tell then: readings, best first."""
    job, offset = task
    (once,) = at_each(job, (offset,))
    answer = run(once)
    if not answer.finite:
        return [answer.doubted()]
    return by_windows(Windows.of(job, Clock(answer.refined.offset, answer.refined.rate)), answer, job)


def by_windows(windows: Windows, answer: Answer, job: Job, *scans: Mapping[str, float]) -> list[Answer]:
    """The answer, freed of the scan's doubt whether its clock breaks where no window has it; else with the doubt, and
    with the parts that they tell of, as often as there are readings.

    Where motion comes back, the windows behind a gap suit two offsets: they lift no doubt that any of the ``scans``
    (their stats) has for this reason. A clock that was mended already is asked by its windows alone.
    """
    if windows.steady and not any(stats.get("returns") for stats in scans):
        return [freed(answer, job)]
    if windows.steady:  # the doubt stays, and why: witnesses ask about it
        stats = dict(answer.scanned.stats) | {"returns": 1.0}
        return [dataclasses.replace(answer, scanned=dataclasses.replace(answer.scanned, stats=stats)).doubted()]
    return [_with_split(windows, split, answer, job) for split in windows.breaks()] or [answer.doubted()]


def _with_split(windows: Windows, split: Split, answer: Answer, job: Job) -> Answer:
    parts = windows.parts(split)
    scanned = dataclasses.replace(answer.scanned, parts=parts)
    matches = matches_of_parts(job, parts, answer.refined.rate)
    return dataclasses.replace(answer, matches=matches, scanned=scanned).doubted()


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
