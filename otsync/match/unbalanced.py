"""Transport with relaxed marginals: for two views that share only a part of what they see.

Balanced transport finds a partner for every track. Two cameras on one scene share a small part of their tracks, so it
forces the rest onto something: measured on basketball, best 100 of a pair within 15 cm: balanced Sinkhorn .45, relaxed
.74. Here a track that finds nothing like it gives up its mass; the cost of doing so is ``marginal``.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ..compute.pot import pot
from ..costs.linear import Cosine, Cost
from ..costs.positions import at_clock
from ..types import Clock, Matches, Status, TrackSet
from ..types.checks import positive
from .problem import Problem, by_score, is_flat, linear_cost, no_information, uniform
from .slot import Matcher, StructuralMatcher

ITERATIONS, TOLERANCE = 2000, 1e-7
"""Of the Sinkhorn iterations; they contract by ρ/(ρ + ε) each, so a few dozen do."""

EVERY_FLAT = 40_000
"""Pairs of tracks that are all tried where costs are flat: 200 tracks on either side."""

LEAST_SHARE = 1e-9
"""A pair with less than this share of the largest mass is none."""


@dataclass(frozen=True)
class UnbalancedOT(Matcher):
    """Entropic transport with relaxed marginals (KL), several partners a track: the default on recordings.

    The plan minimises ``<M,γ> + ε KL(γ | p qᵀ) + ρ KL(γ1 | p) + ρ KL(γᵀ1 | q)``. How much mass moves is found from the
    data: costs count in units of what two unrelated tracks cost, the median of M (most pairs are unrelated).

    Pairs are ranked by the mass that the plan moves between them. (Measured on basketball, 24 pairs of cameras, best 50
    / 100 / 200 within 15 cm: .79 / .685 / .546; the cheapest pairs .78 / .68 / .543; by shares of the tracks' own mass,
    ``γ_ij / sqrt(row_i col_j)``, .73 / .66 / .53. Offsets: 96 pairs, mean error .0008 ± .001 frame below that by the
    cheapest pairs.)

    Args:
        reg: ε, and marginal: ρ, in units of an unrelated pair's cost. Both may be halved or doubled with little effect.
        partners: best partners of every track that are kept, as seen from both videos. top: pairs kept in all, best
            first; None: all of them.
        weighted: whether the mass becomes the ``weight`` of the matches in scan and fit. It does not help there: the
            fit weighs matches by their residuals (36 pairs, mean error .049 frame without, .059 with).
        every: where there are at most so many pairs of tracks, all of them are matches, and up to
            :data:`EVERY_FLAT` where costs are flat: an aligner that weighs candidates itself, as
            :class:`otsync.epipolar.EpipolarScan`, needs no features then. 0: flat costs are NO_INFORMATION.
        costs: what is summed, a tuple of cost objects.

    References: Chizat et al., Scaling algorithms for unbalanced optimal transport problems, 2018; POT's solver.
    """

    reg: float = 0.2
    marginal: float = 0.02
    partners: int = 2
    top: int | None = 200
    weighted: bool = False
    every: int = 0
    costs: tuple[Cost, ...] = (Cosine(center=False),)

    def __post_init__(self) -> None:
        positive("UnbalancedOT.every", self.every, zero=True)
        positive("UnbalancedOT.reg", self.reg)
        positive("UnbalancedOT.marginal", self.marginal)
        check_partners("UnbalancedOT", self.partners, self.top)

    def at(self, clock: Clock) -> UnbalancedOT:
        """The same transport with distances at equal times in place of those that need no time.

        One partner more, since what is near at equal times is right more often: on basketball three partners leave 200
        matches and a mean error of .07 frame, mutual nearest neighbours 25-33 and .11.
        """
        return replace(self, partners=self.partners + 1, costs=at_clock(self.costs, clock))

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        M = linear_cost(self.costs, a, b)
        flat = is_flat(M)
        if self.every and M.size <= (EVERY_FLAT if flat else self.every):
            weight = None if flat else np.exp(-(M - M.min()) / (self.reg * unrelated(M))).ravel()
            every = np.argwhere(np.ones(M.shape, bool))
            found = by_score(every, -M.ravel(), weight=weight, stats={"objective": float(M.sum())})
            return found if self.top is None else found.best(self.top)
        if flat:
            return no_information(M)
        M = M / unrelated(M)
        p, q = uniform(len(a)), uniform(len(b))
        plan, iterations, failed = relaxed_plan(p, q, M, self.reg, self.marginal)
        stats = {"objective": float((M * plan).sum()), "iterations": float(iterations)}
        with np.errstate(divide="ignore"):
            return partners_of(plan, np.log(plan), self.partners, self.top, stats, failed, weighted=self.weighted)


@dataclass(frozen=True)
class UnbalancedFGW(StructuralMatcher):
    """FGW with relaxed marginals (KL), by POT: structure and features where the views share only a part.

    Args:
        marginal: ρ, relative to the structure's unit (the common median distance, squared).
        reg: ε on the same scale. alpha, costs: as in :class:`otsync.FusedGromovWasserstein`.
        partners, top: as in :class:`UnbalancedOT`.
        max_iter: of the outer loop, alternating over two copies of the plan.

    References: Thual et al., Aligning individual brains with Fused Unbalanced Gromov-Wasserstein, NeurIPS 2022.
    """

    marginal: float = 0.1
    reg: float = 0.01
    alpha: float = 0.222
    partners: int = 1
    top: int | None = None
    costs: tuple[Cost, ...] = (Cosine(),)
    max_iter: int = 30

    def __post_init__(self) -> None:
        for name in ("marginal", "reg", "max_iter"):
            positive(f"UnbalancedFGW.{name}", getattr(self, name))
        positive("UnbalancedFGW.alpha", self.alpha, zero=True)
        check_partners("UnbalancedFGW", self.partners, self.top)

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        ot = pot()
        problem = Problem.of(a, b, self.costs, self.alpha)
        if problem.flat:
            return no_information(problem.M)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an inner loop that stops at its limit; the outer one tells
            try:
                plan, _, log = ot.gromov.fused_unbalanced_gromov_wasserstein(
                    problem.Ca,
                    problem.Cb,
                    problem.p,
                    problem.q,
                    reg_marginals=self.marginal,
                    epsilon=self.reg,
                    divergence="kl",
                    unbalanced_solver="sinkhorn_log",
                    alpha=self.alpha / 2,
                    M=problem.M,
                    max_iter=self.max_iter,
                    log=True,
                )
            except ValueError as error:  # "There is NaN in coupling": costs of an outlier overflow its kernel
                if "NaN" not in str(error):
                    raise
                return Matches(np.zeros((0, 2), int), flags=(Status.FAILED,))
        stats = {"objective": problem.objective(plan), "iterations": float(len(log["error"]))}
        return partners_of(plan, -problem.gradient(plan), self.partners, self.top, stats, False)


@dataclass(frozen=True)
class SemirelaxedFGW(StructuralMatcher):
    """FGW that keeps the marginal of one video and leaves the other free, solved both ways and averaged; by POT.

    What it is good for is one video that sees a part of what the other sees. It tends to collapse many tracks onto one
    (measured: docs/benchmarks.md).

    Args:
        alpha, costs, max_iter, tol: as in :class:`otsync.FusedGromovWasserstein`. partners, top: as in
            :class:`UnbalancedOT`.

    References: Vincent-Cuaz et al., Semi-relaxed Gromov-Wasserstein divergence with applications on graphs, ICLR 2022.
    """

    alpha: float = 0.222
    partners: int = 1
    top: int | None = None
    costs: tuple[Cost, ...] = (Cosine(),)
    max_iter: int = 500
    tol: float = 1e-9

    def __post_init__(self) -> None:
        for name in ("max_iter", "tol"):
            positive(f"SemirelaxedFGW.{name}", getattr(self, name))
        positive("SemirelaxedFGW.alpha", self.alpha, zero=True)
        check_partners("SemirelaxedFGW", self.partners, self.top)

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        problem = Problem.of(a, b, self.costs, self.alpha)
        if problem.flat:
            return no_information(problem.M)
        there, n = self._solve(problem.M, problem.Ca, problem.Cb, problem.p, problem.pot_weight)
        back, m = self._solve(problem.M.T, problem.Cb, problem.Ca, problem.q, problem.pot_weight)
        plan = 0.5 * (there + back.T)
        stats = {"objective": problem.objective(plan), "iterations": float(n + m)}
        return partners_of(plan, -problem.gradient(plan), self.partners, self.top, stats, False)

    def _solve(
        self, M: np.ndarray, Ca: np.ndarray, Cb: np.ndarray, p: np.ndarray, weight: float
    ) -> tuple[np.ndarray, int]:
        ot = pot()
        plan, log = ot.gromov.semirelaxed_fused_gromov_wasserstein(
            np.ascontiguousarray(M),
            Ca,
            Cb,
            p,
            "square_loss",
            symmetric=True,
            alpha=weight,
            log=True,
            max_iter=self.max_iter,
            tol_rel=self.tol,
            tol_abs=self.tol * 1e-3,
        )
        return plan, len(log["loss"]) - 1


def check_partners(name: str, partners: int, top: int | None) -> None:
    """ValueError unless both are counts of at least one."""
    positive(f"{name}.partners", partners)
    if top is not None:
        positive(f"{name}.top", top)


def unrelated(M: Float[np.ndarray, "Na Nb"]) -> float:
    """What two unrelated tracks cost: the median of M; its range where most entries are equal."""
    typical = float(np.median(M))
    return typical if typical > 0 else float(np.ptp(M))


def relaxed_plan(
    p: Float[np.ndarray, " Na"], q: Float[np.ndarray, " Nb"], M: Float[np.ndarray, "Na Nb"], reg: float, marginal: float
) -> tuple[Float[np.ndarray, "Na Nb"], int, bool]:
    """Plan of POT's unbalanced Sinkhorn: (plan, iterations, failed).

    The least cost is subtracted first, in the kernel only: it multiplies the plan by one factor, put back afterwards,
    and keeps the kernel from vanishing at small ε.
    """
    ot = pot()
    least = float(M.min())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they warn of is checked below
        plan, log = ot.unbalanced.sinkhorn_unbalanced(
            p,
            q,
            M - least,
            reg,
            marginal,
            method="sinkhorn",
            numItermax=ITERATIONS,
            stopThr=TOLERANCE,
            log=True,
        )
    plan = plan * np.exp(-least / (reg + 2 * marginal))
    return plan, len(log["err"]), not (np.isfinite(plan).all() and plan.sum() > 0)


def partners_of(
    plan: Float[np.ndarray, "Na Nb"],
    score: Float[np.ndarray, "Na Nb"],
    partners: int,
    top: int | None,
    stats: dict[str, float],
    failed: bool,
    *,
    weighted: bool = False,
) -> Matches:
    """Every track's best ``partners`` by the plan, as seen from both videos, in order of ``score``."""
    stats = stats | {"mass": float(plan.sum())}
    if failed or not np.isfinite(plan).all():
        return Matches(np.zeros((0, 2), int), flags=(Status.FAILED,), stats=stats)
    chosen = np.zeros(plan.shape, bool)
    np.put_along_axis(chosen, np.argsort(-plan, axis=1, kind="stable")[:, :partners], True, 1)
    np.put_along_axis(chosen, np.argsort(-plan, axis=0, kind="stable")[:partners], True, 0)
    chosen &= plan > LEAST_SHARE * plan.max()
    i, j = np.nonzero(chosen)
    weight = plan[i, j] / plan.max() if weighted else None
    found = by_score(np.stack([i, j], 1), score[i, j], weight=weight, plan=plan, stats=stats)
    return found if top is None else found.best(top)
