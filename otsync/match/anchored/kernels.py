"""Compiled inner loops of the anchored solver. A leaf, as :mod:`otsync.kernels`, whose pattern it follows.

Every sum runs in one order, and where two blocks write to one place they write the same, so results do not depend on
the number of threads.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import inlined, kernel
from ...compute.simd import (
    LANES,
    any_lane,
    counting_from,
    load,
    maximum,
    minimum,
    repeat,
    select,
    spread,
    square_root,
    store,
)


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
def to_columns(xyz, seen, index, origin, unit, far, first, columns, weight, i0, i1):
    """``(xyz - origin) / unit`` of tracks ``index[i0:i1]``, clipped to ±far, time-major; 0, weight 0 where unseen.

    Of the frames first[w]:first[w + 1] the mean of those that show a track. xyz (N,T,3), seen (N,T); first (W+1,);
    columns (3,W,M), weight (W,M) float32.
    """
    for i in range(i0, i1):
        n = index[i]
        for w in range(len(weight)):
            x = y = z = 0.0
            count = 0
            for t in range(first[w], first[w + 1]):
                if seen[n, t]:
                    x += xyz[n, t, 0]
                    y += xyz[n, t, 1]
                    z += xyz[n, t, 2]
                    count += 1
            if count > 0:
                columns[0, w, i] = min(max((x / count - origin[0]) / unit, -far), far)
                columns[1, w, i] = min(max((y / count - origin[1]) / unit, -far), far)
                columns[2, w, i] = min(max((z / count - origin[2]) / unit, -far), far)
                weight[w, i] = 1.0
            else:
                columns[0, w, i] = columns[1, w, i] = columns[2, w, i] = 0.0
                weight[w, i] = 0.0


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


@inlined()
def _first_least(best, where, distance, index):
    """Where the smallest of the lanes of ``best`` was, the first of equals; two rows of LANES to work in."""
    store(distance, 0, best)
    store(index, 0, where)
    least = 0
    for m in range(1, LANES):
        if distance[m] < distance[least] or (distance[m] == distance[least] and index[m] < index[least]):
            least = m
    return index[least]


@kernel()
def nearest(points, D, centers, label, i0, i1):
    """Index of the nearest center of points i0:i1, the first of equals.

    points (N,D) and centers (D,M) as rows of floats, M a multiple of LANES and below 2^24.
    """
    M = len(centers) // D
    distance, index = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    for i in range(i0, i1, 2):  # two at once: centers are read once for both
        own, other = i * D, min(i + 1, i1 - 1) * D
        best = best_b = spread(np.float32(np.inf))
        where = where_b = spread(np.float32(0))
        for j in range(0, M, LANES):
            apart = apart_b = spread(np.float32(0))
            at = j
            for d in range(D):
                center = load(centers, at)
                delta, delta_b = repeat(points, own + d) - center, repeat(points, other + d) - center
                apart, apart_b = apart + delta * delta, apart_b + delta_b * delta_b
                at += M
            here = counting_from(np.float32(j))
            where, where_b = select(apart < best, here, where), select(apart_b < best_b, here, where_b)
            best, best_b = minimum(apart, best), minimum(apart_b, best_b)
        label[i] = _first_least(best, where, distance, index)
        label[min(i + 1, i1 - 1)] = _first_least(best_b, where_b, distance, index)


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


@kernel()
def farthest(a, b, T, out, i0, i1):
    """D_track of tracks i0:i1 of a to all of b, where all are seen in all T frames.

    a (3,T,N), b (3,T,M) and out (M,N) as rows of floats; N at least LANES, M a multiple of four.
    """
    N, M = len(a) // (3 * T), len(b) // (3 * T)
    for first in range(i0, i1, LANES):
        i = min(first, N - LANES)
        for j in range(0, M, 4):  # four largest ones at once: one alone would wait for itself
            p = q = r = s = spread(np.float32(0))
            at = i
            for t in range(T):
                x, y, z = load(a, at), load(a, at + T * N), load(a, at + 2 * T * N)
                u, v, w = t * M + j, (T + t) * M + j, (2 * T + t) * M + j
                dx, dy, dz = x - repeat(b, u), y - repeat(b, v), z - repeat(b, w)
                p = maximum(p, dx * dx + dy * dy + dz * dz)
                dx, dy, dz = x - repeat(b, u + 1), y - repeat(b, v + 1), z - repeat(b, w + 1)
                q = maximum(q, dx * dx + dy * dy + dz * dz)
                dx, dy, dz = x - repeat(b, u + 2), y - repeat(b, v + 2), z - repeat(b, w + 2)
                r = maximum(r, dx * dx + dy * dy + dz * dz)
                dx, dy, dz = x - repeat(b, u + 3), y - repeat(b, v + 3), z - repeat(b, w + 3)
                s = maximum(s, dx * dx + dy * dy + dz * dz)
                at += N
            store(out, j * N + i, square_root(p))
            store(out, (j + 1) * N + i, square_root(q))
            store(out, (j + 2) * N + i, square_root(r))
            store(out, (j + 3) * N + i, square_root(s))


@kernel()
def shortlist(
    sa, sb, L, ua, ub, D, marks, tau2, feature, offset, least, group, candidates, start, member, index, value, i0, i1
):
    """The K cheapest partners of tracks i0:i1 among the members of their candidate groups.

    Cost: ``mean_k min((sa_ik - sb_jk)², τ²) + feature (offset - ua_i·ub_j)``, the mean over ``marks`` landmarks.
    sa (N,L) signatures, ua (N,D) factors of the linear cost; L and D multiples of four, by zeros. Those of b lie in
    lanes, sb [E,L,LANES] and ub [E,D,LANES]; all four as rows of floats. Block e holds the tracks ``member[e]``, -1
    where there is none, and b's group g has the blocks start[g]:start[g+1]. group (N,) of a's tracks; candidates (G,C)
    b's groups for each, -1 for none; index, value (N,K), cheapest first, -1 and inf where there are fewer. No linear
    part is below ``least``: a block whose signatures alone cost too much is left.
    """
    K = index.shape[1]
    half = L // 8 * 4
    costs = np.empty(LANES, np.float32)
    each = np.float32(1.0) / np.float32(marks)
    for i in range(i0, i1):
        best, where = value[i], index[i]
        for c in range(candidates.shape[1]):
            g = candidates[group[i], c]
            if g < 0:
                continue
            for e in range(start[g], start[g + 1]):
                # four sums at once: one alone would wait for itself
                p = q = r = s = spread(np.float32(0))
                own, at = i * L, e * L * LANES
                for end in (own + half, own + L):
                    while own < end:
                        u, v = repeat(sa, own) - load(sb, at), repeat(sa, own + 1) - load(sb, at + LANES)
                        w = repeat(sa, own + 2) - load(sb, at + 2 * LANES)
                        x = repeat(sa, own + 3) - load(sb, at + 3 * LANES)
                        p, q = p + minimum(u * u, tau2), q + minimum(v * v, tau2)
                        r, s = r + minimum(w * w, tau2), s + minimum(x * x, tau2)
                        own, at = own + 4, at + 4 * LANES
                    near = any_lane(((p + q) + (r + s)) * each + least < best[K - 1])
                    if not near:
                        break
                if not near:
                    continue
                apart = (p + q) + (r + s)
                p = q = r = s = spread(np.float32(0))
                at = e * D * LANES
                for own in range(i * D, (i + 1) * D, 4):
                    p = p + repeat(ua, own) * load(ub, at)
                    q = q + repeat(ua, own + 1) * load(ub, at + LANES)
                    r = r + repeat(ua, own + 2) * load(ub, at + 2 * LANES)
                    s = s + repeat(ua, own + 3) * load(ub, at + 3 * LANES)
                    at += 4 * LANES
                cost = apart * each + feature * (offset - ((p + q) + (r + s)))
                if not any_lane(cost < best[K - 1]):
                    continue
                store(costs, 0, cost)
                for m in range(LANES):
                    if costs[m] < best[K - 1] and member[e, m] >= 0:
                        n = K - 1
                        while n > 0 and best[n - 1] > costs[m]:
                            best[n], where[n] = best[n - 1], where[n - 1]
                            n -= 1
                        best[n], where[n] = costs[m], member[e, m]


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
