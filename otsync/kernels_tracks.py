"""Compiled inner loops of tracks and recordings. A leaf: importing it imports numba."""

from __future__ import annotations

import numpy as np

from .jit import kernel


@kernel()
def keep_apart(uv, apart, count):
    """Greedy choice in the given order: skip a track that stays within ``apart`` of a kept one over >= 5 frames.

    uv (N,T,2), nan unseen. Returns the kept indices.
    """
    N, T = uv.shape[0], uv.shape[1]
    kept = np.empty(min(count, N), np.int64)
    n = 0
    for i in range(N):
        alone = True
        for q in range(n):
            j = kept[q]
            met, furthest, total = 0, 0.0, 0.0
            for t in range(T):
                if np.isnan(uv[i, t, 0]) or np.isnan(uv[j, t, 0]):
                    continue
                d = np.sqrt((uv[i, t, 0] - uv[j, t, 0]) ** 2 + (uv[i, t, 1] - uv[j, t, 1]) ** 2)
                met += 1
                total += d
                furthest = max(furthest, d)
            if met >= 5 and (furthest < apart or total < 0.8 * apart * met):
                alone = False
                break
        if alone:
            kept[n] = i
            n += 1
            if n == count:
                break
    return kept[:n]


@kernel()
def epipolar_evidence(A, B, F, pairs, k0, k1, min_frames, window, min_window, mean, count):
    """Epipolar residuals of candidate pairs at every lag.

    A (Na,Ta,2), B (Nb,Tb,2): pixels, nan unseen. F (Fa,Fb,3,3): one per pose, axes of length 1 when static. Frame t
    of a meets frame t - k of b for the lags k0..k1. Writes the residuals' mean square per sample, over windows of
    ``window`` frames (aligned to a's clock) with their mean removed: ``mean[0]``; and raw: ``mean[1]``; nan where
    fewer than ``min_frames`` samples (``min_window`` per window) exist; and ``count`` the samples behind each.
    """
    Ta, Tb = A.shape[1], B.shape[1]
    moves_a, moves_b = F.shape[0] > 1, F.shape[1] > 1
    for m in range(pairs.shape[0]):
        i, j = pairs[m, 0], pairs[m, 1]
        for k in range(k0, k1 + 1):
            within, raw, n_within, n_raw = 0.0, 0.0, 0, 0
            n, s, q = 0, 0.0, 0.0
            first, last = max(0, k), min(Ta, Tb + k)
            for t in range(first, last):
                xa, ya, xb, yb = A[i, t, 0], A[i, t, 1], B[j, t - k, 0], B[j, t - k, 1]
                if not (np.isnan(xa) or np.isnan(xb)):
                    G = F[t if moves_a else 0, t - k if moves_b else 0]
                    l0 = G[0, 0] * xa + G[0, 1] * ya + G[0, 2]
                    l1 = G[1, 0] * xa + G[1, 1] * ya + G[1, 2]
                    l2 = G[2, 0] * xa + G[2, 1] * ya + G[2, 2]
                    g0 = G[0, 0] * xb + G[1, 0] * yb + G[2, 0]
                    g1 = G[0, 1] * xb + G[1, 1] * yb + G[2, 1]
                    e = (l0 * xb + l1 * yb + l2) / np.sqrt(l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)
                    n += 1
                    s += e
                    q += e * e
                if (t + 1) % window == 0 or t + 1 == last:
                    raw += q
                    n_raw += n
                    if n >= min_window:
                        within += max(q - s * s / n, 0.0)
                        n_within += n
                    n, s, q = 0, 0.0, 0.0
            if n_within >= min_frames:
                mean[0, m, k - k0] = within / n_within
                count[0, m, k - k0] = n_within
            if n_raw >= min_frames:
                mean[1, m, k - k0] = raw / n_raw
                count[1, m, k - k0] = n_raw


@kernel()
def _trimmed(values, n, share):
    """Mean of the smallest ``share`` of the first ``n`` values."""
    ordered = np.sort(values[:n])
    m = max(1, int(np.ceil(share * n)))
    return ordered[:m].mean()


@kernel()
def curve_distances(A, B, pairs_a, pairs_b, share):
    """A (Na,S,3), B (Nb,R,3), nan unseen: trimmed mean distance to the nearest sample, both ways averaged; (P,)."""
    S, R = A.shape[1], B.shape[1]
    out = np.full(len(pairs_a), np.nan)
    to_b, to_a = np.empty(S), np.empty(R)
    for p in range(len(pairs_a)):
        i, j = pairs_a[p], pairs_b[p]
        for r in range(R):
            to_a[r] = np.inf
        n = 0
        for s in range(S):
            if np.isnan(A[i, s, 0]):
                continue
            best = np.inf
            for r in range(R):
                if np.isnan(B[j, r, 0]):
                    continue
                d = (A[i, s, 0] - B[j, r, 0]) ** 2 + (A[i, s, 1] - B[j, r, 1]) ** 2 + (A[i, s, 2] - B[j, r, 2]) ** 2
                if d < best:
                    best = d
                if d < to_a[r]:
                    to_a[r] = d
            if best < np.inf:
                to_b[n] = np.sqrt(best)
                n += 1
        m = 0
        for r in range(R):
            if to_a[r] < np.inf:
                to_a[m] = np.sqrt(to_a[r])
                m += 1
        if n and m:
            out[p] = 0.5 * (_trimmed(to_b, n, share) + _trimmed(to_a, m, share))
    return out


@kernel()
def synchronous_distances(A, B, pairs_a, pairs_b, at, least):
    """Mean distance of A[i,t] and B[j,at[t]] (at -1: none) over frames that both see; nan below ``least`` of them."""
    out = np.full(len(pairs_a), np.nan)
    for p in range(len(pairs_a)):
        i, j = pairs_a[p], pairs_b[p]
        total, n = 0.0, 0
        for t in range(A.shape[1]):
            u = at[t]
            if u < 0 or np.isnan(A[i, t, 0]) or np.isnan(B[j, u, 0]):
                continue
            total += np.sqrt(
                (A[i, t, 0] - B[j, u, 0]) ** 2 + (A[i, t, 1] - B[j, u, 1]) ** 2 + (A[i, t, 2] - B[j, u, 2]) ** 2
            )
            n += 1
        if n >= least:
            out[p] = total / n
    return out
