"""Likelihood scan: how well every whole-frame shift explains the matched motion, and which peaks compete."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ..clocks.common import SAMPLES, CommonClock, common_clock, readable, strongest
from ..clocks.splines import TrackSplines
from ..compute.indices import blocks, evenly
from ..costs.linear import binary_scale, velocity
from ..types import Alignment, Clock, Matches, Status, TrackSet, in_order
from ..types.checks import positive
from ..types.trust import Trust
from .breaks import find_breaks
from .peaks import separate_peaks, vertex
from .signal import Signal, extent_of
from .slot import Aligner
from .spectra import lag_statistics

MIN_OVERLAP = 24 / 30
"""Seconds that two videos must share for an offset to be considered."""

FAST, SLOW = 2 / 30, 5 / 30
"""Half windows, s, over which velocities are regressed: swift motion, and motion above the jitter of a tracker."""

BLOCK = 20 / 30
"""Half the length, s, of the windows in which positions are compared: drifts of depth are slower than that."""

MIN_FRAMES, MIN_WINDOW = 12 / 30, 10 / 30
"""Seconds that a match must be seen in both videos to say anything, altogether and within a window."""

APART = 4 / 30
"""Seconds between peaks that count as different hypotheses."""


COMMON_RATES = (4 / 5, 5 / 6, 24 / 25, 25 / 24, 6 / 5, 5 / 4)
"""Clock ratios of the frame rates 24, 25 and 30, by which a container's fps may be wrong."""

RATE_MATCHES = 40
"""Matches that other rates are tried with, at most; of long clips fewer, a quarter as many samples
as the answer is read from."""

FEWER = 0.25

DIRECT = 300_000_000
"""Matches times lags times common frames up to which sums are made one by one: about a second. Beyond, spectra tell
the velocities and whole positions, and windows are only looked at where they matter."""

CONTENDERS, BACKGROUND = 32, 64
"""Peaks of the velocities at which the windows of long clips are looked at, and lags spread evenly over all whose
median, by common frames, is what they have elsewhere."""


RETURNS_FROM, RETURN_SEEN, RETURN_SHARE = 0.5, 1.2, 0.25
"""Seconds later, at least, at which a video is compared with itself; seconds of it that must be compared, and which
share of the frames and of the samples that both videos share at the answer: ends that are alike, or a few tracks that
are seen again, say little of all the others."""

AGREEING = 0.5
"""What a match must have of the upper quartile's correlation at the answer to agree with it. Partners that are wrong
make two videos less alike; a video is like itself whatever its tracks are matched to."""

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


def may_be_another_time(returning: float, likeness: float, trust: Trust) -> bool:
    """Whether an answer may show what a video shows at another time too, for either is nearly as like itself then."""
    return returning > trust.returning * max(likeness, 0.0)


def returning(
    pair: CommonClock, answer: int, least: int, max_lag: float | None, weight: Float[np.ndarray, " M"]
) -> tuple[float, float]:
    """How like two videos are at a lag, and either to itself at another time, at most: nats a match and common sample.

    Of times only at which the other one, were this what it shows, would leave fewer than ``least`` frames in common: no
    peak is there to say so. Those beyond ``max_lag`` (s) are ruled out by the caller. A scene that returns tells
    nothing of a video that began when the other had ended. Both are read from the matches that agree with the answer;
    of long clips from a few of them.
    """
    some = np.flatnonzero(agreeing(pair, answer))
    longest = max(pair.a.shape[1], pair.b.shape[1])
    some = some[evenly(len(some), max(RATE_MATCHES, DIRECT // (4 * longest**2)))]
    pair, weight = replace(pair, a=pair.a[some], b=pair.b[some]), weight[some]
    common = int(pair.overlap(np.array([answer]))[0])
    if not len(some) or common < 1:
        return 0.0, 0.0
    here, told = (x[0] for x in by_sample(pair, np.array([answer]), weight))
    reach, again = pair.lags(least, None), 0.0
    seen = max(round(RETURN_SEEN * pair.fps), math.ceil(RETURN_SHARE * common))

    def unseen(lags: Int[np.ndarray, " K"]) -> Bool[np.ndarray, " K"]:
        allowed = True if max_lag is None else np.abs(pair.origin + lags / pair.fps) <= max_lag + 1e-9
        return allowed & ((lags > reach[-1]) | (lags < reach[0]))

    for x in (pair.a, pair.b):
        later = np.arange(round(RETURNS_FROM * pair.fps), x.shape[1] - seen + 1)
        later = later[unseen(answer + later) | unseen(answer - later)] if len(reach) else later[:0]
        if len(later):
            alike, samples = by_sample(replace(pair, a=x, b=x), later, weight)
            again = max(again, float(np.max(alike, where=samples >= RETURN_SHARE * told, initial=0.0)))
    return float(here), again


def agreeing(pair: CommonClock, answer: int) -> Bool[np.ndarray, " M"]:
    """The matches whose slow velocities correlate at a lag as those of matches that are right do."""
    half, least = max(1, round(SLOW * pair.fps)), max(1, round(MIN_FRAMES * pair.fps))
    count, power, residual = (x[:, 0] for x in statistics_by_part(pair, np.array([answer]), least, half))
    known = (count > 0) & (power > 0)
    if not known.any():
        return known
    correlation = np.where(known, 1 - residual / np.where(known, power, 1.0), -np.inf)
    return correlation >= AGREEING * max(float(np.quantile(correlation[known], 0.75)), 0.0)


def by_sample(
    pair: CommonClock, lags: Int[np.ndarray, " K"], weight: Float[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """The scan's score at every lag by what a match is seen of there, 0 where none is; and what it is seen of."""
    curves = evidence(pair, lags, weight / max(float(weight.mean()), 1e-12))
    told = np.isfinite(curves.total) & (curves.samples > 0)
    return np.where(told, curves.total, 0.0) / np.where(told, curves.samples, 1.0), curves.samples


@dataclass(frozen=True, eq=False)
class Curves:
    """Scores over K lags, nats a match (-inf where too little is in common), and what else they were made with.

    Args:
        total: what is maximised. slow: of ±5-frame velocities. windows: of windowed positions.
        observed: matches seen long enough at each lag. samples: common ones of a match there, on average by weight.
        motion: at each lag, the rms motion that both videos share, relative to the rms extent of the scene.
        floor: e² of the positions.
    """

    total: Float[np.ndarray, " K"]
    slow: Float[np.ndarray, " K"]
    windows: Float[np.ndarray, " K"]
    observed: Float[np.ndarray, " K"]
    samples: Float[np.ndarray, " K"]
    motion: Float[np.ndarray, " K"]
    floor: float = 0.0


def evidence(pair: CommonClock, lags: Int[np.ndarray, " K"], weight: Float[np.ndarray, " M"] | None = None) -> Curves:
    """The scan's score and its parts at ``lags``; ``weight``: of the matches, with mean 1."""
    weight = np.ones(len(pair.a)) if weight is None else weight

    def frames(seconds: float) -> int:
        return max(1, round(seconds * pair.fps))

    least = frames(MIN_FRAMES)
    count, power, residual = statistics_by_part(pair, lags, least)
    floor, extent = noise_floor(count, power, residual), 0.5 * (extent_of(pair.a) + extent_of(pair.b))
    observed = (count > 0).sum(0).astype(float)
    power -= residual
    power *= count
    samples = weight @ count / len(count)
    shared = 0.5 * power.sum(0) / np.maximum(count.sum(0), 1)
    del count, power, residual  # of long clips, hundreds of megabytes
    fast, slow = (velocity_score(pair, lags, frames(half), least, weight) for half in (FAST, SLOW))
    windows = np.where(observed > 0, window_score(pair, lags, fast + slow, floor, weight), -np.inf)
    return Curves(
        total=fast + slow + windows,
        slow=slow,
        windows=windows,
        observed=observed,
        samples=samples,
        motion=np.sqrt(np.maximum(shared, 0)) / extent if extent > 0 else np.zeros(len(lags)),
        floor=floor,
    )


def window_score(
    pair: CommonClock,
    lags: Int[np.ndarray, " K"],
    motion: Float[np.ndarray, " K"],
    floor: float,
    weight: Float[np.ndarray, " M"],
) -> Float[np.ndarray, " K"]:
    """Mean LLR of the positions in windows; of long clips that at the peaks of ``motion``, the score of velocities, and
    beside them what lags by chance have.
    """
    from . import kernels

    def frames(seconds: float) -> int:
        return max(1, round(seconds * pair.fps))

    def at(some: Int[np.ndarray, " L"]) -> Float[np.ndarray, " L"]:
        total, begin = np.zeros((1, len(some))), np.maximum(some, 0)  # treats a and b alike
        block, few = frames(BLOCK), frames(MIN_WINDOW)
        for part in blocks(len(pair.a), max(pair.a.shape[1], pair.b.shape[1])):  # of long clips few matches at a time
            a, b = Signal.of(pair.a[part]), Signal.of(pair.b[part])
            arrays = *a.for_kernels, *b.for_kernels, some, begin, block, few, floor, weight[part], total
            kernels.windowed_evidence(*arrays)
        return total[0] / len(pair.a)

    if direct(pair.a.shape[:2], pair.b.shape[1], lags):
        return at(lags)
    some, common = evenly(len(lags), BACKGROUND), pair.overlap(lags)
    score = common * float(np.median(at(lags[some]) / common[some]))
    tops = separate_peaks(motion, frames(APART), CONTENDERS)
    if not tops:  # no match is seen in both videos at any lag
        return score
    near = np.add.outer(tops, np.arange(-frames(APART), frames(APART) + 1)).ravel()
    some = np.unique(np.clip(near, 0, len(lags) - 1))
    score[some] = at(lags[some])
    return score


def statistics_by_part(
    pair: CommonClock, lags: Int[np.ndarray, " K"], least: int, half: int | None = None
) -> tuple[Float[np.ndarray, "M K"], Float[np.ndarray, "M K"], Float[np.ndarray, "M K"]]:
    """:func:`statistics` of the positions, or of the velocities over ±``half`` frames; of long clips few matches at a
    time are brought into the form that it reads.
    """
    count, power, residual = (np.zeros((len(pair.a), len(lags))) for _ in range(3))
    for some in blocks(len(pair.a), max(pair.a.shape[1], pair.b.shape[1])):
        a, b = (Signal.of(x[some] if half is None else velocity(x[some], half)) for x in (pair.a, pair.b))
        count[some], power[some], residual[some] = statistics(a, b, lags, least)
    return count, power, residual


def statistics(
    a: Signal, b: Signal, lags: Int[np.ndarray, " K"], least: int
) -> tuple[Float[np.ndarray, "M K"], Float[np.ndarray, "M K"], Float[np.ndarray, "M K"]]:
    """Frames in common, Var a + Var b and Var(a - b) of every match at every lag."""
    from . import kernels

    if not direct(a.arrays[1].shape, b.arrays[1].shape[1], lags):
        return lag_statistics(a, b, lags, least)
    out = tuple(np.zeros((len(a.arrays[0]), len(lags))) for _ in range(3))
    kernels.lag_statistics(*a.for_kernels, *b.for_kernels, lags, least, *out)
    return out  # type: ignore[return-value]


def direct(a: tuple[int, ...], Tb: int, lags: Int[np.ndarray, " K"]) -> bool:
    """Whether sums over the common frames of every match and lag are made one by one: see :data:`DIRECT`.

    Args:
        a: matches, and frames of the first video. Tb: frames of the second.
    """
    M, Ta = a
    common = np.minimum(Ta, Tb + lags) - np.maximum(0, lags)
    return M * float(np.maximum(common, 0).sum()) <= DIRECT


def noise_floor(count: np.ndarray, power: np.ndarray, residual: np.ndarray) -> float:
    """e²: a quarter of the typical match's least residual variance; above rounding of the signal's own variance."""
    known = (count > 0).any(1)
    if not known.any():
        return 1.0
    least = np.where(count > 0, residual, np.inf).min(1)[known]
    largest = power.max(1)[known]
    floor = max(0.25 * float(np.median(least)), 1e-12 * float(np.median(largest)), 1e-24 * float(largest.max()))
    return floor or 1.0


def velocity_score(
    pair: CommonClock,
    lags: Int[np.ndarray, " K"],
    half: int,
    least: int,
    weight: Float[np.ndarray, " M"] | None = None,
) -> Float[np.ndarray, " K"]:
    """Mean LLR of the velocities over ±``half`` frames, the matches counted by ``weight`` (mean 1)."""
    count, power, residual = statistics_by_part(pair, lags, least, half)
    floor = noise_floor(count, power, residual)
    # in place: of long clips these are the largest arrays
    power += floor
    residual += floor
    gain = np.divide(power, residual, out=power)
    np.log(gain, out=gain)
    gain *= count
    if weight is not None:
        gain *= weight[:, None]
    score = 0.5 * gain.sum(0) / len(pair.a)
    return np.where((count > 0).any(0), score, -np.inf)


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


def normalised(pair: CommonClock) -> tuple[CommonClock, float]:
    """The same in units of a power of two near its size, and that unit: squares neither overflow nor vanish."""
    scale = max(binary_scale(pair.a), binary_scale(pair.b))
    return replace(pair, a=pair.a / scale, b=pair.b / scale), scale
