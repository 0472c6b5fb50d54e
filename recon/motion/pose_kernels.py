"""Poses of nodes inside compiled loops, and gradients from poses to knots.

curves = (knots [P,M,3], knot_quats [P,M,4], clock int32 [M]); a moment = (first [V], weights [V,4]): of which knots a
pose is the sum, for each of the V own times that world time may mean; see :mod:`recon.motion.paths`.
"""

from __future__ import annotations

import numpy as np

from otsync.compute.jit import inlined
from otsync.compute.quaternions import unit, unit_backward

F64 = np.float64
WINDOW = 4

inline = inlined(fastmath={"contract", "nsz"})


@inline
def position(curves, moment, m):
    """Position of node m, float64."""
    knots, _, clock = curves
    first, weights = moment
    v = clock[m]
    x, y, z = 0.0, 0.0, 0.0
    for k in range(WINDOW):
        p, w = first[v] + k, weights[v, k]
        x += w * knots[p, m, 0]
        y += w * knots[p, m, 1]
        z += w * knots[p, m, 2]
    return x, y, z


@inline
def orientation(curves, moment, m):
    """Unit quaternion of node m, and one over the length of the splined one; float64."""
    _, quats, clock = curves
    first, weights = moment
    v = clock[m]
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    for k in range(WINDOW):
        p, w = first[v] + k, weights[v, k]
        a += w * quats[p, m, 0]
        b += w * quats[p, m, 1]
        c += w * quats[p, m, 2]
        d += w * quats[p, m, 3]
    return unit((a, b, c, d))


@inline
def lower_position(curves, moment, m, g, g_knots):
    """Add to the knots' gradients what comes from `g`, the gradient of node m's position."""
    first, weights = moment
    v = curves[2][m]
    for k in range(WINDOW):
        p, w = first[v] + k, weights[v, k]
        for c in range(3):
            g_knots[p, m, c] += w * g[c]


@inline
def lower_orientation(curves, moment, m, q, length, g, g_knot_quats):
    """Add to the knots' gradients what comes from `g`, the gradient of node m's unit quaternion `q`; returns that of
    the quaternion before normalisation."""
    first, weights = moment
    g_raw = unit_backward(q, length, g)
    v = curves[2][m]
    for k in range(WINDOW):
        p, w = first[v] + k, weights[v, k]
        for c in range(4):
            g_knot_quats[p, m, c] += w * g_raw[c]
    return g_raw


@inline
def along_time(curves, slopes, first, m, g, g_raw):
    """Gradient of the own time at which node m stands, from those of its position and splined quaternion.

    slopes [V,4]: derivatives of the weights by time.
    """
    knots, quats, clock = curves
    v = clock[m]
    total = 0.0
    for k in range(WINDOW):
        p = first[v] + k
        along = g[0] * knots[p, m, 0] + g[1] * knots[p, m, 1] + g[2] * knots[p, m, 2]
        for c in range(4):
            along += g_raw[c] * quats[p, m, c]
        total += slopes[v, k] * along
    return total


@inline
def poses(begin, end, curves, moment, positions, quats):
    """Positions [M,3] and unit quaternions [M,4] of nodes begin..end."""
    for m in range(begin, end):
        x = position(curves, moment, m)
        q, _ = orientation(curves, moment, m)
        for c in range(3):
            positions[m, c] = x[c]
        for c in range(4):
            quats[m, c] = q[c]


@inline
def poses_backward(begin, end, curves, moment, slopes, incoming, g_knots, g_knot_quats, g_times):
    """Gradients of knots and of each node's own time [M], from those of positions [M,3] and unit quaternions [M,4]."""
    g_positions, g_quats = incoming
    for m in range(begin, end):
        g = F64(g_positions[m, 0]), F64(g_positions[m, 1]), F64(g_positions[m, 2])
        g_q = F64(g_quats[m, 0]), F64(g_quats[m, 1]), F64(g_quats[m, 2]), F64(g_quats[m, 3])
        q, length = orientation(curves, moment, m)
        lower_position(curves, moment, m, g, g_knots)
        g_raw = lower_orientation(curves, moment, m, q, length, g_q, g_knot_quats)
        g_times[m] = along_time(curves, slopes, moment[0], m, g, g_raw)
