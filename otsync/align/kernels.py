"""Compiled loops of the aligners."""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel


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
def lag_statistics(a, wa, qa, b, wb, qb, lags, least, count, power, residual):
    """Variances of every match over its common frames at every lag; the mean over exactly these frames is removed.

    a (M,3,Ta), b (M,3,Tb): 0 where unseen; wa (M,Ta), wb: 1 seen, 0 not; qa = |a|^2, qb. Frame i of a meets i - lag of
    b. Fills (M,K): frames in common; Var(a) + Var(b); Var(a - b). All 0 below ``least`` frames in common.
    """
    M, _, Ta = a.shape
    Tb = b.shape[2]
    for m in range(M):
        for n in range(len(lags)):
            k = lags[n]
            lo, hi = max(0, k), min(Ta, Tb + k)
            if hi - lo < least:
                continue
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
            if c < least:
                continue
            count[m, n] = c
            own = (sx * sx + sy * sy + sz * sz + SX * SX + SY * SY + SZ * SZ) / c
            dx, dy, dz = sx - SX, sy - SY, sz - SZ
            power[m, n] = max((sp + SP - own) / c, 0.0)
            residual[m, n] = max((sp + SP - 2 * cross - (dx * dx + dy * dy + dz * dz) / c) / c, 0.0)


@kernel(fastmath={"contract", "reassoc", "nsz"})
def windowed_evidence(a, wa, qa, b, wb, qb, lags, block, least, floor, weight, out):
    """Sum over matches and windows of n/2 log((Var a + Var b + floor) / (Var(a - b) + floor)) at every lag.

    Matches count by their ``weight``. Arrays as for :func:`lag_statistics`. Windows are two blocks of ``block`` frames
    long and start every block, counted from the first common frame, which treats a and b alike; the first and last
    block are windows of their own too. Adds to out (K,), each window with weight 1/2, since every sample is in two.
    """
    M, _, Ta = a.shape
    Tb = b.shape[2]
    sums = np.empty((2, 10))
    for m in range(M):
        for n in range(len(lags)):
            k = lags[n]
            first, end = max(0, k), min(Ta, Tb + k)
            blocks = (end - first + block - 1) // block
            sums[:] = 0.0
            for j in range(blocks + 1):
                now, before = sums[j % 2], sums[1 - j % 2]
                now[:] = 0.0
                if j < blocks:
                    lo, hi = first + j * block, min(first + (j + 1) * block, end)
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
                    now[0], now[1], now[2], now[3], now[4], now[5] = c, sx, sy, sz, SX, SY
                    now[6], now[7], now[8], now[9] = SZ, sp, SP, cross
                c = now[0] + before[0]
                if c < least:
                    continue
                sx, sy, sz = now[1] + before[1], now[2] + before[2], now[3] + before[3]
                SX, SY, SZ = now[4] + before[4], now[5] + before[5], now[6] + before[6]
                both = now[7] + before[7] + now[8] + before[8]
                own = (sx * sx + sy * sy + sz * sz + SX * SX + SY * SY + SZ * SZ) / c
                dx, dy, dz = sx - SX, sy - SY, sz - SZ
                rest = both - 2 * (now[9] + before[9]) - (dx * dx + dy * dy + dz * dz) / c
                power, residual = max((both - own) / c, 0.0), max(rest / c, 0.0)
                out[n] += weight[m] * (0.25 * c * np.log((power + floor) / (residual + floor)))
