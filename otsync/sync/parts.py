"""Parts of overlaps in which an answer that says "ok" does not hold.

A clock that breaks near an end leaves too little for the search by windows; so does one that breaks where the matches
of one side are few. Two things tell of it. Another offset may suit the last moments better. And positions that agree
everywhere else may not agree there, though no other offset can be seen to suit them: the tracks were matched at the
answer, so that those which the other offset needs are not among the matches.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..clocks.common import readable, strongest
from ..types import Clock, TrackSet
from .alike import LEAST_BESIDE, LIMIT, MARGIN, Raw, Usual
from .graph import Pair
from .mend.breaks import OFF, OTHERS, Seen
from .verdict import Answer

LENGTHS = (10 / 30, 16 / 30)
"""Seconds of an end that another offset may suit better; of the shorter one it is asked whether positions agree."""

BESIDE = 1.0
"""Seconds beside a window that tell the constant differences of its matches."""

SUITS_BETTER, SUITS = 0.2, 0.2
"""How much better another offset may suit an end, where it suits it that well. Of 270 trusted answers to worlds without
a break (mid to brutal, few tracks, like people, flocks, clean ones; seeds 500-560) none has more than .16. Of 130 ends
of real pairs, basketball, nine have .2 to .76: people turn, so that matched points move apart; there nothing suits, .10
at most. Behind lost frames the true offset suits as usual, .3 to .5."""

LITTLE, SURE, SURER, WITHIN = 0.05, 1.5, 1.0, 12
"""The least gain of another offset that is a doubt where more than so many standard errors of the matches tell of it,
and so many more than of any offset in the windows within, of which so many are asked. Where two to five frames were
lost .3 to .9 s from an end, little is left that tells: of 70 worlds (clean to hard, seeds 88400 to 88469) seven were
trusted and wrong. Four are doubted now, three that lost two frames are not. Of 90 sound worlds (88020 to 88024 and
88040 to 88044; nine classes) one is doubted by it."""

SHORT, AS_WELL = 2.0, 0.0
"""Seconds of overlap below which an end must know: little else of it tells, so another offset that suits the end as
well as the answer is a doubt, and so is an end at which no other can be asked for. Of 1.75 s under hard noise two were
trusted with half a second left behind a freeze of eight frames (seeds 91003 and 91016; gains of .08 and .20), and one
with few tracks behind ten lost frames (91044). Sound ones (91010 to 91029) have 0 at most in 20 of 20 under mid noise,
in 12 of 15 under hard."""

AGREES, USUALLY = 0.35, 0.1
"""Share of the samples that agree at an end, over this quantile of the shares within the clip: .57 at least in the same
270, .49 in all but one of 57 real pairs. Of 17 answers that were wrong behind a break .2 to 1.2 s from an end
and trusted without this module (seeds 500-549: ten frames lost or twelve frozen), the limits together catch 11."""

HOLDS, FEWER, TELLING = 0.5, 0.75, 0.7
"""Share of the samples that agree in one of any two windows in a row, over the median of the clip: less, and the answer
does not hold there; nor below the second one where another offset suits one of the two windows clearly better. The
median must be that high: of people who turn, half of the samples agree (.38 to .54 in pairs of basketball), more and
fewer by turns, which tells nothing. Of 325 right answers that are trusted (mid to brutal, few tracks, like people,
flocks, mended breaks; seeds 500-549) the least has .65, and of those below .75 none a gain above .16. Answers that were
wrong and trusted before have 0 to .49: ten lost frames (seed 34002), exchanged halves (507, 34009), a film that is
played backwards (34006); one has .66 and a gain of .25 (35009)."""

WITNESSES, ENOUGH = 5, 5
"""Matches that must be seen at both offsets, and frames that tell the constant differences."""

REACH = 20.0
"""Seconds from an end that are looked at."""

WINDOWS = 40
"""Windows within the clip that tell the usual agreement, at most."""


@dataclass(frozen=True, eq=False)
class Matched:
    """Matched tracks of a pair at its answer, from one end of the overlap inwards.

    Args:
        t: (S,) moments on a's clock. away: (S,) seconds from the end.
    """

    a: Raw
    b: Raw
    clock: Clock
    t: Float[np.ndarray, " S"]
    away: Float[np.ndarray, " S"]

    def window(self, begin: float, length: float) -> tuple[np.ndarray, Usual] | None:
        """Moments of a window that begins ``begin`` s from the end, and what is usual beside it, further inwards; None
        where either has too few frames.
        """
        inner = begin + length + MARGIN
        asked = self.t[(self.away >= begin) & (self.away < begin + length)]
        beside = self.t[(self.away >= inner) & (self.away < inner + BESIDE)]
        if len(asked) < LEAST_BESIDE or len(beside) < ENOUGH:
            return None
        return asked, Usual.of(self._apart(beside), np.ones(len(beside), bool))

    def levels(self, asked: np.ndarray, usual: Usual, late: float = 0.0) -> Float[np.ndarray, "M A"]:
        """How well every match agrees at the moments ``asked`` and an offset that is larger by ``late`` s."""
        bent = self.a.bent(asked) + self.b.bent(self.clock.own(asked - late))
        return usual.levels(self._apart(asked, late), bent)

    def _apart(self, t: np.ndarray, late: float = 0.0) -> Float[np.ndarray, "M A 3"]:
        return self.a.at(t) - self.b.at(self.clock.own(t - late))


def from_ends(answer: Answer, a: TrackSet, b: TrackSet) -> tuple[Matched, Matched]:
    """The matched tracks of a pair from the beginning of its overlap, and from its end, up to :data:`REACH` s."""
    pairs = strongest(answer.matches, readable(LIMIT, a, b)).pairs
    raw = Raw.of(a, pairs[:, 0]), Raw.of(b, pairs[:, 1])
    clock = Clock(answer.refined.offset, answer.refined.rate)
    seen = Seen.by(answer, a, b)[0]
    known = raw[1].sampled(clock.own(a.times))
    sides = []
    for away in (a.times - seen.begin, seen.end - a.times):
        near = (away >= 0) & (away < min(REACH, seen.end - seen.begin)) & known
        sides.append(Matched(*raw, clock, a.times[near], away[near]))
    return sides[0], sides[1]


def broken_part(answer: Answer, a: TrackSet, b: TrackSet) -> tuple[float, float] | None:
    """The part of a pair's overlap in which its answer does not hold: from when to when on a's clock; None: none."""
    seen = Seen.by(answer, a, b)[0]
    for late, matched in zip((False, True), from_ends(answer, a, b), strict=True):
        short = seen.end - seen.begin < SHORT
        if suits_another(matched, AS_WELL if short else SUITS_BETTER) or (short and tells_nothing(matched)):
            begin, length = 0.0, LENGTHS[-1]
        elif (where := does_not_agree(matched)) is not None:
            begin, length = where, LENGTHS[-1]
        else:
            continue
        end = begin + length
        return (seen.end - end, seen.end - begin) if late else (seen.begin + begin, seen.begin + end)
    return None


def suits_another(matched: Matched, limit: float) -> bool:
    """Whether another offset suits the end better by more than ``limit``, by the samples that are seen at both; or by
    less, but as surely as nowhere within.
    """
    for length in LENGTHS:
        better = [o for o in others(matched, 0.0, length) if o.suits > SUITS]
        if any(o.gain > limit for o in better):
            return True
        surest = max((o.sure for o in better if o.gain > LITTLE), default=0.0)
        if surest > SURE and surest > SURER + _surest_within(matched, length):
            return True
    return False


def _surest_within(matched: Matched, length: float) -> float:
    """Of windows behind the end, the most standard errors that a gain of another offset has; inf where none tells."""
    last = float(matched.away.max(initial=0.0)) - length - MARGIN - BESIDE
    begins = np.arange(2 * length, last, max(length, last / WITHIN))
    told = [max((o.sure for o in others(matched, begin, length)), default=np.nan) for begin in begins]
    return float(np.nanmax(told)) if np.isfinite(told).any() else np.inf


class Other(NamedTuple):
    """Another offset in a window, larger by ``late`` s: how much better it suits it, how well, and how many standard
    errors its gain has.
    """

    gain: float
    suits: float
    sure: float
    late: float


def others(matched: Matched, begin: float, length: float) -> Iterator[Other]:
    """Every other offset that enough matches are seen at in a window."""
    if (window := matched.window(begin, length)) is None:
        return
    here = matched.levels(*window)
    steps = np.arange(-round(OTHERS * 30), round(OTHERS * 30) + 1) / 30
    for step in steps[np.abs(steps) > OFF]:
        there = matched.levels(*window, step)
        gain = there - here
        witnesses = np.isfinite(gain).sum(0)
        told = witnesses >= WITNESSES
        if told.sum() >= LEAST_BESIDE:
            better = float((np.nansum(gain[:, told], 0) / witnesses[told]).mean())
            yield Other(better, float(np.nanmean(there[:, told])), _sure(gain), float(step))


def _sure(gain: Float[np.ndarray, "M A"]) -> float:
    """How many standard errors a gain is above none, where each match that is seen long enough is a witness."""
    each = gain[np.isfinite(gain).sum(1) >= LEAST_BESIDE]
    if len(each) < WITNESSES:
        return 0.0
    mean = np.nanmean(each, 1)
    return float(mean.mean() / max(mean.std(ddof=1) / np.sqrt(len(mean)), 1e-12))


def tells_nothing(matched: Matched) -> bool:
    """Whether at the end too little is seen to ask for any other offset, though there are frames enough."""
    asked = [length for length in LENGTHS if matched.window(0.0, length) is not None]
    return bool(asked) and all(next(others(matched, 0.0, length), None) is None for length in asked)


def does_not_agree(matched: Matched) -> float | None:
    """Where far fewer positions agree than usually do within the clip, each predicted from beside it.

    Returns:
        How many seconds from the end: 0 at the end itself, more for two windows in a row within; None: nowhere.
    """
    length = LENGTHS[0]
    last = float(matched.away.max(initial=0.0)) - length - MARGIN - BESIDE
    if last < length:
        return None
    begins = np.arange(0.0, last, max(length / 2, last / WINDOWS))
    shares = np.array([_share(matched, begin, length) for begin in begins])
    told = shares[np.isfinite(shares)]
    if len(told) == 0:
        return None
    if shares[0] < AGREES * float(np.quantile(told, USUALLY)):
        return 0.0
    usual = float(np.median(told))
    if usual <= TELLING:
        return None
    lower = np.maximum(shares[:-1], shares[1:])  # nan where one is not known
    for k in np.flatnonzero(lower < FEWER * usual):
        gains = (o.gain for begin in begins[k : k + 2] for o in others(matched, begin, length))
        if lower[k] < HOLDS * usual or max(gains, default=0.0) > SUITS_BETTER:
            return float(begins[k])
    return None


def _share(matched: Matched, begin: float, length: float) -> float:
    """Of the samples in a window, the share that agrees; nan where fewer than two a frame are seen."""
    if (window := matched.window(begin, length)) is None:
        return np.nan
    level = matched.levels(*window)
    seen = int(np.isfinite(level).sum())
    return float((level > 0).sum() / seen) if seen >= 2 * len(window[0]) else np.nan


def unvouched(
    broken: Mapping[Pair, tuple[float, float]], answers: Sequence[Answer], tracks: Sequence[TrackSet]
) -> set[Pair]:
    """The pairs that parts which do not hold make doubtful.

    They are those pairs themselves, and all of a video for whose clock there no sound pair vouches that sees it.

    Args:
        broken: of pairs, the parts in which they do not hold, on the first video's clock; see :func:`broken_part`.
    """
    sound = [a for a in answers if a.pair not in broken and a.refined.status.ok and a.finite]
    sees = [seen for a in sound for seen in Seen.by(a, tracks[a.pair[0]], tracks[a.pair[1]])]
    videos = set()
    for answer in answers:
        if answer.pair not in broken:
            continue
        begin, end = broken[answer.pair]
        clock = Clock(answer.refined.offset, answer.refined.rate)
        for video, low, high in zip(answer.pair, (begin, clock.own(begin)), (end, clock.own(end)), strict=True):
            if not any(s.video == video and s.begin <= low and s.end >= high for s in sees):
                videos.add(video)
    return set(broken) | {a.pair for a in answers if videos & set(a.pair)}
