"""Where a clock breaks, of videos without depth: the pictures of each show when, its pairs tell by how much.

That a video lost frames, or stood still, shows in its own tracks, to the frame. Before and behind that moment each of
its pairs has an offset of its own, and all of one video's differ by the same time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..clocks.common import missing, nominal_fps, on_clock, within
from ..clocks.cuts import CLEAR_PATH, Steps
from ..clocks.lengths import jumping
from ..clocks.stillness import pauses
from ..geometry import seen_pixels
from ..types import Alignment, Break, Matches, Status, TrackSet, mended_times
from .poses import Views
from .refine import EpipolarRefine
from .scan import EpipolarScan, unit_of

LEAST_PIECE = 24 / 30
"""Seconds filmed on either side of a moment that is asked about: in less, motion that is alike suits another time."""

REACH = 2.0
"""Seconds that may be lost at a cut. That a video goes back in time there is not asked: motion that comes back looks
so."""

COUNTED = 1.5
"""Frames by which a clock may be late otherwise than by how long its pictures stood still."""

SAME = 2.5 / 30
"""Seconds within which the offsets of both pieces are the same."""

DOUBTED = 10.0
"""Nats by which another offset suits one of the pieces better than the answer of both, from which on a clock is
doubted. Basketball (seeds 71900-71929, 73900-73915): of 30 moments at which sound cameras look cut, since all players
jerk, 28 have 0; where ten frames were lost, or fifteen repeated, two cameras have 12 and more in 35 of 36, and four 54
and more in 25 of 25."""

CLEARLY = 0.35
"""Where a camera's path is cut, one offset must beat any two by this share of the weaker piece's evidence: less is
ambiguous. Motion that comes back suits another one nearly as well ("phones in hands, ten lost": .03, seed 80477, and
.20 where poses are 5 mm off, 80534; both were trusted, ten frames off on one side). A path is cut where frames are
missing or a phone was knocked, so little is lost by doubt."""

MENDED = 50.0
"""Nats by which two offsets suit the pieces better than one, from which on a clock is mended. Four of those cameras
have 54 to 660 in 24 of 25, sound ones 0."""

LEAST_PAIRS = 2
"""Pairs that must agree by how much a clock jumps at a cut: of one alone, motion that is alike decides too often. A
picture that stood still tells it by itself."""

AGREED = 1 / 30
"""Seconds within which most of a video's pairs must measure the same jump; what they say they know it to adds to it."""

NEARBY = 5 / 30
"""Seconds within which what tracks and what the camera show is one cut."""

ROUNDING = 1e-6
"""Seconds by which a frame may lie beside a moment."""

WIDE = 10.0
"""Seconds around the offset that a video has within which its pieces are looked for."""

MOST_PAIRS = 8
"""Pairs of a video that are asked, at most: the time of all grows with the square of their number."""

MOST_MOMENTS = 6
"""Moments of a video that are asked about, at most: the longest pauses and the sharpest cuts; and so many more cuts of
its camera's path."""


Span = tuple[float, float]
"""From when to when, s of a video's own clock."""


@dataclass(frozen=True)
class Moment:
    """When a video may have broken, s of its own clock.

    Args:
        start: until then it ran. at: from then on it runs again; later where it stood still between them.
        sure: whether the path of its camera is cut there. Then both pieces must vouch for the same offset.
        told: whether the times of its file say that frames are missing there.
    """

    start: float
    at: float
    sure: bool = False
    told: bool = False

    @property
    def still(self) -> float:
        return self.at - self.start

    def jumps(self, frame: float) -> tuple[float, float]:
        """The least and the largest jump that it may be, s: what stood still is late by that, a cut lacks some."""
        return (-self.still - COUNTED * frame, -self.still + COUNTED * frame) if self.still else (0.0, REACH)


@dataclass(frozen=True)
class Found:
    """A video whose clock breaks.

    Args:
        doubt: nats by which another offset suits one of its pieces better; infinite where its camera's path is cut and
            the pieces do not vouch for one. gain: nats by which two offsets suit both.
        broke: how its pairs measure it; None where they do not agree, or are too few.
    """

    video: int
    doubt: float
    gain: float
    broke: Break | None


def moments(tracks: TrackSet, breaks: Sequence[Break] = ()) -> list[Moment]:
    """When a video looks as if it was cut, or as if it stood still; ``breaks``: that were mended, on its own clock."""
    t, x = tracks.times, seen_pixels(tracks)
    rests = sorted(pauses(x), key=lambda p: p[0] - p[1])[:MOST_MOMENTS]
    steps = Steps.in_pixels(tracks)
    cuts = sorted(steps.cuts(), key=lambda k: -float(steps.jolts[k - 1]))[:MOST_MOMENTS]
    path = Steps.of_camera(tracks)
    shown = sorted(path.cuts(CLEAR_PATH), key=lambda k: -float(path.jolts[k - 1]))[:MOST_MOMENTS]
    sure = [Moment(float(t[k]), float(t[k]), True) for k in shown]
    told = [Moment(float(t[i]), float(t[j])) for i, j in rests]
    gap, made = missing(t), mended_times(np.array([b.at for b in breaks]), breaks)[0]
    told += [
        Moment(float(t[k]), float(t[k]), told=bool(gap[k - 1] and (np.abs(made - t[k]) > NEARBY).all()))
        for k in cuts
        if not any(abs(t[k] - m.at) <= NEARBY for m in sure)
    ]
    long = [m for m in told if m.start - t[0] >= LEAST_PIECE - 1e-9 and t[-1] - m.at >= LEAST_PIECE - 1e-9]
    return [*sure, *long[:MOST_MOMENTS]]


def find_breaks(
    scan: EpipolarScan,
    refiner: EpipolarRefine,
    tracks: Sequence[TrackSet],
    matches: Mapping[tuple[int, int], Matches],
    seconds: Float[np.ndarray, " V"],
    mended: Mapping[int, Sequence[Break]] | None = None,
) -> list[Found]:
    """The videos whose pieces, beside a moment at which they look broken, one offset does not suit.

    Args:
        scan: whose evidence is asked. refiner: what measures jumps.
        matches: of the pairs that are asked, the surest first: of each video so many as :data:`MOST_PAIRS`.
        seconds: (V,) offsets of the videos, of which those of the others are taken as they are; nan where there is
            none.
        mended: breaks of each video that ``tracks`` are mended of: a gap that this made is nothing its file says.
    """
    found = []
    for v in range(len(tracks)):
        asked = Asked.of(scan, refiner, tracks, matches, seconds, v)
        all_moments = moments(tracks[v], (mended or {}).get(v, ())) if asked.pairs else []
        told = []
        for moment in all_moments:
            pieces = asked.pieces(moment)
            doubt = math.inf if moment.sure and not pieces.vouched() else pieces.doubt()
            if moment.told and doubt > DOUBTED and asked.runs_on(moment, _beside(moment, all_moments)):
                continue
            told.append((*pieces.best(*moment.jumps(1 / nominal_fps(tracks[v]))), doubt, moment))
        doubt = max((t[3] for t in told), default=0.0)
        if doubt <= DOUBTED:
            continue
        gain, before, jump, _, moment = max(told, key=lambda t: t[0])
        broke = asked.measured(moment, _beside(moment, all_moments), before, jump) if gain > MENDED else None
        found.append(Found(v, doubt, gain, broke))
    return found


def _beside(moment: Moment, others: Sequence[Moment]) -> tuple[Span, Span]:
    """The spans before and behind a moment up to the nearest others that leave enough: there may be breaks, too."""
    before = [m.at for m in others if m.at <= moment.start - LEAST_PIECE]
    behind = [m.start for m in others if m.start >= moment.at + LEAST_PIECE]
    return (max(before, default=-math.inf), moment.start), (moment.at, min(behind, default=math.inf))


@dataclass(frozen=True, eq=False)
class Asked:
    """A video whose clock may break, and the pairs that are asked about it.

    Args:
        own: the video. around: its offset, s; nan where it has none. pairs: the others, with matches and offsets.
    """

    scan: EpipolarScan
    refiner: EpipolarRefine
    own: TrackSet
    around: float
    pairs: tuple[Compared, ...]

    @classmethod
    def of(
        cls,
        scan: EpipolarScan,
        refiner: EpipolarRefine,
        tracks: Sequence[TrackSet],
        matches: Mapping[tuple[int, int], Matches],
        seconds: Float[np.ndarray, " V"],
        v: int,
    ) -> Asked:
        """Of video v. Of two videos the other one's clock is the world's."""
        offsets = seconds if len(seconds) > 2 else seconds - seconds[1 - v]
        if len(seconds) == 2:
            offsets[1 - v] = 0.0
        pairs: list[Compared] = []
        for (i, j), m in matches.items():
            other = i if v == j else j
            if v in (i, j) and len(m) and np.isfinite(offsets[other]) and len(pairs) < MOST_PAIRS:
                pairs.append(Compared(tracks[other], float(offsets[other]), m, v == j))
        return cls(scan, refiner, tracks[v], float(offsets[v]), tuple(pairs))

    def pieces(self, moment: Moment) -> Evidence:
        """What lies before a moment, and what lies behind it, as all pairs see them."""
        fps = min(nominal_fps(t) for t in (self.own, *(p.other for p in self.pairs)))
        told = [p.curves(self.scan, self.own, moment, self.around, fps) for p in self.pairs]
        low, high = min(at[0] for at, _ in told), max(at[-1] for at, _ in told)
        grid = low + np.arange(round((high - low) * fps) + 1) / fps
        total = np.sum([[np.interp(grid, at, curve, 0.0, 0.0) for curve in nats] for at, nats in told], 0)
        t = self.own.times
        shared = np.zeros((2, len(grid)))
        for k, (begin, end) in enumerate(((t[0], moment.start), (moment.at, t[-1]))):
            for pair in self.pairs:
                first, last = pair.other.times[[0, -1]] + pair.offset
                shared[k] = np.maximum(shared[k], np.minimum(grid + end, last) - np.maximum(grid + begin, first))
        return Evidence(grid, total[0], total[1], shared)

    def runs_on(self, moment: Moment, spans: tuple[Span, Span]) -> bool:
        """Whether most pairs, and more than one, measure the video's offset on both sides of a moment, each side by
        itself from there on, and know the difference to a frame.
        """
        told = [pair.jump(self.refiner, self.own, spans, (self.around, self.around)) for pair in self.pairs]
        known = np.array([t for t in told if t is not None]).reshape(-1, 2)
        agree = int((np.abs(known[:, 0]) + known[:, 1] <= AGREED).sum())
        return agree >= LEAST_PAIRS and 2 * agree > len(told)

    def measured(self, moment: Moment, spans: tuple[Span, Span], before: float, jump: float) -> Break | None:
        """The break as the pairs measure it, beside it; None where most of them do not agree."""
        told = [pair.jump(self.refiner, self.own, spans, (before, before + jump)) for pair in self.pairs]
        known, least = np.array([t for t in told if t is not None]).reshape(-1, 2), 1 if moment.still else LEAST_PAIRS
        if len(known) < least:
            return None
        jumps, sigmas = known.T
        near = np.abs(jumps - np.median(jumps)) <= AGREED + sigmas
        if 2 * near.sum() <= len(told) or near.sum() < least:
            return None
        weight = 1 / sigmas[near] ** 2
        mean = float(weight @ jumps[near] / weight.sum())
        # pairs that differ by more than they say do not know it better together
        misfit = float(weight @ (jumps[near] - mean) ** 2) / max(1, near.sum() - 1)
        sigma = math.sqrt(max(1.0, misfit) / weight.sum())
        frame = 1 / nominal_fps(self.own)
        if not moment.still:
            return jumping(moment.at, mean, sigma, frame)
        if abs(moment.still + mean) > COUNTED * frame:
            return None
        return Break(moment.at, -moment.still, moment.still, 0.0)  # it shows itself how long it stood still


@dataclass(frozen=True, eq=False)
class Compared:
    """Another video that the one in question is compared with.

    Args:
        offset: of the other one, s. later: whether it comes first in ``matches``, the one in question second.
    """

    other: TrackSet
    offset: float
    matches: Matches
    later: bool

    def both(self, own: TrackSet) -> tuple[TrackSet, TrackSet]:
        """As in the matches."""
        return (self.other, own) if self.later else (own, self.other)

    def curves(
        self, scan: EpipolarScan, own: TrackSet, moment: Moment, around: float, fps: float
    ) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "2 K"]]:
        """Offsets of the video in question, s, and the evidence of both of its pieces for them."""
        a, b = self.both(own)
        xa, xb = (on_clock(t, seen_pixels(t), fps) for t in (a, b))
        views, unit, origin = Views.of(a, b, fps), unit_of(a, b), float(a.times[0] - b.times[0])
        lags = np.arange(1 - xb.shape[1], xa.shape[1])
        offsets = self.offset + (1 if self.later else -1) * (origin + lags / fps)
        if np.isfinite(around):
            near = np.abs(offsets - around) <= WIDE
            lags, offsets = lags[near], offsets[near]
        x = xb if self.later else xa
        at = own.times[0] + np.arange(x.shape[1]) / fps
        told = []
        # where a video stands still it shows the moment of the start
        for begin, end in ((-math.inf, moment.start), (moment.at, math.inf)):
            inside = (at >= begin - ROUNDING) & (at < end - ROUNDING)
            part = np.where(inside[None, :, None], x, np.nan)
            one, two = (xa, part) if self.later else (part, xb)
            told.append(scan.evidence(one, two, views, self.matches.pairs, lags, fps, unit, self.matches.weight))
        order = slice(None) if self.later else slice(None, None, -1)
        return offsets[order], np.stack(told)[:, order]

    def jump(
        self, refiner: EpipolarRefine, own: TrackSet, spans: tuple[Span, Span], offsets: tuple[float, float]
    ) -> tuple[float, float] | None:
        """By how much the offset of the video in question jumps, and one sigma, s; None where a piece does not tell.

        Args:
            spans: the pieces. offsets: of the video in each of them, about, s.
        """
        sign, fps = 1 if self.later else -1, min(nominal_fps(own), nominal_fps(self.other))
        found = []
        for span, offset in zip(spans, offsets, strict=True):
            start = Alignment(sign * (offset - self.offset), sigma=1 / fps, fps=fps)
            piece, _ = refiner.placed(*self.both(within(own, *span)), self.matches, start)
            if not math.isfinite(piece.offset) or {Status.MOVED, Status.NO_OVERLAP} & set(piece.flags):
                return None
            found.append(piece)
        first, second = found
        return sign * (second.offset - first.offset), math.hypot(first.sigma, second.sigma)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence (nats) of the pieces of a video for its offsets, of all its pairs together.

    Args:
        offsets: (K,) s, one frame apart. before, behind: (K,) of what lies before a moment, and of what lies behind it.
        shared: (2,K) how many seconds of either another video has filmed, too, at these offsets.
    """

    offsets: Float[np.ndarray, " K"]
    before: Float[np.ndarray, " K"]
    behind: Float[np.ndarray, " K"]
    shared: Float[np.ndarray, "2 K"]

    def best(self, least: float, most: float) -> tuple[float, float, float]:
        """(nats that two offsets have beyond one, the offset before, s, and how much larger it is behind, s).

        Args:
            least, most: s by which it may be larger.
        """
        fps = 1 / (self.offsets[1] - self.offsets[0])
        same = math.floor(SAME * fps + 1e-6)
        one, _, _ = max(self._joint(d) for d in range(-same, same + 1))
        asked = [d for d in range(math.ceil(least * fps - 1e-6), math.floor(most * fps + 1e-6) + 1) if abs(d) > same]
        two, k, d = max((self._joint(d) for d in asked), default=(-math.inf, 0, 0))
        return two - one, float(self.offsets[k]), d / fps

    def doubt(self) -> float:
        """Nats by which another offset suits one of the pieces better than the one that suits both; of pieces that
        others have filmed, too. What suits a piece no better than nothing (0 nats) is no offset of it.
        """
        same = math.floor(SAME / (self.offsets[1] - self.offsets[0]) + 1e-6)
        k = int((self.before + self.behind).argmax())
        near = slice(max(0, k - same), k + same + 1)
        pieces = zip((self.before, self.behind), self.shared[:, k] >= LEAST_PIECE, strict=True)
        told = (float(piece.max()) - max(float(piece[near].max()), 0.0) for piece, filmed in pieces if filmed)
        return max([0.0, *told])

    def vouched(self) -> bool:
        """Whether both pieces, each by itself, tell the same offset, and no two offsets suit them nearly as well."""
        same = math.floor(SAME / (self.offsets[1] - self.offsets[0]) + 1e-6)
        one, two = int(self.before.argmax()), int(self.behind.argmax())
        told = float(min(self.before[one], self.behind[two]))
        return abs(one - two) <= same and told > DOUBTED and self.best(0.0, REACH)[0] < -CLEARLY * told

    def _joint(self, d: int) -> tuple[float, int, int]:
        """(most nats of an offset before, and one behind that is d frames larger; the index of the former; d)."""
        if abs(d) >= len(self.offsets):
            return -math.inf, 0, d
        first = slice(max(0, -d), len(self.offsets) - max(0, d))
        then = slice(max(0, d), len(self.offsets) + min(0, d))
        total = self.before[first] + self.behind[then]
        k = int(total.argmax())
        return float(total[k]), k + first.start, d
