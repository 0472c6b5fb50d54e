"""Compiled inner loops of tracks and recordings. A leaf: importing it imports numba."""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel


@kernel()
def epipolar_evidence(
    A, B, F, rays_a, rays_b, turn, pairs, lives_a, lives_b, low, edge, still, least, window, prior, mean, count
):
    """Epipolar residuals of candidate pairs at every lag at which both tracks live.

    A (Na,Ta,2), B (Nb,Tb,2): pixels, nan unseen; lives_a (Na,2), lives_b (Nb,2): the frames from which on, and before
    which, each is seen. F (3,3): of cameras that are ``still``; of others rays_a, rays_b: the arrays of
    :class:`.poses.Rays` in order, one entry per frame or one. Frame t of a meets frame t - k of b; candidate m is asked
    at the lags from low[m] on, whose answers stand from edge[m] to edge[m + 1]: in ``mean[0]`` the residuals' mean
    square per sample, over windows of ``window`` frames (aligned to a's clock) without their mean or, where a camera
    moves, without what a constant distance of the two points makes of them (``turn`` (Tb,4,3): how b turned;
    ``prior``: least squares' ridge); in ``mean[1]`` the raw one; nan where fewer samples than ``least`` (in all, and in
    a window) exist; and in ``count`` the samples behind each.
    """
    (back_a, line_a, centre_a), (back_b, line_b, centre_b), (min_frames, min_window) = rays_a, rays_b, least
    moves_a, moves_b = back_a.shape[0] > 1, back_b.shape[0] > 1
    for m in range(pairs.shape[0]):
        i, j = pairs[m, 0], pairs[m, 1]
        for at in range(edge[m], edge[m + 1]):
            k = low[m] + at - edge[m]
            within, raw, n_within, n_raw = 0.0, 0.0, 0, 0
            n, s, q = 0, 0.0, 0.0
            p0, p1, h00, h01, h11 = 0.0, 0.0, prior, 0.0, prior
            first, last = max(lives_a[i, 0], lives_b[j, 0] + k), min(lives_a[i, 1], lives_b[j, 1] + k)
            for t in range(first, last):
                xa, ya, xb, yb = A[i, t, 0], A[i, t, 1], B[j, t - k, 0], B[j, t - k, 1]
                if not (np.isnan(xa) or np.isnan(xb)):
                    if still:
                        l0 = F[0, 0] * xa + F[0, 1] * ya + F[0, 2]
                        l1 = F[1, 0] * xa + F[1, 1] * ya + F[1, 2]
                        l2 = F[2, 0] * xa + F[2, 1] * ya + F[2, 2]
                        g0 = F[0, 0] * xb + F[1, 0] * yb + F[2, 0]
                        g1 = F[0, 1] * xb + F[1, 1] * yb + F[2, 1]
                    else:
                        u, v = t if moves_a else 0, t - k if moves_b else 0
                        l0, l1, l2 = _line(xa, ya, back_a[u], centre_a[u], line_b[v], centre_b[v])
                        g0, g1, _ = _line(xb, yb, back_b[v], centre_b[v], line_a[u], centre_a[u])
                    size = np.sqrt(l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)
                    e = (l0 * xb + l1 * yb + l2) / size
                    n += 1
                    s += e
                    q += e * e
                    if not still:
                        Q = turn[t - k if moves_b else 0]
                        along = l0 * xb + l1 * yb
                        step = (Q[3, 0] * xb + Q[3, 1] * yb + Q[3, 2]) / size
                        u = step * (Q[0, 0] * l0 + Q[1, 0] * l1 - Q[2, 0] * along)
                        v = step * (Q[0, 1] * l0 + Q[1, 1] * l1 - Q[2, 1] * along)
                        p0 += u * e
                        p1 += v * e
                        h00 += u * u
                        h01 += u * v
                        h11 += v * v
                if (t + 1) % window == 0 or t + 1 == last:
                    raw += q
                    n_raw += n
                    if n >= min_window:
                        told = s * s / n
                        if not still:
                            told = (h11 * p0 * p0 - 2 * h01 * p0 * p1 + h00 * p1 * p1) / (h00 * h11 - h01 * h01)
                        within += max(q - told, 0.0)
                        n_within += n
                    n, s, q = 0, 0.0, 0.0
                    p0, p1, h00, h01, h11 = 0.0, 0.0, prior, 0.0, prior
            if n_within >= min_frames:
                mean[0, at] = within / n_within
                count[0, at] = n_within
            if n_raw >= min_frames:
                mean[1, at] = raw / n_raw
                count[1, at] = n_raw


@kernel()
def _line(x, y, back, centre, line, other):
    """The epipolar line, in the picture of a camera at ``other``, of the pixel (x, y) of one at ``centre``."""
    d0 = back[0, 0] * x + back[0, 1] * y + back[0, 2]
    d1 = back[1, 0] * x + back[1, 1] * y + back[1, 2]
    d2 = back[2, 0] * x + back[2, 1] * y + back[2, 2]
    c0, c1, c2 = centre[0] - other[0], centre[1] - other[1], centre[2] - other[2]
    n0, n1, n2 = c1 * d2 - c2 * d1, c2 * d0 - c0 * d2, c0 * d1 - c1 * d0
    return (
        line[0, 0] * n0 + line[0, 1] * n1 + line[0, 2] * n2,
        line[1, 0] * n0 + line[1, 1] * n1 + line[1, 2] * n2,
        line[2, 0] * n0 + line[2, 1] * n1 + line[2, 2] * n2,
    )
