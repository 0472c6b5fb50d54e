"""Motion losses on nodes with their gradients, in one pass; torch would take dozens of calls on small tensors.

Each adds `share` times the loss's gradient to that of the knots, and returns the loss. Lengths are in footprints, and
norms are soft: √(x² + soft²) - soft. curves and moments as in :mod:`recon.motion.pose_kernels`.
"""

from __future__ import annotations

import math

import numpy as np

from otsync.compute.jit import kernel
from otsync.compute.quaternions import outer, rotation, rotation_backward, turned, turned_back
from recon.motion.pose_kernels import lower_orientation, lower_position, orientation, position

_kernel = kernel(fastmath={"contract", "nsz"})


@_kernel
def _soft_norm(x, soft):
    """The soft norm of a vector, and one over its unsoftened root: x over it is the gradient."""
    root = math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + soft * soft)
    return root - soft, 1 / root


@_kernel
def stencil(curves, moments, coefficients, per_length, soft, g_knots):
    """mean_m ‖Σ_s coefficients_s x_m(t_s)‖: velocities and accelerations."""
    m_all = curves[0].shape[1]
    total = 0.0
    for m in range(m_all):
        x, y, z = 0.0, 0.0, 0.0
        for s in range(len(coefficients)):
            p = position(curves, (moments[0][s], moments[1][s]), m)
            x += coefficients[s] * p[0]
            y += coefficients[s] * p[1]
            z += coefficients[s] * p[2]
        value, slope = _soft_norm((x * per_length, y * per_length, z * per_length), soft)
        total += value
        slope *= per_length * per_length / m_all
        for s in range(len(coefficients)):
            c = coefficients[s] * slope
            lower_position(curves, (moments[0][s], moments[1][s]), m, (c * x, c * y, c * z), g_knots)
    return total / m_all


@_kernel
def _all_poses(curves, moments):
    """Positions [2,M,3], unit quaternions [2,M,4] and one over the lengths [2,M] at two moments."""
    m_all = curves[0].shape[1]
    places, turns, lengths = np.empty((2, m_all, 3)), np.empty((2, m_all, 4)), np.empty((2, m_all))
    for s in range(2):
        moment = (moments[0][s], moments[1][s])
        for m in range(m_all):
            x = position(curves, moment, m)
            q, lengths[s, m] = orientation(curves, moment, m)
            for c in range(3):
                places[s, m, c] = x[c]
            for c in range(4):
                turns[s, m, c] = q[c]
    return places, turns, lengths


@_kernel
def _apart(places, s, i, k, per_length):
    return (
        (places[s, i, 0] - places[s, k, 0]) * per_length,
        (places[s, i, 1] - places[s, k, 1]) * per_length,
        (places[s, i, 2] - places[s, k, 2]) * per_length,
    )


@_kernel
def _quat(turns, s, k):
    return turns[s, k, 0], turns[s, k, 1], turns[s, k, 2], turns[s, k, 3]


@_kernel
def _pull(g_places, s, i, k, g):
    """The gradient `g` of x_i - x_k, handed to both."""
    for c in range(3):
        g_places[s, i, c] += g[c]
        g_places[s, k, c] -= g[c]


@_kernel
def arap(curves, moments, edges, shares, per_length, soft, g_knots, g_knot_quats):
    """mean_i Σ_k shares_ik ‖l_ik(t_0) - l_ik(t_1)‖, l_ik = R_kᵀ(x_i - x_k); shares [M,K] of the edges [M,K]."""
    m_all = curves[0].shape[1]
    places, turns, lengths = _all_poses(curves, moments)
    g_places, g_turns = np.zeros_like(places), np.zeros_like(turns)
    total = 0.0
    for i in range(m_all):
        for e in range(edges.shape[1]):
            w, k = shares[i, e] / m_all, edges[i, e]
            if w == 0:
                continue
            d0, d1 = _apart(places, 0, i, k, per_length), _apart(places, 1, i, k, per_length)
            q0, q1 = _quat(turns, 0, k), _quat(turns, 1, k)
            R0, R1 = rotation(q0), rotation(q1)
            l0, l1 = turned_back(R0, d0), turned_back(R1, d1)
            change = l0[0] - l1[0], l0[1] - l1[1], l0[2] - l1[2]
            value, slope = _soft_norm(change, soft)
            total += w * value
            slope *= w
            g = slope * change[0], slope * change[1], slope * change[2]
            # l = Rᵀ d: the gradient of d is R g, that of R is d gᵀ
            for s in range(2):
                R, d, q = (R0, d0, q0) if s == 0 else (R1, d1, q1)
                sign = 1.0 if s == 0 else -1.0
                g_s = sign * g[0], sign * g[1], sign * g[2]
                back = turned(R, g_s)
                _pull(g_places, s, i, k, (back[0] * per_length, back[1] * per_length, back[2] * per_length))
                g_q = rotation_backward(q, outer(d, g_s))
                for c in range(4):
                    g_turns[s, k, c] += g_q[c]
    for s in range(2):
        moment = (moments[0][s], moments[1][s])
        for m in range(m_all):
            g = g_places[s, m, 0], g_places[s, m, 1], g_places[s, m, 2]
            lower_position(curves, moment, m, g, g_knots)
            q = _quat(turns, s, m)
            lower_orientation(curves, moment, m, q, lengths[s, m], _quat(g_turns, s, m), g_knot_quats)
    return total


@_kernel
def length(curves, moments, edges, shares, per_length, soft, g_knots):
    """mean_i Σ_k shares_ik |‖x_i - x_k‖(t_0) - ‖x_i - x_k‖(t_1)|, softly."""
    m_all = curves[0].shape[1]
    places = np.empty((2, m_all, 3))
    g_places = np.zeros((2, m_all, 3))
    for s in range(2):
        for m in range(m_all):
            x = position(curves, (moments[0][s], moments[1][s]), m)
            for c in range(3):
                places[s, m, c] = x[c]
    total = 0.0
    for i in range(m_all):
        for e in range(edges.shape[1]):
            w, k = shares[i, e] / m_all, edges[i, e]
            if w == 0:
                continue
            d0, d1 = _apart(places, 0, i, k, per_length), _apart(places, 1, i, k, per_length)
            n0, s0 = _soft_norm(d0, soft)
            n1, s1 = _soft_norm(d1, soft)
            value, slope = _soft_norm((n0 - n1, 0.0, 0.0), soft)
            total += w * value
            g = w * (n0 - n1) * slope * per_length
            _pull(g_places, 0, i, k, (g * s0 * d0[0], g * s0 * d0[1], g * s0 * d0[2]))
            _pull(g_places, 1, i, k, (-g * s1 * d1[0], -g * s1 * d1[1], -g * s1 * d1[2]))
    for s in range(2):
        for m in range(m_all):
            g = g_places[s, m, 0], g_places[s, m, 1], g_places[s, m, 2]
            lower_position(curves, (moments[0][s], moments[1][s]), m, g, g_knots)
    return total
