"""Compiled inner loops. A leaf: importing it imports numba, so algorithms import it when they run.

Every kernel releases the GIL and is called over blocks from :func:`over_blocks`, not with numba's own ``prange``:
its workqueue layer aborts the process when two Python threads enter it, and callers may bring any thread pool.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from .jit import kernel


def over_blocks(work: Callable[..., Any], blocks: Iterable[Any], threads: int | None = None) -> None:
    """Run ``work(block)`` for every block on a small pool; blocks must write to disjoint places."""
    blocks = list(blocks)
    threads = min(threads or os.cpu_count() or 1, len(blocks))
    if threads <= 1:
        for block in blocks:
            work(block)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, blocks))


@kernel(fastmath={"contract", "reassoc", "nsz"})
def max_distance_block(a, b, wa, wb, gaps, i0, i1, j0, j1, out):
    """D_track of rows i0:i1 of ``a`` against columns j0:j1 of ``b``.

    a (3,T,N), b (3,T,M): positions, 0 where unseen; wa (T,N), wb (T,M): 1 seen, 0 not, read only when ``gaps``.
    out (N,M): the largest distance over co-visible frames, nan where there is none.
    """
    T = a.shape[1]
    n, m = i1 - i0, j1 - j0
    best = np.zeros((n, m), a.dtype)
    met = np.zeros((n, m), a.dtype)
    for t in range(T):
        x, y, z = b[0, t, j0:j1], b[1, t, j0:j1], b[2, t, j0:j1]
        w = wb[t, j0:j1]
        for i in range(n):
            px, py, pz = a[0, t, i0 + i], a[1, t, i0 + i], a[2, t, i0 + i]
            row = best[i]
            if gaps:
                if wa[t, i0 + i] == 0:
                    continue
                seen = met[i]
                for j in range(m):
                    dx, dy, dz = px - x[j], py - y[j], pz - z[j]
                    row[j] = max(row[j], w[j] * (dx * dx + dy * dy + dz * dz))
                    seen[j] = max(seen[j], w[j])
            else:
                for j in range(m):
                    dx, dy, dz = px - x[j], py - y[j], pz - z[j]
                    row[j] = max(row[j], dx * dx + dy * dy + dz * dz)
    for i in range(n):
        for j in range(m):
            out[i0 + i, j0 + j] = np.nan if gaps and met[i, j] == 0 else np.sqrt(best[i, j])


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

    a (M,3,Ta), b (M,3,Tb): 0 where unseen; wa (M,Ta), wb: 1 seen, 0 not; qa = |a|^2, qb. Frame i of a meets i - lag of b.
    Fills (M,K): frames in common; Var(a) + Var(b); Var(a - b). All 0 below ``least`` frames in common.
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
def windowed_evidence(a, wa, qa, b, wb, qb, lags, block, least, floor, out):
    """Sum over matches and windows of n/2 log((Var a + Var b + floor) / (Var(a - b) + floor)) at every lag.

    Arrays as for :func:`lag_statistics`. Windows are two blocks of ``block`` frames long and start every block,
    counted from the first common frame, which treats a and b alike; the first and last block are windows of their own
    too. Adds to out (K,), each window with weight 1/2, since every sample is in two.
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
                out[n] += 0.25 * c * np.log((power + floor) / (residual + floor))


@kernel(fastmath={"contract", "reassoc", "nsz"})
def shift_residuals(x, coefficients, mean, first, value, slope, clock, ok, lo, hi, least, rr, g, h):
    """Detrended residual of every match against the other video's spline, and its products with the Jacobian.

    x (M,T,3): one video's curve at its own frames. The other's spline, coefficients (M,n,3) plus mean (M,3), is read at
    the moments that these frames show: ``first`` (T,) index of the first of four coefficients, their weights ``value``
    and ``slope`` (T,4) for position and d/dt. R = x - spline; columns of the Jacobian are the slope and slope * clock.
    From both the masked mean over the frames lo[t]:hi[t] (T,) is removed. ok (M,T): where both are known.
    Fills (M,T): rr = |R|^2; g (P,M,T) = J·R; h (P,P,M,T) = J·J; 0 where not ok or where a match has < ``least`` frames.
    """
    M, T, _ = x.shape
    P = g.shape[0]
    D = 3 * (1 + P)
    raw = np.zeros((T, D))
    total = np.zeros((T + 1, D))
    seen = np.zeros(T + 1)
    part = np.zeros(D)
    for m in range(M):
        for t in range(T):
            seen[t + 1] = seen[t] + ok[m, t]
        if seen[T] < least:
            rr[m] = 0.0
            for p in range(P):
                g[p, m] = 0.0
                for q in range(P):
                    h[p, q, m] = 0.0
            continue
        for t in range(T):
            if ok[m, t]:
                f = first[t]
                for d in range(3):
                    s = mean[m, d]
                    v = 0.0
                    for q in range(4):
                        s += value[t, q] * coefficients[m, f + q, d]
                        v += slope[t, q] * coefficients[m, f + q, d]
                    raw[t, d] = x[m, t, d] - s
                    raw[t, 3 + d] = v
                    if P > 1:
                        raw[t, 6 + d] = v * clock[t]
                for d in range(D):
                    total[t + 1, d] = total[t, d] + raw[t, d]
            else:
                for d in range(D):
                    total[t + 1, d] = total[t, d]
        for t in range(T):
            if not ok[m, t]:
                rr[m, t] = 0.0
                for p in range(P):
                    g[p, m, t] = 0.0
                    for q in range(P):
                        h[p, q, m, t] = 0.0
                continue
            around = seen[hi[t]] - seen[lo[t]]
            for d in range(D):
                part[d] = raw[t, d] - (total[hi[t], d] - total[lo[t], d]) / around
            rr[m, t] = part[0] * part[0] + part[1] * part[1] + part[2] * part[2]
            for p in range(P):
                i = 3 + 3 * p
                g[p, m, t] = part[i] * part[0] + part[i + 1] * part[1] + part[i + 2] * part[2]
                for q in range(P):
                    j = 3 + 3 * q
                    h[p, q, m, t] = part[i] * part[j] + part[i + 1] * part[j + 1] + part[i + 2] * part[j + 2]


@kernel(fastmath={"contract", "reassoc", "nsz"})
def synchronous_distances(a, wa, b, wb, farthest, least, i0, i1, place, motion):
    """Distances of rows i0:i1 of a from all of b at common moments.

    a (N,S,3), b (M,S,3): 0 where unseen; wa (N,S), wb (M,S): seen. Fills, where at least ``least`` moments are common:
    place (N,M): mean distance, each cut off at ``farthest``; motion (N,M): rms distance about its mean vector.
    """
    S = a.shape[1]
    for i in range(i0, i1):
        for j in range(b.shape[0]):
            n = 0
            total = square = mx = my = mz = 0.0
            for s in range(S):
                if wa[i, s] and wb[j, s]:
                    x, y, z = a[i, s, 0] - b[j, s, 0], a[i, s, 1] - b[j, s, 1], a[i, s, 2] - b[j, s, 2]
                    d2 = x * x + y * y + z * z
                    total += min(np.sqrt(d2), farthest)
                    square += d2
                    mx += x
                    my += y
                    mz += z
                    n += 1
            if n >= least:
                place[i, j] = total / n
                motion[i, j] = np.sqrt(max(square / n - (mx * mx + my * my + mz * mz) / (n * n), 0.0))
