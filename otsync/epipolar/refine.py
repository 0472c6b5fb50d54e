"""The depth-free offset below the frame: Gauss-Newton on epipolar residuals of continuous tracks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from ..clocks.common import nominal_fps
from ..refine.slot import JUDGED_BY, Refiner
from ..types import Alignment, Matches, Status, TrackSet, in_order
from ..types.trust import Trust
from .residuals import Residuals, broken
from .scan import EpipolarScan

SPREAD_ITERATIONS = 4
"""Steps of the fits with other windows: they start from the answer."""

UNKNOWN_SIGMA = 0.5
"""Sigma in frames where the fit left its start, so that the scan's whole-frame answer stands."""

COMMON_ERRORS = 0.33
"""Seconds; blur²/COMMON_ERRORS joins sigma, as that of positions does (:mod:`otsync.refine.splines`). Smooth bodies
that turn slide beneath their tracks: a sample tells the time to 1.9 frames, and offsets are .5 frame off; textured
balls, whose samples tell it to .27 frame, .03. What residuals have in common differs by less. Of 72 offsets of 18 films
(seeds 77000 to 77017) 67 and 94 % lie within one and two sigmas, 62 and 92 without it. Real people, whose samples tell
it to 1 to 2 frames, are off by .05; so how cycles close has the last word (:func:`otsync.sync.graph.judged_by_cycles`,
which ``tentative`` asks for)."""

ALONE = 1.6**0.5
"""Times sigma: what films are off by more than their pairs say, before any cycle is seen (seeds 77000 to 77017 and
79500 to 79517)."""

LEAST_SIGMA = 0.03
"""Frames added to sigma in squares: what is left on clean tracks, from splines and calibration."""

UNREAD = ("min_overlap", "max_lag", "weak", "ambiguous")
"""Parameters of the scan that its likelihoods do not depend on."""


@dataclass(frozen=True)
class EpipolarRefine(Refiner):
    """Continuous offset that flattens the epipolar residuals of the candidates which the scan's offset supports.

    Candidates are weighed at the start (their share of their track's mixture), then
    ``R = H [e(x_a(t), x_b(t - δ))]`` is minimised over δ by robust Gauss-Newton, H removing the mean over
    ±``windows[0]`` seconds: a candidate need not be the same physical point, it must only move like it. b's tracks are
    splines, never bridged over gaps.

    Args:
        windows: half windows of detrending, s: the answer's, and those whose answers tell its spread.
        scan: whose likelihoods weigh the candidates.
        reach: largest step from the start, s; beyond it the start stays, MOVED.
    """

    windows: tuple[float, ...] = (20 / 30, 10 / 30, 40 / 30)
    reach: float = 2 / 30
    iterations: int = 12
    scan: EpipolarScan = field(default_factory=EpipolarScan)
    trust: Trust = field(default_factory=lambda: Trust(evidence=1.0))

    needs_xyz = False

    def __post_init__(self) -> None:
        self.trust.check("EpipolarRefine.trust", JUDGED_BY)
        for name in UNREAD:
            if getattr(self.scan, name) != getattr(EpipolarScan, name):
                raise ValueError(
                    f"EpipolarRefine.scan.{name}: expected without it, since the fit reads only the scan's "
                    f"likelihoods; found {getattr(self.scan, name)}. Set it on the aligner."
                )

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment) -> Alignment:
        found, problem = self.placed(a, b, matches, alignment)
        if problem is None:
            return found
        rate, sigma = problem.rate(found.offset, self.windows[0], self.iterations)
        if not math.isfinite(sigma):
            return found
        return replace(found, stats=found.stats | {"fitted_rate": 1 + rate, "rate_sigma": sigma})

    def placed(
        self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment
    ) -> tuple[Alignment, Residuals | None]:
        """The answer without the rate that the pair would have, and what it was fitted to."""
        if not np.isfinite(alignment.offset) or len(matches) == 0:
            return alignment, None
        fps = min(nominal_fps(a), nominal_fps(b))
        problem = self.scan.residuals(a, b, matches, alignment.offset, fps)
        if problem is None:
            flags = in_order((*alignment.flags, Status.NO_OVERLAP))
            return replace(alignment, flags=flags), None
        offset, found = problem.solve(alignment.offset, self.windows[0], self.iterations, self.reach)
        common = problem.common_error(found, self.windows[0])
        others = [
            problem.solve(offset, w, SPREAD_ITERATIONS, self.reach)[0] for w in self.windows[1:] if np.isfinite(offset)
        ]
        spread = max((abs(o - offset) for o in others if np.isfinite(o)), default=0.0)
        wander, blur = problem.wander(found)
        sigma = ALONE * math.hypot(max(problem.scatter(found), common), spread, blur**2 / COMMON_ERRORS)
        raised = list(alignment.flags)
        if not np.isfinite(offset) or abs(offset - alignment.offset) > self.reach:
            offset, sigma = alignment.offset, UNKNOWN_SIGMA / fps
            raised.append(Status.MOVED)
        if broken(wander, blur):
            raised.append(Status.BROKEN_CLOCK)
        stats = alignment.stats | {
            "moved": abs(offset - alignment.offset),
            "spread": spread,
            "common_error": ALONE * common,
            "tentative": 1.0,
            "wander": wander,
            "blur": blur,
            "fitted_matches": float(len(problem.weight)),
        }
        ordered = in_order(raised)
        sigma = float(np.hypot(sigma, LEAST_SIGMA / fps))
        return replace(alignment, offset=float(offset), sigma=sigma, flags=ordered, stats=stats), problem
