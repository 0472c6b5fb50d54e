"""Sub-frame offsets in continuous time: ``refine(a, b, matches, alignment, refiner)``.

A refiner is an object in a slot: any callable ``refiner(a, b, matches, alignment) -> Alignment``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from ..clocks.common import nominal_fps, readable, strongest
from ..clocks.splines import SMOOTHING, TrackSplines
from ..costs.linear import binary_scale
from ..types import Alignment, Clock, Matches, Status, TrackSet, in_order
from ..types.checks import positive
from ..types.trust import Trust
from .common_error import common_error
from .common_motion import common_motion
from .gauss_newton import GROUPS, Fit, common_span, fit_clock, neighbours, overlap_seconds, velocity_correlation
from .seconds import Seconds
from .slot import JUDGED_BY, Rate, Refiner

LEAST_SIGMA = 0.008 / 30
"""Seconds; no sigma is reported below this."""

COMMON_ERRORS = 2.5
"""Seconds; blur²/COMMON_ERRORS joins sigma: errors that whole videos share (drifting depth, limbs, smoothing) grow with
the square of the noise, and neither residuals nor other windows show them. This and :data:`LEAST_SIGMA` were chosen on
mid, hard and brutal worlds of the seeds 72000 to 72039 and 75000 to 75039: 76, 68 and 71 % within one sigma."""

LONG = 180 / 30
"""Seconds of overlap from which a fitted rate may be kept: over less, one of 1 % moves the ends by less than a frame,
and what whole videos have in common (drifting depth, limbs) looks like one: real cameras, 3.3 s, "1.010 ± .0015". Over
less, too, sigma covers a rate that is surely real: of 2 % over 3 to 5 s, ends were off by 1.1 to 1.6 frames at sigma
.2, where the free rate was up to 8 of its sigmas off (96 worlds, seeds 41000-41015)."""

AT_ENDS = 0.1
"""Share of ``blur`` by which errors that a whole video shares move the offset of a moment by itself."""

LEAST_AT_ENDS = 0.012 / 30
"""Seconds, one sigma at least, of the same."""

FORGOTTEN = 1.2
"""Seconds within which such errors are forgotten: drifts of depth, one step of somebody who walks."""

LEAST_WANDER = 0.05 / 30
"""Seconds by which the parts of the overlap may differ, however well the tracks agree. In units of the limit that this
and :attr:`otsync.Trust.wander` make, 460 right answers (mid to brutal, few tracks, breaks; seeds 500-699) have .96 at
most; two takes of one choreography that were trusted 1.06 to 1.14."""

SHORT = 7.0
"""Times (FORGOTTEN / overlap)⁴ by which the scatter's variance grows: of an overlap that is not much longer than such
an error lasts the fit takes in much of it, and the rest is no measure. Forty clips of 2.5 s (75000 to 75019 and 79000
to 79019) had 51 and 79 % of their ends within one and two sigmas without it; over five seconds it is nothing."""

TWO_SECONDS = 2.0
"""Seconds of overlap below which there are no two whole ones that could differ: a part of one that does tells of noise.
Of a film of 1.6 s four of fifteen pairs were doubted, none of which was off by more than it said."""

LEAST_DRIFT = 0.1 / 30
"""Seconds by which a rate must move the ends of the overlap to be worth telling."""

UNSETTLED, UNSETTLED_SHORT = (1.0, 2.0), (2.5, 4.0)
"""Sigmas of a rate that is not kept, from which on it may be real, and from which on sigma covers it; and those of
overlaps shorter than :data:`LONG`, over which few rates are real, and right answers have up to 3.1 (180 hard ones,
seeds 500-599 and 41000-41079; one has 3.9). Rates of .1 % over 20 s, 2.4 to 3.2 sigma, were left out and the ends were
off by .3 frame at sigma .07."""

MOST_RATE = 0.03
"""Relative difference of rates beyond which a fit from one offset is not to be believed."""

DECLARED = 1e-4
"""Relative error of a frame rate that a file declares: what quartz clocks differ by."""

VELOCITY = 5 / 30
"""Half window, s, of the velocities whose correlation judges the fit."""


READS = (
    "moved",
    "spread",
    "correlation",
    "blur",
    "common",
    "wander",
    "unsteady",
    "astray",
    "untold",
    "parted",
    "overlap",
    "matches",
    "rate_sigmas",
)
"""The limits of :class:`otsync.Trust` that flags of the fit, and of its neighbourhoods, are raised by."""


@dataclass(frozen=True)
class SplineRefine(Refiner):
    """Offset of two sets of continuous curves by robust Gauss-Newton, with an honest sigma.

    Tracks become penalised cubic splines that never answer within a gap. The residual of a match is the difference of
    its two curves minus its mean over ±``windows[0]`` seconds, read at the frames of both videos, so that constant and
    slowly drifting errors drop out and exchanging a and b flips the sign to rounding. Samples and whole matches that
    fit badly lose weight; matches with a ``weight`` of their own begin with it. Sigma adds the scatter over
    neighbourhoods of matches or blocks of one second (wider where these are few), the ``spread`` of the answers with
    the other windows beyond what the noise of these explains (the largest difference, so its square counts half), and
    what blur predicts: errors of the model that no residual shows. It holds at both ends of the overlap: the
    uncertainty of the rate grows with the distance from the middle. What all seconds are off by beyond chance counts
    like errors in common, whichever is more; and each end holds what a parabola through the seconds shows there.

    Args:
        windows: half windows of detrending in seconds: the answer's, and those that it is compared with.
        smoothing: of the splines, see :class:`otsync.splines.TrackSplines`.
        rate: ``fit`` frees the rate and keeps it where it is significant and moves the ends of the overlap;
            ``fixed`` takes the clocks as declared, and such a rate raises RATE_MISMATCH.
        limit: of more matches only so many are used, the best by score.
        trust: limits behind the flags.
    """

    windows: tuple[float, ...] = (14 / 30, 10 / 30, 28 / 30)
    smoothing: float = SMOOTHING
    rate: Rate = "fit"
    limit: int = 500
    trust: Trust = field(default_factory=Trust)

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment) -> Alignment:
        if not math.isfinite(alignment.offset):
            return alignment
        matches = strongest(matches, readable(self.limit, a, b))
        curves = self.splines(a, b, matches)
        start = Clock(alignment.offset, alignment.rate)
        weight = None if matches.weight is None else matches.shares
        fit = fit_clock(*curves, start, self.windows[0], weight=weight)
        if fit is None:
            flags = in_order((*alignment.flags, Status.NO_OVERLAP))
            return replace(alignment, flags=flags)
        fit, free, rate_flag, rate_stats = self._rate(curves, fit, weight)
        overlap = overlap_seconds(*curves, fit.clock)
        others = [fit_clock(*curves, fit.clock, w, weight=weight, iterations=10) for w in self.windows[1:]]
        spread = max((self._apart(o, fit, curves) for o in others), default=0.0)
        model = max((self._beyond_noise(o, fit, curves) for o in others), default=0.0)
        fps = min(nominal_fps(a), nominal_fps(b))
        unseen = (fit.blur**2 / COMMON_ERRORS) ** 2
        shared = model / 2 + unseen + LEAST_SIGMA**2
        together = neighbours(curves[0].mean + curves[1].mean, GROUPS)
        common = common_error(*curves, fit.clock, fit.weights, together, self.windows[0])
        seconds = Seconds.of(*curves, fit.clock, self.windows[0], weight)
        floor = self._wanders(fit.blur)
        sway = seconds.sway(floor)
        fit = _of_short(fit, overlap)
        # three estimates of one thing: what tracks have in common makes seconds differ, too
        shared += max(0.0, max(common, sway) ** 2 - float(fit.unbiased[0, 0]))
        guessed = unseen + max(0.0, common**2 - float(fit.unbiased[0, 0]))
        long = overlap >= LONG - 1e-9
        unsettled = unsettled_rate(rate_stats, fit.clock.rate, UNSETTLED if long else UNSETTLED_SHORT)
        ends = self._ends(curves, fit, free, shared, unsettled, rate_stats.get("rate_sigma"))
        bend = seconds.bend(math.sqrt(unseen))
        drift = unsettled * overlap / 2  # which the ends hold already, and a parabola shows as well
        begin, end = (math.sqrt(max(0.0, bent**2 - drift**2)) for bent in bend)
        ends = math.hypot(ends[0], begin), math.hypot(ends[1], end)
        stats = (
            alignment.stats
            | rate_stats
            | {
                "matches": float(len(matches)),
                "effective_matches": min(fit.effective_matches, *(float(len(np.unique(c))) for c in matches.pairs.T)),
                "moved": self._moved(start, fit.clock, curves),
                "spread": spread,
                "blur": fit.blur,
                "common_motion": common_motion(*curves, fit.clock, fit.weights, self.windows[0]),
                "wander": fit.wander,
                "unsteady": seconds.unsteady(floor),
                "astray": seconds.astray(floor),
                "untold": seconds.untold(),
                "settled": float(fit.settled),
                "common_error": common,
                "tentative": min(1.0, guessed / max(ends) ** 2),
                "sway": sway,
                "bend": max(bend),
                "scatter": math.sqrt(max(float(fit.covariance[0, 0]), 0.0)),
                "correlation": velocity_correlation(*curves, fit, VELOCITY),
                "overlap": overlap,
                "iterations": float(fit.iterations),
                "sigma_begin": ends[0],
                "sigma_end": ends[1],
            }
        )
        flags = in_order((*alignment.flags, *self._flags(stats), *rate_flag))
        return replace(
            alignment,
            offset=fit.clock.offset,
            rate=fit.clock.rate,
            sigma=max(ends),
            fps=fps,
            flags=flags,
            stats=stats,
        )

    def __post_init__(self) -> None:
        if self.rate not in ("fixed", "fit"):
            raise ValueError(f"SplineRefine.rate: expected 'fixed' or 'fit'; found {self.rate!r}.")
        if not self.windows or not all(w > 0 for w in self.windows):
            raise ValueError(f"SplineRefine.windows: expected seconds above 0, at least one; found {self.windows}.")
        positive("SplineRefine.smoothing", self.smoothing, zero=True)
        positive("SplineRefine.limit", self.limit)
        self.trust.check("SplineRefine.trust", (*READS, *JUDGED_BY))

    def with_rate(self, rate: Rate) -> SplineRefine:
        return replace(self, rate=rate)

    def splines(self, a: TrackSet, b: TrackSet, matches: Matches) -> tuple[TrackSplines, TrackSplines]:
        """Curves of the matched tracks, in units of a power of two near their size; repeated tracks are fitted once."""
        sides = []
        for tracks, column in ((a, matches.pairs[:, 0]), (b, matches.pairs[:, 1])):
            used, index = np.unique(column, return_inverse=True)
            sides.append((tracks.times, tracks.positions(used), index))
        scale = max(binary_scale(x) for _, x, _ in sides)
        first, second = (
            TrackSplines(times, np.divide(x, scale, out=x), smoothing=self.smoothing).take(index)
            for times, x, index in sides
        )
        return first, second

    def _apart(self, other: Fit | None, fit: Fit, curves: tuple[TrackSplines, TrackSplines]) -> float:
        """Seconds between two answers; a window without an answer counts as a frame."""
        return curves[0].frame if other is None else abs(other.clock.offset - fit.clock.offset)

    def _moved(self, start: Clock, found: Clock, curves: tuple[TrackSplines, TrackSplines]) -> float:
        """Seconds between two clocks where they are nearest in the overlap.

        A scan at a wrong rate has its peak where any part of the overlap is right: at one end it is then far from what
        the fit says of the other.
        """
        begin, end = (found.world(t) - start.world(t) for t in common_span(*curves, found))
        return 0.0 if begin * end <= 0 else min(abs(begin), abs(end))

    def _beyond_noise(self, other: Fit | None, fit: Fit, curves: tuple[TrackSplines, TrackSplines]) -> float:
        """s², of how far two answers are apart, more than the noise of the one that knows less explains.

        An efficient answer has no error in common with its difference to another one, whose variance is then that of
        the other less its own (Hausman 1978).
        """
        explained = 0.0 if other is None else float(other.unbiased[0, 0] - fit.unbiased[0, 0])
        return max(0.0, self._apart(other, fit, curves) ** 2 - max(0.0, explained))

    def _rate(
        self, curves: tuple[TrackSplines, TrackSplines], fit: Fit, weight: Float[np.ndarray, " M"] | None
    ) -> tuple[Fit, Fit | None, tuple[Status, ...], dict[str, float]]:
        """The fit to keep, the one with a free rate, a warning where that one is right and not kept, and statistics."""
        overlap = overlap_seconds(*curves, fit.clock)
        free = fit_clock(*curves, fit.clock, self.windows[0], weight=weight, fit_rate=True)
        if free is None:
            return fit, None, (), {}
        common = (AT_ENDS * free.blur) ** 2 + LEAST_AT_ENDS**2
        # the slope of a line through errors of that size, which are forgotten within FORGOTTEN seconds
        sigma = math.sqrt(float(free.covariance[1, 1]) + 12 * common * FORGOTTEN / max(overlap, curves[0].frame) ** 3)
        stats = {"fitted_rate": free.clock.rate, "rate_sigma": sigma}
        off = abs(free.clock.rate - fit.clock.rate)
        if overlap < LONG - 1e-9:
            return fit, None, (), stats
        if off <= self.trust.rate_sigmas * sigma or off * overlap / 2 <= LEAST_DRIFT:
            return fit, free, (), stats
        if self.rate == "fixed" or abs(free.clock.rate - 1) > MOST_RATE:
            return fit, free, (Status.RATE_MISMATCH,), stats
        return free, free, (), stats

    def _ends(
        self,
        curves: tuple[TrackSplines, TrackSplines],
        fit: Fit,
        free: Fit | None,
        shared: float,
        unsettled: float,
        measured: float | None,
    ) -> tuple[float, float]:
        """One sigma at the beginning and at the end of the overlap.

        shared: variance of errors that both ends have; unsettled: what the rate may be off by; measured: one sigma of
        the rate where it was fitted.
        """
        begin, end = common_span(*curves, fit.clock)
        fitted = free is not None and (len(fit.covariance) > 1 or fit.clock.rate != 1.0)
        if fitted:
            assert free is not None
            # the ends hang on the outer seconds, whose errors are not independent: the cautious one
            C = free.covariance
            variance = [float(C[0, 0] + 2 * t * C[0, 1] + t * t * C[1, 1]) for t in (begin, end)]
        else:
            # a free fit that agrees with the declared rate knows it better over a long overlap
            known = DECLARED if measured is None else min(DECLARED, measured)
            drift = math.hypot(known, unsettled) * (end - begin) / 2
            variance = [float(fit.unbiased[0, 0]) + drift**2] * 2
        return math.sqrt(max(variance[0], 0) + shared), math.sqrt(max(variance[1], 0) + shared)

    def _wanders(self, blur: float) -> float:
        """Seconds by which single seconds of one clock may differ: what all tracks share moves them."""
        return self.trust.wander * blur + LEAST_WANDER

    def _flags(self, stats: dict[str, float]) -> tuple[Status, ...]:
        t = self.trust
        found = {
            Status.WEAK: stats["common_motion"] < t.common or stats["blur"] > t.blur or not stats["settled"],
            Status.MOVED: stats["moved"] > t.moved,
            Status.SPREAD: stats["spread"] > t.spread,
            Status.BROKEN_CLOCK: (
                stats["wander"] > self._wanders(stats["blur"]) and stats["overlap"] >= TWO_SECONDS - 1e-9
            )
            or stats["unsteady"] > t.unsteady
            or stats["astray"] > t.astray
            or stats["untold"] > t.untold,
            Status.SHORT_OVERLAP: stats["overlap"] < t.overlap - 1e-9,
            Status.FEW_MATCHES: stats["effective_matches"] < t.matches,
            Status.POOR_FIT: stats["correlation"] < t.correlation,
        }
        return tuple(flag for flag, raised in found.items() if raised)


def _of_short(fit: Fit, overlap: float) -> Fit:
    """See :data:`SHORT`."""
    grown = 1 + SHORT * (FORGOTTEN / max(overlap, 1e-9)) ** 4
    return replace(fit, unbiased=grown * fit.unbiased)


def unsettled_rate(stats: dict[str, float], kept: float, sigmas: tuple[float, float] = UNSETTLED) -> float:
    """By how much the rate that is kept may be off, where a free one differs from it by more than its noise.

    Args:
        sigmas: from which on it may, and from which on all of the difference counts.
    """
    if "rate_sigma" not in stats:
        return 0.0
    off = abs(stats["fitted_rate"] - kept)
    low, high = sigmas
    return off * float(np.clip((off / stats["rate_sigma"] - low) / (high - low), 0.0, 1.0))
