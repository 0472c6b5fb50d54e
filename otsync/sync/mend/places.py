"""Breaks that positions tell of: in one world frame a matched track is where its partner is, at the right offset alone.

Matched tracks differ by a constant, a bias of depth or another point of the limb. Where one offset holds, that constant
is known; from there on single frames tell whether another offset suits them. So parts are found, and measured, that are
too short for windows of motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import stdtrit

from ...clocks.common import readable, strongest
from ...clocks.splines import TrackSplines
from ...refine.gauss_newton import GROUPS, ONE_SIGMA, ROBUST, jackknife, neighbours
from ...types import Clock, TrackSet
from ..alike import LEAST_BESIDE, LIMIT, MARGIN, Raw, Usual
from ..verdict import Answer

REACH = 2.0
"""Seconds by which another offset may differ."""

LEAST_JUMP = 3 / 30
"""Seconds; smaller steps are a rate, or noise."""

LEAST_PART = 8
"""Frames of a part, at least."""

WITNESSES = 5
"""Matches that must be seen at a moment."""

GAIN, BETTER, SUITS = 4.0, 0.25, 0.25
"""Levels of :class:`otsync.sync.alike.Usual`, summed over frames, that a part must gain by an offset of its own; and by
how much, in the mean, that offset must suit the part better, and how well."""

BESIDE = 1.0
"""Seconds beside a break that tell the constant differences of the matches."""

TRIED, FEWEST = 6, 2
"""Parts of known offset that are measured in the same way, at most and at least."""

MOST_FRAMES = 1500
"""Of longer clips windows of motion tell enough."""

ROUNDS, ITERATIONS = 3, 8

NONE = np.zeros((0, 2))


def parts_by_place(answer: Answer, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "P 2"]:
    """Two parts of a pair's overlap, one with the answer's offset and one with the offset that suits its positions.

    Returns rows (seconds of a's clock from which on, offset in seconds) as :attr:`Alignment.parts` has them; none where
    one offset suits all.
    """
    clock = Clock(answer.refined.offset, answer.refined.rate)
    frame = float(np.median(np.diff(a.times))) if a.n_frames > 1 else 0.0
    if not (frame > 0 and a.n_frames <= MOST_FRAMES):
        return NONE
    pairs = strongest(answer.matches, readable(LIMIT, a, b)).pairs
    first, second = Raw.of(a, pairs[:, 0]), Raw.of(b, pairs[:, 1])
    usual = _usual(first, second, clock)
    if usual is None:
        return NONE
    here = _levels(first, second, clock, 0.0, usual)
    straight = np.nan_to_num(here)
    before, behind = np.concatenate([[0.0], np.cumsum(straight)]), float(straight.sum())
    best, found = GAIN, NONE
    count = round(REACH / frame)
    for k in range(-count, count + 1):
        if abs(k) * frame < LEAST_JUMP:
            continue
        there = _levels(first, second, clock, k * frame, usual)
        other = np.concatenate([[0.0], np.cumsum(np.nan_to_num(there))])
        seen = np.concatenate([[0], np.cumsum(np.isfinite(there))])
        for late in (True, False):
            # the offset grows from the first part to the second: that many of a's frames have no partner
            grows = k if late else -k
            gap = max(grows, 0)
            ends = np.arange(len(here) + 1)  # where the first part ends
            begins = np.minimum(ends + gap, len(here))
            if late:
                total = before[ends] + other[-1] - other[begins]
                part, known = other[-1] - other[begins], seen[-1] - seen[begins]
                plain = behind - before[begins]
            else:
                total = other[ends] + behind - before[begins]
                part, known, plain = other[ends], seen[ends], before[ends]
            with np.errstate(divide="ignore", invalid="ignore"):
                told = (known >= LEAST_PART) & (part > SUITS * known) & (part - plain > BETTER * known)
            total = np.where(told, total, -np.inf)
            at = int(np.argmax(total))
            if total[at] - behind > best:
                best = float(total[at] - behind)
                offsets = (clock.offset, clock.offset + k * frame)
                begin = a.times[min(int(begins[at]), len(here) - 1)]
                found = np.array([[a.times[0], offsets[not late]], [begin, offsets[late]]])
    return found


def _usual(a: Raw, b: Raw, clock: Clock) -> Usual | None:
    """How far apart matched tracks are where the clock holds: in a few rounds, since that part is not known."""
    apart = a.x - b.at(clock.own(a.times))
    inside = np.isfinite(apart[..., 0]).sum(0) >= WITNESSES
    usual = None
    for _ in range(ROUNDS):
        if inside.sum() < LEAST_PART:
            return usual
        usual = Usual.of(apart, inside)
        if not usual.known.any():
            return None
        level = _mean(usual.levels(apart))
        known = np.isfinite(level)
        if not known.any():
            return None
        inside = known & (np.nan_to_num(level) >= 0.5 * float(np.quantile(level[known], 0.75)))
    return usual


def _levels(a: Raw, b: Raw, clock: Clock, late: float, usual: Usual) -> Float[np.ndarray, " T"]:
    """(T,) how well positions agree at a's frames and an offset larger by ``late`` s; nan where too few are seen."""
    t = clock.own(a.times - late)
    return _mean(usual.levels(a.x - b.at(t), b.bent(t)))


def _mean(levels: Float[np.ndarray, "M T"]) -> Float[np.ndarray, " T"]:
    seen = np.isfinite(levels)
    count = seen.sum(0)
    return np.where(count >= WITNESSES, np.where(seen, levels, 0.0).sum(0) / np.maximum(count, 1), np.nan)


@dataclass(frozen=True, eq=False)
class Part:
    """A part of an overlap: from ``begin`` to ``end`` s of a's clock, at an offset, s."""

    begin: float
    end: float
    offset: float

    def moments(self, times: Float[np.ndarray, " T"]) -> Bool[np.ndarray, " T"]:
        return (times >= self.begin) & (times <= self.end)


def measured(a: TrackSplines, b: TrackSplines, known: Part, short: Part) -> tuple[float, float]:
    """The offset of a short part, and one sigma of it, s, by the places that the matches have in the part beside it,
    whose offset is known; (its own offset, nan) where nothing tells.

    Places drift, those of all matches alike, which their scatter does not show. So the same is asked of parts of the
    known one, too, as long and as far from what they are measured by: what these are off by joins sigma. They are few,
    and overlap by half: sigma is that of Student's distribution with as many degrees of freedom as would not overlap.
    """
    offset, sigma = _by_place(a, b, known, short)
    length, gap = min(short.end, float(a.times[-1])) - max(short.begin, float(a.times[0])), _gap(known, short)
    inwards = -1.0 if known.begin < short.begin else 1.0
    first = _nearest(known, short) + inwards * a.frame
    off = []
    for k in range(TRIED):
        near = first + inwards * k * length / 2
        low, high = sorted((near, near + inwards * length))
        beyond = high + gap if inwards > 0 else low - gap
        begin, end = sorted((beyond, beyond + inwards * BESIDE))
        rest = Part(begin, end, known.offset)
        if not (known.begin <= rest.begin and rest.end <= known.end):
            break
        found, scatter = _by_place(a, b, rest, Part(low, high, known.offset))
        if math.isfinite(scatter):
            off.append(found - known.offset)
    if len(off) < FEWEST:
        return offset, math.nan
    student = float(stdtrit((len(off) + 1) / 2, ONE_SIGMA))
    return offset, math.hypot(sigma, student * float(np.sqrt(np.mean(np.square(off)))))


def _by_place(a: TrackSplines, b: TrackSplines, known: Part, short: Part) -> tuple[float, float]:
    """See :func:`measured`; sigma tells of the scatter between neighbourhoods of matches alone."""
    nearest = known.moments(a.times) & (np.abs(a.times - _nearest(known, short)) <= BESIDE)
    asked = a.times[short.moments(a.times)]
    if nearest.sum() < LEAST_BESIDE or len(asked) < LEAST_BESIDE:
        return short.offset, math.nan
    t = a.times[nearest]
    seen = a.support(t) & b.support(t - known.offset)
    told = seen.sum(1) >= LEAST_BESIDE
    apart = np.where(seen[..., None], a.joined(t) - b.joined(t - known.offset), 0.0)
    middle = apart.sum(1) / np.maximum(seen.sum(1), 1)[:, None]
    place, visible, offset = a.joined(asked), a.support(asked) & told[:, None], short.offset
    group = neighbours(a.mean + b.mean, GROUPS)
    H, g = np.zeros(GROUPS), np.zeros(GROUPS)
    for _ in range(ITERATIONS):
        own = asked - offset
        ok = visible & b.support(own)
        if ok.sum() < WITNESSES * LEAST_BESIDE:
            return short.offset, math.nan
        r, v = place - b.joined(own) - middle[:, None], b.velocity(own)
        size = np.sqrt((r**2).sum(2))
        w = np.where(ok, 1 / (1 + (size / max(ROBUST * float(np.median(size[ok])), 1e-300)) ** 2), 0.0)
        H, g = (np.bincount(group, (w[..., None] * v * x).sum((1, 2)), GROUPS).astype(float) for x in (v, r))
        if not H.sum() > 0:
            return short.offset, math.nan
        offset -= float(np.clip(g.sum() / H.sum(), -MARGIN, MARGIN))
    return offset, math.sqrt(max(float(jackknife(H[:, None, None], g[:, None])[0, 0]), 0.0))


def _nearest(known: Part, short: Part) -> float:
    """The moment of the known part that is nearest to the short one."""
    return known.end if known.begin < short.begin else known.begin


def _gap(known: Part, short: Part) -> float:
    """Seconds between the two."""
    return max(short.begin - known.end, known.begin - short.end, 0.0)
