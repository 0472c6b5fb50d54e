"""The offset of a pair without depth: epipolar residuals of 2-D tracks over every lag, for the ``aligner`` slot.

If track j of b shows the same point as track i of a, the signed Sampson residual e(t, k) of x_i(t) and x_j(t - k) to
the pair's epipolar geometry is zero at the true lag k, whatever the depth. If j shows another point of the same
moving thing, e is not zero but nearly constant over a second: its variance drops all the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ..align.evidence import APART
from ..align.likelihood import MIN_OVERLAP
from ..align.peaks import peak, separate_peaks
from ..align.slot import Aligner
from ..clocks.common import nominal_fps, on_clock
from ..compute.indices import lives
from ..geometry import seen_pixels
from ..types import Alignment, Matches, Status, TrackSet, in_order
from .poses import Lines, Views
from .residuals import APART_BY, MAD, Residuals, broken

MIXTURE_CAP = 80.0
"""Nats that one candidate counts at most: beyond them the exponential says nothing more, and could overflow."""

FLOOR = -1.0
"""Nats of the outlier, the candidate that every track has besides its own: none of them can veto an offset."""

TRACK_CAP = 32.0
"""Nats towards which a track's evidence levels off: none carries an offset alone."""

INDEPENDENT = 8
"""Samples of a smooth track at 30 fps that count as one: neighbours tell the same."""

MIN_WINDOW = 12 / 30
"""Seconds within a window that a candidate must be seen in both videos for the window to count."""

LEAST_SAMPLES = 3
"""Samples that a variance needs, however few frames a second there are."""

PEAKS = 8
"""Peaks that are kept as hypotheses."""

SIGMA, LEAST_MARGIN = 0.15, 0.03
"""Sigma in frames of a peak without rivals; it grows with the inverse of the margin, down to the least one."""

LEAST_LEAD = 0.8
"""Robust deviations of the curve by which the first peak must lead: a low peak needs a clear margin. Only wrong
matches: .5; right answers with 80 % wrong matches 1.3, on basketball from 1.1 on (14 pairs)."""

LEAST_TRACKS, LEAST_OVERLAP = 5, 40 / 30
"""Tracks, and seconds in common, below which an answer is flagged: the limits of :class:`otsync.Trust`."""

DETREND, STEPS = 20 / 30, 3
"""Half the window, s, and Gauss-Newton steps, by which the seconds of an answer are asked for offsets of their own."""


@dataclass(frozen=True)
class EpipolarScan(Aligner):
    """Evidence of every lag from ``uv`` and the calibration alone.

    Per candidate pair and lag: -n/16 [log(1 + V/s²) - median over lags], n samples (at least ``min_seen``), summed
    for V the residual's variance in windows (``motion``) and its raw mean square (``position``). Removing the level
    per sample is what denies a short overlap any reward. Per track the candidates form a mixture with an outlier
    floor, capped: one wrong candidate can neither veto nor carry an offset. A sum over candidates without the mixture
    fails (55 % > 2 frames); motion alone 18 %, position alone 39 %. Motion and position must be those of one
    candidate: with a mixture for each, 8 of 630 pairs (fresh seeds) were off by more than 2 frames, with one for both
    2.

    A single pair cannot be certified (an alias of 65 frames kept a high margin): solve the graph of all pairs. Where
    the seconds of the overlap say different offsets, as of motion that comes back nearly alike, it is BROKEN_CLOCK.

    Args:
        window: seconds. motion_scale, position_scale: s in pixels at 640 of width.
        min_overlap, max_lag: seconds, as in :class:`otsync.ConstantShift`.
        min_seen: seconds that a candidate must be seen in both videos to say anything.
        weak, ambiguous: flags: rise of the peak over the median in (robust) deviations of the curve; its lead over the
            second peak as a share of the rise. They flag 1.6 % of the pairs of basketball (fresh seed).
    """

    window: float = 50 / 30
    motion_scale: float = 2.0
    position_scale: float = 6.0
    min_overlap: float = MIN_OVERLAP
    min_seen: float = 12 / 30
    max_lag: float | None = None
    weak: float = 1.2
    ambiguous: float = 0.2

    needs_xyz = False
    flags_itself = True

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches) -> Alignment:
        for name, tracks in (("a", a), ("b", b)):
            if tracks.uv is None or tracks.camera is None:
                raise ValueError(f"{name}: expected pixels (uv) and a camera for the epipolar scan; one is missing.")
        assert a.camera is not None and b.camera is not None
        fps = min(nominal_fps(a), nominal_fps(b))
        xa, xb = (on_clock(tracks, seen_pixels(tracks), fps) for tracks in (a, b))
        origin = float(a.times[0] - b.times[0])
        least = max(2, round(self.min_overlap * fps))
        lags = np.arange(-(xb.shape[1] - least), xa.shape[1] - least + 1)
        lags = lags[np.minimum(xa.shape[1], xb.shape[1] + lags) - np.maximum(0, lags) >= least]
        if self.max_lag is not None:
            lags = lags[np.abs(origin + lags / fps) <= self.max_lag + 1e-9]
        if len(matches) == 0 or len(lags) == 0:
            return _nothing(fps, Status.FEW_MATCHES if len(matches) == 0 else Status.NO_OVERLAP)
        total = self.evidence(xa, xb, Views.of(a, b, fps), matches.pairs, lags, fps, unit_of(a, b), matches.weight)
        if np.ptp(total) == 0:
            return _nothing(fps, Status.NO_OVERLAP)
        overlap = np.minimum(xa.shape[1], xb.shape[1] + lags) - np.maximum(0, lags)
        found = self._answer(lags, total, overlap / fps, origin, fps, matches)
        residuals = self.residuals(a, b, matches, found.offset, fps)
        if residuals is None:
            return found
        _, last = residuals.solve(found.offset, DETREND, STEPS, 1 / fps)
        flags = (Status.BROKEN_CLOCK,) if broken(*residuals.wander(last)) else ()
        return replace(found, flags=in_order((*found.flags, *flags)))

    def residuals(self, a: TrackSet, b: TrackSet, matches: Matches, offset: float, fps: float) -> Residuals | None:
        """Of the matches that have most of their tracks' evidence at ``offset``, s; None where there are too few."""
        xa, xb = (on_clock(tracks, seen_pixels(tracks), fps) for tracks in (a, b))
        views = Views.of(a, b, fps)
        lag = round((offset - float(a.times[0] - b.times[0])) * fps)
        share = self.support(xa, xb, views, matches.pairs, lag, fps, unit_of(a, b))
        return Residuals.of(a, b, xa, Lines.of(a, b, fps), matches.pairs, share, fps)

    def evidence(
        self,
        xa: Float[np.ndarray, "Na Ta 2"],
        xb: Float[np.ndarray, "Nb Tb 2"],
        views: Views,
        pairs: Int[np.ndarray, "M 2"],
        lags: Int[np.ndarray, " K"],
        fps: float,
        unit: float,
        weight: Float[np.ndarray, " M"] | None = None,
    ) -> Float[np.ndarray, " K"]:
        """Summed evidence per lag, in nats; mean over the mixtures of a's and of b's tracks."""
        told = self.scores(xa, xb, views, pairs, lags, fps, unit)
        if not np.isfinite(told.mean).any():
            return np.zeros(len(lags))
        both = np.full((len(pairs), len(lags)), -np.inf)
        both[told.candidate, told.lag] = told.nats.sum(0)
        return 0.5 * (mixture(both, pairs[:, 0], weight) + mixture(both, pairs[:, 1], weight))

    def scores(
        self,
        xa: np.ndarray,
        xb: np.ndarray,
        views: Views,
        pairs: np.ndarray,
        lags: np.ndarray,
        fps: float,
        unit: float,
    ) -> Told:
        """Log-likelihood of candidates at the lags at which their tracks live, against the typical one: by motion and
        by position, -inf where too little is seen; 0 of a kind that is known nowhere.
        """
        least, window = max(2, round(self.min_seen * fps)), max(4, round(self.window * fps))
        told = residuals_by_lag(xa, xb, views, pairs, lags, least, window, max(LEAST_SAMPLES, round(MIN_WINDOW * fps)))
        mean, count, nats = told.mean, told.count, np.full(told.mean.shape, -np.inf)
        for kind, scale in enumerate((self.motion_scale, self.position_scale)):
            known = np.isfinite(mean[kind])
            if known.any():
                level = np.log1p(mean[kind, known] / (scale * unit) ** 2)
                weight = count[kind, known] / (2 * INDEPENDENT) * (30 / fps)
                nats[kind, known] = -weight * (level - np.median(level))
            else:
                nats[kind] = 0.0  # the other kind alone is asked
        return replace(told, nats=nats)

    def support(
        self, xa: np.ndarray, xb: np.ndarray, views: Views, pairs: np.ndarray, lag: int, fps: float, unit: float
    ) -> Float[np.ndarray, " M"]:
        """Each candidate's share of its tracks' mixtures at ``lag``, the outlier included; in [0, 1]."""
        told = self.scores(xa, xb, views, pairs, np.arange(lag - 1, lag + 2), fps, unit)
        share = np.zeros(len(pairs))
        if not np.isfinite(told.mean).any():
            return share
        best = np.full((2, len(pairs)), -np.inf)
        for kind in (0, 1):
            np.maximum.at(best[kind], told.candidate, told.nats[kind])
        likelihood = np.exp(np.minimum(best.sum(0), MIXTURE_CAP))
        for side in (0, 1):
            total = np.bincount(pairs[:, side], likelihood)[pairs[:, side]]
            share += 0.5 * likelihood / (total + 1.0)
        return share

    def _answer(
        self, lags: np.ndarray, total: np.ndarray, overlap: np.ndarray, origin: float, fps: float, matches: Matches
    ) -> Alignment:
        lag = peak(lags, total)
        best = int(np.argmax(total))
        level = float(np.median(total))
        spread = MAD * float(np.median(np.abs(total - level))) + 1e-12
        peaks = separate_peaks(total, max(2, round(APART * fps)), PEAKS)
        strength = float(total[best] - level)
        margin = 1.0 if len(peaks) < 2 else float((total[peaks[0]] - total[peaks[1]]) / max(strength, 1e-12))
        flags = []
        if strength < self.weak * spread or total[best] <= 0:
            # every right answer on basketball and the mouse had a positive peak: below 0 outliers explain it better
            flags.append(Status.WEAK)
        if margin < self.ambiguous or margin * strength < LEAST_LEAD * spread:
            flags.append(Status.AMBIGUOUS)
        tracks = min(len(np.unique(column)) for column in matches.pairs.T)
        if tracks < LEAST_TRACKS:
            flags.append(Status.FEW_MATCHES)
        if overlap[best] < LEAST_OVERLAP - 1e-9:
            flags.append(Status.SHORT_OVERLAP)
        if best in (0, len(lags) - 1):
            flags.append(Status.BORDER)
        flags = list(in_order(flags))
        curve = np.stack([origin + lags / fps, total], 1)
        hypotheses = curve[peaks].copy()
        hypotheses[0, 0] = origin + lag / fps
        return Alignment(
            origin + lag / fps,
            sigma=SIGMA / max(margin, LEAST_MARGIN) / fps,
            hypotheses=hypotheses,
            curve=curve,
            fps=fps,
            flags=tuple(flags),
            stats={
                "matches": float(len(matches)),
                "overlap": float(overlap[best]),
                "evidence": strength / spread,
                "margin": margin,
            },
        )


@dataclass(frozen=True, eq=False)
class Told:
    """What candidates say at the lags at which both of their tracks live: one entry each.

    Args:
        candidate, lag: (E,) indices. mean: (2,E) square pixels, of residuals without the mean of each window, and of
            the residuals themselves; nan where too few. count: (2,E) samples behind them. nats: (2,E).
    """

    candidate: Int[np.ndarray, " E"]
    lag: Int[np.ndarray, " E"]
    mean: Float[np.ndarray, "2 E"]
    count: Float[np.ndarray, "2 E"]
    nats: Float[np.ndarray, "2 E"]


def residuals_by_lag(
    xa: Float[np.ndarray, "Na Ta 2"],
    xb: Float[np.ndarray, "Nb Tb 2"],
    views: Views,
    pairs: Int[np.ndarray, "M 2"],
    lags: Int[np.ndarray, " K"],
    least: int,
    window: int,
    least_in_window: int,
) -> Told:
    """Mean square epipolar residuals of candidates at every lag; ``nats`` are nan still.

    Work and memory grow with how long tracks live, not with the clip.

    Args:
        lags: frames, one after the other. least: samples that tell anything. window: frames. least_in_window: samples.
    """
    from .kernels import epipolar_evidence

    lives_a, lives_b = (lives(np.isfinite(x[..., 0])) for x in (xa, xb))
    (begin_a, end_a), (begin_b, end_b) = lives_a[pairs[:, 0]].T, lives_b[pairs[:, 1]].T
    low = np.maximum(lags[0], begin_a + least - end_b)
    high = np.minimum(lags[-1], end_a - least - begin_b)
    long = np.minimum(end_a - begin_a, end_b - begin_b) >= least
    many = np.where(long, np.maximum(0, high - low + 1), 0)
    edge = np.concatenate([[0], np.cumsum(many)])
    mean, count = np.full((2, edge[-1]), np.nan), np.zeros((2, edge[-1]))
    still = len(views.a.back) == len(views.b.back) == 1
    F = views.F(0, 0) if still else np.zeros((3, 3))
    arrays = np.ascontiguousarray(xa), np.ascontiguousarray(xb), F, views.a.arrays, views.b.arrays, views.turn
    limits = (least, least_in_window), window, APART_BY**-2
    epipolar_evidence(*arrays, pairs, lives_a, lives_b, low, edge, still, *limits, mean, count)
    candidate = np.repeat(np.arange(len(pairs)), many)
    lag = np.arange(edge[-1]) - edge[candidate] + low[candidate] - lags[0]
    return Told(candidate, lag, mean, count, np.full(mean.shape, np.nan))


def mixture(
    score: Float[np.ndarray, "M K"], track: Int[np.ndarray, " M"], prior: Float[np.ndarray, " M"] | None = None
) -> Float[np.ndarray, " K"]:
    """Σ over tracks of the log-mean-exp over its candidates, from the floor up, levelling off towards the cap.

    ``prior``: what a candidate counts beside the others of its track, in any unit; None: all alike.

    A hard cap makes plateaus of neighbouring lags where tracks live long; at 8 nats they hid one answer in ten.
    """
    order = np.argsort(track, kind="stable")
    edges = np.flatnonzero(np.diff(track[order], prepend=-1))
    weight = np.exp(np.minimum(score[order], MIXTURE_CAP))
    counts = np.diff(np.append(edges, len(order)))[:, None].astype(float)
    if prior is not None:
        weight *= prior[order, None]
        counts = np.maximum(np.add.reduceat(prior[order], edges), np.finfo(float).tiny)[:, None]
    sums = np.add.reduceat(weight, edges, axis=0)
    nats = np.log(sums / counts + np.exp(FLOOR))
    return np.where(nats > 0, -TRACK_CAP * np.expm1(-np.maximum(nats, 0) / TRACK_CAP), nats).sum(0)


def unit_of(a: TrackSet, b: TrackSet) -> float:
    """Factor for pixel constants, which are given at 640 pixels of width."""
    assert a.camera is not None and b.camera is not None
    return 0.5 * (a.camera.width + b.camera.width) / 640


def _nothing(fps: float, flag: Status) -> Alignment:
    return Alignment(float("nan"), fps=fps, flags=(flag,), stats={"matches": 0.0})
