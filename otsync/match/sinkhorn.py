"""Entropic transport that stays a plan at any regularisation."""

from __future__ import annotations

import numpy as np

MARGINAL_ERROR = 1e-3
"""Largest L1 error of a plan's marginals (which sum to one) before the answer counts as failed."""


def sinkhorn(
    p: np.ndarray, q: np.ndarray, cost: np.ndarray, eps: float, *, max_iter: int = 5000, tol: float = 1e-9
) -> tuple[np.ndarray, int, bool]:
    """Entropic plan, rounded to its marginals: (plan, iterations, failed).

    Scalings are absorbed into the potentials before they leave the range of floats, and ε is annealed down from the
    spread of the cost (Schmitzer, Stabilized sparse scaling algorithms for entropy regularized transport, 2019). POT's
    own variants return zeros, nan or negative entries for ε below about a hundredth of the spread.
    """
    f = cost.min(1)
    g = (cost - f[:, None]).min(0)  # each row and column now has an entry without slack: no sum underflows to zero
    step, iterations = max(float(np.ptp(cost)), eps), 0
    while True:
        step = max(eps, step / 4)
        u, v, error = np.ones_like(p), np.ones_like(q), np.inf
        K = np.exp((f[:, None] + g[None] - cost) / step)
        for k in range(max_iter if step == eps else 50):
            u = p / (K @ v)
            v = q / (K.T @ u)
            iterations += 1
            extreme = max(np.abs(np.log(u)).max(), np.abs(np.log(v)).max()) > 100
            if extreme or k % 10 == 9:
                error = float(np.abs(u * (K @ v) - p).sum())
            if extreme:
                f, g = f + step * np.log(u), g + step * np.log(v)
                u, v = np.ones_like(p), np.ones_like(q)
                K = np.exp((f[:, None] + g[None] - cost) / step)
            if error < tol:
                break
        f, g = f + step * np.log(u), g + step * np.log(v)
        if step == eps:
            break
    plan = np.exp((f[:, None] + g[None] - cost) / eps)
    return round_to_marginals(plan, p, q), iterations, not error < MARGINAL_ERROR


def round_to_marginals(plan: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The nearby plan that meets its marginals exactly (Altschuler, Weed and Rigollet, NeurIPS 2017, Alg. 2)."""
    tiny = np.finfo(float).tiny
    plan = plan * np.minimum(1.0, p / np.maximum(plan.sum(1), tiny))[:, None]
    plan = plan * np.minimum(1.0, q / np.maximum(plan.sum(0), tiny))[None]
    rows, columns = np.maximum(p - plan.sum(1), 0), np.maximum(q - plan.sum(0), 0)
    return plan + np.outer(rows, columns) / max(float(np.abs(rows).sum()), tiny)
