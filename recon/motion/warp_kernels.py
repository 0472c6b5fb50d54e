"""The warp of :mod:`recon.motion.warp` in two compiled phases, forward and backward.

forward:  relative  node by node: its pose at t, then the relative motion of each of its (rest, node) pairs: a row.
          carry     Gaussian by Gaussian: the weighted sum of eight rows, and what it does to mean and orientation.
backward: lift      Gaussian by Gaussian: gradients of mean and orientation, and of the summed row.
          gather    pair by pair: gradient of its row, over the slots of the Gaussians that use it.
          lower     node by node: gradient of its pose, hence of its four knots and of the time.

Every output has one owner, who sums in a fixed order: results do not depend on the threads.

A row is, for linear blending, the rotation's nine entries, the shift and the quaternion (wxyz): 16 floats. For dual
quaternions it is the quaternion and twice the dual part: 8 floats, in 16 as well. The last LANES-independent part is
written with plain loops over a row, which LLVM turns into vector instructions.

Arguments that belong together travel as tuples: curves = (knots [P,M,3], knot_quats [P,M,4], clock [M], first [V],
weights [V,4]), pairs = (rest positions [Q,3], rest quats [Q,4], node_starts [M+1]), slots = (pair of each slot [N,8],
weights [N,8]).
"""

from __future__ import annotations

import numpy as np

from recon.motion.quaternion_kernels import (
    conjugate,
    dot4,
    outer,
    product,
    rotation,
    rotation_backward,
    turned,
    turned_back,
    unit,
    unit_backward,
)
from recon.raster.cpu.threads import kernel

F32, F64 = np.float32, np.float64
ROW = 16
SHIFT, QUAT = 9, 12  # where they begin in a row of linear blending
REAL, DUAL = 0, 4  # and in one of dual quaternions
WINDOW = 4

_kernel = kernel(fastmath={"contract", "reassoc", "nsz"})


@_kernel
def _four(array, i, at):
    return array[i, at], array[i, at + 1], array[i, at + 2], array[i, at + 3]


@_kernel
def _three(array, i, at):
    return array[i, at], array[i, at + 1], array[i, at + 2]


@_kernel
def _nine(array, i):
    return (
        array[i, 0], array[i, 1], array[i, 2],
        array[i, 3], array[i, 4], array[i, 5],
        array[i, 6], array[i, 7], array[i, 8],
    )  # fmt: skip


@_kernel
def _pose(curves, m):
    """Position, and orientation before normalisation, of node m."""
    knots, quats, clock, first, weights = curves
    v = clock[m]
    px, py, pz = 0.0, 0.0, 0.0
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    for k in range(WINDOW):
        p, w = first[v] + k, weights[v, k]
        px += w * knots[p, m, 0]
        py += w * knots[p, m, 1]
        pz += w * knots[p, m, 2]
        a += w * quats[p, m, 0]
        b += w * quats[p, m, 1]
        c += w * quats[p, m, 2]
        d += w * quats[p, m, 3]
    return (px, py, pz), (a, b, c, d)


@_kernel
def _rest(pairs, j):
    p, q = pairs[0], pairs[1]
    return (F64(p[j, 0]), F64(p[j, 1]), F64(p[j, 2])), (F64(q[j, 0]), F64(q[j, 1]), F64(q[j, 2]), F64(q[j, 3]))


@_kernel
def _put(row, i, at, values):
    for k, value in enumerate(values):
        row[i, at + k] = value


@_kernel
def relative(begin, end, curves, pairs, dual, rows):
    """Rows [Q,16] of the pairs of nodes begin..end."""
    node_starts = pairs[2]
    for m in range(begin, end):
        p, raw = _pose(curves, m)
        q, _ = unit(raw)
        for j in range(node_starts[m], node_starts[m + 1]):
            p_rest, q_rest = _rest(pairs, j)
            turn = product(q, conjugate(q_rest))
            R = rotation(turn)
            moved = turned(R, p_rest)
            shift = p[0] - moved[0], p[1] - moved[1], p[2] - moved[2]
            if dual:
                _put(rows, j, REAL, turn)
                _put(rows, j, DUAL, product((0.0, shift[0], shift[1], shift[2]), turn))
            else:
                _put(rows, j, 0, R)
                _put(rows, j, SHIFT, shift)
                _put(rows, j, QUAT, turn)


@_kernel
def _sum_rows(n, slots, rows, at, length, width, signed, total):
    """Row n of `total`: the weighted sum of the rows of its slots, `at` saying where in them the quaternion begins.

    signed [N,8]: the weights with the signs that bring the quaternions into the first one's hemisphere. The first
    `length` entries are summed with the weights, the others up to `width` with the signed ones.
    """
    of_slot, weights = slots
    nearest = of_slot[n, 0]
    for c in range(width):
        total[n, c] = 0
    for k in range(8):
        j, w = of_slot[n, k], weights[n, k]
        agree = F32(0)
        for c in range(at, at + 4):
            agree += rows[j, c] * rows[nearest, c]
        s = w if agree >= 0 else -w
        signed[n, k] = s
        for c in range(length):
            total[n, c] += w * rows[j, c]
        for c in range(length, width):
            total[n, c] += s * rows[j, c]


@_kernel
def _dual_motion(b, e):
    """Unit quaternion, one over the length, shift, and one over the squared length of a blended dual quaternion."""
    u, n = unit(b)
    c = product(e, conjugate(b))
    return u, n, (c[1] * n * n, c[2] * n * n, c[3] * n * n)


@_kernel
def carry(begin, end, slots, rows, dual, means, quats, signed, total, moved_means, moved_quats):
    """Means [N,3] and quats [N,4] of Gaussians begin..end; keeps their summed rows and signed weights for backward."""
    for n in range(begin, end):
        mean = _three(means, n, 0)
        if dual:
            _sum_rows(n, slots, rows, REAL, 0, 8, signed, total)
            u, _, shift = _dual_motion(_four(total, n, REAL), _four(total, n, DUAL))
            x = turned(rotation(u), mean)
        else:
            _sum_rows(n, slots, rows, QUAT, QUAT, ROW, signed, total)
            u, _ = unit(_four(total, n, QUAT))
            x, shift = turned(_nine(total, n), mean), _three(total, n, SHIFT)
        for c in range(3):
            moved_means[n, c] = x[c] + shift[c]
        _put(moved_quats, n, 0, product(u, _four(quats, n, 0)))


@_kernel
def lift(begin, end, total, dual, means, quats, incoming, outgoing, g_total):
    """Gradients of means, quats and summed rows of Gaussians begin..end.

    incoming = gradients of the moved means [N,3] and quats [N,4]; outgoing = of the means and quats.
    """
    for n in range(begin, end):
        mean, quat = _three(means, n, 0), _four(quats, n, 0)
        g_x, g_q = _three(incoming[0], n, 0), _four(incoming[1], n, 0)
        g_u = product(g_q, conjugate(quat))
        if dual:
            b, e = _four(total, n, REAL), _four(total, n, DUAL)
            u, length, shift = _dual_motion(b, e)
            R = rotation(u)
            turn = rotation_backward(u, outer(g_x, mean))
            g_u = g_u[0] + turn[0], g_u[1] + turn[1], g_u[2] + turn[2], g_u[3] + turn[3]
            g_b = unit_backward(u, length, g_u)
            # shift = vector part of e b* / |b|²
            per = length * length
            g_c = F32(0), g_x[0] * per, g_x[1] * per, g_x[2] * per
            through = product(conjugate(g_c), e)
            radial = -2 * per * (shift[0] * g_x[0] + shift[1] * g_x[1] + shift[2] * g_x[2])
            for c in range(4):
                g_total[n, REAL + c] = g_b[c] + through[c] + radial * b[c]
            _put(g_total, n, DUAL, product(g_c, b))
        else:
            u, length = unit(_four(total, n, QUAT))
            R = _nine(total, n)
            _put(g_total, n, 0, outer(g_x, mean))
            _put(g_total, n, SHIFT, g_x)
            _put(g_total, n, QUAT, unit_backward(u, length, g_u))
        _put(outgoing[0], n, 0, turned_back(R, g_x))
        _put(outgoing[1], n, 0, product(conjugate(u), g_q))


@_kernel
def gather(begin, end, starts, slot_list, weights, signed, dual, g_total, g_rows):
    """Gradients of rows begin..end of the pairs: over the slots of each, in order."""
    for j in range(begin, end):
        for c in range(ROW):
            g_rows[j, c] = 0
        for i in range(starts[j], starts[j + 1]):
            slot = slot_list[i]
            n, k = slot >> 3, slot & 7
            w, s = weights[n, k], signed[n, k]
            if dual:
                for c in range(8):
                    g_rows[j, c] += s * g_total[n, c]
            else:
                for c in range(QUAT):
                    g_rows[j, c] += w * g_total[n, c]
                for c in range(QUAT, ROW):
                    g_rows[j, c] += s * g_total[n, c]


@_kernel
def _row_backward(g_rows, j, dual, turn, shift):
    """Gradients of rotation, shift and quaternion of pair j, in float64, from that of its row."""
    if dual:
        g_real, g_dual = _four(g_rows, j, REAL), _four(g_rows, j, DUAL)
        # dual = (0, shift) turn
        g_shift = product((F64(g_dual[0]), F64(g_dual[1]), F64(g_dual[2]), F64(g_dual[3])), conjugate(turn))
        through = product((0.0, -shift[0], -shift[1], -shift[2]), (F64(g_dual[0]), F64(g_dual[1]), F64(g_dual[2]), F64(g_dual[3])))
        g_turn = g_real[0] + through[0], g_real[1] + through[1], g_real[2] + through[2], g_real[3] + through[3]
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (g_shift[1], g_shift[2], g_shift[3]), g_turn
    G, s, q = _nine(g_rows, j), _three(g_rows, j, SHIFT), _four(g_rows, j, QUAT)
    return (
        (F64(G[0]), F64(G[1]), F64(G[2]), F64(G[3]), F64(G[4]), F64(G[5]), F64(G[6]), F64(G[7]), F64(G[8])),
        (F64(s[0]), F64(s[1]), F64(s[2])),
        (F64(q[0]), F64(q[1]), F64(q[2]), F64(q[3])),
    )


@_kernel
def lower(begin, end, curves, slopes, pairs, dual, g_rows, g_knots, g_knot_quats, g_times):
    """Gradients of knots, and of each node's own time [M], for nodes begin..end. slopes [V,4]: dw/dt."""
    knots, quats, clock, first, weights = curves
    for m in range(begin, end):
        p, raw = _pose(curves, m)
        q, length = unit(raw)
        x0, x1, x2 = 0.0, 0.0, 0.0
        q0, q1, q2, q3 = 0.0, 0.0, 0.0, 0.0
        for j in range(pairs[2][m], pairs[2][m + 1]):
            p_rest, q_rest = _rest(pairs, j)
            turn = product(q, conjugate(q_rest))
            moved = turned(rotation(turn), p_rest)
            G, g_shift, g_turn = _row_backward(
                g_rows, j, dual, turn, (p[0] - moved[0], p[1] - moved[1], p[2] - moved[2])
            )
            # shift = p - R p_rest
            O = outer(g_shift, p_rest)
            through = rotation_backward(
                turn,
                (
                    G[0] - O[0], G[1] - O[1], G[2] - O[2],
                    G[3] - O[3], G[4] - O[4], G[5] - O[5],
                    G[6] - O[6], G[7] - O[7], G[8] - O[8],
                ),
            )  # fmt: skip
            g_q = product(
                (g_turn[0] + through[0], g_turn[1] + through[1], g_turn[2] + through[2], g_turn[3] + through[3]), q_rest
            )
            x0, x1, x2 = x0 + g_shift[0], x1 + g_shift[1], x2 + g_shift[2]
            q0, q1, q2, q3 = q0 + g_q[0], q1 + g_q[1], q2 + g_q[2], q3 + g_q[3]
        g_p, g_raw = (x0, x1, x2), unit_backward(q, length, (q0, q1, q2, q3))
        v = clock[m]
        g_time = 0.0
        for k in range(WINDOW):
            i, w = first[v] + k, weights[v, k]
            along = g_p[0] * knots[i, m, 0] + g_p[1] * knots[i, m, 1] + g_p[2] * knots[i, m, 2]
            g_time += slopes[v, k] * (along + dot4(g_raw, (quats[i, m, 0], quats[i, m, 1], quats[i, m, 2], quats[i, m, 3])))
            for c in range(3):
                g_knots[i, m, c] = w * g_p[c]
            for c in range(4):
                g_knot_quats[i, m, c] = w * g_raw[c]
        g_times[m] = g_time
