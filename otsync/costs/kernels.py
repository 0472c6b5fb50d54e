"""Compiled distances between tracks."""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel


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
def add_frame_distances(A, B, pairs_a, pairs_b, total, count):
    """Adds to total (P,) the distances of A[i,t] and B[j,t] over the frames that both see, and to count (P,) these."""
    for p in range(len(pairs_a)):
        i, j = pairs_a[p], pairs_b[p]
        for t in range(A.shape[1]):
            if np.isnan(A[i, t, 0]) or np.isnan(B[j, t, 0]):
                continue
            total[p] += np.sqrt(
                (A[i, t, 0] - B[j, t, 0]) ** 2 + (A[i, t, 1] - B[j, t, 1]) ** 2 + (A[i, t, 2] - B[j, t, 2]) ** 2
            )
            count[p] += 1


@kernel()
def paired_epipolar_residuals(A, B, F, pairs_a, pairs_b, window, least):
    """Signed Sampson residuals of A[i,t] and B[j,t] (pixels, nan unseen) at equal times: (variance, mean square).

    F (T,3,3): at each time, or one (1,3,3) of cameras that stand still. The variance is within windows of ``window``
    frames; nan below ``least`` samples.
    """
    variance, square = np.full(len(pairs_a), np.nan), np.full(len(pairs_a), np.nan)
    T = A.shape[1]
    moves = F.shape[0] > 1
    for p in range(len(pairs_a)):
        i, j = pairs_a[p], pairs_b[p]
        within, raw, n_raw = 0.0, 0.0, 0
        n, s, q = 0, 0.0, 0.0
        for t in range(T):
            xa, ya, xb, yb = A[i, t, 0], A[i, t, 1], B[j, t, 0], B[j, t, 1]
            if not (np.isnan(xa) or np.isnan(xb)):
                G = F[t if moves else 0]
                l0 = G[0, 0] * xa + G[0, 1] * ya + G[0, 2]
                l1 = G[1, 0] * xa + G[1, 1] * ya + G[1, 2]
                l2 = G[2, 0] * xa + G[2, 1] * ya + G[2, 2]
                g0 = G[0, 0] * xb + G[1, 0] * yb + G[2, 0]
                g1 = G[0, 1] * xb + G[1, 1] * yb + G[2, 1]
                e = (l0 * xb + l1 * yb + l2) / np.sqrt(l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)
                n += 1
                s += e
                q += e * e
            if (t + 1) % window == 0 or t + 1 == T:
                raw += q
                n_raw += n
                if n:
                    within += max(q - s * s / n, 0.0)
                n, s, q = 0, 0.0, 0.0
        if n_raw >= least:
            variance[p] = within / n_raw
            square[p] = raw / n_raw
    return variance, square
