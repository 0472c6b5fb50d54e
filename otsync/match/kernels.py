"""Compiled loop of the matcher at synchronised times."""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel


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
