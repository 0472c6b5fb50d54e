"""Where a clock breaks, of videos without depth: the pictures of each show when, its pairs tell by how much.

That a video lost frames, or stood still, shows in its own tracks, to the frame. Before and behind that moment each of
its pairs has an offset of its own, and all of one video's differ by the same time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..clocks.common import nominal_fps, on_clock, within
from ..clocks.cuts import Steps
from ..clocks.lengths import jumping
from ..clocks.stillness import pauses
from ..geometry import fundamentals, seen_pixels
from ..types import Alignment, Break, Matches, Status, TrackSet
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

MENDED = 50.0
"""Nats by which two offsets suit the pieces better than one, from which on a clock is mended. Four of those cameras
have 54 to 660 in 24 of 25, sound ones 0."""

LEAST_PAIRS = 2
"""Pairs that must agree by how much a clock jumps at a cut: of one alone, motion that is alike decides too often. A
picture that stood still tells it by itself."""

AGREED = 1 / 30
"""Seconds within which most of a video's pairs must measure the same jump; what they say they know it to adds to it."""

ROUNDING = 1e-6
"""Seconds by which a frame may lie beside a moment."""

MOST_MOMENTS = 6
"""Moments of a video that are asked about, at most: the longest pauses and the sharpest cuts."""


@dataclass(frozen=True)
class Moment:
    """When a video may have broken, s of its own clock.

    Args:
        start: until then it ran. at: from then on it runs again; later where it stood still between them.
    """

    start: float
    at: float

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
        doubt: nats by which another offset suits one of its pieces better. gain: by which two offsets suit both.
        broke: how its pairs measure it; None where they do not agree, or are too few.
    """

    video: int
    doubt: float
    gain: float
    broke: Break | None


def moments(tracks: TrackSet) -> list[Moment]:
    """When a video looks as if it was cut, or as if it stood still."""
    t, x = tracks.times, seen_pixels(tracks)
    rests = sorted(pauses(x), key=lambda p: p[0] - p[1])[:MOST_MOMENTS]
    steps = Steps.in_pixels(tracks)
    cuts = sorted(steps.cuts(), key=lambda k: -float(steps.jolts[k - 1]))[:MOST_MOMENTS]
    told = [Moment(float(t[i]), float(t[j])) for i, j in rests]
    told += [Moment(float(t[k]), float(t[k])) for k in cuts]
    long = [m for m in told if m.start - t[0] >= LEAST_PIECE - 1e-9 and t[-1] - m.at >= LEAST_PIECE - 1e-9]
    return long[:MOST_MOMENTS]


def find_breaks(
    refiner: EpipolarRefine,
    tracks: Sequence[TrackSet],
    matches: Mapping[tuple[int, int], Matches],
    seconds: Float[np.ndarray, " V"],
) -> list[Found]:
    """The videos whose pieces, beside a moment at which they look broken, one offset does not suit.

    Args:
        matches: of the pairs that are asked. seconds: (V,) offsets of the videos, of which those of the others are
            taken as they are; nan where there is none.
    """
    fps = min(nominal_fps(t) for t in tracks)
    found = []
    for v, video in enumerate(tracks):
        pairs = {pair: m for pair, m in matches.items() if v in pair and len(m) and _other_known(pair, v, seconds)}
        told = []
        for moment in moments(video) if pairs else ():
            pieces = Pieces.of(refiner.scan, tracks, pairs, seconds, v, moment, fps)
            told.append((*pieces.best(*moment.jumps(1 / nominal_fps(video))), pieces.doubt(), moment))
        doubt = max((t[3] for t in told), default=0.0)
        if doubt <= DOUBTED:
            continue
        gain, before, jump, _, moment = max(told, key=lambda t: t[0])
        broke = _measured(refiner, tracks, pairs, seconds, v, moment, before, jump) if gain > MENDED else None
        found.append(Found(v, doubt, gain, broke))
    return found


def _other_known(pair: tuple[int, int], v: int, seconds: Float[np.ndarray, " V"]) -> bool:
    """Whether the video that v is compared with has an offset; of two videos the other one's clock is the world's."""
    return bool(len(seconds) == 2 or np.isfinite(seconds[_other(pair, v)]))


def _other(pair: tuple[int, int], v: int) -> int:
    return pair[0] if v == pair[1] else pair[1]


def _of_other(pair: tuple[int, int], v: int, seconds: Float[np.ndarray, " V"]) -> float:
    """The offset of the video that v is compared with, s."""
    return 0.0 if len(seconds) == 2 else float(seconds[_other(pair, v)])


@dataclass(frozen=True, eq=False)
class Pieces:
    """Evidence (nats) of the pieces of a video for its offsets, of all its pairs together.

    Args:
        offsets: (K,) s, one frame apart. before, behind: (K,) of what lies before a moment, and of what lies behind it.
        shared: (2,K) how many seconds of either another video has filmed, too, at these offsets.
    """

    offsets: Float[np.ndarray, " K"]
    before: Float[np.ndarray, " K"]
    behind: Float[np.ndarray, " K"]
    shared: Float[np.ndarray, "2 K"]

    @classmethod
    def of(
        cls,
        scan: EpipolarScan,
        tracks: Sequence[TrackSet],
        matches: Mapping[tuple[int, int], Matches],
        seconds: Float[np.ndarray, " V"],
        v: int,
        moment: Moment,
        fps: float,
    ) -> Pieces:
        """Of video v, with the others' offsets as they are."""
        told = []
        for pair, m in matches.items():
            offsets, nats = _curves(scan, tracks, pair, m, v, moment, fps)
            other = _of_other(pair, v, seconds)
            told.append((other + offsets, nats) if v == pair[1] else ((other - offsets)[::-1], nats[:, ::-1]))
        low, high = min(at[0] for at, _ in told), max(at[-1] for at, _ in told)
        grid = low + np.arange(round((high - low) * fps) + 1) / fps
        total = np.sum([[np.interp(grid, at, curve, 0.0, 0.0) for curve in nats] for at, nats in told], 0)
        own = tracks[v].times
        spans = (own[0], moment.start), (moment.at, own[-1])
        shared = np.zeros((2, len(grid)))
        for pair in matches:
            filmed = tracks[_other(pair, v)].times + _of_other(pair, v, seconds)
            for k, (begin, end) in enumerate(spans):
                common = np.minimum(grid + end, filmed[-1]) - np.maximum(grid + begin, filmed[0])
                shared[k] = np.maximum(shared[k], common)
        return cls(grid, total[0], total[1], shared)

    def best(self, least: float, most: float) -> tuple[float, float, float]:
        """(nats that two offsets have beyond one, the offset before, s, and how much larger it is behind, s).

        Args:
            least, most: s by which it may be larger.
        """
        fps = 1 / (self.offsets[1] - self.offsets[0])
        same = round(SAME * fps)
        one, _, _ = max(self._joint(d) for d in range(-same, same + 1))
        asked = [d for d in range(math.ceil(least * fps - 1e-6), math.floor(most * fps + 1e-6) + 1) if abs(d) > same]
        two, k, d = max((self._joint(d) for d in asked), default=(-math.inf, 0, 0))
        return two - one, float(self.offsets[k]), d / fps

    def doubt(self) -> float:
        """Nats by which another offset suits one of the pieces better than the one that suits both; of pieces that
        others have filmed, too.
        """
        same = round(SAME / (self.offsets[1] - self.offsets[0]))
        k = int((self.before + self.behind).argmax())
        near = slice(max(0, k - same), k + same + 1)
        pieces = zip((self.before, self.behind), self.shared[:, k] >= LEAST_PIECE, strict=True)
        return max((float(piece.max() - piece[near].max()) for piece, filmed in pieces if filmed), default=0.0)

    def _joint(self, d: int) -> tuple[float, int, int]:
        """(most nats of an offset before, and one behind that is d frames larger; the index of the former; d)."""
        first = slice(max(0, -d), len(self.offsets) - max(0, d))
        then = slice(max(0, d), len(self.offsets) + min(0, d))
        if not len(self.offsets[first]):
            return -math.inf, 0, d
        total = self.before[first] + self.behind[then]
        k = int(total.argmax())
        return float(total[k]), k + first.start, d


def _curves(
    scan: EpipolarScan,
    tracks: Sequence[TrackSet],
    pair: tuple[int, int],
    matches: Matches,
    v: int,
    moment: Moment,
    fps: float,
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "2 K"]]:
    """A pair's offsets, s, and the evidence of both pieces of video v for them."""
    a, b = tracks[pair[0]], tracks[pair[1]]
    assert a.camera is not None and b.camera is not None
    xa, xb = (on_clock(t, seen_pixels(t), fps) for t in (a, b))
    F, unit = fundamentals(a.camera, b.camera), unit_of(a, b)
    lags = np.arange(1 - xb.shape[1], xa.shape[1])
    told = []
    for begin, end in _spans(moment):
        at = tracks[v].times[0] + np.arange((xa if v == pair[0] else xb).shape[1]) / fps
        inside = ((at >= begin - ROUNDING) & (at < end - ROUNDING))[None, :, None]
        one = np.where(inside, xa, np.nan) if v == pair[0] else xa
        two = np.where(inside, xb, np.nan) if v == pair[1] else xb
        told.append(scan.evidence(one, two, F, matches.pairs, lags, fps, unit, matches.weight))
    return float(a.times[0] - b.times[0]) + lags / fps, np.stack(told)


def _spans(moment: Moment) -> Iterator[tuple[float, float]]:
    """From when to when each piece was filmed; where a video stands still it shows the moment of the start."""
    yield -math.inf, moment.start
    yield moment.at, math.inf


def _measured(
    refiner: EpipolarRefine,
    tracks: Sequence[TrackSet],
    matches: Mapping[tuple[int, int], Matches],
    seconds: Float[np.ndarray, " V"],
    v: int,
    moment: Moment,
    before: float,
    jump: float,
) -> Break | None:
    """The break as the pairs of video v measure it; None where most of them do not agree."""
    told = [
        _jump(refiner, tracks, pair, m, v, moment, before - _of_other(pair, v, seconds), jump)
        for pair, m in matches.items()
    ]
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
    frame = 1 / nominal_fps(tracks[v])
    if not moment.still:
        return jumping(moment.at, mean, sigma, frame)
    # it shows itself how long it stood still
    return Break(moment.at, -moment.still, moment.still, 0.0) if abs(moment.still + mean) <= COUNTED * frame else None


def _jump(
    refiner: EpipolarRefine,
    tracks: Sequence[TrackSet],
    pair: tuple[int, int],
    matches: Matches,
    v: int,
    moment: Moment,
    before: float,
    jump: float,
) -> tuple[float, float] | None:
    """By how much a pair says that the offset of video v jumps, and one sigma, s; None where a piece does not tell."""
    a, b = tracks[pair[0]], tracks[pair[1]]
    sign = 1 if v == pair[1] else -1
    fps = min(nominal_fps(a), nominal_fps(b))
    found = []
    for (begin, end), offset in zip(_spans(moment), (before, before + jump), strict=True):
        one, two = (within(t, begin, end) if t is tracks[v] else t for t in (a, b))
        piece = refiner(one, two, matches, Alignment(sign * offset, sigma=1 / fps, fps=fps))
        if not math.isfinite(piece.offset) or {Status.MOVED, Status.NO_OVERLAP} & set(piece.flags):
            return None
        found.append(piece)
    first, second = found
    return sign * (second.offset - first.offset), math.hypot(first.sigma, second.sigma)
