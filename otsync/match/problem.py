"""One FGW problem in the paper's units, and the step from a transport plan to matches."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ..costs.linear import Cost, fill_unseen, total_cost, track_distance
from ..types import Matches, Status, TrackSet
from .sinkhorn import MARGINAL_ERROR

FLAT = 1e-9
"""Costs whose spread is below this (of order-one costs) carry no information."""


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
        return Matches(np.zeros((0, 2), int), flags=(Status.FAILED,), stats=stats)
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
    pairs: np.ndarray,
    score: np.ndarray,
    *,
    weight: np.ndarray | None = None,
    plan: Any = None,
    flags: tuple[Status, ...] = (),
    stats: dict[str, float],
) -> Matches:
    """Matches in order of score, best first, ties by a's index."""
    order = np.argsort(-score, kind="stable")
    return Matches(pairs[order], score[order], plan, flags, stats, None if weight is None else weight[order])


def no_information(M: np.ndarray) -> Matches:
    """The answer to constant costs. A solver would return the product plan without a word."""
    plan = np.full(M.shape, 1.0 / M.size)
    return Matches(np.zeros((0, 2), int), None, plan, (Status.NO_INFORMATION,), {"mass": 1.0, "marginal_error": 0.0})


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


def uniform(n: int) -> Float[np.ndarray, " n"]:
    return np.full(n, 1.0 / n)
