"""The warp of :mod:`recon.motion.warp` in two compiled phases, forward and backward.

forward:  relative  node by node: its pose at t, then the relative motion of each of its (rest, node) pairs: a row.
          carry     Gaussian by Gaussian: the weighted sum of eight rows, and what it does to mean and orientation.
backward: lift      Gaussian by Gaussian: gradients of mean and orientation, and of the summed row.
          gather    pair by pair: gradient of its row, over the slots of the Gaussians that use it.
          lower     node by node: gradient of its pose, hence of its four knots and of the time.

Every output has one owner, who sums in a fixed order: results do not depend on the threads.

A row is, for linear blending, the rotation's nine entries, the shift and the quaternion (wxyz): 16 floats. For dual
quaternions it is the quaternion and twice the dual part: 8 floats, in a row of 16 as well. Rows, means and quats are
flat; a row is read as one vector, or as a head and a tail where vectors are shorter.

Arguments that belong together travel as tuples: curves and moment as in :mod:`recon.motion.pose_kernels`, pairs = (rest
positions [Q,3], rest quats [Q,4], node_starts [M+1]), slots = (pair of each slot [N,8], weights [N,8]).
"""

from __future__ import annotations

import numpy as np

from otsync.compute import simd
from otsync.compute.jit import kernel
from otsync.compute.quaternions import (
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
from otsync.compute.simd import LANES
from recon.motion.pose_kernels import along_time, lower_orientation, lower_position, orientation, position

F32, F64 = np.float32, np.float64
ROW = 16
SHIFT, QUAT = 9, 12  # where they begin in a row of linear blending
REAL, DUAL = 0, 4  # and in one of dual quaternions
TAIL = ROW - LANES  # where the last vector of a row begins; 0 where one vector holds a row

_kernel = kernel(fastmath={"contract", "reassoc", "nsz"})


@_kernel
def _four(flat, i):
    return flat[i], flat[i + 1], flat[i + 2], flat[i + 3]


@_kernel
def _three(flat, i):
    return flat[i], flat[i + 1], flat[i + 2]


@_kernel
def _nine(flat, i):
    return (
        flat[i],
        flat[i + 1],
        flat[i + 2],
        flat[i + 3],
        flat[i + 4],
        flat[i + 5],
        flat[i + 6],
        flat[i + 7],
        flat[i + 8],
    )


@_kernel
def _rest(pairs, j):
    p, q = pairs[0], pairs[1]
    return (F64(p[j, 0]), F64(p[j, 1]), F64(p[j, 2])), (F64(q[j, 0]), F64(q[j, 1]), F64(q[j, 2]), F64(q[j, 3]))


@_kernel
def _put(flat, i, values):
    for k, value in enumerate(values):
        flat[i + k] = value


@_kernel
def relative(begin, end, curves, moment, pairs, dual, rows):
    """Rows [Q,16] of the pairs of nodes begin..end."""
    node_starts = pairs[2]
    for m in range(begin, end):
        p = position(curves, moment, m)
        q, _ = orientation(curves, moment, m)
        for j in range(node_starts[m], node_starts[m + 1]):
            p_rest, q_rest = _rest(pairs, j)
            turn = product(q, conjugate(q_rest))
            R = rotation(turn)
            moved = turned(R, p_rest)
            shift = p[0] - moved[0], p[1] - moved[1], p[2] - moved[2]
            if dual:
                _put(rows, j * ROW + REAL, turn)
                _put(rows, j * ROW + DUAL, product((0.0, shift[0], shift[1], shift[2]), turn))
            else:
                _put(rows, j * ROW, R)
                _put(rows, j * ROW + SHIFT, shift)
                _put(rows, j * ROW + QUAT, turn)


@_kernel
def _sum_rows(n, slots, rows, at, dual, signed, total):
    """Row n of `total`: the weighted sum of the rows of its slots, `at` saying where in them the quaternion begins.

    signed [N,8]: the weights with the signs that bring the quaternions into the first one's hemisphere. Dual
    quaternions are summed with these; of other rows only the quaternion is.
    """
    of_slot, weights = slots
    nearest = _four(rows, of_slot[n, 0] * ROW + at)
    crossed = False
    head = tail = simd.spread(F32(0))
    for k in range(8):
        begin, w = of_slot[n, k] * ROW, weights[n, k]
        s = w if dot4(nearest, _four(rows, begin + at)) >= 0 else -w
        signed[n, k] = s
        if dual:
            head = head + s * simd.load(rows, begin)
        else:
            head = head + w * simd.load(rows, begin)
            tail = tail + w * simd.load(rows, begin + TAIL)
            crossed |= s < 0
    if not dual:
        simd.store(total, n * ROW + TAIL, tail)
    simd.store(total, n * ROW, head)
    if crossed:
        for k in range(8):
            if signed[n, k] < 0:  # rare: two neighbours have turned apart by half a turn since the rest
                _add_twice(total, n, signed[n, k], rows, of_slot[n, k])


@_kernel
def _add_twice(total, i, w, rows, j):
    """To the quaternion of row i twice w times that of row j: what was added with the wrong sign becomes right."""
    for c in range(QUAT, ROW):
        total[i * ROW + c] += 2 * w * rows[j * ROW + c]


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
        mean = _three(means, 3 * n)
        if dual:
            _sum_rows(n, slots, rows, REAL, dual, signed, total)
            u, _, shift = _dual_motion(_four(total, n * ROW + REAL), _four(total, n * ROW + DUAL))
            x = turned(rotation(u), mean)
        else:
            _sum_rows(n, slots, rows, QUAT, dual, signed, total)
            u, _ = unit(_four(total, n * ROW + QUAT))
            x, shift = turned(_nine(total, n * ROW), mean), _three(total, n * ROW + SHIFT)
        for c in range(3):
            moved_means[3 * n + c] = x[c] + shift[c]
        _put(moved_quats, 4 * n, product(u, _four(quats, 4 * n)))


@_kernel
def lift(begin, end, total, dual, means, quats, incoming, outgoing, g_total):
    """Gradients of means, quats and summed rows of Gaussians begin..end.

    incoming = gradients of the moved means [N,3] and quats [N,4]; outgoing = of the means and quats.
    """
    for n in range(begin, end):
        mean, quat = _three(means, 3 * n), _four(quats, 4 * n)
        g_x, g_q = _three(incoming[0], 3 * n), _four(incoming[1], 4 * n)
        g_u = product(g_q, conjugate(quat))
        if dual:
            b, e = _four(total, n * ROW + REAL), _four(total, n * ROW + DUAL)
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
                g_total[n * ROW + REAL + c] = g_b[c] + through[c] + radial * b[c]
            _put(g_total, n * ROW + DUAL, product(g_c, b))
        else:
            u, length = unit(_four(total, n * ROW + QUAT))
            R = _nine(total, n * ROW)
            _put(g_total, n * ROW, outer(g_x, mean))
            _put(g_total, n * ROW + SHIFT, g_x)
            _put(g_total, n * ROW + QUAT, unit_backward(u, length, g_u))
        _put(outgoing[0], 3 * n, turned_back(R, g_x))
        _put(outgoing[1], 4 * n, product(conjugate(u), g_q))


@_kernel
def gather(begin, end, starts, slot_list, weights, signed, dual, g_total, g_rows):
    """Gradients of rows begin..end of the pairs: over the slots of each, in order."""
    for j in range(begin, end):
        head = tail = simd.spread(F32(0))
        crossed = False
        for i in range(starts[j], starts[j + 1]):
            slot = slot_list[i]
            n, k = slot >> 3, slot & 7
            w, s = weights[n, k], signed[n, k]
            if dual:
                head = head + s * simd.load(g_total, n * ROW)
            else:
                head = head + w * simd.load(g_total, n * ROW)
                tail = tail + w * simd.load(g_total, n * ROW + TAIL)
                crossed |= s < 0
        if not dual:
            simd.store(g_rows, j * ROW + TAIL, tail)
        simd.store(g_rows, j * ROW, head)
        if crossed:
            for i in range(starts[j], starts[j + 1]):
                n, k = slot_list[i] >> 3, slot_list[i] & 7
                if signed[n, k] < 0:
                    _add_twice(g_rows, j, signed[n, k], g_total, n)


@_kernel
def _row_backward(g_rows, j, dual, turn, shift):
    """Gradients of rotation, shift and quaternion of pair j, in float64, from that of its row."""
    if dual:
        g_real, g_dual = _four(g_rows, j * ROW + REAL), _four(g_rows, j * ROW + DUAL)
        # dual = (0, shift) turn
        g_shift = product((F64(g_dual[0]), F64(g_dual[1]), F64(g_dual[2]), F64(g_dual[3])), conjugate(turn))
        through = product(
            (0.0, -shift[0], -shift[1], -shift[2]), (F64(g_dual[0]), F64(g_dual[1]), F64(g_dual[2]), F64(g_dual[3]))
        )
        g_turn = g_real[0] + through[0], g_real[1] + through[1], g_real[2] + through[2], g_real[3] + through[3]
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (g_shift[1], g_shift[2], g_shift[3]), g_turn
    G, s, q = _nine(g_rows, j * ROW), _three(g_rows, j * ROW + SHIFT), _four(g_rows, j * ROW + QUAT)
    return (
        (F64(G[0]), F64(G[1]), F64(G[2]), F64(G[3]), F64(G[4]), F64(G[5]), F64(G[6]), F64(G[7]), F64(G[8])),
        (F64(s[0]), F64(s[1]), F64(s[2])),
        (F64(q[0]), F64(q[1]), F64(q[2]), F64(q[3])),
    )


@_kernel
def lower(begin, end, curves, moment, slopes, pairs, dual, g_rows, g_knots, g_knot_quats, g_times):
    """Gradients of knots, and of each node's own time [M], for nodes begin..end. slopes [V,4]: dw/dt."""
    for m in range(begin, end):
        p = position(curves, moment, m)
        q, length = orientation(curves, moment, m)
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
                    G[0] - O[0],
                    G[1] - O[1],
                    G[2] - O[2],
                    G[3] - O[3],
                    G[4] - O[4],
                    G[5] - O[5],
                    G[6] - O[6],
                    G[7] - O[7],
                    G[8] - O[8],
                ),
            )
            g_q = product(
                (g_turn[0] + through[0], g_turn[1] + through[1], g_turn[2] + through[2], g_turn[3] + through[3]), q_rest
            )
            x0, x1, x2 = x0 + g_shift[0], x1 + g_shift[1], x2 + g_shift[2]
            q0, q1, q2, q3 = q0 + g_q[0], q1 + g_q[1], q2 + g_q[2], q3 + g_q[3]
        g_p = x0, x1, x2
        lower_position(curves, moment, m, g_p, g_knots)
        g_raw = lower_orientation(curves, moment, m, q, length, (q0, q1, q2, q3), g_knot_quats)
        g_times[m] = along_time(curves, slopes, moment[0], m, g_p, g_raw)
