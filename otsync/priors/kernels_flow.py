"""Compiled loops of optical flow on a part of an image: one level of dense inverse search, and its refinement.

Images and planes of a level are flat float32 arrays of rows of ``stride = w + 2 PAD`` with PAD more pixels on every
side and TAIL at the end, so that neighbours, and what a vector reads too much, exist. Flow is in pixels of the level.
A leaf: importing it imports numba.
"""

from __future__ import annotations

import math

import numpy as np

from ..compute import simd
from ..compute.jit import inlined, kernel
from ..compute.simd import LANES, counting_from, load, magnitude, maximum, select, square_root, store, total

SIDE = 8
"""Pixels of a patch's side: a vector holds a row."""

PAD, TAIL = 24, 64
"""Pixels around every level, and at least so many at the end of its arrays."""

PAGE, SHIFT = 1024, 80
"""Numbers in a page of memory, and how many more than whole pages a plane has: planes whose lengths are whole pages
share the same few places of the fastest cache."""

PLANES = 18
"""Planes that :func:`refine` works in."""

inline = inlined(fastmath={"contract", "nsz"})

ONE, ZERO, HALF = np.float32(1), np.float32(0), np.float32(0.5)
PATCH = np.float32(SIDE * SIDE)

STILL = np.float32(1e-4)
"""Squared pixels of a step below which a patch has arrived."""

SLOPES = np.float32(4.0)
"""Sum of squared slopes (grey levels a pixel) of a patch below which it shows nothing: it stays where it began."""


def length(h: int, w: int) -> int:
    """Numbers in a plane of a level."""
    least = (h + 2 * PAD) * (w + 2 * PAD) + TAIL
    return least + (SHIFT - least) % PAGE


@inline
def _row():
    """1 in the lanes of a patch's row, 0 in those of a longer vector beyond."""
    return select(counting_from(ZERO) < np.float32(SIDE), ONE, ZERO)


@inline
def _corner(x, y, stride):
    """Where a patch with its first pixel at (x, y) begins in a plane, and its bilinear weights."""
    i, j = math.floor(x), math.floor(y)
    u, v = np.float32(x - i), np.float32(y - j)
    return np.int64(j) * stride + np.int64(i), (ONE - u) * (ONE - v), u * (ONE - v), (ONE - u) * v, u * v


@inline
def _difference(I, J, stride, a, at, row):
    """A row of what the moved patch differs by."""
    b, w00, w01, w10, w11 = at
    moved = load(J, b) * w00 + load(J, b + 1) * w01 + load(J, b + stride) * w10 + load(J, b + stride + 1) * w11
    return (moved - load(I, a)) * row


@inline
def _down(at, stride):
    return at[0] + stride, at[1], at[2], at[3], at[4]


@inline
def _misfit(I, J, stride, a, x, y, row):
    """Sum of squared differences less their mean, of the patch at ``a`` moved to (x, y)."""
    at = _corner(x, y, stride)
    first, second = row * ZERO, row * ZERO
    for _ in range(SIDE):
        d = _difference(I, J, stride, a, at, row)
        first, second = first + d, second + d * d
        a, at = a + stride, _down(at, stride)
    s = total(first)
    return total(second) - s * s / PATCH


@inline
def _slopes(X, Y, stride, a, row):
    """Sums of a patch's slopes and of their products, less their means."""
    x, y, xx, xy, yy = row * ZERO, row * ZERO, row * ZERO, row * ZERO, row * ZERO
    for _ in range(SIDE):
        g, h = load(X, a) * row, load(Y, a) * row
        x, y, xx, xy, yy = x + g, y + h, xx + g * g, xy + g * h, yy + h * h
        a += stride
    sx, sy = total(x), total(y)
    return sx, sy, total(xx) - sx * sx / PATCH, total(xy) - sx * sy / PATCH, total(yy) - sy * sy / PATCH


@inline
def _pull(I, J, X, Y, stride, a, x, y, row):
    """Misfit of a moved patch, and the products of its differences, less their mean, with its slopes."""
    at = _corner(x, y, stride)
    first, second, gx, gy = row * ZERO, row * ZERO, row * ZERO, row * ZERO
    for _ in range(SIDE):
        d = _difference(I, J, stride, a, at, row)
        first, second = first + d, second + d * d
        gx, gy = gx + d * load(X, a), gy + d * load(Y, a)
        a, at = a + stride, _down(at, stride)
    s = total(first)
    return total(second) - s * s / PATCH, s, total(gx), total(gy)


@inline
def _inside(x, most):
    return min(max(x, ONE), most)


@inline
def _solved(I, J, X, Y, stride, a, x, y, u, v, right, bottom, steps, row):
    """(u, v) after at most ``steps`` Gauss-Newton steps from (u, v), as long as the misfit falls."""
    sx, sy, xx, xy, yy = _slopes(X, Y, stride, a, row)
    det = xx * yy - xy * xy
    if xx + yy < SLOPES or det < np.float32(1e-3) * (xx + yy) * (xx + yy):
        return u, v
    least, best_u, best_v = np.float32(np.inf), u, v
    for _ in range(steps):
        misfit, s, gx, gy = _pull(I, J, X, Y, stride, a, _inside(x + u, right), _inside(y + v, bottom), row)
        if not misfit < least:
            break
        least, best_u, best_v = misfit, u, v
        gx, gy = gx - s * sx / PATCH, gy - s * sy / PATCH
        du, dv = (yy * gx - xy * gy) / det, (xx * gy - xy * gx) / det
        if du * du + dv * dv < STILL:
            break
        u, v = u - du, v - dv
    return best_u, best_v


@kernel(fastmath={"contract", "nsz"})
def search(I, J, X, Y, h, w, rows, columns, wanted, u0, v0, steps, U, V, known):
    """Flow from I to J of the patches that are wanted, spread over their pixels.

    I, J: grey levels. X, Y: slopes of I. rows, columns: first pixels of the patches. wanted (rows, columns): which of
    them. u0, v0 (rows, columns): where they begin. U, V, known: planes that are written, ``known`` 1 where a patch
    lies, else 0.

    Twice, from the first patch on and from the last, a patch begins at the best of its own flow and those of two
    neighbours. What leaves its beginning by more than a patch is not believed.
    """
    stride = w + 2 * PAD
    right, bottom = np.float32(w + 2 * PAD - SIDE - 2), np.float32(h + 2 * PAD - SIDE - 2)
    row = _row()
    pu, pv = u0.copy(), v0.copy()
    n, m = len(rows), len(columns)
    for way in range(2):
        side = 2 * way - 1
        for ii in range(n):
            i = ii if way == 0 else n - 1 - ii
            for jj in range(m):
                j = jj if way == 0 else m - 1 - jj
                if not wanted[i, j]:
                    continue
                x, y = np.float32(columns[j] + PAD), np.float32(rows[i] + PAD)
                a = (rows[i] + PAD) * stride + columns[j] + PAD
                u, v = pu[i, j], pv[i, j]
                least = _misfit(I, J, stride, a, _inside(x + u, right), _inside(y + v, bottom), row)
                for k in range(2):
                    i2, j2 = (i, j + side) if k == 0 else (i + side, j)
                    if 0 <= i2 < n and 0 <= j2 < m and wanted[i2, j2]:
                        u2, v2 = pu[i2, j2], pv[i2, j2]
                        misfit = _misfit(I, J, stride, a, _inside(x + u2, right), _inside(y + v2, bottom), row)
                        if misfit < least:
                            least, u, v = misfit, u2, v2
                u, v = _solved(I, J, X, Y, stride, a, x, y, u, v, right, bottom, steps, row)
                if abs(u - u0[i, j]) > SIDE or abs(v - v0[i, j]) > SIDE:
                    u, v = u0[i, j], v0[i, j]
                pu[i, j], pv[i, j] = u, v
    U[:], V[:], known[:] = ZERO, ZERO, ZERO
    for i in range(n):
        for j in range(m):
            if wanted[i, j]:
                a = (rows[i] + PAD) * stride + columns[j] + PAD
                u, v = pu[i, j], pv[i, j]
                x, y = _inside(np.float32(columns[j] + PAD) + u, right), _inside(np.float32(rows[i] + PAD) + v, bottom)
                at = _corner(x, y, stride)
                for _ in range(SIDE):
                    d = _difference(I, J, stride, a, at, row)
                    share = row / maximum(magnitude(d), ONE)
                    store(known, a, load(known, a) + share)
                    store(U, a, load(U, a) + share * u)
                    store(V, a, load(V, a) + share * v)
                    a, at = a + stride, _down(at, stride)
    for k in range(0, len(U) - LANES + 1, LANES):
        shares = load(known, k)
        if simd.any_lane(shares > ZERO):
            there = shares > ZERO
            shares = select(there, shares, ONE)
            store(U, k, load(U, k) / shares)
            store(V, k, load(V, k) / shares)
            store(known, k, select(there, ONE, ZERO))


@kernel()
def beginnings(U, V, known, h, w, h2, w2, rows, columns, wanted, u0, v0):
    """Flow (u0, v0) that patches of a level of h2 x w2 pixels begin with, from that of the coarser level of h x w."""
    stride = w + 2 * PAD
    across, down = np.float32(w2 / w), np.float32(h2 / h)
    for i in range(len(rows)):
        for j in range(len(columns)):
            u0[i, j], v0[i, j] = ZERO, ZERO
            if not wanted[i, j]:
                continue
            x = min(max((columns[j] + SIDE / 2) / across - 0.5, 0.0), w - 1.0)
            y = min(max((rows[i] + SIDE / 2) / down - 0.5, 0.0), h - 1.0)
            c, r = int(x), int(y)
            whole, u, v = ZERO, ZERO, ZERO
            for q in range(2):
                for p in range(2):
                    k = (r + q + PAD) * stride + c + p + PAD
                    share = np.float32((1 - abs(x - c - p)) * (1 - abs(y - r - q))) * known[k]
                    whole, u, v = whole + share, u + share * U[k], v + share * V[k]
            if whole > 0:
                u0[i, j], v0[i, j] = across * u / whole, down * v / whole


@kernel()
def stretches(moves, h, w, plane):
    """Where vectors begin that hold all pixels of ``moves`` (h,w) uint8; whether row and column of these add up to an
    odd number. Writes 1 in ``plane``, which is 0, where something moves.
    """
    stride = w + 2 * PAD
    first, odd = np.empty(h * (w // LANES + 1), np.int64), np.empty(h * (w // LANES + 1), np.float32)
    n = 0
    for y in range(h):
        x = 0
        while x < w:
            if not moves[y, x]:
                x += 1
                continue
            a = (y + PAD) * stride + x + PAD
            first[n], odd[n] = a, (x + y) & 1
            n += 1
            for k in range(min(LANES, w - x)):
                plane[a + k] = moves[y, x + k] != 0
            x += LANES
    # every second one, then the others: what one writes is not read by the next, which would wait for it
    order = np.concatenate((np.arange(0, n, 2), np.arange(1, n, 2)))
    return first[order], odd[order]


@inline
def _weight(residual, norm, strength, eps):
    """Of a row of the data term: strength / (norm sqrt(residual² / norm + eps²))."""
    return strength / (norm * square_root(residual * residual / norm + eps))


@kernel(fastmath={"contract", "nsz"})
def refine(I, J, h, w, first, odd, inside, U, V, known, P, rounds, sweeps, smooth, grey, slope):
    """Variational refinement of the flow (U, V) from I to J where ``inside`` is 1, in place (Brox et al., ECCV 2004).

    Grey levels and their slopes stay as they are, robustly, and the flow is smooth, robustly; beyond ``inside`` is
    nothing. first, odd: vectors (:func:`stretches`). P (PLANES,n): planes to work in. rounds: times that the robust
    weights are found anew; sweeps of successive over-relaxation in each. smooth, grey, slope: strengths.
    """
    stride = w + 2 * PAD
    M, Iz, Ix, Iy, Ixx, Ixy, Iyy, Ixz, Iyz = P[0], P[1], P[2], P[3], P[4], P[5], P[6], P[7], P[8]
    dU, dV, right, below, b1, b2, A12, r1, r2 = P[9], P[10], P[11], P[12], P[13], P[14], P[15], P[16], P[17]
    P[9:13] = ZERO
    top, side = np.float32(w + 2 * PAD - 2), np.float32(h + 2 * PAD - 2)
    # mean of both images and their difference, wherever a slope of a slope looks
    M[:], Iz[:] = I, ZERO
    for y in range(PAD, PAD + h):
        for x in range(PAD, PAD + w):
            a = y * stride + x
            if known[a] > 0:
                b, w00, w01, w10, w11 = _corner(
                    _inside(np.float32(x) + U[a], top), _inside(np.float32(y) + V[a], side), stride
                )
                moved = w00 * J[b] + w01 * J[b + 1] + w10 * J[b + stride] + w11 * J[b + stride + 1]
                M[a], Iz[a] = HALF * (moved + I[a]), moved - I[a]
    for a in first:
        for b in (a - stride, a - 1, a + 1, a + stride):
            store(Ix, b, (load(M, b + 1) - load(M, b - 1)) * HALF)
            store(Iy, b, (load(M, b + stride) - load(M, b - stride)) * HALF)
    for a in first:
        store(Ixz, a, (load(Iz, a + 1) - load(Iz, a - 1)) * HALF)
        store(Iyz, a, (load(Iz, a + stride) - load(Iz, a - stride)) * HALF)
        store(Ixx, a, (load(Ix, a + 1) - load(Ix, a - 1)) * HALF)
        store(Ixy, a, (load(Ix, a + stride) - load(Ix, a - stride)) * HALF)
        store(Iyy, a, (load(Iy, a + stride) - load(Iy, a - stride)) * HALF)
    eps, zeta = np.float32(1e-6), np.float32(0.01)
    relax = np.float32(1.6)
    white = select(counting_from(ZERO) - simd.round_down(counting_from(ZERO) * HALF) * np.float32(2) < HALF, ONE, ZERO)
    black = ONE - white
    for _ in range(rounds):
        for a in first:
            here = load(inside, a)
            east, south = here * load(inside, a + 1), here * load(inside, a + stride)
            u, v = load(U, a) + load(dU, a), load(V, a) + load(dV, a)
            ux = (load(U, a + 1) + load(dU, a + 1) - u) * east
            vx = (load(V, a + 1) + load(dV, a + 1) - v) * east
            uy = (load(U, a + stride) + load(dU, a + stride) - u) * south
            vy = (load(V, a + stride) + load(dV, a + stride) - v) * south
            weight = smooth / square_root(ux * ux + vx * vx + uy * uy + vy * vy + eps)
            store(right, a, weight * east)
            store(below, a, weight * south)
        for a in first:
            here = load(inside, a)
            du, dv = load(dU, a), load(dV, a)
            x, y, z = load(Ix, a), load(Iy, a), load(Iz, a)
            norm = x * x + y * y + zeta
            k = _weight(z + x * du + y * dv, norm, grey, eps) * here
            a11, a12, a22 = k * x * x, k * x * y, k * y * y
            c1, c2 = k * x * z, k * y * z
            xx, xy, yy, xz, yz = load(Ixx, a), load(Ixy, a), load(Iyy, a), load(Ixz, a), load(Iyz, a)
            norm = xx * xx + xy * xy + zeta
            k = _weight(xz + xx * du + xy * dv, norm, slope, eps) * here
            a11, a12, a22 = a11 + k * xx * xx, a12 + k * xx * xy, a22 + k * xy * xy
            c1, c2 = c1 + k * xx * xz, c2 + k * xy * xz
            norm = xy * xy + yy * yy + zeta
            k = _weight(yz + xy * du + yy * dv, norm, slope, eps) * here
            a11, a12, a22 = a11 + k * xy * xy, a12 + k * xy * yy, a22 + k * yy * yy
            c1, c2 = c1 + k * xy * yz, c2 + k * yy * yz
            e, t, s, q = load(right, a), load(right, a - 1), load(below, a), load(below, a - stride)
            around = e + t + s + q + zeta
            u, v = load(U, a), load(V, a)
            pull = e * (load(U, a + 1) - u) + t * (load(U, a - 1) - u)
            c1 = pull + s * (load(U, a + stride) - u) + q * (load(U, a - stride) - u) - c1
            pull = e * (load(V, a + 1) - v) + t * (load(V, a - 1) - v)
            c2 = pull + s * (load(V, a + stride) - v) + q * (load(V, a - stride) - v) - c2
            store(b1, a, c1)
            store(b2, a, c2)
            store(A12, a, a12)
            store(r1, a, relax / (a11 + around))
            store(r2, a, relax / (a22 + around))
        for _ in range(sweeps):
            for parity in range(2):
                for n in range(len(first)):
                    # a checkerboard, so that neighbours wait for each other: pixels of one colour, then of the other
                    a = first[n]
                    turn = (white if odd[n] == parity else black) * load(inside, a)
                    e, t, s, q = load(right, a), load(right, a - 1), load(below, a), load(below, a - stride)
                    u, v, cross = load(dU, a), load(dV, a), load(A12, a)
                    near = e * load(dU, a + 1) + t * load(dU, a - 1)
                    near = near + s * load(dU, a + stride) + q * load(dU, a - stride)
                    u2 = u + turn * (load(r1, a) * (near + load(b1, a) - cross * v) - relax * u)
                    near = e * load(dV, a + 1) + t * load(dV, a - 1)
                    near = near + s * load(dV, a + stride) + q * load(dV, a - stride)
                    v2 = v + turn * (load(r2, a) * (near + load(b2, a) - cross * u2) - relax * v)
                    store(dU, a, u2)
                    store(dV, a, v2)
    for a in first:
        store(U, a, load(U, a) + load(dU, a))
        store(V, a, load(V, a) + load(dV, a))
