"""Cross-video track matching by optimal transport (paper, Sec. 3.3): ``match(a, b, matcher)``.

A matcher is an object in a slot: any callable ``matcher(a, b) -> Matches``. The ones here differ only in what they
minimise; marginals are uniform, C is D_track divided by the common median of both videos, M the sum of ``costs``.
Measured on synthetic figures (N = 2000): FGW by conditional gradient P50 .67, partial mass .76, features alone .51.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from .costs import Cosine, Cost, fill_unseen, total_cost, track_distance
from .frontier import ANCHORED_FROM, fitting
from .shutter import at_frame_times
from .sinkhorn import MARGINAL_ERROR, sinkhorn
from .types import Matches, Refused, Status, TrackSet, in_order
from .vouch import vouch

log = logging.getLogger("otsync")

LP_PIVOTS = 10_000_000
"""Limit for POT's network simplex. Its default of 1e5 stops short from N = 5000 on, with no more than a warning."""

FLAT = 1e-9
"""Costs whose spread is below this (of order-one costs) carry no information."""


class Matcher(Protocol):
    """The ``matcher`` slot."""

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches: ...


def match(
    a: TrackSet, b: TrackSet, matcher: Matcher | None = None, *, budget: float | None = None, throw: bool = True
) -> Matches:
    """Correspondences between the tracks of two videos.

    Args:
        a, b: track sets; they need no common frame, clock or size.
        matcher: the algorithm; default: :func:`matcher_for` their sizes.
        budget: seconds; takes the most accurate matcher that is predicted to fit, and tells the log which.
        throw: raise :class:`otsync.Refused` when the answer is flagged, instead of returning it.

    Example:
        >>> from otsync import match, FusedGromovWasserstein
        >>> matches = match(a, b, FusedGromovWasserstein(alpha=0.222))  # doctest: +SKIP
        >>> best = matches.best(100)                                    # doctest: +SKIP
    """
    a.check("a", xyz=False)
    b.check("b", xyz=False)
    a, b = at_frame_times(a), at_frame_times(b)
    if matcher is not None and budget is not None:
        raise ValueError("matcher, budget: expected one of them; found both. A budget chooses the matcher.")
    matcher = matcher or matcher_for(len(a), len(b), budget)
    if budget is not None:
        log.info("match: %s fits %g s for %d x %d tracks", matcher, budget, len(a), len(b))
    started = time.perf_counter()
    found = matcher(a, b)
    found.check("matcher", len(a), len(b))
    found = vouch(found, a, b, getattr(matcher, "costs", ()))
    found.stats.setdefault("seconds", time.perf_counter() - started)
    if throw and not found.status.ok:
        raise Refused("match", found)
    return found


def matcher_for(n_a: int, n_b: int, budget: float | None = None) -> Matcher:
    """The matcher for so many tracks: the most accurate one, or the most accurate that fits ``budget`` seconds.

    Without a budget the paper's :class:`FusedGromovWasserstein` up to 200 tracks and :class:`AnchoredFGW` above, where
    it is both faster and more precise than any dense solver. Seconds are those of one thread of the machine that the
    benchmark was measured on (:mod:`otsync.frontier`).
    """
    from .anchored import AnchoredFGW

    known: dict[str, Callable[[], Matcher]] = {
        "NearestNeighbor": NearestNeighbor,
        "OptimalTransport": OptimalTransport,
        "FusedGromovWasserstein": FusedGromovWasserstein,
        "PartialFGW": PartialFGW,
        "AnchoredFGW, small": lambda: AnchoredFGW(anchors=100, cells=500, restarts=1),
        "AnchoredFGW": AnchoredFGW,
    }
    n = max(n_a, n_b)
    if budget is None:
        return AnchoredFGW() if min(n_a, n_b) >= ANCHORED_FROM else FusedGromovWasserstein()
    positive("budget", budget)
    return known[fitting(n, budget)]()


@dataclass(frozen=True)
class NearestNeighbor:
    """Mutual nearest neighbours by the linear cost: what one does without transport."""

    costs: tuple[Cost, ...] = (Cosine(),)

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        M = linear_cost(self.costs, a, b)
        if is_flat(M):
            return no_information(M)
        best_b, best_a = M.argmin(1), M.argmin(0)
        i = np.flatnonzero(best_a[best_b] == np.arange(len(a)))
        pairs = np.stack([i, best_b[i]], 1)
        return by_score(pairs, -M[i, best_b[i]], stats={"objective": float(M[i, best_b[i]].sum())})


@dataclass(frozen=True)
class OptimalTransport:
    """Transport on features only: the paper's ablation.

    Args:
        reg: 0 for the exact plan (network simplex); else Sinkhorn with ε = reg times the spread of the cost.
        costs: what is summed, a tuple of cost objects.
    """

    reg: float = 0.0
    costs: tuple[Cost, ...] = (Cosine(),)

    def __post_init__(self) -> None:
        positive("OptimalTransport.reg", self.reg, zero=True)

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        import ot

        M = linear_cost(self.costs, a, b)
        if is_flat(M):
            return no_information(M)
        p, q = uniform(len(a)), uniform(len(b))
        if self.reg == 0:
            plan, log = ot.emd(p, q, M, numItermax=LP_PIVOTS, log=True)
            iterations, failed = 1, log["warning"] is not None
        else:
            plan, iterations, failed = sinkhorn(p, q, M, self.reg * float(np.ptp(M)))
        stats = {"objective": float((M * plan).sum()), "iterations": float(iterations)}
        return from_plan(plan, M, p, q, 1.0, stats, failed)


@dataclass(frozen=True)
class FusedGromovWasserstein:
    """The paper's FGW by POT's conditional gradient.

    F(γ) = Σ (C^a_ik - C^b_jl)² γ_ij γ_kl + α/2 <M, γ>, C divided by the common median of both videos.

    Args:
        alpha: the paper's α. POT's weight is a = 2/(2+α) and F = (1 + α/2) F_POT; the optimum is broad (.2 to .5).
        max_iter, tol: of the conditional gradient; ``tol`` is relative to the objective.
        device: None for numpy, or a torch device ("cuda", "cpu"): POT's torch back end does the products there. The
            inner transport problem, most of the time, is solved on the CPU all the same.

    References: Vayer et al., Optimal Transport for structured data, ICML 2019; paper Eq. 1.
    """

    alpha: float = 0.222
    costs: tuple[Cost, ...] = (Cosine(),)
    max_iter: int = 500
    tol: float = 1e-9
    device: str | None = None

    def __post_init__(self) -> None:
        positive("FusedGromovWasserstein.alpha", self.alpha, zero=True)
        positive("FusedGromovWasserstein.max_iter", self.max_iter)
        positive("FusedGromovWasserstein.tol", self.tol)

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        import ot

        problem = Problem.of(a, b, self.costs, self.alpha)
        if problem.flat:
            return no_information(problem.M)
        arrays = on_device(self.device, problem.M, problem.Ca, problem.Cb, problem.p, problem.q)
        plan, log = ot.gromov.fused_gromov_wasserstein(
            *arrays, "square_loss", symmetric=True, alpha=problem.pot_weight, log=True, max_iter=self.max_iter,
            tol_rel=self.tol, tol_abs=self.tol * 1e-3, numItermaxEmd=LP_PIVOTS,
        )  # fmt: skip
        iterations = len(log["loss"]) - 1
        done = iterations < self.max_iter
        return problem.matches(plan if self.device is None else plan.cpu().numpy(), iterations, converged=done)


@dataclass(frozen=True)
class GromovWasserstein:
    """Structure only, no features: it cannot see mirror images, and shows what features add."""

    max_iter: int = 500
    tol: float = 1e-9
    device: str | None = None

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        return FusedGromovWasserstein(0.0, (), self.max_iter, self.tol, self.device)(a, b)


@dataclass(frozen=True)
class EntropicFGW:
    """FGW by projected gradient with entropic steps (stabilised Sinkhorn).

    Args:
        reg: ε relative to the spread of the linearised cost, so that no unit enters; annealed down to it from .1.
        alpha, costs: as in :class:`FusedGromovWasserstein`.

    References: Peyré et al., Gromov-Wasserstein averaging of kernel and distance matrices, ICML 2016.
    """

    reg: float = 0.01
    alpha: float = 0.222
    costs: tuple[Cost, ...] = (Cosine(),)
    max_iter: int = 100
    tol: float = 1e-6

    def __post_init__(self) -> None:
        positive("EntropicFGW.reg", self.reg)
        positive("EntropicFGW.alpha", self.alpha, zero=True)
        positive("EntropicFGW.max_iter", self.max_iter)
        positive("EntropicFGW.tol", self.tol)

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        problem = Problem.of(a, b, self.costs, self.alpha)
        if problem.flat:
            return no_information(problem.M)
        plan = np.outer(problem.p, problem.q)
        reg, failed, converged, iterations = max(0.1, self.reg), False, False, 0
        while iterations < self.max_iter:
            iterations += 1
            cost = problem.gradient(plan)
            after, _, failed = sinkhorn(problem.p, problem.q, cost, reg * max(float(np.ptp(cost)), FLAT))
            change = float(np.abs(after - plan).sum())
            plan = after
            converged = reg == self.reg and change < self.tol
            if converged or (reg == self.reg and failed):
                break
            reg = max(self.reg, 0.7 * reg)
        return problem.matches(plan, iterations, failed=failed, converged=converged)


@dataclass(frozen=True)
class PartialFGW:
    """FGW that transports only ``mass`` of both videos and leaves the rest unmatched.

    Balanced marginals force every outlier onto something; measured at N = 2000, mass .65 raises precision from
    .47 to .755 at the same recall.

    References: Chapel et al., Partial Optimal Transport with Applications on Positive-Unlabeled Learning, 2020.
    """

    mass: float = 0.65
    alpha: float = 0.222
    costs: tuple[Cost, ...] = (Cosine(),)
    tol: float = 1e-8

    def __post_init__(self) -> None:
        if not 0 < self.mass <= 1:
            raise ValueError(f"PartialFGW.mass: expected a share in (0, 1]; found {self.mass}.")
        positive("PartialFGW.alpha", self.alpha, zero=True)
        positive("PartialFGW.tol", self.tol)

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        import ot

        problem = Problem.of(a, b, self.costs, self.alpha)
        if problem.flat:
            return no_information(problem.M)
        # POT forbids matching dummy to dummy at 100 max((1-a) M), which a far outlier's gradient can exceed. At
        # fixed mass a constant added to M changes no minimiser: make it dominate the largest possible gradient.
        largest = 2 * max(problem.Ca.max(), problem.Cb.max()) ** 2
        lift = largest / (1 - problem.pot_weight) if problem.pot_weight < 1 else 0.0
        mass = min(self.mass, float(problem.p.sum()), float(problem.q.sum()))  # 49 times 1/49 is not quite 1
        plan, log = ot.gromov.partial_fused_gromov_wasserstein(
            problem.M + lift, problem.Ca, problem.Cb, problem.p, problem.q, mass, "square_loss",
            alpha=problem.pot_weight, log=True, symmetric=True, tol=self.tol, warn=False,
            numItermax=LP_PIVOTS,  # POT hands its outer limit on as the LP's pivots
        )  # fmt: skip
        return problem.matches(plan, len(log["loss"]) - 1, mass=self.mass)


# --- what the solvers share --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Problem:
    """One FGW problem in the paper's units: M of order one, C divided by the common median."""

    M: Float[np.ndarray, "Na Nb"]
    Ca: Float[np.ndarray, "Na Na"]
    Cb: Float[np.ndarray, "Nb Nb"]
    p: Float[np.ndarray, " Na"]
    q: Float[np.ndarray, " Nb"]
    alpha: float

    @classmethod
    def of(cls, a: TrackSet, b: TrackSet, costs: tuple[Cost, ...], alpha: float) -> Problem:
        a.check("a")
        b.check("b")
        check_memory(len(a), len(b))
        Ca, Cb = normalised_structure(a, b)
        return cls(total_cost(costs, a, b), Ca, Cb, uniform(len(a)), uniform(len(b)), alpha)

    @property
    def pot_weight(self) -> float:
        """POT minimises (1-a) <M,γ> + a GW; a = 2/(2+α)."""
        return 2.0 / (2.0 + self.alpha)

    @property
    def flat(self) -> bool:
        """Whether neither features nor structure distinguish the tracks."""
        return (self.alpha == 0 or is_flat(self.M)) and (
            is_flat(self.Ca, diagonal=False) or is_flat(self.Cb, diagonal=False)
        )

    def structure(self, plan: Float[np.ndarray, "Na Nb"]) -> Float[np.ndarray, "Na Nb"]:
        """L_ij = Σ_kl (C^a_ik - C^b_jl)² γ_kl."""
        rows, columns = plan.sum(1), plan.sum(0)
        return (self.Ca**2 @ rows)[:, None] + (self.Cb**2 @ columns)[None] - 2 * self.Ca @ plan @ self.Cb

    def gradient(self, plan: Float[np.ndarray, "Na Nb"]) -> Float[np.ndarray, "Na Nb"]:
        """The linearised cost: dF/dγ = 2 L(γ) + α/2 M."""
        return 2 * self.structure(plan) + self.alpha / 2 * self.M

    def objective(self, plan: Float[np.ndarray, "Na Nb"]) -> float:
        """F of the paper's Eq. 1."""
        return float((self.structure(plan) * plan).sum() + self.alpha / 2 * (self.M * plan).sum())

    def matches(
        self, plan: np.ndarray, iterations: int, *, mass: float = 1.0, failed: bool = False, converged: bool = True
    ) -> Matches:
        """Discrete matches of a plan; ``stats["converged"]`` is 0 when the solver stopped at its limit."""
        objective = self.objective(plan)
        stats = {
            "objective": objective,
            "objective_pot": objective / (1 + self.alpha / 2),
            "iterations": float(iterations),
            "converged": float(converged),
        }
        return from_plan(plan, self.gradient(plan), self.p, self.q, mass, stats, failed)


def normalised_structure(a: TrackSet, b: TrackSet) -> tuple[Float[np.ndarray, "Na Na"], Float[np.ndarray, "Nb Nb"]]:
    """D_track of both videos over one common median, so that α means the same in every unit.

    The median, never the maximum: one track 50 times too far away would wipe the structure out.
    """
    assert a.xyz is not None and b.xyz is not None
    raw = [track_distance(a.xyz, a.seen), track_distance(b.xyz, b.seen)]
    known = [d[np.isfinite(d) & (d > 0)] for d in raw]
    median = float(np.median([np.median(k) for k in known if k.size])) if any(k.size for k in known) else 1.0
    Ca, Cb = (fill_unseen(d).astype(float) / median for d in raw)
    return Ca, Cb


def from_plan(
    plan: Float[np.ndarray, "Na Nb"],
    linear: Float[np.ndarray, "Na Nb"],
    p: Float[np.ndarray, " Na"],
    q: Float[np.ndarray, " Nb"],
    mass: float,
    stats: dict[str, float],
    failed: bool,
) -> Matches:
    """Discrete one-to-one matches by the Hungarian method on the plan (paper), scored by minus the linearised cost.

    Scoring by plan value would rank an entropic plan by how crowded a place is: P50 .37 instead of .70.
    """
    from scipy.optimize import linear_sum_assignment

    if not np.isfinite(plan).all():
        return Matches(np.zeros((0, 2), int), status=Status.FAILED, flags=(Status.FAILED,), stats=stats)
    # a balanced plan meets its marginals; a partial one stays below them and carries its mass
    excess = (plan.sum(1) - p, plan.sum(0) - q)
    error = max(float(np.abs(e).sum()) if mass == 1 else float(np.maximum(e, 0).sum()) for e in excess)
    stats |= {"mass": float(plan.sum()), "marginal_error": max(error, abs(float(plan.sum()) - mass))}
    failed = failed or stats["marginal_error"] > MARGINAL_ERROR
    # equal entries of the plan are split by the linearised cost, so that duplicates fall deterministically
    spread = max(float(np.ptp(linear)), np.finfo(float).tiny)
    i, j = linear_sum_assignment(plan - 1e-9 * plan.max() * (linear - linear.min()) / spread, maximize=True)
    carried = plan[i, j] > 1e-6 * plan.max()
    i, j = i[carried], j[carried]
    flags = (Status.FAILED,) if failed else ()
    return by_score(np.stack([i, j], 1), -linear[i, j], plan=plan, flags=flags, stats=stats)


def by_score(
    pairs: np.ndarray, score: np.ndarray, *, plan: Any = None, flags: tuple[Status, ...] = (), stats: dict[str, float]
) -> Matches:
    """Matches in order of score, best first, ties by a's index."""
    order = np.argsort(-score, kind="stable")
    flags = in_order(flags)
    return Matches(pairs[order], score[order], plan, flags[0] if flags else Status.OK, flags, stats)


def no_information(M: np.ndarray) -> Matches:
    """The answer to constant costs. A solver would return the product plan without a word."""
    flags = (Status.NO_INFORMATION,)
    plan = np.full(M.shape, 1.0 / M.size)
    return Matches(np.zeros((0, 2), int), None, plan, flags[0], flags, {"mass": 1.0, "marginal_error": 0.0})


def is_flat(C: np.ndarray, *, diagonal: bool = True) -> bool:
    """Whether a cost matrix of order-one entries is constant (``diagonal=False``: off its diagonal)."""
    values = C if diagonal else C[~np.eye(len(C), dtype=bool)]
    return values.size <= 1 or float(np.ptp(values)) <= FLAT * max(1.0, float(np.abs(values).max()))


def check_memory(n_a: int, n_b: int) -> None:
    """ValueError, before anything is allocated, when a dense problem's matrices cannot fit into memory."""
    need = 8 * (6 * n_a * n_b + 3 * n_a**2 + 3 * n_b**2)  # at the peak of POT's conditional gradient
    have = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if need > have:
        raise ValueError(
            f"a, b: a dense solver needs about {need / 2**30:.0f} GiB for {n_a} x {n_b} tracks; this machine has "
            f"{have / 2**30:.0f}. Use AnchoredFGW, which is sparse, or take fewer tracks."
        )


def linear_cost(costs: tuple[Cost, ...], a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
    """M, when it fits into memory."""
    check_memory(len(a), len(b))
    return total_cost(costs, a, b)


def on_device(device: str | None, *arrays: np.ndarray) -> list[Any]:
    """The arrays as they are, or as torch tensors on ``device``."""
    if device is None:
        return list(arrays)
    import torch

    return [torch.as_tensor(x, device=device) for x in arrays]


def uniform(n: int) -> Float[np.ndarray, " n"]:
    return np.full(n, 1.0 / n)


def positive(name: str, value: float, *, zero: bool = False) -> None:
    if not (np.isfinite(value) and (value > 0 or (zero and value == 0))):
        raise ValueError(f"{name}: expected a number {'>=' if zero else '>'} 0; found {value}.")
