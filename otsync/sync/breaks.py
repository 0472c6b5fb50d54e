"""Breaks of clocks in a set of videos: which video froze, lost frames or was cut, where, and by how much.

A pair says that its offset jumps, not whose clock it is. A video that stands still where the other moves is the one
that froze; among three and more the video that most pairs name is the one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..clocks.common import readable, strongest
from ..clocks.splines import TrackSplines
from ..refine.gauss_newton import fit_clock
from ..refine.splines import SplineRefine
from ..types import Break, Clock, TrackSet, mended_frames
from .verdict import Answer

LIMIT = 200
"""Matches that a break is located by."""

WINDOW = 14 / 30
"""Half window, s, of the detrending in the fits of the parts."""

MARGIN = 3 / 30
"""Seconds beside a break that the fits of its parts leave out: curves are smoothed across it."""

STILL = 0.35
"""A video stands still where its speed is below this share of what it is around, and moves around."""

FASTEST = 0.75
"""Quantile of the speeds around from which on tracks are asked."""

AROUND = 20 / 30
"""Seconds on either side of a pause that tell the usual speed."""

SAME_MOMENT, SAME_JUMP = 0.5, 0.1
"""Seconds within which two pairs tell of the same break."""

MOVING, RESTING = 0.6, 0.4
"""Votes of a pair whose break could be either's: frames are lost more often than videos go back in time."""

SEARCH = 2.0
"""Seconds around a break's coarse place in which it is looked for, at most, beside :data:`AROUND`."""

ENOUGH, LEAST_BESIDE = 15, 4
"""Frames that tell where a match's own constant difference lies; and that are asked beside a break, at least."""

LEAST_KNOWN = 5
"""Samples that tell where a match's own constant difference lies, at least."""

BACK = 1.5
"""Seconds that a video must go back by to be taken for cut; less is lost frames."""

SNAP = 0.3
"""Frames within which the length of a freeze is a whole number of frames."""

BESIDE, OFF, OTHERS = 0.45, 1.5 / 30, 10 / 30
"""Seconds on either side of a mended break in which no offset that differs by more than :data:`OFF` s, of those within
:data:`OTHERS`, may suit the positions better than the answer. Beside freezes, lost frames and cuts one within a frame
of the answer is the best (46 worlds of mid noise); beside a slow motion that is taken for lost frames one that is 2 to
7 frames off (10 of 10)."""

MOST = 4
"""Breaks that are mended, at most."""

GAP = 2.5
"""Frames beyond which what lies between two samples is a gap in a clock, of which nothing is known."""


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


def suspects(answer: Answer, a: TrackSet, b: TrackSet, fps: Sequence[float]) -> list[Suspect]:
    """Both readings of every jump of a pair's offset, located to a frame and measured below it."""
    matches = strongest(answer.matches, readable(LIMIT, a, b))
    curves = SplineRefine().splines(a, b, matches)
    raw = Raw.of(a, matches.pairs[:, 0]), Raw.of(b, matches.pairs[:, 1])
    found = []
    parts = answer.scanned.parts
    for k in range(len(parts) - 1):
        begin = parts[k][0] if k else -math.inf
        end = parts[k + 2][0] if k + 2 < len(parts) else math.inf
        found += _readings(answer, curves, raw, parts[k][1], parts[k + 1], (begin, end), fps)
    return found


def _readings(
    answer: Answer,
    curves: tuple[TrackSplines, TrackSplines],
    raw: tuple[Raw, Raw],
    before: float,
    after: np.ndarray,
    limits: tuple[float, float],
    fps: Sequence[float],
) -> list[Suspect]:
    a, b = curves
    when, later = float(after[0]), float(after[1])
    low, high = limits
    first, second = float(before), later
    gap = 0.0
    one = two = None
    for margin in (2 * AROUND / 3, MARGIN):
        one = fit_clock(a.within(low, when - margin), b, Clock(first), WINDOW)
        two = fit_clock(a.within(when + gap + margin, high), b, Clock(second), WINDOW)
        first = one.clock.offset if one is not None and abs(one.clock.offset - first) < AROUND else first
        second = two.clock.offset if two is not None and abs(two.clock.offset - second) < AROUND else second
        when, gap = _moment(*raw, first, second, when, limits)
    jump = second - first
    sigma = math.hypot(*(math.sqrt(float(f.covariance[0, 0])) if f is not None else math.nan for f in (one, two)))
    i, j = answer.pair
    if jump > 0 and gap == 0:  # a's frames run on, b's go back: its parts are in the other order
        return [Suspect(j, Break(_turn(*raw, second, first), -jump, 0.0, sigma), 1.0)]
    at_b = when - first
    if jump > 0:  # a's frames from `when` on for `jump` s have no partner: a stood still, or b lost them
        froze, lost = (i, when, a), (j, at_b)
    else:
        froze, lost = (j, at_b, b), (i, when)
    video, start, own = froze
    length = abs(jump)
    frame = 1 / fps[video]
    if abs(length / frame - round(length / frame)) < SNAP:
        length = round(length / frame) * frame
    stands = stood_still(own, start, abs(jump))
    back = Break(start + length, -length, length, sigma) if stands else Break(start, -abs(jump), 0.0, sigma)
    gone = Break(lost[1], abs(jump), 0.0, sigma)
    votes = (1.0, 0.0) if stands else (RESTING, MOVING)
    return [Suspect(video, back, votes[0]), Suspect(lost[0], gone, votes[1])]


@dataclass(frozen=True, eq=False)
class Raw:
    """Matched tracks as they were seen: curves are smoothed across a break, samples are not.

    Args:
        times: (T,) s. x: (M,T,3), nan where not seen.
    """

    times: np.ndarray
    x: np.ndarray

    @classmethod
    def of(cls, tracks: TrackSet, index: np.ndarray) -> Raw:
        return cls(tracks.times, tracks.take(index).positions())

    def at(self, t: np.ndarray) -> np.ndarray:
        """(M,S,3) between two samples on a line; nan outside."""
        right = np.clip(np.searchsorted(self.times, t), 1, len(self.times) - 1)
        step = self.times[right] - self.times[right - 1]
        share = ((t - self.times[right - 1]) / step)[None, :, None]
        x = (1 - share) * self.x[:, right - 1] + share * self.x[:, right]
        outside = (t < self.times[0]) | (t > self.times[-1])
        return np.where(outside[None, :, None], np.nan, x)

    def sampled(self, t: np.ndarray) -> np.ndarray:
        """(S,) whether a moment lies between two samples that are no gap apart (:data:`GAP`)."""
        right = np.clip(np.searchsorted(self.times, t), 1, len(self.times) - 1)
        steps = np.diff(self.times)
        return np.asarray(steps[right - 1] < GAP * np.median(steps))

    @cached_property
    def _bends(self) -> np.ndarray:
        square = np.zeros(self.x.shape[:2])
        second = ((self.x[:, 2:] - 2 * self.x[:, 1:-1] + self.x[:, :-2]) ** 2).sum(2) / 64
        square[:, 1:-1] = np.where(np.isfinite(second), second, 0.0)
        return square

    def bent(self, t: np.ndarray) -> np.ndarray:
        """(M,S) how far a curve may lie off such a line, squared: an eighth of the second difference; 0 where unknown.

        At a sample it is an eighth as well: curves that bend there are not known better than their samples are apart.
        """
        right = np.clip(np.searchsorted(self.times, t), 1, len(self.times) - 1)
        return np.maximum(self._bends[:, right - 1], self._bends[:, right])


def _moment(
    a: Raw, b: Raw, first: float, second: float, near: float, limits: tuple[float, float]
) -> tuple[float, float]:
    """The time of a's clock up to which the first offset suits the positions better, and how many seconds later the
    second one begins to.
    """
    reach = AROUND + min(abs(second - first), SEARCH)
    t = a.times[(a.times > max(limits[0], near - reach)) & (a.times < min(limits[1], near + reach))]
    gap = max(second - first, 0.0)
    if len(t) < 3:
        return near, gap
    frame = float(np.median(np.diff(a.times)))
    # the coarse place may lie at either end of a gap
    sides = [t < near - gap - MARGIN, t > near + gap + MARGIN]
    for k, wide in enumerate((t < near - MARGIN, t > near + MARGIN)):
        if sides[k].sum() < ENOUGH:
            sides[k] = wide
    scores = [_suits(a, b, o, t, inside) for o, inside in zip((first, second), sides, strict=True)]
    one = np.concatenate([[0.0], np.cumsum(scores[0])])
    two = np.concatenate([np.cumsum(scores[1][::-1])[::-1], [0.0]])
    found = {}
    for g in {0.0, gap}:
        total = one + two[np.minimum(np.arange(len(t) + 1) + round(g / frame), len(t))]
        best = int(np.argmax(total))
        found[g] = float(total[best]), float(t[best] if best < len(t) else t[-1] + frame)
    # frames within the gap that suit the second offset all the same add up to 1 each
    if gap >= BACK and found[0.0][0] > found[gap][0] + 0.5 * min(gap / frame, 15):
        gap = 0.0
    return found[gap][1], gap


def _turn(a: Raw, b: Raw, first: float, second: float) -> float:
    """The time of b's own clock from which on it has the second offset, where its parts are not in a's order.

    Frames that neither offset brings into a's clip count for neither.
    """
    t = b.times
    scores = [_suits(b, a, -offset, t, np.ones(len(t), bool)) for offset in (first, second)]
    one = np.concatenate([[0.0], np.cumsum(scores[0])])
    two = np.concatenate([np.cumsum(scores[1][::-1])[::-1], [0.0]])
    best = int(np.argmax(one + two))
    return float(t[best] if best < len(t) else t[-1] + np.median(np.diff(t)))


def _suits(a: Raw, b: Raw, offset: float, t: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(S,) how well positions agree at a's times ``t`` and an offset, in (-inf, 1]: 0 is undecided, or nothing seen.

    Every match has a constant difference of its own, its median ``inside`` (S,) the part where the offset holds.
    """
    return _agreement(a.at(t) - b.at(t - offset), inside)


def _agreement(apart: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(S,) how well positions agree, from the differences (M,S,3) of matched tracks: see :func:`_suits`."""
    level = Usual.of(apart, inside).levels(apart)
    return np.asarray(np.nansum(level, 0) / np.maximum(np.isfinite(level).sum(0), 1))


@dataclass(frozen=True, eq=False)
class Usual:
    """How far apart matched tracks usually are, which tells how well they agree elsewhere.

    Args:
        known: (M,) matches of which enough is seen. middle: (M',3) the constant difference of each of them, its median.
        spread: the median squared distance from it.
    """

    known: np.ndarray
    middle: np.ndarray
    spread: float

    @classmethod
    def of(cls, apart: np.ndarray, inside: np.ndarray) -> Usual:
        """From the differences (M,S,3) at the moments ``inside`` (S,)."""
        seen = np.isfinite(apart[..., 0]) & inside
        known = seen.sum(1) >= LEAST_KNOWN
        if not known.any():
            return cls(known, np.zeros((0, 3)), 1.0)
        middle = np.nanmedian(np.where(seen[known][..., None], apart[known], np.nan), 1)
        off = ((apart[known] - middle[:, None]) ** 2).sum(2)
        return cls(known, middle, float(np.median(off[seen[known]])) + 1e-300)

    def levels(self, apart: np.ndarray, bent: np.ndarray | None = None) -> np.ndarray:
        """(M',S) how well each known match agrees at each moment, in (-inf, 1]; nan where it is not seen.

        Args:
            apart: (M,S,3) differences. bent: (M,S) squared error of what was read between samples; it counts for
                nothing.
        """
        off = ((apart[self.known] - self.middle[:, None]) ** 2).sum(2)
        usual = self.spread if bent is None else self.spread + bent[self.known]
        return np.asarray(1 - np.log1p(off / (4 * usual)))


def stood_still(curves: TrackSplines, start: float, length: float) -> bool:
    """Whether tracks rest from ``start`` on for ``length`` s, and move before and behind: the fastest quarter of them,
    since noise has a speed, too, and what hardly moves has no other.
    """
    inner = min(0.25 * length, MARGIN)
    during = _speeds(curves, start + inner, start + length - inner)
    around = np.stack(
        [
            _speeds(curves, start - AROUND, start - MARGIN),
            _speeds(curves, start + length + MARGIN, start + length + AROUND),
        ]
    )
    sides = np.isfinite(around)
    usual = np.where(sides, around, 0.0).sum(0) / np.maximum(sides.sum(0), 1)
    known = np.isfinite(during) & sides.any(0)
    if not known.any():
        return False
    fast = known & (usual >= np.quantile(usual[known], FASTEST))
    return float(np.median(during[fast])) < STILL * float(np.median(usual[fast]))


def _speeds(curves: TrackSplines, begin: float, end: float) -> np.ndarray:
    """(M,) rms speed of every track within a span; nan where it is not seen."""
    t = curves.times[(curves.times >= begin) & (curves.times <= end)]
    if len(t) == 0:
        return np.full(len(curves.mean), np.nan)
    seen = curves.support(t)
    power = np.where(seen, (curves.velocity(t) ** 2).sum(2), 0.0).sum(1)
    return np.where(seen.any(1), np.sqrt(power / np.maximum(seen.sum(1), 1)), np.nan)


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
            still = float(np.median([s.found.still for s in same]))
            middle = Break(
                float(np.median([s.found.at for s in same])),
                float(np.median([s.found.jump for s in same])),
                still,
                float(np.median([s.found.sigma for s in same])) / math.sqrt(len(same)),
            )
            best, most = Suspect(one.video, middle, votes), votes
    return best


def remeasured(answer: Answer, a: TrackSet, b: TrackSet, moment: float) -> tuple[float, float]:
    """What is left of a jump after it was mended, s, and one sigma of it; ``moment``: of the break, on a's clock."""
    curves = SplineRefine().splines(a, b, strongest(answer.matches, readable(LIMIT, a, b)))
    start = Clock(answer.refined.offset, answer.refined.rate)
    one = fit_clock(curves[0].within(-math.inf, moment - MARGIN), curves[1], start, WINDOW)
    two = fit_clock(curves[0].within(moment + MARGIN, math.inf), curves[1], start, WINDOW)
    if one is None or two is None:
        return 0.0, math.nan
    sigma = math.hypot(*(math.sqrt(float(f.covariance[0, 0])) for f in (one, two)))
    return two.clock.offset - one.clock.offset, sigma


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
        near = (t >= low) & (t <= high)
        if near.sum() < LEAST_BESIDE:
            continue
        suits = [_level(*raw, clock, s, t[away], t[near]) for s in steps]
        if abs(steps[int(np.argmax(suits))]) > OFF:
            return False
    return True


def _level(a: Raw, b: Raw, clock: Clock, late: float, known: np.ndarray, asked: np.ndarray) -> float:
    """How well positions agree at the moments ``asked`` of a's clock and an offset that is larger by ``late`` s, where
    the differences at ``known`` moments, at the clock's own offset, are what is usual: see :func:`_suits`.
    """
    times = np.concatenate([known, asked])
    at_b = np.concatenate([clock.own(known), clock.own(asked - late)])
    return float(_agreement(a.at(times) - b.at(at_b), np.arange(len(times)) < len(known))[len(known) :].mean())
