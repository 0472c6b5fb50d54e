"""Compiled inner loops of visual hull and stereo. A leaf: importing it imports numba.

0 marks "unknown" throughout: with numba's fast maths a test for nan would be removed.
"""

from __future__ import annotations

import numpy as np

from ..compute.jit import kernel

_fast = {"contract", "reassoc", "nsz", "arcp"}


@kernel(fastmath=_fast)
def _votes(x, y, z, P, masks, near):
    """(views that see the point inside their image, views whose mask holds it)."""
    inside, held = 0, 0
    h, w = masks.shape[1], masks.shape[2]
    for v in range(P.shape[0]):
        depth = P[v, 2, 0] * x + P[v, 2, 1] * y + P[v, 2, 2] * z + P[v, 2, 3]
        if depth < near:
            continue
        u = (P[v, 0, 0] * x + P[v, 0, 1] * y + P[v, 0, 2] * z + P[v, 0, 3]) / depth
        t = (P[v, 1, 0] * x + P[v, 1, 1] * y + P[v, 1, 2] * z + P[v, 1, 3]) / depth
        if u < 0 or t < 0 or u >= w or t >= h:
            continue
        inside += 1
        if masks[v, int(t), int(u)]:
            held += 1
    return inside, held


@kernel(fastmath=_fast)
def carve(masks, coarse_masks, P, low, voxel, dims, block, min_views, misses, near):
    """Occupied voxels of the visual hull, uint8 (dims).

    masks (V,h,w) uint8; coarse_masks: dilated by a block's projection, for the first test of whole blocks; P (V,3,4)
    projections to mask pixels. A voxel is kept when at least ``min_views`` images contain it and at most
    ``misses`` of their masks do not.
    """
    grid = np.zeros((dims[0], dims[1], dims[2]), np.uint8)
    size = voxel * block
    for a in range(dims[0] // block):
        for b in range(dims[1] // block):
            for c in range(dims[2] // block):
                i, f = _votes(
                    low[0] + (a + 0.5) * size,
                    low[1] + (b + 0.5) * size,
                    low[2] + (c + 0.5) * size,
                    P,
                    coarse_masks,
                    near,
                )
                if i < min_views or f < i - misses:
                    continue
                for p in range(block):
                    for q in range(block):
                        for r in range(block):
                            k, m, n = a * block + p, b * block + q, c * block + r
                            i, f = _votes(
                                low[0] + (k + 0.5) * voxel,
                                low[1] + (m + 0.5) * voxel,
                                low[2] + (n + 0.5) * voxel,
                                P,
                                masks,
                                near,
                            )
                            if i >= min_views and f >= i - misses:
                                grid[k, m, n] = 1
    return grid


@kernel(fastmath=_fast)
def first_hit(grid, low, voxel, center, rays, step, near, far):
    """Depth at which each ray ``center + z ray`` (rays have unit z in the camera) enters the hull; 0: never."""
    out = np.zeros(len(rays))
    for n in range(len(rays)):
        z = near
        while z < far:
            i = int(np.floor((center[0] + z * rays[n, 0] - low[0]) / voxel))
            j = int(np.floor((center[1] + z * rays[n, 1] - low[1]) / voxel))
            k = int(np.floor((center[2] + z * rays[n, 2] - low[2]) / voxel))
            if 0 <= i < grid.shape[0] and 0 <= j < grid.shape[1] and 0 <= k < grid.shape[2] and grid[i, j, k]:
                out[n] = z
                break
            z += step
    return out


@kernel(fastmath=_fast)
def _bilinear(image, u, v):
    i, j = int(u), int(v)
    a, b = u - i, v - j
    return (1 - b) * ((1 - a) * image[j, i] + a * image[j, i + 1]) + b * (
        (1 - a) * image[j + 1, i] + a * image[j + 1, i + 1]
    )


@kernel(fastmath=_fast)
def sweep(points, start, depths, image, others, P, R, center, inverse_K, half, noise):
    """Normalised cross-correlation of patches around ``points`` with other views, over depths behind ``start``.

    points (N,2): pixels (+0.5 convention); start (N,): depth of the hull, 0 skips the point; depths (D,): added to
    it; image (h,w), others (V,h,w) grey float32; P (V,3,4); R (3,3) camera to world; the patch is parallel to the
    image plane and warped affinely. Returns (N,D): the mean of the two best views, one view's less .2, -1 for none.
    ``noise``: variance of grey levels that keeps flat patches from correlating.
    """
    N, D, side = len(points), len(depths), 2 * half + 1
    n = side * side
    out = np.full((N, D), -1.0)
    own, seen = np.empty(n), np.empty(n)
    h, w = image.shape
    for p in range(N):
        x, y = points[p, 0], points[p, 1]
        if start[p] <= 0 or x < half + 1 or y < half + 1 or x >= w - half - 1 or y >= h - half - 1:
            continue
        q, mean = 0, 0.0
        for b in range(-half, half + 1):
            for a in range(-half, half + 1):
                own[q] = _bilinear(image, x - 0.5 + a, y - 0.5 + b)
                mean += own[q]
                q += 1
        mean /= n
        power = 0.0
        for q in range(n):
            own[q] -= mean
            power += own[q] * own[q]
        dx = inverse_K[0, 0] * x + inverse_K[0, 1] * y + inverse_K[0, 2]
        dy = inverse_K[1, 1] * y + inverse_K[1, 2]
        for d in range(D):
            z = start[p] + depths[d]
            X = center[0] + z * (R[0, 0] * dx + R[0, 1] * dy + R[0, 2])
            Y = center[1] + z * (R[1, 0] * dx + R[1, 1] * dy + R[1, 2])
            Z = center[2] + z * (R[2, 0] * dx + R[2, 1] * dy + R[2, 2])
            # world displacement of one pixel to the right and down at this depth
            rx, ry, rz = z * inverse_K[0, 0] * R[0, 0], z * inverse_K[0, 0] * R[1, 0], z * inverse_K[0, 0] * R[2, 0]
            sx, sy, sz = z * inverse_K[1, 1] * R[0, 1], z * inverse_K[1, 1] * R[1, 1], z * inverse_K[1, 1] * R[2, 1]
            best, second = -1.0, -1.0
            for v in range(P.shape[0]):
                depth = P[v, 2, 0] * X + P[v, 2, 1] * Y + P[v, 2, 2] * Z + P[v, 2, 3]
                if depth < 0.1 * z:
                    continue
                U = (P[v, 0, 0] * X + P[v, 0, 1] * Y + P[v, 0, 2] * Z + P[v, 0, 3]) / depth
                V = (P[v, 1, 0] * X + P[v, 1, 1] * Y + P[v, 1, 2] * Z + P[v, 1, 3]) / depth
                dr = P[v, 2, 0] * rx + P[v, 2, 1] * ry + P[v, 2, 2] * rz
                ds = P[v, 2, 0] * sx + P[v, 2, 1] * sy + P[v, 2, 2] * sz
                Ur = (P[v, 0, 0] * rx + P[v, 0, 1] * ry + P[v, 0, 2] * rz - U * dr) / depth
                Vr = (P[v, 1, 0] * rx + P[v, 1, 1] * ry + P[v, 1, 2] * rz - V * dr) / depth
                Us = (P[v, 0, 0] * sx + P[v, 0, 1] * sy + P[v, 0, 2] * sz - U * ds) / depth
                Vs = (P[v, 1, 0] * sx + P[v, 1, 1] * sy + P[v, 1, 2] * sz - V * ds) / depth
                reach = half * max(abs(Ur) + abs(Us), abs(Vr) + abs(Vs)) + 2
                if reach > U or reach > V or w - reach <= U or h - reach <= V:
                    continue
                q, mean = 0, 0.0
                for b in range(-half, half + 1):
                    for a in range(-half, half + 1):
                        seen[q] = _bilinear(others[v], U - 0.5 + a * Ur + b * Us, V - 0.5 + a * Vr + b * Vs)
                        mean += seen[q]
                        q += 1
                mean /= n
                own_power, cross = 0.0, 0.0
                for q in range(n):
                    e = seen[q] - mean
                    own_power += e * e
                    cross += e * own[q]
                score = cross / np.sqrt((power + n * noise) * (own_power + n * noise))
                if score > best:
                    best, second = score, best
                elif score > second:
                    second = score
            if second > -1:
                out[p, d] = 0.5 * (best + second)
            elif best > -1:
                out[p, d] = best - 0.2
    return out


@kernel(fastmath=_fast)
def choose_depth(scores, start, first, step, near, prior):
    """Depth per group of sub-points, their scores added up at the same absolute depth.

    scores (N,S,D): group n's sub-points; start (N,S): their hull depths, 0 invalid; sub-point 0 is the point itself;
    those whose hull depth differs by more than ``near`` belong to another surface. ``prior``: score lost per unit
    behind the hull. Returns depth (N,), 0 unknown, and its score (N,).
    """
    N, S, D = scores.shape
    depth, quality = np.zeros(N), np.full(N, -1.0)
    total = np.empty(D)
    for n in range(N):
        if start[n, 0] <= 0:
            continue
        total[:] = 0.0
        count = 0
        for s in range(S):
            if start[n, s] <= 0 or abs(start[n, s] - start[n, 0]) > near:
                continue
            shift = int(np.round((start[n, 0] - start[n, s]) / step))
            count += 1
            for d in range(D):
                e = min(max(d + shift, 0), D - 1)
                total[d] += max(scores[n, s, e], -0.2)
        best, at = -1e9, 0
        for d in range(D):
            value = total[d] / count - prior * (first + d * step)
            if value > best:
                best, at = value, d
        offset = 0.0
        if 0 < at < D - 1:
            bend = total[at - 1] - 2 * total[at] + total[at + 1]
            if bend < 0:
                offset = min(max(0.5 * (total[at - 1] - total[at + 1]) / bend, -0.5), 0.5)
        depth[n] = start[n, 0] + first + (at + offset) * step
        quality[n] = total[at] / count
    return depth, quality
