"""Compiled loop of the clock fit."""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel


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
        begin, end, count = T, 0, 0
        for t in range(T):
            if ok[m, t]:
                begin, end, count = min(begin, t), t + 1, count + 1
        rr[m] = 0.0
        for p in range(P):
            g[p, m] = 0.0
            for q in range(P):
                h[p, q, m] = 0.0
        if count < least:
            continue
        # of long clips a match lives in a small part: nothing beside it is read
        seen[begin] = 0.0
        total[begin] = 0.0
        for t in range(begin, end):
            seen[t + 1] = seen[t] + ok[m, t]
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
        for t in range(begin, end):
            if not ok[m, t]:
                continue
            low, high = max(lo[t], begin), min(hi[t], end)
            around = seen[high] - seen[low]
            for d in range(D):
                part[d] = raw[t, d] - (total[high, d] - total[low, d]) / around
            rr[m, t] = part[0] * part[0] + part[1] * part[1] + part[2] * part[2]
            for p in range(P):
                i = 3 + 3 * p
                g[p, m, t] = part[i] * part[0] + part[i + 1] * part[1] + part[i + 2] * part[2]
                for q in range(P):
                    j = 3 + 3 * q
                    h[p, q, m, t] = part[i] * part[j] + part[i + 1] * part[j + 1] + part[i + 2] * part[j + 2]
