"""Quaternions and rotations inside compiled loops: tuples (w, x, y, z), matrices as nine entries row by row.

A gradient of the loss with respect to q is called g_q.
"""

from __future__ import annotations

import math

from .jit import inlined

LEAST_NORM = 1e-12  # below it a quaternion is no direction any more: divided by this instead, it stays finite

inline = inlined(fastmath={"contract", "nsz"})


@inline
def product(p, q):
    """The Hamilton product p q."""
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


@inline
def conjugate(q):
    return q[0], -q[1], -q[2], -q[3]


@inline
def dot4(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@inline
def unit(q):
    """q divided by its length, and one over the length."""
    n = 1 / max(math.sqrt(dot4(q, q)), LEAST_NORM)
    return (q[0] * n, q[1] * n, q[2] * n, q[3] * n), n


@inline
def unit_backward(q, n, g):
    """Gradient of the quaternion whose unit is q, n being one over its length, from that of the unit."""
    radial = dot4(g, q)  # the normalisation forgets the length
    return (
        (g[0] - radial * q[0]) * n,
        (g[1] - radial * q[1]) * n,
        (g[2] - radial * q[2]) * n,
        (g[3] - radial * q[3]) * n,
    )


@inline
def rotation(q):
    """Of a unit quaternion."""
    w, x, y, z = q
    return (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@inline
def rotation_backward(q, G):
    """Gradient of the unit quaternion q from that of its rotation, G."""
    w, x, y, z = q
    return (
        2 * (x * (G[7] - G[5]) + y * (G[2] - G[6]) + z * (G[3] - G[1])),
        2 * (-2 * x * (G[4] + G[8]) + y * (G[3] + G[1]) + z * (G[6] + G[2]) + w * (G[7] - G[5])),
        2 * (x * (G[3] + G[1]) - 2 * y * (G[0] + G[8]) + z * (G[7] + G[5]) + w * (G[2] - G[6])),
        2 * (x * (G[6] + G[2]) + y * (G[7] + G[5]) - 2 * z * (G[0] + G[4]) + w * (G[3] - G[1])),
    )


@inline
def turned(R, a):
    """R a."""
    return (
        R[0] * a[0] + R[1] * a[1] + R[2] * a[2],
        R[3] * a[0] + R[4] * a[1] + R[5] * a[2],
        R[6] * a[0] + R[7] * a[1] + R[8] * a[2],
    )


@inline
def turned_back(R, a):
    """Rᵀ a."""
    return (
        R[0] * a[0] + R[3] * a[1] + R[6] * a[2],
        R[1] * a[0] + R[4] * a[1] + R[7] * a[2],
        R[2] * a[0] + R[5] * a[1] + R[8] * a[2],
    )


@inline
def outer(a, b):
    """a bᵀ."""
    return (
        a[0] * b[0],
        a[0] * b[1],
        a[0] * b[2],
        a[1] * b[0],
        a[1] * b[1],
        a[1] * b[2],
        a[2] * b[0],
        a[2] * b[1],
        a[2] * b[2],
    )
