"""How matched tracks stray from each other: along the cameras' lines of sight, and in every direction alike.

Depth is the worst coordinate of every camera, so the difference of two matched tracks scatters most along the two lines
of sight and least across both. Three variances say by how much, for the fast and for the slow part of the residual
each; they are read off the residuals themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

LEAST_EVERY = 0.02
"""Share of all the scatter that lies in every direction at least: no direction is trusted blindly."""

ALIKE = 0.05
"""How much is set on two cameras that err alike, against what a sample says. It decides where they look the same way,
and nothing tells the one's error from the other's."""

Sight = tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3"]]
"""Unit vectors from the camera of a to the tracks of each match in a's frame, and the same of b in b's."""


@dataclass(frozen=True, eq=False)
class Metric:
    """What residuals are measured by, of every match, for the fast and the slow part: r' inverse r is the square.

    Args:
        inverse: of the covariance, whose determinant is 1. of_a, of_b: the share of either video in the covariance.
    """

    inverse: Float[np.ndarray, "M 2 3 3"]
    of_a: Float[np.ndarray, "M 2 3 3"]
    of_b: Float[np.ndarray, "M 2 3 3"]

    @classmethod
    def even(cls, n: int) -> Metric:
        """The same in every direction, half of it either video's."""
        same = np.broadcast_to(np.eye(3), (n, 2, 3, 3)).copy()
        return cls(same, 0.5 * same, 0.5 * same)


@dataclass(frozen=True, eq=False)
class Noise:
    """Variances of the fast and the slow part: along a's line of sight, along b's, and in every direction."""

    variances: Float[np.ndarray, "2 3"]

    def metric(self, sight: Sight) -> Metric:
        """Args: sight: both in the frame of the residuals."""
        along_a, along_b = (x[:, None, :, None] * x[:, None, None, :] for x in sight)
        p_a, p_b, every = self.variances.T[:, None, :, None, None]
        own = [p * along + 0.5 * every * np.eye(3) for p, along in ((p_a, along_a), (p_b, along_b))]
        total = own[0] + own[1]
        unit = np.cbrt(np.linalg.det(total))[..., None, None]
        return Metric(np.linalg.inv(total / unit), own[0] / unit, own[1] / unit)

    @classmethod
    def of(cls, sight: Sight, scatter: Float[np.ndarray, "M 2 3 3"], count: Float[np.ndarray, "M 2"]) -> Noise | None:
        """The variances that residuals show, by least squares on their products; None where there is no scatter.

        Args:
            sight: both in the frame of the residuals. scatter: weighted sums of r r'. count: of the weights.
        """
        along_a, along_b = (x[:, :, None] * x[:, None, :] for x in sight)
        alike = (along_a * along_b).sum((1, 2))
        found = np.zeros((2, 3))
        for k in range(2):
            n = count[:, k].sum()
            power = float(np.trace(scatter[:, k].sum(0)))
            if not (n > 0 and power > 0):
                return None
            both = float(count[:, k] @ alike) / n - ALIKE
            normal = np.array([[1 + ALIKE, both, 1], [both, 1 + ALIKE, 1], [1, 1, 3]])
            right = np.array([(along_a * scatter[:, k]).sum(), (along_b * scatter[:, k]).sum(), power])
            root = np.linalg.cholesky(normal + 1e-9 * np.eye(3))
            found[k] = nnls(root.T, np.linalg.solve(root, right / power))[0]
            found[k, 2] = max(found[k, 2], LEAST_EVERY * found[k].sum())
        return cls(found)
