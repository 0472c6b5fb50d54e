"""Compiled loops of the joint fit of clock and similarity."""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel

fast = kernel(fastmath={"contract", "reassoc", "nsz"})


@fast
def split(u, y, v, ok, lo, hi, least, slow):
    """Moving means of what the residual is made of: slow (M,T,9) the masked means of u, y, v over lo[t]:hi[t].

    u, y, v (M,T,3); ok (M,T). 0 where not ok, and for matches with fewer than ``least`` frames.
    """
    M, T = ok.shape
    total = np.zeros((T + 1, 9))
    seen = np.zeros(T + 1)
    for m in range(M):
        for t in range(T):
            seen[t + 1] = seen[t] + ok[m, t]
            for d in range(3):
                if ok[m, t]:
                    total[t + 1, d] = total[t, d] + u[m, t, d]
                    total[t + 1, 3 + d] = total[t, 3 + d] + y[m, t, d]
                    total[t + 1, 6 + d] = total[t, 6 + d] + v[m, t, d]
                else:
                    total[t + 1, d] = total[t, d]
                    total[t + 1, 3 + d] = total[t, 3 + d]
                    total[t + 1, 6 + d] = total[t, 6 + d]
        for t in range(T):
            good = ok[m, t] and seen[T] >= least
            for d in range(9):
                slow[m, t, d] = (total[hi[t], d] - total[lo[t], d]) / (seen[hi[t]] - seen[lo[t]]) if good else 0.0


@fast
def residual_squares(u, y, slow, tau, used, inverse, fast_rr, slow_rr):
    """Squares of the fast and of the slow part of the residual u - y - tau, (M,T), 0 where not used.

    inverse (M,2,3,3): of both parts of every match; r' inverse r is the square.
    """
    M, T = used.shape
    low, high = np.zeros(3), np.zeros(3)
    for m in range(M):
        for t in range(T):
            f = s = 0.0
            if used[m, t]:
                residual(u, y, slow, tau, m, t, low, high)
                for d in range(3):
                    for e in range(3):
                        f += high[d] * inverse[m, 0, d, e] * high[e]
                        s += low[d] * inverse[m, 1, d, e] * low[e]
            fast_rr[m, t] = f
            slow_rr[m, t] = s


@fast
def residual(u, y, slow, tau, m, t, low, high):
    """The slow and the fast part of one residual."""
    for d in range(3):
        low[d] = slow[m, t, d] - slow[m, t, 3 + d] - tau[d]
        high[d] = u[m, t, d] - y[m, t, d] - tau[d] - low[d]


@fast
def scatter(u, y, slow, tau, used, w_fast, w_slow, products, count):
    """Add what both parts of every match scatter: products (M,2,3,3) of w r r', count (M,2) of w."""
    M, T = used.shape
    low, high = np.zeros(3), np.zeros(3)
    for m in range(M):
        for t in range(T):
            if used[m, t]:
                residual(u, y, slow, tau, m, t, low, high)
                f, s = w_fast[m, t], w_slow[m, t]
                count[m, 0] += f
                count[m, 1] += s
                for d in range(3):
                    for e in range(3):
                        products[m, 0, d, e] += f * high[d] * high[e]
                        products[m, 1, d, e] += s * low[d] * low[e]


@fast
def normal_equations(
    u, y, v, slow, tau, used, inverse, of_a, of_b, w_fast, w_slow, block, H_match, g_match, H_time, g_time
):
    """Add J'WJ and J'Wr of one video's frames, by match and by block of time.

    Columns: offset, rotation vector (3), log scale, translation (3). r = u - y - tau with
    dr = v d(offset) + y x w - (u + y)/2 d(log scale) - d(tau), each split into its moving mean and what is left.
    w_fast, w_slow (M,T): weights of the two parts. block (T,).

    inverse, of_a, of_b (M,2,3,3): of the covariance, which turns and grows with b: C = of_a + of_b, so r'C^-1r changes
    by -q' dC q too, q = C^-1 r. Without that term the error in y, which is in r and in dr, turns b's errors to where C
    is largest: an error of rotation however many tracks there are (Ohta and Kanatani 1998).
    """
    M, T = used.shape
    J, WJ = np.zeros((3, 8)), np.zeros((3, 8))
    r, q, of_y, more = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    p = np.zeros(9)
    turning = np.zeros(8)
    for m in range(M):
        for t in range(T):
            if not used[m, t]:
                continue
            for part in range(2):
                w = w_fast[m, t] if part == 0 else w_slow[m, t]
                if w <= 0:
                    continue
                for d in range(3):
                    if part == 0:
                        p[d] = u[m, t, d] - slow[m, t, d]
                        p[3 + d] = y[m, t, d] - slow[m, t, 3 + d]
                        p[6 + d] = v[m, t, d] - slow[m, t, 6 + d]
                        r[d] = p[d] - p[3 + d]
                        J[d, 5 + d] = 0.0
                    else:
                        p[d], p[3 + d], p[6 + d] = slow[m, t, d], slow[m, t, 3 + d], slow[m, t, 6 + d]
                        r[d] = p[d] - p[3 + d] - tau[d]
                        J[d, 5 + d] = -1.0
                    J[d, 0] = p[6 + d]
                    J[d, 4] = -0.5 * (p[d] + p[3 + d])
                # d(-R y)/dw = y x w
                J[0, 1], J[0, 2], J[0, 3] = 0.0, -p[5], p[4]
                J[1, 1], J[1, 2], J[1, 3] = p[5], 0.0, -p[3]
                J[2, 1], J[2, 2], J[2, 3] = -p[4], p[3], 0.0
                for d in range(3):
                    q[d] = 0.0
                    for e in range(3):
                        q[d] += inverse[m, part, d, e] * r[e]
                    for i in range(8):
                        WJ[d, i] = 0.0
                        for e in range(3):
                            WJ[d, i] += w * inverse[m, part, d, e] * J[e, i]
                for d in range(3):
                    of_y[d] = more[d] = 0.0
                    for e in range(3):
                        of_y[d] += of_b[m, part, d, e] * q[e]
                        more[d] += (of_b[m, part, d, e] - of_a[m, part, d, e]) * q[e]
                turning[1] = w * (of_y[1] * q[2] - of_y[2] * q[1])
                turning[2] = w * (of_y[2] * q[0] - of_y[0] * q[2])
                turning[3] = w * (of_y[0] * q[1] - of_y[1] * q[0])
                turning[4] = 0.5 * w * (q[0] * more[0] + q[1] * more[1] + q[2] * more[2])
                b = block[t]
                for i in range(8):
                    g = WJ[0, i] * r[0] + WJ[1, i] * r[1] + WJ[2, i] * r[2] - turning[i]
                    g_match[m, i] += g
                    g_time[b, i] += g
                    for j in range(i + 1):
                        h = WJ[0, i] * J[0, j] + WJ[1, i] * J[1, j] + WJ[2, i] * J[2, j]
                        H_match[m, i, j] += h
                        H_time[b, i, j] += h
