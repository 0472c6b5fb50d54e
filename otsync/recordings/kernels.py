"""Compiled loop that keeps chosen tracks apart."""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel

CLOSE = 0.8
"""Mean distance, as a share of the one that separates tracks, below which a track follows another all the same."""


@kernel()
def apart_from_others(uv, apart, least, count):
    """Greedy choice in the given order, without tracks that stay within ``apart`` of a chosen one.

    Two tracks are compared where both are seen, in ``least`` frames or more.
    uv (N,T,2), nan unseen. Returns the chosen indices, at most ``count``.
    """
    N, T = uv.shape[0], uv.shape[1]
    chosen = np.empty(min(count, N), np.int64)
    n = 0
    for i in range(N):
        alone = True
        for q in range(n):
            j = chosen[q]
            met, furthest, total = 0, 0.0, 0.0
            for t in range(T):
                if np.isnan(uv[i, t, 0]) or np.isnan(uv[j, t, 0]):
                    continue
                d = np.sqrt((uv[i, t, 0] - uv[j, t, 0]) ** 2 + (uv[i, t, 1] - uv[j, t, 1]) ** 2)
                met += 1
                total += d
                furthest = max(furthest, d)
            if met >= least and (furthest < apart or total < CLOSE * apart * met):
                alone = False
                break
        if alone:
            chosen[n] = i
            n += 1
            if n == count:
                break
    return chosen[:n]
