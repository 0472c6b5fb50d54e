"""Other packages' fused Gromov-Wasserstein, for the benchmark where they are installed; never a dependency."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from ..costs.linear import Cosine
from ..match.problem import Problem, from_plan
from ..match.slot import MatcherLike
from ..types import Matches, TrackSet


@dataclass(frozen=True)
class OttJax:
    """ott-jax: entropic FGW with ε relative to the cost."""

    reg: float = 0.01

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        import jax.numpy as jnp
        from ott.geometry.geometry import Geometry
        from ott.problems.quadratic.quadratic_problem import QuadraticProblem
        from ott.solvers.linear.sinkhorn import Sinkhorn
        from ott.solvers.quadratic.gromov_wasserstein import GromovWasserstein

        problem = Problem.of(a, b, (Cosine(),), 0.222)
        structure = [Geometry(cost_matrix=jnp.asarray(C, jnp.float32)) for C in (problem.Ca, problem.Cb)]
        fused = QuadraticProblem(*structure, Geometry(cost_matrix=jnp.asarray(problem.M)), fused_penalty=0.111)
        solver = GromovWasserstein(linear_solver=Sinkhorn(), epsilon=self.reg, relative_epsilon="mean")
        plan = np.asarray(solver(fused).matrix, float)
        stats = {"objective": problem.objective(plan)}
        return from_plan(plan, problem.gradient(plan), problem.p, problem.q, 1.0, stats, False)


def installed() -> dict[str, tuple[MatcherLike, int]]:
    """name -> (matcher, largest size), of the packages that are installed."""
    return {"ott-jax": (OttJax(), 2000)} if find_spec("ott") else {}
