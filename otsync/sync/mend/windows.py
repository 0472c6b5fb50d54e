"""Every window of an overlap, matched by itself at every offset around an answer.

Matches that are made without any time are half wrong where tracks are noisy, and the right ones are too few to tell of
single windows. Matches that were made at one time agree with it, wherever they are read. Here nothing favours an
offset: each window gets matches of its own at each of them, and the evidence of these. So a part of the overlap that
has an offset of its own stands out under noise that hides it from everything else; and where every window says the
answer's offset, its clock does not break there.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ...align.evidence import evidence
from ...clocks.common import CommonClock, nominal_fps, within
from ...clocks.cuts import CALM, Steps
from ...clocks.splines import sampled
from ...costs.linear import Cosine
from ...match.synchronous import MOMENTS as MOST_MOMENTS
from ...match.synchronous import SynchronousMatching, apart, joined, longest_seen, mutual, placed, rms_extent
from ...match.verb import match
from ...types import Clock, Matches, Status, TrackSet
from ..pairs import Job
from ..rematching import at_known_times, evidence_of
from ..verdict import Answer

LENGTH, STEP = 24 / 30, 12 / 30
"""Seconds of a window, and from one to the next."""

MOST = 60
"""Windows, at most: of longer overlaps they lie further apart."""

EVERY, REACH = 3 / 30, 45 / 30
"""Seconds between offsets, and from the answer's to the furthest."""

MOMENTS = 12
"""Of a window, that tracks are compared at."""

LONG_WINDOW = 900
"""Frames of an overlap that are one window still, where it is asked for as a whole."""

TRACKS = 300
"""Of each video, that take part: those that are seen longest."""

EXTENT_AT = 48
"""Moments that tell the extent of the scene."""

LONG = 3000
"""Frames from which on only those around a window are read at a time."""

FEWEST = 3
"""Matches of a window, at least."""

NEAR = 1
"""Steps of :data:`EVERY` beside an offset that are the same one still."""

BREAKS = 0.14
"""What the windows on one side must gain by another offset, as a share of what a window usually has: a break. In worlds
with one that was not mended (15 frames frozen, ten lost; mid to brutal; seeds 41000-41015, 53000-53019) it is .24 at
least, .3 in 53 of 56. In 40 right answers of hard and brutal noise it is .12 at most, but for two that are known badly
(.32, .55), and 0 in 60 of less noise. Of 20 worlds of 24 tracks three right
answers have .43 to .63: a mend must still prove itself."""

RIVAL, TRIED = 0.5, 4
"""Share of the best gain from which another offset is tried as well, and offsets that are tried, at most."""

STEADY, SUPPORTED = 0.1, 0.3
"""Up to which gain a clock does not break, where every window has at least this share of what one usually has."""

OF_PIECES = frozenset({Status.SHORT_OVERLAP, Status.RATE_MISMATCH, Status.COARSE})
"""Doubts that a piece of a clip may have: it is short."""

LEAST_JUMP = 3 / 30
"""Seconds between the offsets of two pieces, at least."""

WHOLE = 0.9
"""Share of a window's moments that both videos must have frames of, for it to be asked so: a mended clock has gaps."""


@dataclass(frozen=True)
class Split:
    """One part of an overlap, from its begin or up to its end, that another offset suits better.

    Args:
        at: s of a's clock. late: s by which the offset is larger there. behind: whether it is the later part.
        gain: in units of what a window usually has.
    """

    at: float
    late: float
    behind: bool
    gain: float


@dataclass(frozen=True, eq=False)
class Windows:
    """What each window says.

    Args:
        clock: the answer that they are around. begin: (W,) s of a's clock. late: (O,) s beside the answer's offset.
        evidence: (W,O) nats, of all matches that are made in a window at an offset together; none below 0.
        whole: (W,) whether both videos have frames of all of it at the answer's offset.
    """

    clock: Clock
    begin: Float[np.ndarray, " W"]
    late: Float[np.ndarray, " O"]
    evidence: Float[np.ndarray, "W O"]
    whole: Bool[np.ndarray, " W"]

    @classmethod
    def of(cls, job: Job, clock: Clock, whole: bool = False) -> Windows:
        """Of a pair whose tracks have positions.

        Args:
            whole: all of the overlap as one window, unless it is long (:data:`LONG_WINDOW`).
        """
        a, b = (t.take(longest_seen(t, TRACKS)) for t in (job.a, job.b))
        assert a.xyz is not None and b.xyz is not None
        fps = min(nominal_fps(a), nominal_fps(b))
        length, every = round(LENGTH * fps), max(1, round(EVERY * fps))
        around = round(REACH * fps / every)
        late = np.arange(-around, around + 1) * every
        ends = [clock.world(float(t)) for t in b.times[[0, -1]]]
        start = max(float(a.times[0]), ends[0])
        frames = int((min(float(a.times[-1]), ends[1]) - start) * fps + 1e-6) + 1
        if whole and frames <= LONG_WINDOW:
            length = max(length, frames)
        if frames < length:
            return cls(clock, np.zeros(0), late / fps, np.zeros((0, len(late))), np.zeros(0, bool))
        count = min(MOST, -(-(frames - length) // max(1, round(STEP * fps))) + 1)
        first = np.round(np.linspace(0, frames - length, count)).astype(int)
        costs = (Cosine(),) if job.matcher is None else job.matcher.costs
        unlike = SynchronousMatching(clock.offset, clock.rate, costs).unlike(a, b)
        look = _Look(a, b, clock, unlike, fps)
        if not look.extent(start, start + frames / fps) > 0:
            return cls(clock, start + first / fps, late / fps, np.zeros((count, len(late))), np.ones(count, bool))
        beside = around * every
        moments = MOMENTS if length < frames else MOST_MOMENTS
        found, full = [], []
        # of a long clip the curves of one window at a time are held
        for some in [first] if frames <= LONG else first[:, None]:
            begin, end = int(some[0]) - beside, int(some[-1]) + length + beside
            part = look.at(start + np.arange(begin, end) / fps)
            for k in some - begin:
                found.append([part.evidence(int(k), int(k - step), length, moments) for step in late])
                full.append(part.there[k : k + length].mean() >= WHOLE)
        return cls(clock, start + first / fps, late / fps, np.maximum(np.array(found), 0.0), np.array(full))

    @property
    def usual(self) -> float:
        """What a window has at the answer's offset, the median of all."""
        here = self._near()[:, len(self.late) // 2]
        return float(np.median(here)) if len(here) else 0.0

    @property
    def steady(self) -> bool:
        """Whether every window says the answer's offset."""
        here, usual = self._near()[:, len(self.late) // 2], self.usual
        split = self.split()
        supported = usual > 0 and self.whole.any() and here[self.whole].min() >= SUPPORTED * usual
        return bool(supported and (split is None or split.gain <= STEADY))

    def split(self) -> Split | None:
        """The part that gains most by an offset of its own; None where none gains anything."""
        return max(self._splits(), key=lambda split: split.gain, default=None)

    def rivals(self, share: float) -> list[float]:
        """Other offsets, s beside the answer's, that have this share of its evidence, each better than those beside it,
        best first.
        """
        total, middle = self.evidence.sum(0), len(self.late) // 2
        least = share * float(self._near()[:, middle].sum())
        around = np.pad(total, (NEAR, NEAR))
        peak = total >= np.maximum.reduce([around[k : k + len(total)] for k in range(2 * NEAR + 1)])
        there = peak & (total > 0) & (total >= least) & (np.abs(np.arange(len(total)) - middle) > NEAR)
        order = np.flatnonzero(there)
        return [float(self.late[k]) for k in order[np.argsort(-total[order], kind="stable")]][:TRIED]

    def breaks(self) -> list[Split]:
        """The parts that gain enough for a break, each by an offset that suits it better than those beside it, best
        first. Motion that nearly repeats leaves several; the right one is that after which the clock is whole.
        """
        found = self._splits()
        gain = np.array([0.0, *(split.gain for split in found), 0.0])
        peaks = [s for k, s in enumerate(found, 1) if gain[k] >= max(gain[k - 1], gain[k + 1])]
        least = max(BREAKS, RIVAL * float(gain.max()))
        return sorted((s for s in peaks if s.gain > least), key=lambda split: -split.gain)[:TRIED]

    def _splits(self) -> list[Split]:
        """Of every other offset the part that gains most by it."""
        near = self._near()
        if len(near) < 2 or not self.usual > 0:
            return []
        middle = len(self.late) // 2
        gains = (near - near[:, [middle]]) * self.whole[:, None]  # what lies in a gap is seen at other offsets only
        centre = self.begin + LENGTH / 2
        cuts = (centre[1:] + centre[:-1]) / 2
        found = []
        for k in np.flatnonzero(np.abs(np.arange(len(self.late)) - middle) > 2 * NEAR):
            # a part is never all of the overlap: then the answer were another one
            early = np.cumsum(gains[:, k])[:-1]
            both = np.stack([early, gains[:, k].sum() - early])
            behind, at = np.unravel_index(int(np.argmax(both)), both.shape)
            part = slice(int(at) + 1, None) if behind else slice(0, int(at) + 1)
            gain = float(both[behind, at]) / self.usual
            if gain > 0:
                found.append(Split(float(cuts[at]), self._peak(int(k), part), bool(behind), gain))
        return found

    def _peak(self, k: int, part: slice) -> float:
        """The offset near the k-th that suits a part best, s beside the answer's."""
        near = slice(max(0, k - NEAR), k + NEAR + 1)
        return float(self.late[near][int(np.argmax(self.evidence[part, near].sum(0)))])

    def _near(self) -> Float[np.ndarray, "W O"]:
        """The most that a window has at an offset or within :data:`NEAR` of it."""
        wide = np.pad(self.evidence, ((0, 0), (NEAR, NEAR)))
        shifted = [wide[:, k : k + len(self.late)] for k in range(2 * NEAR + 1)]
        return np.maximum.reduce(shifted)

    def parts(self, split: Split) -> Float[np.ndarray, "2 2"]:
        """Rows (seconds of a's clock from which on, offset in seconds) as :attr:`Alignment.parts` has them."""
        own = self.clock.offset, self.clock.offset + split.late
        first, second = own if split.behind else own[::-1]
        return np.array([[self.begin[0], first], [split.at, second]])


@dataclass(frozen=True, eq=False)
class _Look:
    """Two videos on one clock, ``unlike`` their features, in units of costs; ``fps`` of what they are read at."""

    a: TrackSet
    b: TrackSet
    clock: Clock
    unlike: Float[np.ndarray, "Na Nb"] | float
    fps: float

    def extent(self, begin: float, end: float) -> float:
        """Of the scene."""
        a, b = self._positions(np.linspace(begin, end, EXTENT_AT))
        return 0.5 * (rms_extent(a) + rms_extent(b))

    def at(self, t: Float[np.ndarray, " G"]) -> _Part:
        """The tracks at moments of a's clock."""
        there = _has_frames(self.a.times, t) & _has_frames(self.b.times, self.clock.own(t))
        extent = self.extent(float(t[0]), float(t[-1]))
        return _Part(*self._positions(t), there, self.unlike, extent, placed(self.a, self.b), self.fps)

    def _positions(self, t: Float[np.ndarray, " G"]) -> tuple[Float[np.ndarray, "Na G 3"], Float[np.ndarray, "Nb G 3"]]:
        a, b = self.a, self.b
        assert a.xyz is not None and b.xyz is not None
        return sampled(a.times, a.xyz, a.seen, t), sampled(b.times, b.xyz, b.seen, self.clock.own(t))


@dataclass(frozen=True, eq=False)
class _Part:
    """Tracks of both videos on one grid of moments.

    Args:
        a, b: (N,G,3). there: (G,) whether both videos have a frame. unlike: of their features, in units of costs.
        extent: of the scene. both: whether places count. fps: of the grid.
    """

    a: Float[np.ndarray, "Na G 3"]
    b: Float[np.ndarray, "Nb G 3"]
    there: Bool[np.ndarray, " G"]
    unlike: Float[np.ndarray, "Na Nb"] | float
    extent: float
    both: bool
    fps: float

    def evidence(self, at_a: int, at_b: int, length: int, moments: int) -> float:
        """Nats of the matches that are made where a's frames from ``at_a`` on show what b's from ``at_b`` on do."""
        if at_b < 0 or at_b + length > self.b.shape[1] or not self.extent > 0:
            return 0.0
        a, b = self.a[:, at_a : at_a + length], self.b[:, at_b : at_b + length]
        some = np.unique(np.linspace(0, length - 1, moments).round().astype(int))
        cost = joined(self.unlike, *apart(a[:, some], b[:, some], self.extent), self.both)
        i, j = mutual(cost)
        if len(i) < FEWEST:
            return 0.0
        found = evidence(CommonClock(a[i], b[j], self.fps, 0.0), np.zeros(1, int)).total[0]
        return float(found) * len(i) if np.isfinite(found) else 0.0


def _has_frames(times: Float[np.ndarray, " T"], t: Float[np.ndarray, " G"]) -> Bool[np.ndarray, " G"]:
    """Which moments a video has a frame of, within a usual frame's length."""
    usual = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    k = np.clip(np.searchsorted(times, t), 1, max(len(times) - 1, 1))
    nearest = np.minimum(np.abs(times[np.minimum(k, len(times) - 1)] - t), np.abs(times[k - 1] - t))
    return nearest <= usual


def matches_of_parts(job: Job, parts: Float[np.ndarray, "P 2"], rate: float) -> Matches:
    """Matches that are made in every part at its own offset: of both videos' frames there, put together."""
    ends = [*parts[1:, 0], np.inf]
    found = [
        match(within(job.a, begin, end), job.b, at_known_times(job.matcher, Clock(float(offset), rate)), throw=False)
        for (begin, offset), end in zip(parts, ends, strict=True)
    ]
    together = np.concatenate([m.pairs for m in found])
    score = np.concatenate([m.score for m in found if m.score is not None])
    pairs, kept = np.unique(together, axis=0, return_index=True)
    return Matches(pairs, score[kept])


@dataclass(frozen=True)
class Pieces:
    """A pair of which one video may be cut, in the two pieces that the cut makes of it.

    One offset does not suit a video that is cut, and under noise no peak of its scan stands out; each piece has one.

    Args:
        which: 0 where the first video is cut, 1 where the second one is. cut: s of its own clock.
    """

    job: Job
    which: int
    cut: float

    @classmethod
    def of(cls, job: Job) -> Pieces | None:
        """At the sharpest jolt of both videos; None where none may be a cut."""
        sharpest = [Steps.of(tracks).sharpest() for tracks in (job.a, job.b)]
        which = int(np.argmax([size for _, size in sharpest]))
        cut, size = sharpest[which]
        return None if size < CALM else cls(job, which, cut)

    @property
    def jobs(self) -> tuple[Job, Job]:
        """The work on the pair, with what lies before the cut, and with what lies behind it."""
        cut, a, b = self.cut, self.job.a, self.job.b
        spans = (-np.inf, cut), (cut, np.inf)
        if self.which == 0:
            before, behind = (dataclasses.replace(self.job, a=within(a, *span)) for span in spans)
        else:
            before, behind = (dataclasses.replace(self.job, b=within(b, *span)) for span in spans)
        return before, behind

    def joined(self, before: Answer, behind: Answer) -> Answer | None:
        """The better of the answers of both pieces, with both as its parts; None where one of them leaves a doubt."""
        told = before, behind
        if not all(a.finite and set(a.refined.flags) <= OF_PIECES for a in told):
            return None
        first, second = (a.refined.offset for a in told)
        if abs(second - first) < LEAST_JUMP:
            return None
        begin, turn = float(self.job.a.times[0]), self.cut if self.which == 0 else self.cut + first
        earliest, latest = (float(t) for t in self.job.b.times[[0, -1]])
        if self.which == 1 and latest - earliest < 2 * (first - second):
            # b goes back so far that a shows the later piece first
            first, second, turn = second, first, earliest + first
        parts = np.array([[begin, first], [turn, second]])
        best = max(told, key=evidence_of)
        matches = matches_of_parts(self.job, parts, 1.0)
        return dataclasses.replace(best, matches=matches, scanned=dataclasses.replace(best.scanned, parts=parts))
