"""In what part of an overlap a step of a clock would be heard.

Near an end a clock may step, by frames that were lost or that stood still, and leave too little behind to tell: under
heavy noise no method can know of it. How near that is can be known. Where no other offset suits the last moments nearly
as well as the answer does, a clock that had stepped there would show another offset that suits them as much better,
which :func:`otsync.sync.parts.broken_part` hears.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..compute.threads import MapLike
from ..types import TrackSet
from .mend.breaks import Seen
from .parts import Matched, from_ends, others
from .verdict import Answer

TELLS = 0.1
"""By how much worse any other offset must suit an end that tells a step, in the units of
:data:`otsync.sync.parts.SUITS_BETTER`. Of 420 worlds that lose 2 to 8 frames .2 to 1.6 s from an end (mid to brutal,
seeds 95000 to 96429), 33 answers were trusted and more than a frame off behind the loss, by up to 7.8: each where no
step would be heard, by this limit. Of eight mid worlds without a step (95200 to 95207) the ends tell by their last
.27 s."""

LENGTHS = tuple(n / 30 for n in (8, 10, 12, 16, 20, 24, 30, 36))
"""Seconds of an end that are asked, the shortest first."""

BY_MOTION = 1.5
"""Seconds of a part that windows of motion tell (:mod:`otsync.refine.seconds`, :mod:`otsync.align.breaks`) where places
do not. Of the same worlds no answer was trusted and wrong behind a step that left more than 1.05 s."""


def with_steps_heard(answers: Sequence[Answer], tracks: Sequence[TrackSet], map: MapLike) -> tuple[Answer, ...]:
    """The answers, those that are sure with two statistics more: from when (``heard_begin``) to when (``heard_end``) on
    a's clock a step would be heard, s; nan: nowhere.

    Args:
        tracks: of every video, on the clocks of the answers. map: as in :func:`otsync.synchronize`.
    """
    asked = [(a, tracks[a.pair[0]], tracks[a.pair[1]]) for a in answers if a.finite and a.refined.status.ok]
    asked = [(answer, a, b) for answer, a, b in asked if a.xyz is not None and b.xyz is not None]
    told = {job[0].pair: heard for job, heard in zip(asked, map(_heard_of, asked), strict=True)}
    return tuple(_telling(a, *told[a.pair]) if a.pair in told else a for a in answers)


def _telling(answer: Answer, begin: float, end: float) -> Answer:
    stats = answer.refined.stats | {"heard_begin": begin, "heard_end": end}
    return replace(answer, refined=replace(answer.refined, stats=stats))


def _heard_of(job: tuple[Answer, TrackSet, TrackSet]) -> tuple[float, float]:
    return heard(*job)


def heard(answer: Answer, a: TrackSet, b: TrackSet) -> tuple[float, float]:
    """From when to when on a's clock a step of an answer's clock would be heard, s; nan twice: nowhere."""
    seen = Seen.by(answer, a, b)[0]
    first, last = (unheard(matched) for matched in from_ends(answer, a, b))
    begin, end = seen.begin + first, seen.end - last
    return (begin, end) if begin < end else (float("nan"), float("nan"))


def unheard(matched: Matched) -> float:
    """Seconds of an end in which a step would not be heard."""
    for length in LENGTHS:
        told = list(others(matched, 0.0, length))
        both = {other.late > 0 for other in told} == {True, False}
        if both and all(other.gain < -TELLS for other in told):
            return length
    return BY_MOTION
