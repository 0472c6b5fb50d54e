"""Breaks of clocks in a set of videos: which video froze, lost frames or was cut, where, and by how much.

A pair says that its offset jumps, not whose clock it is. A video that stands still where the other moves is the one
that froze; among three and more the video that most pairs name is the one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...clocks.common import readable, strongest
from ...clocks.cuts import Steps
from ...clocks.lengths import jumping, lasting
from ...clocks.splines import TrackSplines
from ...clocks.stillness import AROUND, pause, pause_of_pictures, picture_frames, stood_still
from ...refine.gauss_newton import Fit, fit_clock
from ...refine.splines import SplineRefine
from ...types import Break, Clock, TrackSet, mended_frames
from ..alike import LEAST_BESIDE, LIMIT, MARGIN, Raw, Usual
from ..verdict import Answer
from .places import Part, measured

WINDOW = 14 / 30
"""Half window, s, of the detrending in the fits of the parts."""

SAME_MOMENT, SAME_JUMP = 0.5, 0.1
"""Seconds within which two pairs tell of the same break."""

MOVING, RESTING = 0.6, 0.4
"""Votes of a pair whose break could be either's: frames are lost more often than videos go back in time."""

SEARCH = 2.0
"""Seconds around a break's coarse place in which it is looked for, at most, beside :data:`AROUND`."""

USUAL = 3.0
"""Seconds beyond these in which is read how far apart matched tracks usually are."""

ENOUGH = 15
"""Frames that tell where a match's own constant difference lies."""

BACK = 0.5
"""Seconds by which a video must go back to be told from one whose partner lost frames."""

HALF = 0.5
"""Share of the way from how well frames suit their own offset to how well others suit the wrong one, from which on they
have no partner. In replays of .6 to 1.5 s it is .1 to .4, beside 15 frames to a second that are missing .7 to 1.1."""

LONG = 1.5
"""Seconds that may be missing from which on the frames beside a break that suit are used to measure it; of less they
are left out, since a video that stands still for so long half suits both offsets."""

SIGMAS = 3.0
"""By which a pause that is counted may differ from what a pair measures, or by a frame and a half."""

BESIDE, OFF, OTHERS = 0.45, 1.5 / 30, 10 / 30
"""Seconds on either side of a mended break in which no offset that differs by more than :data:`OFF` s, of those within
:data:`OTHERS`, may suit the positions better than the answer. Beside freezes, lost frames and cuts one within a frame
of the answer is the best (46 worlds of mid noise); beside a slow motion that is taken for lost frames one that is 2 to
7 frames off (10 of 10)."""

STAIRS = 5.0
"""Seconds on either side of a break in which a video shows how often its file repeats a picture."""

SHORT = 1.5
"""Seconds below which what its matches differ by does not cover the error of a part: 48 and 79 % of .65 s of mid worlds
lie within one and two such sigmas, 57 and 87 % of .8 s, 70 and 93 % of 1 s. With what the seconds of the other part
differ by it is 71 and 93 % of .65 s and 63 and 97 % of .8 s (all on 600 to 629, which it was chosen on). On 640 to 655
it is 67 and 86, and 56 and 84 %: still too few; and of 1 s, even with it, 56 and 84 %. A part of 1.2 s was off by .9
frame at a sigma of .15 (80469), so that a jump was rounded to the wrong frame."""

UNTOLD = 2.0
"""Times the sigma of a short part beyond which there are no two seconds that could tell how far one is off."""

MOST = 4
"""Breaks that are mended, at most."""


@dataclass(frozen=True)
class Suspect:
    """One reading of a pair's jump: this video's clock broke. votes: how much the pair believes it."""

    video: int
    found: Break
    votes: float


def mended(tracks: TrackSet, breaks: Sequence[Break]) -> TrackSet:
    """The tracks on the clock that the video had before its first break; frames that tell no time are left out."""
    if not breaks:
        return tracks
    keep, shown = mended_frames(tracks.times, breaks)
    fields = ("xyz", "visible", "uv", "sigma")
    taken = {f: v[:, keep] for f in fields if (v := getattr(tracks, f)) is not None}
    camera = tracks.camera
    if camera is not None and camera.w2c.ndim == 3:
        camera = replace(camera, w2c=camera.w2c[keep])
    return replace(tracks, **taken, timestamps=shown, fps=None, camera=camera)


def suspects(answer: Answer, a: TrackSet, b: TrackSet, fps: Sequence[float], within: float = AROUND) -> list[Suspect]:
    """Both readings of every jump of a pair's offset, located to a frame and measured below it.

    Args:
        within: s by which the offsets of its parts may be off.
    """
    matches = strongest(answer.matches, readable(LIMIT, a, b))
    curves = SplineRefine().splines(a, b, matches)
    raw = Raw.of(a, matches.pairs[:, 0]), Raw.of(b, matches.pairs[:, 1])
    steps = Steps.of(a), Steps.of(b)
    found = []
    parts = answer.scanned.parts
    for k in range(len(parts) - 1):
        begin = parts[k][0] if k else -math.inf
        end = parts[k + 2][0] if k + 2 < len(parts) else math.inf
        found += _readings(answer, curves, raw, steps, parts[k][1], parts[k + 1], (begin, end), fps, within)
    return found


def _readings(
    answer: Answer,
    curves: tuple[TrackSplines, TrackSplines],
    raw: tuple[Raw, Raw],
    steps: tuple[Steps, Steps],
    before: float,
    after: np.ndarray,
    limits: tuple[float, float],
    fps: Sequence[float],
    within: float,
) -> list[Suspect]:
    a, b = curves
    when, later = float(after[0]), float(after[1])
    low, high = limits
    first, second = float(before), later
    gap = 0.0
    sigmas = [math.nan, math.nan]
    stairs = _stairs(raw[0].around(when, STAIRS), raw[1].around(when - first, STAIRS))
    for margin in (2 * AROUND / 3, MARGIN):
        sides = Part(low, when - margin, first), Part(when + gap + margin, high, second)
        (first, second), sigmas = _offsets(a, b, sides, stairs, within)
        when, gap = _moment(*raw, first, second, when, limits)
    jump, sigma = second - first, math.hypot(*sigmas)
    at_b = when - first
    if jump > 0:  # a's frames from `when` on for `jump` s have no partner: a stood still, or b lost them
        (froze, start), (lost, gone) = (0, when), (1, at_b)
    else:
        (froze, start), (lost, gone) = (1, at_b), (0, when)
    length, frame = abs(jump), 1 / fps[answer.pair[froze]]
    shown = raw[froze]
    stands = stood_still(shown.times, shown.x, start, length)
    back = goes_back(raw, first, second, when, limits) if stands is None and length >= BACK else None
    if back is not None:
        k, moment = back
        cut, v = steps[k].cut_near(moment, AROUND), answer.pair[k]
        return [Suspect(v, jumping(moment if cut is None else cut, -length, sigma, 1 / fps[v]), 1.0)]
    cut, back_at = steps[lost].cut_near(gone, AROUND), steps[froze].cut_near(start, AROUND)
    if stands is not None:
        repeats = _counted(shown, stands, length, sigma, frame) or lasting(stands, length, sigma, frame)
    else:
        repeats = jumping(start if back_at is None else back_at, -length, sigma, frame)
    misses = jumping(gone if cut is None else cut, length, sigma, 1 / fps[answer.pair[lost]])
    # what one video shows by itself decides
    votes = RESTING, MOVING
    if (cut is None) != (stands is None and back_at is None):
        votes = (1.0, 0.0) if cut is None else (0.0, 1.0)
    return [
        Suspect(answer.pair[froze], repeats, votes[0]),
        Suspect(answer.pair[lost], misses, votes[1]),
    ]


def goes_back(
    raw: tuple[Raw, Raw], first: float, second: float, when: float, limits: tuple[float, float]
) -> tuple[int, float] | None:
    """Which of the two videos, 0 or 1, goes back to what it has shown or not yet shown, and when, on its own clock:
    every frame of it has a partner at one of the two offsets. None: neither does.

    Args:
        when, limits: as of :func:`_moment`, on the first one's clock.
    """
    a, b = raw
    low, high = limits
    if second < first:
        near = _turn(a, b, first, second)[1]
        moments = _moments(b, a, -first, -second, near, (low - first, high - second))
        return None if moments.whole is None else (1, moments.whole)
    moments = _moments(a, b, first, second, when, limits)
    if moments.whole is None:
        return None
    # a shows anew what b shows once; or b's parts are in the other order
    (turned, turn), (ordered, _) = _turn(a, b, second, first), _turn(a, b, first, second)
    return (1, turn) if turned > ordered else (0, moments.whole)


def _counted(shown: Raw, start: float, length: float, sigma: float, frame: float) -> Break | None:
    """A pause that the video itself shows, of about the length that the pair measured: its frames are counted."""
    found = pause(shown.times, shown.x, start, length)
    if found is not None:
        end, frames = found[1], round((found[1] - found[0]) / frame)
    else:
        pictures = pause_of_pictures(shown.times, shown.x, start, length)
        if pictures is None:
            return None
        end, frames = pictures
    lasts = frames * frame
    near = max(1.5 * frame, SIGMAS * sigma if math.isfinite(sigma) else 0.0)
    return Break(end, -lasts, lasts, 0.0) if abs(lasts - length) <= near else None


def _stairs(a: Raw, b: Raw) -> float:
    """Variance, s², of the offset of a second of two videos whose files repeat pictures, by that alone: a picture that
    lasts p frames is late by any of 0 to p - 1, and only so many pictures tell the time.
    """
    total = 0.0
    for raw in (a, b):
        if len(raw.times) > 1:
            frame, lasts = float(np.median(np.diff(raw.times))), picture_frames(raw.x)
            total += (lasts**2 - 1) / 12 * frame**2 * lasts * frame
    return total


def _offsets(
    a: TrackSplines, b: TrackSplines, sides: tuple[Part, Part], stairs: float, within: float = AROUND
) -> tuple[list[float], list[float]]:
    """Offsets of two parts beside a break, and their sigmas, s; nan where a part cannot tell: its offset stays.

    Each by the motion within it; where that is too little, by the places of the matches in the other part.

    Args:
        stairs: see :func:`_stairs`.
    """
    fits = [fit_clock(a.within(p.begin, p.end), b, Clock(p.offset), WINDOW) for p in sides]
    near = [f is not None and abs(f.clock.offset - p.offset) < within for f, p in zip(fits, sides, strict=True)]
    found = [f.clock.offset if f is not None and ok else p.offset for f, p, ok in zip(fits, sides, near, strict=True)]
    sigma = [sigma_of_part(f, g, _length(a, b, p)) for f, g, p in zip(fits, fits[::-1], sides, strict=True)]
    for k in (0, 1):
        if fits[k] is None and near[1 - k]:
            found[k], sigma[k] = measured(a, b, replace(sides[1 - k], offset=found[1 - k]), sides[k])
    lengths = [max(_length(a, b, p), a.frame) for p in sides]
    return found, [math.sqrt(s**2 + stairs / length) for s, length in zip(sigma, lengths, strict=True)]


def sigma_of_part(fit: Fit | None, other: Fit | None, length: float) -> float:
    """One sigma, s, of the offset of a part that is ``length`` s long. In little more than a second all matches err
    alike, and do not show it: there the seconds of the part beyond the break tell how far one is off that holds so much
    motion.
    """
    if fit is None:
        return math.nan
    own = math.sqrt(float(fit.covariance[0, 0]))
    if other is None or length >= SHORT:
        return own
    off = other.off_by(fit.information)
    return math.hypot(own, off) if off > 0 else UNTOLD * own


def _length(a: TrackSplines, b: TrackSplines, part: Part) -> float:
    """Seconds of a part that both videos show."""
    first, last = (float(t) + part.offset for t in b.times[[0, -1]])
    return min(part.end, float(a.times[-1]), last) - max(part.begin, float(a.times[0]), first)


@dataclass(frozen=True)
class _Moments:
    """Where a break lies on one clock, s.

    Args:
        when, gap: the first offset suits up to ``when``, the second one from ``gap`` later on.
        whole: where the first offset ends and the second one begins at once; None where frames beside it suit neither.
    """

    when: float
    gap: float
    whole: float | None


def _moments(a: Raw, b: Raw, first: float, second: float, near: float, limits: tuple[float, float]) -> _Moments:
    """Where the break near ``near`` lies on a's clock, within ``limits``."""
    reach = AROUND + min(abs(second - first), SEARCH)
    wide = reach + USUAL
    t = a.times[(a.times > max(limits[0], near - wide)) & (a.times < min(limits[1], near + wide))]
    asked = np.abs(t - near) < reach
    gap = max(second - first, 0.0)
    if asked.sum() < 3:
        return _Moments(near, gap, None)
    frame = float(np.median(np.diff(a.times)))
    # the coarse place may lie at either end of a gap
    sides = [t < near - gap - MARGIN, t > near + gap + MARGIN]
    for k, beside in enumerate((t < near - MARGIN, t > near + MARGIN)):
        if sides[k].sum() < ENOUGH:
            sides[k] = beside
    one, two = (_suits(a, b, o, t, inside)[asked] for o, inside in zip((first, second), sides, strict=True))
    t = t[asked]
    before = np.concatenate([[0.0], np.cumsum(one)])
    behind = np.concatenate([np.cumsum(two[::-1])[::-1], [0.0]])

    def best(missing: int) -> tuple[float, int]:
        """The largest sum where so many frames belong to neither part, and which is the first of them."""
        total = before + behind[np.minimum(np.arange(len(t) + 1) + missing, len(t))]
        k = int(np.argmax(total))
        return float(total[k]), k

    def moment(k: int) -> float:
        return float(t[k] if k < len(t) else t[-1] + frame)

    missing = round(gap / frame)
    (without, when), (whole, at) = best(missing), best(0)
    missing = min(missing, len(t) - when)
    wrong = np.concatenate([one[at:], two[:at]])
    if not missing or not len(wrong):
        return _Moments(moment(when), gap, None)
    right = without / max(len(t) - missing, 1)
    # frames that have no partner suit no better than others do at the wrong offset
    share = (right - (whole - without) / missing) / max(right - float(wrong.mean()), 1e-9)
    return _Moments(moment(when), gap, moment(at) if share < HALF else None)


def _moment(
    a: Raw, b: Raw, first: float, second: float, near: float, limits: tuple[float, float]
) -> tuple[float, float]:
    """The time of a's clock up to which the first offset suits the positions better, and how many seconds later the
    second one begins to: at once where a gap of :data:`LONG` would leave out frames that suit.
    """
    found = _moments(a, b, first, second, near, limits)
    return (found.whole, 0.0) if found.whole is not None and found.gap >= LONG else (found.when, found.gap)


def _turn(a: Raw, b: Raw, first: float, second: float) -> tuple[float, float]:
    """How well frames of b suit two offsets one after the other, and the time of its own clock from which on the second
    one holds.

    Frames that neither offset brings into a's clip count for neither.
    """
    t = b.times
    scores = [_suits(b, a, -offset, t, np.ones(len(t), bool)) for offset in (first, second)]
    one = np.concatenate([[0.0], np.cumsum(scores[0])])
    two = np.concatenate([np.cumsum(scores[1][::-1])[::-1], [0.0]])
    total = one + two
    best = int(np.argmax(total))
    return float(total[best]), float(t[best] if best < len(t) else t[-1] + np.median(np.diff(t)))


def _suits(a: Raw, b: Raw, offset: float, t: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(S,) how well positions agree at a's times ``t`` and an offset, in (-inf, 1]: 0 is undecided, or nothing seen.

    Every match has a constant difference of its own, its median ``inside`` (S,) the part where the offset holds.
    """
    return _agreement(a.at(t) - b.at(t - offset), inside)


def _agreement(apart: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(S,) how well positions agree, from the differences (M,S,3) of matched tracks: see :func:`_suits`."""
    level = Usual.of(apart, inside).levels(apart)
    return np.asarray(np.nansum(level, 0) / np.maximum(np.isfinite(level).sum(0), 1))


@dataclass(frozen=True)
class Seen:
    """What one pair that answers without any doubt sees of a video: from ``begin`` to ``end`` of its own clock, s."""

    video: int
    begin: float
    end: float

    @classmethod
    def by(cls, answer: Answer, a: TrackSet, b: TrackSet) -> tuple[Seen, Seen]:
        """Of both videos of a pair."""
        clock = Clock(answer.refined.offset, answer.refined.rate)
        begin, end = (clock.world(float(t)) for t in b.times[[0, -1]])
        begin, end = max(begin, float(a.times[0])), min(end, float(a.times[-1]))
        i, j = answer.pair
        return cls(i, begin, end), cls(j, clock.own(begin), clock.own(end))

    def across(self, suspect: Suspect) -> bool:
        """Whether it is of the suspect's video and sees enough on both sides of its break to have seen that."""
        last = suspect.found.at + max(suspect.found.jump, 0.0)
        return self.video == suspect.video and self.begin <= suspect.found.at - AROUND and self.end >= last + AROUND


def culprit(found: Sequence[Suspect], sound: Sequence[Seen]) -> Suspect | None:
    """The reading with most votes from all pairs, its jump the median of theirs.

    Args:
        sound: what pairs that answer without any doubt see: each is a vote for the clock of its video, there.
    """
    best, most = None, 0.0
    for one in found:
        same = [
            s
            for s in found
            if s.video == one.video
            and abs(s.found.at - one.found.at) < SAME_MOMENT
            and abs(s.found.jump - one.found.jump) < SAME_JUMP
        ]
        votes = sum(s.votes for s in same) - sum(seen.across(one) for seen in sound)
        if votes > most + 1e-9:
            # a video that shows how long it stood still does so whichever pair asks: no measured length joins it
            told = [s.found for s in same if s.found.still > 0 and s.found.sigma == 0] or [s.found for s in same]
            middle = Break(
                float(np.median([b.at for b in told])),
                float(np.median([b.jump for b in told])),
                float(np.median([b.still for b in told])),
                float(np.median([b.sigma for b in told])) / math.sqrt(len(told)),
            )
            best, most = Suspect(one.video, middle, votes), votes
    return best


def remeasured(answer: Answer, a: TrackSet, b: TrackSet, moment: float) -> tuple[float, float]:
    """What is left of a jump after it was mended, s, and one sigma of it; ``moment``: of the break, on a's clock."""
    matches = strongest(answer.matches, readable(LIMIT, a, b))
    curves = SplineRefine().splines(a, b, matches)
    offset = answer.refined.offset
    raw = Raw.of(a, matches.pairs[:, 0]), Raw.of(b, matches.pairs[:, 1])
    stairs = _stairs(raw[0].around(moment, STAIRS), raw[1].around(moment - offset, STAIRS))
    for margin in (MARGIN, curves[0].frame):  # right up to the break where too little is left of a part
        sides = Part(-math.inf, moment - margin, offset), Part(moment + margin, math.inf, offset)
        (first, second), sigmas = _offsets(*curves, sides, stairs)
        sigma = math.hypot(*sigmas)
        if math.isfinite(sigma):
            break
    return second - first, sigma


def runs_on(answer: Answer, a: TrackSet, b: TrackSet, before: float, behind: float) -> bool:
    """Whether a mended clock has the answer's offset right beside the break: one that changed its speed has not.

    Args:
        before, behind: the moments on a's clock up to which the first part goes, and from which on the second one does.
    """
    pairs = strongest(answer.matches, readable(LIMIT, a, b)).pairs
    raw = Raw.of(a, pairs[:, 0]), Raw.of(b, pairs[:, 1])
    clock = Clock(answer.refined.offset, answer.refined.rate)
    first, last = clock.world(float(b.times[0])), clock.world(float(b.times[-1]))
    t = a.times[(a.times >= first) & (a.times <= last)]
    away = (t < before - BESIDE) | (t > behind + BESIDE)
    if away.sum() < ENOUGH:
        return True  # nothing tells how well the positions agree elsewhere
    steps = np.arange(-round(OTHERS * 30), round(OTHERS * 30) + 1) / 30
    for low, high in ((before - BESIDE, before - MARGIN), (behind + MARGIN, behind + BESIDE)):
        near = (t >= low) & (t <= high) & raw[1].sampled(clock.own(t))
        if near.sum() < LEAST_BESIDE:
            continue
        suits = [_level(*raw, clock, s, t[away], t[near]) for s in steps]
        if abs(steps[int(np.argmax(suits))]) > OFF:
            return False
    return True


def _level(a: Raw, b: Raw, clock: Clock, late: float, known: np.ndarray, asked: np.ndarray) -> float:
    """How well positions agree at the moments ``asked`` of a's clock and an offset that is larger by ``late`` s, where
    the differences at ``known`` moments, at the clock's own offset, are what is usual: see :func:`_suits`. Of those
    moments that both videos show there; -inf where these are too few.
    """
    times = np.concatenate([known, asked])
    at_b = np.concatenate([clock.own(known), clock.own(asked - late)])
    apart = a.at(times) - b.at(at_b)
    shown = (np.arange(len(times)) >= len(known)) & np.isfinite(apart[..., 0]).any(0)
    if shown.sum() < LEAST_BESIDE:
        return -math.inf
    return float(_agreement(apart, np.arange(len(times)) < len(known))[shown].mean())
