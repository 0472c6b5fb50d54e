"""Real spherical harmonics up to degree 4, in the order and with the signs of 3DGS and gsplat.

Recurrences after Sloan, "Efficient Spherical Harmonic Evaluation", JCGT 2(2), 2013.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

C0 = math.sqrt(1 / (4 * math.pi))  # the constant harmonic: colour = C0 * coefficient + 0.5
MAX_DEGREE = 4


def basis(degree: int, directions: Tensor) -> list[Tensor]:
    """The (degree + 1)^2 harmonics at unit `directions` [...,3], each of shape [...]; index l^2 + l + m."""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(z, C0)]
    # cos and sin of m * azimuth times sin(polar)^m, by the angle-addition recurrence
    cosines, sines = [torch.ones_like(z)], [torch.zeros_like(z)]
    for _ in range(degree):
        c, s = cosines[-1], sines[-1]
        cosines.append(x * c - y * s)
        sines.append(x * s + y * c)
    legendre = _legendre(degree, z)
    for l in range(1, degree + 1):
        below: list[Tensor] = []
        above: list[Tensor] = []
        for m in range(1, l + 1):
            # the alternating sign is the Condon-Shortley phase, which 3DGS keeps
            norm = (-1) ** m * math.sqrt((2 * l + 1) / (2 * math.pi) * math.factorial(l - m) / math.factorial(l + m))
            below.insert(0, norm * legendre[l][m] * sines[m])
            above.append(norm * legendre[l][m] * cosines[m])
        zonal = math.sqrt((2 * l + 1) / (4 * math.pi)) * legendre[l][0]
        values += [*below, zonal, *above]
    return values


def _legendre(degree: int, z: Tensor) -> list[list[Tensor]]:
    """Associated Legendre polynomials P_l^m(z) / (1 - z^2)^(m/2) without the Condon-Shortley phase."""
    table = [[torch.ones_like(z)]]
    for l in range(1, degree + 1):
        row = []
        for m in range(l + 1):
            if m == l:
                row.append((2 * l - 1) * table[l - 1][m - 1])
            elif m == l - 1:
                row.append((2 * l - 1) * z * table[l - 1][m])
            else:
                row.append(((2 * l - 1) * z * table[l - 1][m] - (l + m - 1) * table[l - 2][m]) / (l - m))
        table.append(row)
    return table


def evaluate(degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
    """Sum of harmonics [...,3] in the `directions` [...,3] (any length), from `coefficients` [...,K,3]."""
    n = (degree + 1) ** 2
    values = basis(degree, torch.nn.functional.normalize(directions, dim=-1))
    return (torch.stack(values, -1)[..., None] * coefficients[..., :n, :]).sum(-2)


def view_colors(degree: int, means: Tensor, coefficients: Tensor, viewmats: Tensor) -> Tensor:
    """Colours [C,N,3] that cameras `viewmats` [C,4,4] see: max(SH(mean - camera centre) + 0.5, 0).

    means [N,3] or [C,N,3] world units; coefficients [N,K,3] or one set per camera [C,N,K,3].
    """
    rotation, translation = viewmats[:, :3, :3], viewmats[:, :3, 3]
    # the centre by a solve, not by a transpose: gsplat inverts, and so gradients agree for any matrix
    centres = -torch.linalg.solve(rotation, translation)
    directions = means - centres[:, None]
    return (evaluate(degree, directions, coefficients) + 0.5).clamp_min(0)
