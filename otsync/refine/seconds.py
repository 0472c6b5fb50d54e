"""Every second of an overlap answers for itself: what each says the offset is, and whether one clock explains them all.

A fit of the whole overlap gives samples that disagree less weight, whole seconds of them too: where a clock wanders, or
where there is no common time at all, it settles on the part that agrees most, and says that it fits well. A fit of one
second alone goes where that second leads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..clocks.splines import TrackSplines
from ..compute.indices import evenly
from ..types import Clock
from .gauss_newton import fit_clock

LENGTH, STEP = 1.0, 0.5
"""Seconds of a part, and between the beginnings of two."""

MOST = 40
"""Parts that are asked, at most; of long overlaps they are spread evenly."""

LEAST = 3
"""Parts that tell whether a clock runs evenly, at least."""

MOVES, UNUSUAL = 0.05, 3.0
"""Share of what usually moves that must move in a second which is to tell the time; and times the usual sigma of single
seconds that its sigma must have to be unusual."""

WITNESSES = 1.5
"""Neighbourhoods of matches, of equal information, that a second must have to tell the time. One by itself agrees with
itself: of few tracks such seconds are off by 5.6 of their sigmas, rms (12 worlds, seeds 41000-41011), those with more
by up to 3.6; in two takes, slow motion, freezes and films played backwards there is none."""

WILD = 3.0
"""Times as many sigmas as is usual among the seconds that one of them counts as off by at most, where all are asked for
their scatter."""

BY_CHANCE = 1 + math.sqrt(2)
"""Variances of a parabola that chance may make of an even clock: one and its standard error."""

PARABOLA, LEAST_OFF = 5, 0.03 / 30
"""Parts that tell a parabola, at least; and seconds by which a part may be off, whatever its sigma says."""

FURTHER = 8.0
"""Times further that errors in common move one part than the whole. At 3 hard worlds that are right look bent in two of
15, at 8 in none, and of clocks that bend sigma holds the same 6 of 10 ends within two sigmas (seeds 81020-81039)."""

ITERATIONS = 12


@dataclass(frozen=True, eq=False)
class Seconds:
    """What short parts of an overlap say.

    Args:
        at: (K,) their middles, s on a's clock. late: (K,) by how much larger than the answer's the offset of each is,
            s; nan where a part cannot tell. sigma: (K,) of that, jackknifed within the part. moving: (K,) how much
            moves there, in any unit.
    """

    at: Float[np.ndarray, " K"]
    late: Float[np.ndarray, " K"]
    sigma: Float[np.ndarray, " K"]
    moving: Float[np.ndarray, " K"]

    @classmethod
    def of(
        cls,
        a: TrackSplines,
        b: TrackSplines,
        clock: Clock,
        window: float,
        weight: Float[np.ndarray, " M"] | None = None,
    ) -> Seconds:
        """Of the answer ``clock``, with the fit's detrending ``window`` and ``weight`` of the matches."""
        ends = clock.world(b.times[[0, -1]])
        begin, end = max(float(a.times[0]), float(ends[0])), min(float(a.times[-1]), float(ends[1]))
        count = max(1, math.ceil((end - begin - LENGTH) / STEP) + 1)  # both ends are looked at
        first = np.linspace(begin, max(begin, end - LENGTH), count)[evenly(count, MOST)]
        told = np.full((3, len(first)), np.nan)
        for k, t in enumerate(first.tolist()):
            span = t, t + LENGTH
            fit = fit_clock(a, b, clock, window, weight=weight, iterations=ITERATIONS, span=span)
            if fit is not None and fit.witnesses >= WITNESSES:
                scatter = math.sqrt(max(float(fit.covariance[0, 0]), 0.0))
                told[:, k] = fit.clock.offset - clock.offset, scatter, fit.information
        return cls(first + LENGTH / 2, *told)

    def unsteady(self, floor: float) -> float:
        """Root mean square of what the parts are off by, each in units of how well it is known; 0 where few can tell.

        Args:
            floor: seconds by which single seconds may be off whatever their sigma says: errors that all tracks share.
        """
        off = self._off(floor)
        return float(np.sqrt((off**2).mean())) if len(off) else 0.0

    def astray(self, floor: float) -> float:
        """The part that is off by most, in the same units; 0 where few can tell.

        Of two takes one second may be off alone, which many others hide in a mean.

        Args:
            floor: as of :meth:`unsteady`.
        """
        return float(self._off(floor).max(initial=0.0))

    def _off(self, floor: float) -> Float[np.ndarray, " N"]:
        """What the parts that can tell are off by; none where they are few."""
        known = np.isfinite(self.late)
        if known.sum() < LEAST:
            return np.zeros(0)
        return np.abs(self.late[known]) / np.hypot(self.sigma[known], floor)

    def sway(self, floor: float) -> float:
        """By how much an even clock is off at any moment, one sigma, s, as far as chance does not explain it; 0 where
        few parts can tell.

        A clock that sways shows it in all of its seconds: what they are off by has more variance than their sigmas
        have. This is the difference, averaged by information (the method of moments of DerSimonian and Laird 1986,
        about the answer), beyond one standard error of it: what ten seconds of an even clock show by chance, half of a
        second's own variance, is none. A second that is wild among the others counts as off by :data:`WILD` times as
        much as usual. A clock that bends by less than single seconds can tell looks even.

        Args:
            floor: as of :meth:`unsteady`.
        """
        known = np.isfinite(self.late) & np.isfinite(self.sigma)
        if known.sum() < LEAST or not math.isfinite(floor):
            return 0.0
        chance = self.sigma[known] ** 2 + floor**2
        usual = max(1.0, float(np.median(self.late[known] ** 2 / chance)))
        excess = np.minimum(self.late[known] ** 2, WILD**2 * usual * chance) - chance
        by_chance = math.sqrt(2 * len(chance)) / float((1 / chance).sum())
        return math.sqrt(max(float(np.average(excess, weights=1 / chance)) - by_chance, 0.0))

    def bend(self, shared: float) -> tuple[float, float]:
        """By how much the answer is off at the beginning and at the end of the overlap, one sigma, s, by a parabola
        through its seconds, as far as chance does not explain it; 0 where few parts can tell.

        An even clock that is fitted to one whose rate changes is off one way at both ends and the other way between.
        Single seconds hardly show that. What they scatter about the parabola says how well it is known: errors that all
        tracks share for a second scatter, too.

        Args:
            shared: seconds by which errors that no residual shows move the answer; :data:`FURTHER` times as far they
                move one part.
        """
        known = np.isfinite(self.late) & (self.sigma <= LENGTH)
        if len(np.unique(self.at[known])) < PARABOLA or not math.isfinite(shared):
            return 0.0, 0.0
        begin, end = self.at[0] - LENGTH / 2, self.at[-1] + LENGTH / 2
        u = (self.at[known] - (begin + end) / 2) / ((end - begin) / 2)
        X = np.stack([np.ones_like(u), u, u**2], 1)
        weight = 1 / (self.sigma[known] ** 2 + LEAST_OFF**2 + (FURTHER * shared) ** 2)
        covariance = np.linalg.inv((X.T * weight) @ X)
        found = covariance @ (X.T * weight) @ self.late[known]
        rest = self.late[known] - X @ found
        # parts that overlap by half tell little more together than one
        twice = max(1.0, LENGTH / float(np.median(np.diff(self.at[known]))))
        scale = twice * max(1.0, float(weight @ rest**2) / (len(u) - X.shape[1]))
        off = []
        for side in (-1.0, 1.0):
            x = np.array([1.0, side, 1.0])
            variance = scale * float(x @ covariance @ x)
            off.append(math.sqrt(max(float(x @ found) ** 2 - BY_CHANCE * variance, 0.0)))
        return off[0], off[1]

    def untold(self) -> float:
        """The larger sigma of the first and the last second, s, of those in which things move and which is far larger
        than usual; 0 where neither is.

        Where nothing moves nothing can be told, and nothing speaks against the clock that holds beside it. Where things
        move and all the same no offset suits them, the answer does not hold there, or nobody knows.
        """
        known = np.isfinite(self.sigma)
        if known.sum() < LEAST:
            return 0.0
        moves = known & (self.moving >= MOVES * float(np.median(self.moving[known])))
        unusual = self.sigma > UNUSUAL * float(np.median(self.sigma[known]))
        return float(max((self.sigma[k] for k in (0, -1) if moves[k] and unusual[k]), default=0.0))
