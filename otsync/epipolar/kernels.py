"""Compiled inner loops of tracks and recordings. A leaf: importing it imports numba."""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel


@kernel()
def epipolar_evidence(A, B, F, pairs, lives_a, lives_b, low, edge, min_frames, window, min_window, mean, count):
    """Epipolar residuals of candidate pairs at every lag at which both tracks live.

    A (Na,Ta,2), B (Nb,Tb,2): pixels, nan unseen; lives_a (Na,2), lives_b (Nb,2): the frames from which on, and before
    which, each is seen. F (Fa,Fb,3,3): one per pose, axes of length 1 when static. Frame t of a meets frame t - k of b;
    candidate m is asked at the lags from low[m] on, whose answers stand from edge[m] to edge[m + 1]: in ``mean[0]`` the
    residuals' mean square per sample, over windows of ``window`` frames (aligned to a's clock) with their mean removed;
    in ``mean[1]`` the raw one; nan where fewer than ``min_frames`` samples (``min_window`` per window) exist; and in
    ``count`` the samples behind each.
    """
    moves_a, moves_b = F.shape[0] > 1, F.shape[1] > 1
    for m in range(pairs.shape[0]):
        i, j = pairs[m, 0], pairs[m, 1]
        for at in range(edge[m], edge[m + 1]):
            k = low[m] + at - edge[m]
            within, raw, n_within, n_raw = 0.0, 0.0, 0, 0
            n, s, q = 0, 0.0, 0.0
            first, last = max(lives_a[i, 0], lives_b[j, 0] + k), min(lives_a[i, 1], lives_b[j, 1] + k)
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
                mean[0, at] = within / n_within
                count[0, at] = n_within
            if n_raw >= min_frames:
                mean[1, at] = raw / n_raw
                count[1, at] = n_raw
