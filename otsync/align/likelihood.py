"""Likelihood scan: how well every whole-frame shift explains the matched motion, and which peaks compete."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import SAMPLES, CommonClock, common_clock, readable, strongest
from ..clocks.splines import TrackSplines
from ..types import Alignment, Clock, Matches, Status, TrackSet, in_order
from ..types.checks import positive
from ..types.trust import Trust
from .another_time import may_be_another_time, returning
from .breaks import find_breaks
from .evidence import APART, MIN_FRAMES, SLOW, Curves, evidence, normalised, velocity_score
from .peaks import separate_peaks, vertex
from .slot import Aligner

MIN_OVERLAP = 24 / 30
"""Seconds that two videos must share for an offset to be considered."""

COMMON_RATES = (4 / 5, 5 / 6, 24 / 25, 25 / 24, 6 / 5, 5 / 4)
"""Clock ratios of the frame rates 24, 25 and 30, by which a container's fps may be wrong."""

RATE_MATCHES = 40
"""Matches that other rates are tried with, at most; of long clips fewer, a quarter as many samples
as the answer is read from."""

FEWER = 0.25

READS = ("evidence", "margin", "returning", "disagreement", "alias", "overlap", "matches", "motion", "rate_gain")
"""The limits of :class:`otsync.Trust` that the scan's flags are raised by."""


@dataclass(frozen=True)
class LikelihoodScan(Aligner):
    """Log-likelihood ratio of "these two tracks show the same motion" against "unrelated", at every shift.

    For match m, shift k and a signal of a and b over the n frames that both see (the mean over them removed)::

        LLR = n/2 log((Var a + Var b + e²) / (Var(a - b) + e²)),   e = ½ sqrt(median_m min_k Var(a - b))

    summed over velocities of ±2 and ±5 frames and, with weight ½, positions in windows of 40 frames, averaged over the
    matches (by their ``weight``, where they have one). The logarithm lets a wrong match add about nothing instead of a
    veto; the factor n gives no reward for a tiny overlap; a point at rest adds nothing; e makes the noise scale
    automatic, so no unit enters. Constant errors (depth bias, another surface point) drop out of velocities and of
    demeaned windows.

    Args:
        max_lag: largest |offset| in seconds; None: whatever leaves ``min_overlap`` seconds in common.
        min_overlap: seconds.
        peaks: how many competing offsets to keep as ``hypotheses``.
        limit: of more matches only so many are read, the best by score; time is proportional to them.
        trust: limits behind the flags.
    """

    max_lag: float | None = None
    min_overlap: float = MIN_OVERLAP
    peaks: int = 5
    limit: int = 500
    trust: Trust = field(default_factory=Trust)

    flags_itself = True

    def __post_init__(self) -> None:
        if self.max_lag is not None:
            positive("LikelihoodScan.max_lag", self.max_lag, zero=True)
        for name in ("min_overlap", "peaks", "limit"):
            positive(f"LikelihoodScan.{name}", getattr(self, name))
        self.trust.check("LikelihoodScan.trust", READS)

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches) -> Alignment:
        matches = strongest(matches, readable(self.limit, a, b))
        pair, scale = normalised(common_clock(a, b, matches))
        lags = pair.lags(self._least(pair), self.max_lag)
        if len(matches) == 0 or len(lags) == 0:
            return unanswered(pair, matches)
        curves = evidence(pair, lags, matches.shares)
        score = curves.total
        if not np.isfinite(score).any():
            return unanswered(pair, matches)
        tops = separate_peaks(score, round(APART * pair.fps), self.peaks, prefer=np.abs(lags))
        offset = float(pair.seconds(vertex(lags, score, tops[0])))
        stats = self._stats(pair, lags, curves, tops) | {"matches": float(len(matches))}
        stats |= self._another_time(pair, int(lags[tops[0]]), matches.shares)
        stats["other_rate"], stats["other_rate_gain"] = other_rate(a, b, pair, matches, scale, self.max_lag)
        flags = self._flags(stats)
        rivals = stats["margin"] < self.trust.margin
        found = find_breaks(pair, lags, score, curves.floor, matches.shares, ambiguous=rivals)
        parts, stats["parts_gain"], stats["returns"] = found.parts, found.gain, float(found.returns)
        flags = (*flags, *((Status.BROKEN_CLOCK,) if len(parts) or found.doubtful else ()))
        return Alignment(
            offset,
            hypotheses=np.array([[pair.seconds(vertex(lags, score, i)), score[i]] for i in tops]),
            curve=np.stack([pair.origin + lags / pair.fps, score], 1),
            fps=pair.fps,
            flags=flags,
            stats=stats,
            parts=parts,
        )

    def another_time(self, a: TrackSet, b: TrackSet, matches: Matches, clock: Clock) -> dict[str, float]:
        """How like the videos are at an answer, and either to itself where no lag could show the rival.

        Returns:
            likeness, returning: nats a match and common sample, at the answer and at another time (see
            :func:`returning`). another_time: 1 where it may be another time's, by the limit of ``trust``.
        """
        matches = strongest(matches, readable(self.limit, a, b))
        pair, _ = normalised(common_clock(a, b, matches))
        begin, end = clock.world(b.times[[0, -1]])
        middle = (max(float(a.times[0]), float(begin)) + min(float(a.times[-1]), float(end))) / 2
        late = middle - (middle - clock.offset) / clock.rate  # of b there, by which a lag is counted
        return self._another_time(pair, round((late - pair.origin) * pair.fps), matches.shares)

    def _another_time(self, pair: CommonClock, answer: int, weight: Float[np.ndarray, " M"]) -> dict[str, float]:
        alike, again = returning(pair, answer, self._least(pair), self.max_lag, weight)
        return {
            "likeness": alike,
            "returning": again,
            "another_time": float(may_be_another_time(again, alike, self.trust)),
        }

    def _least(self, pair: CommonClock) -> int:
        """Frames that two videos must share."""
        return max(1, round(self.min_overlap * pair.fps))

    def _stats(
        self, pair: CommonClock, lags: Int[np.ndarray, " K"], curves: Curves, tops: list[int]
    ) -> dict[str, float]:
        """What the flags are decided by, kept for reports."""
        score, best = curves.total, tops[0]
        finite = np.flatnonzero(np.isfinite(score))
        base = float(np.median(score[finite]))
        rise = float(score[best] - base)
        overlap = pair.overlap(lags)
        # per common frame as well: a period later, exact repetition has the same rate of evidence over fewer frames
        rivals = [max(r, r * overlap[best] / overlap[i]) for i in tops[1:] if (r := float(score[i] - base)) > 0]
        second = max(rivals, default=0.0)
        others = [int(np.argmax(c)) for c in (curves.slow, curves.windows)]
        rate = np.where(np.isfinite(score), (score - min(base, 0.0)) / overlap, -np.inf)
        return {
            "evidence": rise,
            "margin": (rise - second) / rise if rise > 0 else 0.0,
            "disagreement": max(abs(int(lags[i] - lags[best])) for i in others) / pair.fps,
            "alias": abs(int(lags[int(np.argmax(rate))] - lags[best])) / pair.fps,
            "overlap": float(overlap[best]) / pair.fps,
            "observed_matches": float(curves.observed[best]),
            "motion": curves.motion[best],
            "border": float(best - finite[0] <= 1 or finite[-1] - best <= 1),
        }

    def _flags(self, stats: dict[str, float]) -> tuple[Status, ...]:
        t = self.trust
        found = {
            Status.WEAK: stats["evidence"] < t.evidence,
            Status.AMBIGUOUS: stats["margin"] < t.margin or stats["another_time"] > 0,
            Status.DISAGREE: stats["disagreement"] > t.disagreement + 1e-9,
            Status.ALIAS: stats["alias"] > t.alias + 1e-9,
            Status.SHORT_OVERLAP: stats["overlap"] < t.overlap - 1e-9,
            Status.FEW_MATCHES: stats["observed_matches"] < t.matches,
            Status.STATIC: stats["motion"] < t.motion,
            Status.BORDER: stats["border"] > 0,
            Status.RATE_MISMATCH: stats["other_rate_gain"] > t.rate_gain,
        }
        return in_order(flag for flag, raised in found.items() if raised)


def other_rate(
    a: TrackSet, b: TrackSet, pair: CommonClock, matches: Matches, scale: float, max_lag: float | None
) -> tuple[float, float]:
    """Which of :data:`COMMON_RATES` suits the slow velocities best, and how many times better than the declared clocks.

    A warning, not an answer: read from a few dozen matches only, as every pair pays for it.
    """
    many = readable(RATE_MATCHES, a, b, FEWER * SAMPLES)
    some = np.unique(np.linspace(0, len(matches) - 1, many).astype(int))
    half, least = max(1, round(SLOW * pair.fps)), max(1, round(MIN_FRAMES * pair.fps))

    def rise(p: CommonClock) -> float:
        k = p.lags(max(1, round(MIN_OVERLAP * pair.fps)), max_lag)
        if not len(k):
            return 0.0
        score = velocity_score(p, k, half, least)
        finite = score[np.isfinite(score)]
        return float(finite.max() - np.median(finite)) if len(finite) else 0.0

    declared = CommonClock(pair.a[some], pair.b[some], pair.fps, pair.origin)
    curves = TrackSplines(b.times, b.take(matches.pairs[some, 1]).positions() / scale)
    rises = {}
    for rate in COMMON_RATES:
        n = int(np.floor((b.times[-1] - b.times[0]) * rate * pair.fps + 1e-6)) + 1
        t = b.times[0] + np.arange(n) / (rate * pair.fps)
        other = CommonClock(declared.a, curves.sample(t), pair.fps, float(a.times[0] - rate * b.times[0]))
        rises[rate] = rise(other)
    best = max(rises, key=rises.__getitem__)
    now = rise(declared)
    return best, rises[best] / now if now > 0 else 0.0


def unanswered(
    pair: CommonClock, matches: Matches, cost: np.ndarray | None = None, why: Status = Status.NO_OVERLAP
) -> Alignment:
    """The answer when no lag leaves matched samples to compare, or they tell nothing."""
    flags = (Status.FEW_MATCHES if len(matches) == 0 else why,)
    stats = {"matches": float(len(matches))}
    return Alignment(float("nan"), cost=cost, fps=pair.fps, flags=flags, stats=stats)
