"""The coarsest level: partial fused Gromov-Wasserstein between some 140 anchors of each video, by POT."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...compute.pot import pot

LP_PIVOTS = 10_000_000

SETTLED = 1e-3
"""Relative gain of a step of conditional gradient that ends the descent. Smaller ones move a few anchors, and the
rounds on cells decide these anew: 1e-5 took twice as many transport problems, and its answers were no better."""


@dataclass(frozen=True, eq=False)
class AnchorProblem:
    """M (na,nb) the sum of costs, Ca and Cb the anchors' D_track over the common median, alpha the paper's."""

    M: Float[np.ndarray, "na nb"]
    Ca: Float[np.ndarray, "na na"]
    Cb: Float[np.ndarray, "nb nb"]
    alpha: float

    def gradient(self, plan: Float[np.ndarray, "na nb"]) -> Float[np.ndarray, "na nb"]:
        """2 Σ_kl (C^a_ik - C^b_jl)² γ_kl + α/2 M."""
        rows, columns = plan.sum(1), plan.sum(0)
        structure = (self.Ca**2 @ rows)[:, None] + (self.Cb**2 @ columns)[None] - 2 * self.Ca @ plan @ self.Cb
        return 2 * structure + self.alpha / 2 * self.M

    def objective(self, plan: Float[np.ndarray, "na nb"]) -> float:
        """Paper, Eq. 1, of the mass that is transported."""
        return float(((self.gradient(plan) + self.alpha / 2 * self.M) * plan).sum() / 2)

    def solve(self, mass: float, start: Float[np.ndarray, "na nb"] | None) -> Float[np.ndarray, "na nb"]:
        """A stationary partial plan from ``start`` (None: the product plan)."""
        ot = pot()
        p, q = (np.full(n, 1 / n) for n in self.M.shape)
        weight = 2 / (2 + self.alpha)
        # see PartialFGW: at fixed mass a constant changes no minimiser, and keeps POT's dummies apart
        lift = 2 * max(self.Ca.max(), self.Cb.max()) ** 2 / max(1 - weight, 1e-12)
        plan, _ = ot.gromov.partial_fused_gromov_wasserstein(
            self.M + lift,
            self.Ca,
            self.Cb,
            p,
            q,
            mass,
            "square_loss",
            G0=start,
            alpha=weight,
            log=True,
            symmetric=True,
            tol=SETTLED,
            warn=False,
            numItermax=LP_PIVOTS,
        )
        return plan

    def features_only(self, mass: float) -> Float[np.ndarray, "na nb"]:
        """The partial plan of M alone: the second start."""
        ot = pot()
        p, q = (np.full(n, 1 / n) for n in self.M.shape)
        # POT asserts marginals of a start to the last bit
        return (1 - 1e-9) * ot.partial.partial_wasserstein(p, q, self.M + 1.0, m=mass)
