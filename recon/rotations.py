"""Rotations as quaternions wxyz and matrices, in torch and numpy; and the pose of a camera that looks at a point.

Inside kernels: :mod:`otsync.compute.quaternions`.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

LEAST_NORM = 1e-12  # as in the kernels, which are not imported here: the renderer works without numba


def unit(quats: Tensor) -> Tensor:
    """Quaternions [...,4] divided by their lengths."""
    return torch.nn.functional.normalize(quats, dim=-1, eps=LEAST_NORM)


def conjugate(quats: Tensor) -> Tensor:
    """The inverse rotations of *unit* quaternions [...,4]."""
    return torch.cat([quats[..., :1], -quats[..., 1:]], -1)


def product(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton products p q [...,4]: as rotations, first q, then p."""
    a, b, c, d = p.unbind(-1)
    e, f, g, h = q.unbind(-1)
    return torch.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        -1,
    )


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotations [...,3,3] of *unit* quaternions wxyz [...,4]."""
    w, x, y, z = quats.unbind(-1)
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(entries, -1).reshape(*quats.shape[:-1], 3, 3)


def rotation_vectors(quats: Tensor) -> Tensor:
    """Logarithms [...,3] of *unit* quaternions [...,4]: axis times angle, radians in -pi..pi. Smooth at no rotation."""
    q = torch.where(quats[..., :1] < 0, -quats, quats)
    sine2 = (q[..., 1:] ** 2).sum(-1, keepdim=True)
    small = sine2 < 1e-12
    sine = torch.where(small, 1.0, sine2).sqrt()
    # at tiny angles, angle / sin(angle / 2) is 2 to within rounding; where() must not see 0 / 0 in its other branch
    factor = torch.where(small, 2.0, 2 * torch.atan2(sine, q[..., :1]) / sine)
    return factor * q[..., 1:]


def quaternions(matrices: Float[np.ndarray, "*B 3 3"]) -> Float[np.ndarray, "*B 4"]:
    """Unit quaternions of rotation matrices, either of the two signs."""
    from scipy.spatial.transform import Rotation

    lead = matrices.shape[:-2]
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat(scalar_first=True).reshape(*lead, 4)


def continuous(quats: Float[np.ndarray, "P *B 4"]) -> Float[np.ndarray, "P *B 4"]:
    """The same rotations with signs along the first axis such that neighbours lie in one hemisphere.

    A spline runs through the four components: it would pass near zero between q and -q, though they are one rotation.
    """
    steps = np.einsum("p...i,p...i->p...", quats[1:], quats[:-1])
    flips = np.cumprod(np.where(steps < 0, -1.0, 1.0), axis=0)
    return np.concatenate([quats[:1], quats[1:] * flips[..., None]])


def look_at(
    eye: Float[np.ndarray, " 3"], focus: Float[np.ndarray, " 3"], up: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    """World to camera (OpenCV axes) of a camera at ``eye`` that looks at ``focus``, its rows along the horizon.

    ValueError where it looks along ``up``.
    """
    z = focus - eye
    z = z / np.linalg.norm(z)
    x = np.cross(z, up)
    if np.linalg.norm(x) < 1e-6 * np.linalg.norm(up):
        raise ValueError("up: expected an axis across the line of sight; found it along it. Move the eye aside.")
    x /= np.linalg.norm(x)
    w2c = np.eye(4)
    w2c[:3, :3] = np.stack([x, np.cross(z, x), z])
    w2c[:3, 3] = -w2c[:3, :3] @ eye
    return w2c
