"""Compiled loops of the aligners."""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel
from ..compute.threads import for_each, ranges

SAMPLES_AT_ONCE = 10_000_000
"""Samples times lags that one thread takes at a time: some hundredths of a second."""


@kernel()
def open_end_path(cost, level):
    """Warping path with free ends: from the first row or column to the last row or column.

    Maximises the sum of ``level - cost`` over a monotone path (semi-global alignment), so that frames outside the
    overlap cost nothing and a long overlap is worth having. A diagonal step counts twice (Sakoe and Chiba's
    symmetric form): then a path's weight is the frames it spans, and a staircase gains nothing over a line.
    Returns (P,2) frame pairs.
    """
    n, m = cost.shape
    total = np.empty((n, m))
    step = np.zeros((n, m), np.int8)  # 0 start, 1 diagonal, 2 down, 3 right
    for i in range(n):
        for j in range(m):
            gain = level - cost[i, j]
            if i > 0 and j > 0:
                best, move = total[i - 1, j - 1] + 2 * gain, 1
                if total[i - 1, j] + gain > best:
                    best, move = total[i - 1, j] + gain, 2
                if total[i, j - 1] + gain > best:
                    best, move = total[i, j - 1] + gain, 3
                total[i, j] = best
                step[i, j] = move
            else:
                total[i, j] = gain
    i, j = n - 1, m - 1
    for c in range(m):
        if total[n - 1, c] > total[i, j]:
            i, j = n - 1, c
    for r in range(n):
        if total[r, m - 1] > total[i, j]:
            i, j = r, m - 1
    path = np.empty((n + m, 2), np.int64)
    length = 0
    while True:
        path[length, 0], path[length, 1] = i, j
        length += 1
        move = step[i, j]
        if move == 0:
            break
        if move != 3:
            i -= 1
        if move != 2:
            j -= 1
    return path[:length][::-1]


@kernel(fastmath={"contract", "reassoc", "nsz"})
def common_sums(a, wa, qa, b, wb, qb, m, lo, hi, k, out):
    """Sums over the frames lo:hi of a in which match m is seen in both; frame i of a meets i - k of b.

    Fills out (10,): frames in common, Σa (3), Σb (3), Σ|a|², Σ|b|², Σa·b.
    """
    x, y, z, u, p = a[m, 0, lo:hi], a[m, 1, lo:hi], a[m, 2, lo:hi], wa[m, lo:hi], qa[m, lo:hi]
    X, Y, Z = b[m, 0, lo - k : hi - k], b[m, 1, lo - k : hi - k], b[m, 2, lo - k : hi - k]
    U, P = wb[m, lo - k : hi - k], qb[m, lo - k : hi - k]
    c = sx = sy = sz = SX = SY = SZ = sp = SP = cross = 0.0
    for i in range(hi - lo):
        c += u[i] * U[i]
        sx += x[i] * U[i]
        sy += y[i] * U[i]
        sz += z[i] * U[i]
        SX += X[i] * u[i]
        SY += Y[i] * u[i]
        SZ += Z[i] * u[i]
        sp += p[i] * U[i]
        SP += P[i] * u[i]
        cross += x[i] * X[i] + y[i] * Y[i] + z[i] * Z[i]
    out[0], out[1], out[2], out[3], out[4], out[5] = c, sx, sy, sz, SX, SY
    out[6], out[7], out[8], out[9] = SZ, sp, SP, cross


@kernel(fastmath={"contract", "reassoc", "nsz"})
def variances(s):
    """Var(a) + Var(b) and Var(a - b) from :func:`common_sums`."""
    c = s[0]
    own = (s[1] * s[1] + s[2] * s[2] + s[3] * s[3] + s[4] * s[4] + s[5] * s[5] + s[6] * s[6]) / c
    dx, dy, dz = s[1] - s[4], s[2] - s[5], s[3] - s[6]
    both = s[7] + s[8]
    rest = both - 2 * s[9] - (dx * dx + dy * dy + dz * dz) / c
    return max((both - own) / c, 0.0), max(rest / c, 0.0)


@kernel(fastmath={"contract", "reassoc", "nsz"})
def lag_statistics(a, wa, qa, lives_a, b, wb, qb, lives_b, lags, least, count, power, residual):
    """Variances of every match over its common frames at every lag; the mean over exactly these frames is removed.

    a (M,3,Ta), b (M,3,Tb): 0 where unseen; wa (M,Ta), wb: 1 seen, 0 not; qa = |a|^2, qb; lives_a (M,2), lives_b: from
    and before which frame. Frame i of a meets i - lag of b. Fills (M,K): frames in common; Var(a) + Var(b); Var(a - b).
    All 0 below ``least`` frames in common.
    """
    s = np.empty(10)
    for m in range(len(a)):
        for n in range(len(lags)):
            k = lags[n]
            lo, hi = max(lives_a[m, 0], lives_b[m, 0] + k), min(lives_a[m, 1], lives_b[m, 1] + k)
            if hi - lo < least:
                continue
            common_sums(a, wa, qa, b, wb, qb, m, lo, hi, k, s)
            if s[0] < least:
                continue
            count[m, n] = s[0]
            power[m, n], residual[m, n] = variances(s)


def windowed_evidence(a, wa, qa, lives_a, b, wb, qb, lives_b, lags, begin, block, least, floor, weight, out):
    """Sum over matches and windows of n/2 log((Var a + Var b + floor) / (Var(a - b) + floor)) at every lag.

    Matches count by their ``weight``. Arrays as for :func:`lag_statistics`. Windows are two blocks of ``block`` frames
    long and start every block, counted from frame ``begin`` (K,) of a; the first and last block are windows of their
    own too. Adds to out (W,K), where W = 1 for the sum of all windows, or one row a window; each counts 1/2, since
    every sample is in two. The lags are spread over threads.
    """
    at_once = max(1, SAMPLES_AT_ONCE // max(a.shape[0] * a.shape[2], 1))
    arrays = a, wa, qa, lives_a, b, wb, qb, lives_b, lags, begin, block, least, floor, weight, out
    for_each(add_evidence, ranges(len(lags), at_once), *arrays)


@kernel(fastmath={"contract", "reassoc", "nsz"})
def add_evidence(first, end, a, wa, qa, lives_a, b, wb, qb, lives_b, lags, begin, block, least, floor, weight, out):
    """:func:`windowed_evidence` of the lags first:end."""
    sums = np.empty((2, 10))
    whole = np.empty(10)
    for m in range(len(a)):
        for n in range(first, end):
            k = lags[n]
            lowest, highest = max(lives_a[m, 0], lives_b[m, 0] + k), min(lives_a[m, 1], lives_b[m, 1] + k)
            if highest - lowest < least:
                continue
            blocks = (highest - begin[n] + block - 1) // block
            sums[:] = 0.0
            for j in range(max(0, (lowest - begin[n]) // block), blocks + 1):
                now, before = sums[j % 2], sums[1 - j % 2]
                now[:] = 0.0
                lo, hi = max(lowest, begin[n] + j * block), min(begin[n] + (j + 1) * block, highest)
                if hi > lo:
                    common_sums(a, wa, qa, b, wb, qb, m, lo, hi, k, now)
                for q in range(10):
                    whole[q] = now[q] + before[q]
                if whole[0] < least:
                    continue
                power, residual = variances(whole)
                row = j if len(out) > 1 else 0
                out[row, n] += weight[m] * (0.25 * whole[0] * np.log((power + floor) / (residual + floor)))
