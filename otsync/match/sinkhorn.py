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
    spread of the cost (Schmitzer, Stabilized sparse scaling algorithms for entropy regularized transport, 2019).

    It stays beside POT's because it is faster where all are valid, and valid at every ε. Measured over five costs
    (features of the catalogue's pair, FGW's gradient at its start and at a plan, with an outlier 50 x away, every track
    twice); plans whose marginals err by less than 1e-3 before rounding, and mean seconds of one thread::

        ε / spread                        .1          .01         .005        .001        .0001
        N = 50  this                      5/5 .001    5/5 .021    5/5 .028    5/5 .001    5/5 .016
                sinkhorn_stabilized       5/5 .002    5/5 .044    5/5 .058    4/5 .024    1/5  -
                sinkhorn_log              5/5 .016    5/5 .51     5/5 .59     5/5 .28     5/5 .57
                sinkhorn_epsilon_scaling  5/5 .024    5/5 .045    5/5 .038    5/5 .021    5/5 .015
        N = 200 this                      5/5 .001    5/5 .064    5/5 .052    5/5 .030    5/5 .031
                sinkhorn_stabilized       5/5 .002    5/5 .12     5/5 .14     4/5 .043    1/5  -
                sinkhorn_log              5/5 .022    5/5 2.6     5/5 2.5     5/5 .94     5/5 2.7
                sinkhorn_epsilon_scaling  5/5 .048    5/5 .11     5/5 .080    5/5 .092    5/5 .079
        N = 500 this                      5/5 .007    5/5 .29     5/5 .19     5/5 .11     5/5 .12
                sinkhorn_stabilized       5/5 .007    5/5 .54     5/5 .56     4/5 .36     1/5  -
                sinkhorn_log              5/5 .070    5/5 14      5/5 13
                sinkhorn_epsilon_scaling  5/5 .24     5/5 .54     5/5 .38

    The regularised costs agree to 1e-5 of the spread where plans are valid. (POT 0.9.7; 5000 iterations, 100 of
    epsilon scaling, tolerance 1e-9; the failures of sinkhorn_stabilized are nan.)
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
