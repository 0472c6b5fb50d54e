"""Compiled inner loops. A leaf: importing it imports numba, so algorithms import it when they run.

Every kernel releases the GIL and is called over blocks from :func:`over_blocks`, not with numba's own ``prange``:
its workqueue layer aborts the process when two Python threads enter it, and callers may bring any thread pool.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numba as nb
import numpy as np

_jit = partial(nb.njit, nogil=True, cache=True, error_model="numpy")


def over_blocks(work: Callable[..., Any], blocks: Iterable[Any], threads: int | None = None) -> None:
    """Run ``work(block)`` for every block on a small pool; blocks must write to disjoint places."""
    blocks = list(blocks)
    threads = min(threads or os.cpu_count() or 1, len(blocks))
    if threads <= 1:
        for block in blocks:
            work(block)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, blocks))


@_jit(fastmath={"contract", "reassoc", "nsz"})
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


@_jit()
def open_end_path(cost, level):
    """Warping path with free ends: from the first row or column to the last row or column.

    Maximises the sum of ``level - cost`` over a monotone path (semi-global alignment), so that frames outside the
    overlap cost nothing and a long overlap is worth having. A diagonal step counts twice (Sakoe and Chiba's
    symmetric form): then a path's weight is the frames it spans, and a staircase gains nothing over a line.
    Returns (P,2) frame pairs.
    """
    n, m = cost.shape
    total = np.empty((n, m))
    step = np.zeros((n, m), np.int8)  # 0 start, 1 diagonal, 2 down, 3 right
    for i in range(n):
        for j in range(m):
            gain = level - cost[i, j]
            if i > 0 and j > 0:
                best, move = total[i - 1, j - 1] + 2 * gain, 1
                if total[i - 1, j] + gain > best:
                    best, move = total[i - 1, j] + gain, 2
                if total[i, j - 1] + gain > best:
                    best, move = total[i, j - 1] + gain, 3
                total[i, j] = best
                step[i, j] = move
            else:
                total[i, j] = gain
    i, j = n - 1, m - 1
    for c in range(m):
        if total[n - 1, c] > total[i, j]:
            i, j = n - 1, c
    for r in range(n):
        if total[r, m - 1] > total[i, j]:
            i, j = r, m - 1
    path = np.empty((n + m, 2), np.int64)
    length = 0
    while True:
        path[length, 0], path[length, 1] = i, j
        length += 1
        move = step[i, j]
        if move == 0:
            break
        if move != 3:
            i -= 1
        if move != 2:
            j -= 1
    return path[:length][::-1]
