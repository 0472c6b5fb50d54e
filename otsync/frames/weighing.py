"""Candidates for clock and similarity of a pair: laid over the other video, fitted, weighed, and finished."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..align.vouch import drifts
from ..types import Clock, Similarity
from .agreement import Overlay, feature_distances, overlay
from .clouds import Cloud
from .fit import Joint, fit_jointly

WINDOW = 14 / 30
"""Half window, s, of the moving means that split the residual: as of :class:`otsync.SplineRefine`."""

SAME_TIME, SAME_TURN = 4 / 30, 15.0
"""Seconds and degrees within which two answers are the same one."""

QUICK_MATCHES = 80
"""Matches of the fits that weigh candidates against each other."""

QUICK_STEPS, QUICK = 5, 2e-3
"""Steps of those first fits, and the step (frames, radians) that ends them."""

FITTED = 8
"""Candidates that are fitted, those that most tracks agree with before. Of the twenty of a second search, the one that
was best after its fit was among the first five before it, on all pairs where the limits of flags were chosen."""

PROMISING = 4
"""Candidates that are matched anew and fitted once more, those that most tracks agree with after the first time."""

FINAL_STEPS, FINAL = 8, 3e-4

CLOSE, WIDE = (3, 200), (8, 800)
"""Of each other's best, and in all: matches of the final fits."""

RIVALS = 3
"""Rivals that are fitted on before they count: many are the first answer on its way."""

Candidate = tuple[float, float, Similarity]
"""How many matches agree with it, offset in seconds, similarity between the units."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """A candidate after a quick fit, and the sum of tracks that agree with it."""

    joint: Joint
    agreement: float

    def same(self, other: Weighed) -> bool:
        apart = abs(self.joint.clock.offset - other.joint.clock.offset)
        return apart <= SAME_TIME and self.joint.transform.degrees_from(other.joint.transform) <= SAME_TURN


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds, and the distances of their features."""

    a: Cloud
    b: Cloud
    features: Float[np.ndarray, "Na Nb"] | None

    @classmethod
    def of(cls, a: Cloud, b: Cloud) -> Pair:
        return cls(a, b, feature_distances(a, b))

    def overlay(self, joint: Joint) -> Overlay:
        return self.overlay_at(joint.clock, joint.transform)

    def overlay_at(self, clock: Clock, transform: Similarity) -> Overlay:
        return overlay(self.a, self.b, clock.offset, clock.rate, transform)

    def fit(
        self,
        pairs: np.ndarray,
        clock: Clock,
        start: Similarity,
        steps: int,
        small: float,
        *,
        directed: bool = False,
    ) -> Joint | None:
        """Args: directed: whether depth, where cameras are known, counts for less than what they see across."""
        if len(pairs) < 4:
            return None
        i, j = pairs.T
        curves = self.a.curves.take(i), self.b.curves.take(j)
        known = directed and self.a.sight is not None and self.b.sight is not None
        sight = (self.a.sight[i], self.b.sight[j]) if known else None  # type: ignore[index]
        try:
            return fit_jointly(*curves, clock, start, WINDOW, sight=sight, iterations=steps, tolerance=small)
        except np.linalg.LinAlgError:
            return None

    def finish(self, joint: Joint, sure: bool) -> Joint:
        """Matched anew and fitted until nothing moves; if sure, with lines of sight, too, where these tell the rotation
        better.

        Two errors keep matched tracks apart. Where it is depth, the lines of sight tell it from motion, and neighbours
        on all sides of a track average out where the points sit on the body: half the error of rotation on simulated
        jugglers. Where cameras see two sides of a body, as people's on basketball, neither holds, the nearest matches
        and no direction do better, and the sigmas say so.
        """
        even = self.rounds(joint, ((CLOSE, QUICK), (CLOSE, QUICK), (CLOSE, FINAL)), False)
        if not sure or self.a.sight is None or self.b.sight is None:
            return even
        directed = self.rounds(even, ((CLOSE, QUICK), (WIDE, FINAL)), True)
        return min(even, directed, key=lambda j: j.transform.rotation_sigma)

    def still(self) -> bool:
        """Whether nothing moves in either video, so that no other answer would say more."""
        return all(drifts(c.tracks, np.arange(len(c))) for c in (self.a, self.b))

    def rounds(self, joint: Joint, rounds: tuple[tuple[tuple[int, int], float], ...], directed: bool) -> Joint:
        for (k, most), small in rounds:
            pairs, _ = self.overlay(joint).matches(self.features, k, most)
            again = self.fit(pairs, joint.clock, joint.transform, FINAL_STEPS, small, directed=directed)
            if again is None:
                break
            joint = again
        return joint

    def rival(self, first: Weighed, others: list[Weighed]) -> float:
        """The agreement of the best answer that stays another one when it is fitted on."""
        strongest, looked = 0.0, 0
        for w in others:
            if first.same(w) or w.agreement <= strongest:
                continue
            if looked < RIVALS:
                looked += 1
                again = self.weigh(w.joint.clock.offset, w.joint.transform)
                if again is None or first.same(again):
                    continue
                w = again
            strongest = max(strongest, w.agreement)
        return strongest

    def weigh_all(self, candidates: list[Candidate]) -> list[Weighed]:
        """The most promising candidates after quick fits, best first."""
        begun = [(Clock(offset), S, self.overlay_at(Clock(offset), S)) for _, offset, S in candidates]
        if len(begun) > FITTED:
            begun = sorted(begun, key=lambda c: -c[2].agreement())[:FITTED]
        first = [self.laid(*c) for c in begun]
        best = sorted((w for w in first if w is not None), key=lambda w: -w.agreement)[:PROMISING]
        again = [self.laid(w.joint.clock, w.joint.transform, self.overlay(w.joint)) for w in best]
        return sorted((w for w in again if w is not None), key=lambda w: -w.agreement)

    def weigh(self, offset: float, start: Similarity) -> Weighed | None:
        """Two rounds of matching in the common frame and fitting; None where nothing is left to fit."""
        return next(iter(self.weigh_all([(0.0, offset, start)])), None)

    def laid(self, clock: Clock, start: Similarity, over: Overlay) -> Weighed | None:
        """Matched in the common frame, where they lie ``over`` each other, fitted, and weighed; None where nothing is
        left to fit."""
        pairs, _ = over.matches(self.features, 2, QUICK_MATCHES)
        joint = self.fit(pairs, clock, start, QUICK_STEPS, QUICK)
        if joint is None or not 0.2 < joint.transform.scale < 5:
            return None
        return Weighed(joint, self.overlay(joint).agreement())
