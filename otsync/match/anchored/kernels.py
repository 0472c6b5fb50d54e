"""Compiled inner loops of the anchored solver. A leaf, as :mod:`otsync.kernels`, whose pattern it follows.

Blocks write to disjoint places and every sum runs in one order, so results do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import kernel

_fast = kernel(fastmath={"contract", "reassoc", "nsz"})


@kernel()
def visible_means(xyz, seen, mean, i0, i1):
    """Mean visible position of tracks i0:i1 in float64, nan for one never seen; xyz (N,T,3), seen (N,T), mean (N,3)."""
    for i in range(i0, i1):
        x = y = z = 0.0
        n = 0
        for t in range(seen.shape[1]):
            if seen[i, t]:
                x += xyz[i, t, 0]
                y += xyz[i, t, 1]
                z += xyz[i, t, 2]
                n += 1
        mean[i, 0], mean[i, 1], mean[i, 2] = x / n, y / n, z / n


@kernel()
def to_columns(xyz, seen, index, origin, unit, far, columns, weight, i0, i1):
    """``(xyz - origin) / unit`` of tracks ``index[i0:i1]``, clipped to ±far, time-major; 0, weight 0 where unseen.

    xyz (N,T,3), seen (N,T); columns (3,T,M), weight (T,M) float32.
    """
    for i in range(i0, i1):
        n = index[i]
        for t in range(seen.shape[1]):
            if seen[n, t]:
                for c in range(3):
                    columns[c, t, i] = min(max((xyz[n, t, c] - origin[c]) / unit, -far), far)
                weight[t, i] = 1.0
            else:
                for c in range(3):
                    columns[c, t, i] = 0.0
                weight[t, i] = 0.0


@kernel()
def poses(columns, weight, frames, out, i0, i1):
    """Positions at some frames, of each track at the nearest frame where it is seen (the earlier of two).

    columns (3,T,N), weight (T,N), frames (F,); out (N, 3F).
    """
    T = weight.shape[0]
    for i in range(i0, i1):
        for f in range(len(frames)):
            at = frames[f]
            for d in range(T):
                if at - d >= 0 and weight[at - d, i] > 0:
                    at = at - d
                    break
                if at + d < T and weight[at + d, i] > 0:
                    at = at + d
                    break
            for c in range(3):
                out[i, 3 * f + c] = columns[c, at, i]


@_fast
def nearest(points, centers, label, i0, i1):
    """Index of the nearest center of points i0:i1 (the first of equals); points (N,D), centers (D,M)."""
    D, M = centers.shape
    distance = np.empty(M, points.dtype)
    for i in range(i0, i1):
        for j in range(M):
            distance[j] = 0
        for d in range(D):
            p = points[i, d]
            row = centers[d]
            for j in range(M):
                delta = p - row[j]
                distance[j] += delta * delta
        best = 0
        for j in range(1, M):
            if distance[j] < distance[best]:
                best = j
        label[i] = best


@kernel()
def group_means(columns, weight, label, out, count, t0, t1):
    """Mean position of every group at frames t0:t1, over its members seen there; out (3,T,M), count (T,M)."""
    N, M = columns.shape[2], out.shape[2]
    for t in range(t0, t1):
        for i in range(N):
            if weight[t, i] > 0:
                g = label[i]
                count[t, g] += 1
                for c in range(3):
                    out[c, t, g] += columns[c, t, i]
        for g in range(M):
            if count[t, g] > 0:
                for c in range(3):
                    out[c, t, g] /= count[t, g]


@kernel()
def spread_out(points, n, first):
    """``n`` indices by farthest-point sampling of points (N,D), beginning with ``first``."""
    N, D = points.shape
    chosen = np.empty(n, np.int64)
    apart = np.full(N, np.inf)
    at = first
    for k in range(n):
        chosen[k] = at
        best, top = 0, -1.0
        for i in range(N):
            d = 0.0
            for c in range(D):
                d += (points[i, c] - points[at, c]) ** 2
            apart[i] = min(apart[i], d)
            if apart[i] > top:
                best, top = i, apart[i]
        at = best
    return chosen


@_fast
def shortlist(sa, sb, ua, ub, tau2, feature, offset, group, candidates, start, member, index, value, i0, i1):
    """The K cheapest partners of tracks i0:i1 among the members of their candidate groups.

    Cost: ``mean_k min((sa_ik - sb_jk)², τ²) + feature (offset - ua_i·ub_j)``.
    sa (N,L), sb (M,L) signatures; ua (N,D), ub (M,D) factors of the linear cost; group (N,) of a's tracks;
    candidates (G,C) b's groups for each, -1 for none; b's group g holds ``member[start[g]:start[g+1]]``;
    index, value (N,K), cheapest first, -1 and inf where there are fewer.
    """
    L, D, K = sa.shape[1], ua.shape[1], index.shape[1]
    for i in range(i0, i1):
        own, traits = sa[i], ua[i]
        best, where = value[i], index[i]
        for c in range(candidates.shape[1]):
            g = candidates[group[i], c]
            if g < 0:
                continue
            for m in range(start[g], start[g + 1]):
                j = member[m]
                other = sb[j]
                total = sa.dtype.type(0)
                for k in range(L):
                    d = own[k] - other[k]
                    total += min(d * d, tau2)
                total /= L
                theirs = ub[j]
                dot = sa.dtype.type(0)
                for k in range(D):
                    dot += traits[k] * theirs[k]
                total += feature * (offset - dot)
                if total < best[K - 1]:
                    at = K - 1
                    while at > 0 and best[at - 1] > total:
                        best[at], where[at] = best[at - 1], where[at - 1]
                        at -= 1
                    best[at], where[at] = total, j


@kernel()
def one_to_one(i, j, n_a, n_b):
    """Positions of the pairs that greedy one-to-one matching keeps, the pairs given cheapest first."""
    used_a, used_b = np.zeros(n_a, np.bool_), np.zeros(n_b, np.bool_)
    kept = np.empty(min(n_a, n_b), np.int64)
    n = 0
    for e in range(len(i)):
        if not used_a[i[e]] and not used_b[j[e]]:
            used_a[i[e]] = used_b[j[e]] = True
            kept[n] = e
            n += 1
    return kept[:n]
