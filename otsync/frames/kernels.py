"""Compiled loops of the search for clock and pose: which matches move alike, and the similarity that most agree on."""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel

fast = kernel(fastmath={"contract", "reassoc", "nsz"})


@fast
def distances_within(x, seen, out):
    """Distance of every two of M tracks at every frame: x (M,T,3), seen (M,T); out (P,T), 0 where one is unseen."""
    M, T = seen.shape
    p = 0
    for m in range(M):
        for n in range(m + 1, M):
            for t in range(T):
                if seen[m, t] and seen[n, t]:
                    dx, dy, dz = x[m, t, 0] - x[n, t, 0], x[m, t, 1] - x[n, t, 1], x[m, t, 2] - x[n, t, 2]
                    out[p, t] = np.sqrt(dx * dx + dy * dy + dz * dz)
                else:
                    out[p, t] = 0.0
            p += 1


@kernel()
def draw(state):
    """The next number in [0, 1) of a xorshift generator: the same on every machine, of its own for every shift."""
    x = state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return (x >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@fast
def agreeing_pairs(u, v, M, lag, step, least, nearest, tolerance, growth, together):
    """Which pairs of matches keep the same distance in both videos when b's frame t - lag shows a's frame t.

    u (P,Ta), v (P,Tb): distances within a and within b, 0 unseen. Two matches agree when, over at least ``least`` of
    every ``step``-th common frame, the distances differ by less than ``tolerance`` (rms) after the scale that suits
    them best, which lies within a factor ``growth``; matches nearer than ``nearest`` say nothing.
    Fills together (M,M) and returns how many pairs agree.
    """
    Ta, Tb = u.shape[1], v.shape[1]
    first, last = max(0, lag), min(Ta, Tb + lag)
    p, count = 0, 0
    for m in range(M):
        together[m, m] = False
        for n in range(m + 1, M):
            uu = vv = uv = 0.0
            k = 0
            for t in range(first, last, step):
                x, y = u[p, t], v[p, t - lag]
                if x > 0 and y > 0:
                    uu += x * x
                    vv += y * y
                    uv += x * y
                    k += 1
            p += 1
            same = False
            if k >= least and uu > k * nearest * nearest and vv > k * nearest * nearest:
                s2 = uu / vv
                if s2 < growth * growth and s2 * growth * growth > 1:
                    same = 2 * (np.sqrt(uu * vv) - uv) < tolerance * tolerance * k
            together[m, n] = together[n, m] = same
            count += same
    return count


@kernel()
def fit_points(A, B, n, out):
    """The similarity from the first n rows of B to those of A (Umeyama 1991; the scale of Horn 1987, which is the same
    both ways).

    out (13): scale, R row by row, t. Returns the second singular value of A relative to its first: 0 on a line.
    """
    ca, cb = np.zeros(3), np.zeros(3)
    for i in range(n):
        for d in range(3):
            ca[d] += A[i, d]
            cb[d] += B[i, d]
    ca /= n
    cb /= n
    C, S = np.zeros((3, 3)), np.zeros((3, 3))
    aa = bb = 0.0
    for i in range(n):
        for d in range(3):
            x = A[i, d] - ca[d]
            aa += x * x
            bb += (B[i, d] - cb[d]) ** 2
            for e in range(3):
                C[d, e] += x * (B[i, e] - cb[e])
                S[d, e] += x * (A[i, e] - ca[e])
    if not (aa > 0 and bb > 0):
        return 0.0
    U, _, Vt = np.linalg.svd(C)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        U[:, 2] = -U[:, 2]
    R = U @ Vt
    s = np.sqrt(aa / bb)
    out[0] = s
    for d in range(3):
        out[10 + d] = ca[d]
        for e in range(3):
            out[1 + 3 * d + e] = R[d, e]
            out[10 + d] -= s * R[d, e] * cb[e]
    spread = np.linalg.eigvalsh(S)
    return np.sqrt(max(spread[1], 0.0) / max(spread[2], 1e-300))


@fast
def misfits(x, seen_x, y, seen_y, lag, step, least, found, limit, error):
    """Median distance of every match over at most every ``step``-th common frame; inf below ``least`` of them.

    Distances count in the unit midway between both frames, so that exchanging the videos changes none.
    Fills error (M,) and returns the sum of max(0, 1 - error / limit).
    """
    M, Ta, Tb = len(x), x.shape[1], y.shape[1]
    first, last = max(0, lag), min(Ta, Tb + lag)
    values = np.empty((last - first) // step + 1)
    unit = np.sqrt(found[0])
    total = 0.0
    for m in range(M):
        k = 0
        for t in range(first, last, step):
            if seen_x[m, t] and seen_y[m, t - lag]:
                b0, b1, b2 = found[0] * y[m, t - lag, 0], found[0] * y[m, t - lag, 1], found[0] * y[m, t - lag, 2]
                d0 = x[m, t, 0] - found[1] * b0 - found[2] * b1 - found[3] * b2 - found[10]
                d1 = x[m, t, 1] - found[4] * b0 - found[5] * b1 - found[6] * b2 - found[11]
                d2 = x[m, t, 2] - found[7] * b0 - found[8] * b1 - found[9] * b2 - found[12]
                d = d0 * d0 + d1 * d1 + d2 * d2
                i = k
                while i > 0 and values[i - 1] > d:  # insertion: there are a dozen
                    values[i] = values[i - 1]
                    i -= 1
                values[i] = d
                k += 1
        if k < least:
            error[m] = np.inf
            continue
        middle = 0.5 * (np.sqrt(values[(k - 1) // 2]) + np.sqrt(values[k // 2]))
        error[m] = middle / unit
        total += max(0.0, 1 - error[m] / limit)
    return total


@kernel()
def gather(x, seen_x, y, seen_y, chosen, lag, step, A, B):
    """Common samples of the chosen matches into the rows of A and B; how many there are."""
    first, last = max(0, lag), min(x.shape[1], y.shape[1] + lag)
    n = 0
    for m in chosen:
        for t in range(first, last, step):
            if n < len(A) and seen_x[m, t] and seen_y[m, t - lag]:
                for d in range(3):
                    A[n, d], B[n, d] = x[m, t, d], y[m, t - lag, d]
                n += 1
    return n


@kernel()
def turned(p, q):
    """Cosine of the angle between the rotations of two similarities."""
    trace = 0.0
    for i in range(1, 10):
        trace += p[i] * q[i]
    return 0.5 * (trace - 1)


@kernel()
def scan_shifts(
    x,
    seen_x,
    y,
    seen_y,
    u,
    v,
    lags,
    step,
    coarse,
    least,
    draws,
    nearest,
    tolerance,
    limit,
    growth,
    apart,
    seed,
    k0,
    k1,
    scores,
    found,
):
    """The best similarities at shifts k0:k1 of ``lags``, by consensus of three matched tracks at a time.

    x (M,Ta,3), y (M,Tb,3): matched tracks with seen_x, seen_y; u, v: their distances within each video
    (:func:`distances_within`). Triples are drawn among matches whose mutual distances agree, fitted, judged by the
    matches of every ``coarse``-th frame, and the best fitted again to all that agree with them.
    Fills scores (K,H) and found (K,H,13): H answers a shift, best first, turned by more than acos(``apart``) from
    better ones; score 0 where there is none.
    """
    M, H = len(x), scores.shape[1]
    together = np.zeros((M, M), np.bool_)
    error, mates = np.empty(M), np.empty(M, np.int64)
    A, B = np.empty((M * (x.shape[1] // step + 1), 3)), np.empty((M * (x.shape[1] // step + 1), 3))
    triple, trial = np.empty(3, np.int64), np.empty(13)
    state = np.empty(1, np.uint64)
    degree = np.empty(M)
    for k in range(k0, k1):
        lag = lags[k]
        state[0] = np.uint64(0x9E3779B97F4A7C15) * np.uint64(seed + 1) + np.uint64(lag + (1 << 20)) * np.uint64(
            0xD1B54A32D192ED03
        )
        for _ in range(4):
            draw(state)
        if agreeing_pairs(u, v, M, lag, step, least, nearest, tolerance, growth, together) < 3:
            continue
        total = 0.0
        for m in range(M):
            degree[m] = together[m].sum()
            total += degree[m]
        for _ in range(draws):
            # a match by how many agree with it, one of those, and one that agrees with both
            left, m = draw(state) * total, 0
            while m < M - 1 and left >= degree[m]:
                left -= degree[m]
                m += 1
            count = 0
            for n in range(M):
                if together[m, n]:
                    mates[count] = n
                    count += 1
            if count < 2:
                continue
            n = mates[int(draw(state) * count)]
            count = 0
            for o in range(M):
                if together[m, o] and together[n, o]:
                    mates[count] = o
                    count += 1
            if count < 1:
                continue
            triple[0], triple[1], triple[2] = m, n, mates[int(draw(state) * count)]
            rows = gather(x, seen_x, y, seen_y, triple, lag, step, A, B)
            if rows < 3 or fit_points(A, B, rows, trial) < 0.08:
                continue
            if not (trial[0] < growth and trial[0] * growth > 1):
                continue
            score = misfits(x, seen_x, y, seen_y, lag, coarse, 2, trial, limit, error)
            keep(score, trial, scores[k], found[k], apart)
        for h in range(H):
            if scores[k, h] <= 0:
                break
            best = found[k, h].copy()
            score = misfits(x, seen_x, y, seen_y, lag, step, least, best, limit, error)
            for _ in range(3):
                near = np.flatnonzero(error < limit)
                if len(near) < 3:
                    break
                rows = gather(x, seen_x, y, seen_y, near, lag, step, A, B)
                if rows < 3 or fit_points(A, B, rows, trial) < 0.02:
                    break
                again = misfits(x, seen_x, y, seen_y, lag, step, least, trial, limit, error)
                if again <= score or not (trial[0] < growth and trial[0] * growth > 1):
                    break
                score = again
                best[:] = trial
            scores[k, h] = score
            found[k, h] = best
        sort_answers(scores[k], found[k])


@kernel()
def keep(score, trial, scores, found, apart):
    """Put a trial among the best answers of a shift: in the place of one that it hardly differs from, or by rank."""
    H = len(scores)
    if score <= scores[H - 1]:
        return
    place = H - 1
    for h in range(H):
        if scores[h] > 0 and turned(found[h], trial) > apart:
            if scores[h] >= score:
                return
            place = h
            break
    while place > 0 and scores[place - 1] < score:
        scores[place] = scores[place - 1]
        found[place] = found[place - 1]
        place -= 1
    scores[place] = score
    found[place] = trial


@kernel()
def sort_answers(scores, found):
    for i in range(1, len(scores)):
        j = i
        while j > 0 and scores[j] > scores[j - 1]:
            s, f = scores[j], found[j].copy()
            scores[j], found[j] = scores[j - 1], found[j - 1]
            scores[j - 1], found[j - 1] = s, f
            j -= 1


@fast
def laid_over(a, wa, b, wb, least, place, motion, alike):
    """Distances of all tracks at common moments: a (N,S,3), b (M,S,3) 0 where unseen; wa, wb: seen.

    Fills (N,M), where at least ``least`` moments are common: place, the mean distance; motion, the rms distance about
    its mean vector; alike, 1 - Var(a - b) / (Var a + Var b): 1 the same motion, 0 and less unrelated or none.
    """
    S = a.shape[1]
    for i in range(len(a)):
        for j in range(len(b)):
            n = 0
            total = square = power = 0.0
            mx = my = mz = ax = ay = az = bx = by = bz = 0.0
            for s in range(S):
                if wa[i, s] and wb[j, s]:
                    p, q, r = a[i, s, 0], a[i, s, 1], a[i, s, 2]
                    u, v, w = b[j, s, 0], b[j, s, 1], b[j, s, 2]
                    ax, ay, az = ax + p, ay + q, az + r
                    bx, by, bz = bx + u, by + v, bz + w
                    power += p * p + q * q + r * r + u * u + v * v + w * w
                    p, q, r = p - u, q - v, r - w
                    d2 = p * p + q * q + r * r
                    mx, my, mz = mx + p, my + q, mz + r
                    total += np.sqrt(d2)
                    square += d2
                    n += 1
            if n >= least:
                apart = max(square / n - (mx * mx + my * my + mz * mz) / (n * n), 0.0)
                shared = power / n - (ax * ax + ay * ay + az * az + bx * bx + by * by + bz * bz) / (n * n)
                place[i, j] = total / n
                motion[i, j] = np.sqrt(apart)
                alike[i, j] = 1 - apart / shared if shared > 0 else 0.0
