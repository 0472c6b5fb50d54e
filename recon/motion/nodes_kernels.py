"""Loops over pairs of tracks: the greedy pick, and D_track."""

from __future__ import annotations

import numpy as np

from otsync.compute.jit import kernel


@kernel()
def _near(xyz, seen, i, j, reach2, top):
    """Whether the top-th largest distance of tracks i and j over the frames that both are seen is within reach."""
    beyond, common = 0, 0
    for t in range(xyz.shape[1]):
        if seen[i, t] and seen[j, t]:
            common += 1
            x, y, z = xyz[i, t, 0] - xyz[j, t, 0], xyz[i, t, 1] - xyz[j, t, 1], xyz[i, t, 2] - xyz[j, t, 2]
            if x * x + y * y + z * z > reach2:
                beyond += 1
                if beyond >= top:
                    return False
    # of fewer than `top` common frames the largest distance counts
    return common >= top or (common > 0 and beyond == 0)


@kernel()
def pick(xyz, seen, order, reach2, top, most):
    """Greedy cover of the tracks in `order`, cut off at `most`: those picked."""
    picked = np.empty(most, np.int64)
    n = 0
    for i in order:
        covered = False
        for p in range(n):
            if _near(xyz, seen, i, picked[p], reach2, top):
                covered = True
                break
        if not covered:
            picked[n] = i
            n += 1
            if n == most:
                break
    return picked[:n]


@kernel()
def track_distances(xyz, seen, top):
    """D_track of all pairs, float32 [M,M]; inf where never seen together."""
    m = len(xyz)
    out = np.empty((m, m), np.float32)
    largest = np.empty(top, np.float32)
    for i in range(m):
        out[i, i] = 0
        for j in range(i):
            common = 0
            largest[:] = -1
            for t in range(xyz.shape[1]):
                if seen[i, t] and seen[j, t]:
                    common += 1
                    x, y, z = xyz[i, t, 0] - xyz[j, t, 0], xyz[i, t, 1] - xyz[j, t, 1], xyz[i, t, 2] - xyz[j, t, 2]
                    d = x * x + y * y + z * z
                    if d > largest[0]:  # ascending: the least of the largest is replaced first
                        k = 0
                        while k + 1 < top and largest[k + 1] < d:
                            largest[k] = largest[k + 1]
                            k += 1
                        largest[k] = d
            value = np.float32(np.inf)
            if common >= top:
                value = np.sqrt(largest[0])
            elif common > 0:
                value = np.sqrt(largest[top - 1])
            out[i, j] = value
            out[j, i] = value
    return out
