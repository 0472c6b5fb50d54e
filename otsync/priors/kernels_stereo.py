"""Compiled inner loops of visual hull and stereo. A leaf: importing it imports numba.

0 marks "unknown" throughout: with numba's fast maths a test for nan would be removed.
"""

from __future__ import annotations

import numpy as np

from ..compute.jit import inlined, kernel

_fast = {"contract", "reassoc", "nsz", "arcp"}

TILE = 24
"""Pixels along a side of the squares in which an image is correlated, at most: patches of one share their samples."""

SKIP = 16
"""Voxels along a side of the blocks that rays go through at once where they are empty."""

CLOSE = 0.1
"""Share of a point's own depth from which it lies in front of another view."""

EDGE = 2.0
"""Pixels from the border of another view within which nothing is compared."""


@kernel(fastmath=_fast)
def _occupied(x, y, z, P, masks, sizes, near, min_views, misses):
    """Whether at least ``min_views`` images contain the point and at most ``misses`` of their masks do not.

    Most points are empty, and the first views say so: the others are not asked.
    """
    inside, missed = 0, 0
    for v in range(P.shape[0]):
        w, h = sizes[v]
        depth = P[v, 2, 0] * x + P[v, 2, 1] * y + P[v, 2, 2] * z + P[v, 2, 3]
        if depth < near:
            continue
        u = (P[v, 0, 0] * x + P[v, 0, 1] * y + P[v, 0, 2] * z + P[v, 0, 3]) / depth
        t = (P[v, 1, 0] * x + P[v, 1, 1] * y + P[v, 1, 2] * z + P[v, 1, 3]) / depth
        if u < 0 or t < 0 or u >= w or t >= h:
            continue
        inside += 1
        if not masks[v, int(t), int(u)]:
            missed += 1
            if missed > misses:
                return False
    return inside >= min_views


@kernel(fastmath=_fast)
def carve(masks, coarse_masks, sizes, P, low, voxel, dims, block, min_views, misses, near):
    """Occupied voxels of the visual hull, uint8 (dims).

    masks (V,h,w) uint8, of which sizes (V,2), width and height, are each view's own; coarse_masks: dilated by a block's
    projection, for the first test of whole blocks; P (V,3,4) projections to mask pixels. A voxel is kept when at least
    ``min_views`` images contain it and at most ``misses`` of their masks do not.
    """
    grid = np.zeros((dims[0], dims[1], dims[2]), np.uint8)
    size = voxel * block
    for a in range(dims[0] // block):
        for b in range(dims[1] // block):
            for c in range(dims[2] // block):
                x, y, z = low[0] + (a + 0.5) * size, low[1] + (b + 0.5) * size, low[2] + (c + 0.5) * size
                if not _occupied(x, y, z, P, coarse_masks, sizes, near, min_views, misses):
                    continue
                for k in range(a * block, (a + 1) * block):
                    for m in range(b * block, (b + 1) * block):
                        for n in range(c * block, (c + 1) * block):
                            x, y, z = low[0] + (k + 0.5) * voxel, low[1] + (m + 0.5) * voxel, low[2] + (n + 0.5) * voxel
                            grid[k, m, n] = _occupied(x, y, z, P, masks, sizes, near, min_views, misses)
    return grid


@kernel()
def blocks_of(grid):
    """Which blocks of :data:`SKIP` voxels a side hold an occupied one, uint8."""
    X, Y, Z = grid.shape
    out = np.zeros((X // SKIP + 1, Y // SKIP + 1, Z // SKIP + 1), np.uint8)
    for i in range(X):
        for j in range(Y):
            for c in range(Z // SKIP + 1):
                some = np.uint8(0)
                for k in range(c * SKIP, min((c + 1) * SKIP, Z)):
                    some |= grid[i, j, k]
                out[i // SKIP, j // SKIP, c] |= some
    return out


@kernel(fastmath=_fast)
def first_hit(grid, blocks, low, voxel, center, rays, step, near, far):
    """Depth at which each ray ``center + z ray`` (rays have unit z in the camera) enters the hull; 0: never.

    Depths are ``near`` and whole steps from there. blocks: of :func:`blocks_of`: a ray goes through empty ones at once.
    """
    out = np.zeros(len(rays))
    for n in range(len(rays)):
        # from where the ray enters the box to where it leaves it
        enters, leaves = near, far
        for a in range(3):
            if abs(rays[n, a]) > 1e-12:
                one = (low[a] - center[a]) / rays[n, a]
                other = (low[a] + voxel * grid.shape[a] - center[a]) / rays[n, a]
                enters, leaves = max(enters, min(one, other)), min(leaves, max(one, other))
        k = max(0, int((enters - near) / step) - 1)
        while near + k * step < min(leaves + step, far):
            z = near + k * step
            x = (center[0] + z * rays[n, 0] - low[0]) / voxel
            y = (center[1] + z * rays[n, 1] - low[1]) / voxel
            t = (center[2] + z * rays[n, 2] - low[2]) / voxel
            i, j, m = int(np.floor(x)), int(np.floor(y)), int(np.floor(t))
            k += 1
            if not (0 <= i < grid.shape[0] and 0 <= j < grid.shape[1] and 0 <= m < grid.shape[2]):
                continue
            if blocks[i // SKIP, j // SKIP, m // SKIP]:
                if grid[i, j, m]:
                    out[n] = z
                    break
            else:
                ahead = _within(x, i, rays[n, 0]), _within(y, j, rays[n, 1]), _within(t, m, rays[n, 2])
                k = max(k, int((z - near + voxel * min(ahead)) / step))
    return out


@inlined(fastmath=_fast)
def _within(x, i, ray):
    """How far along a ray, in voxels, it stays within the block of voxel i, from place x on one axis."""
    if abs(ray) < 1e-12:
        return 1e9
    begin = i // SKIP * SKIP
    return ((begin + SKIP if ray > 0 else begin) - x) / ray


@kernel(fastmath=_fast)
def planes_of(start, group, first, last, near, step):
    """First and last plane in which each point is compared, (M,), the last before the first for none; and its group.

    start (M+1,): depth of the hull at the points, 0 unknown, and a 0 for the point that is none; group (N,S): the
    points whose correlations are added, the one that is measured first. It asks for the planes, at whole numbers of
    ``step``, from ``first`` to ``last`` behind its hull, which are returned last, (N,2); the others are asked where
    their hull is no further than ``near`` from its own. The group of a point is -1 where several ask for it, -2 where
    none does.
    """
    low, high, owner = np.full(len(start), 2**30), np.full(len(start), -1), np.full(len(start), -2)
    asked = np.zeros((len(group), 2), np.int64)
    for n in range(len(group)):
        z = start[group[n, 0]]
        one, other = max(1, int(np.ceil((z + first) / step))), int(np.floor((z + last) / step))
        if z <= 0 or other < one:
            asked[n, 1] = -1
            continue
        asked[n, 0], asked[n, 1] = one, other
        for s in range(group.shape[1]):
            m = group[n, s]
            if start[m] > 0 and abs(start[m] - z) <= near:
                low[m], high[m] = min(low[m], one), max(high[m], other)
                owner[m] = n if owner[m] == -2 else -1
    return low[:-1], high[:-1], owner[:-1], asked


@kernel(fastmath=_fast)
def _include(box, points, m, half, h, w):
    """Widen a box (first and last column, first and last row) by the pixels around a point."""
    i, j = int(np.floor(points[m, 0] - 0.5)), int(np.floor(points[m, 1] - 0.5))
    if max(i, half) < min(i + 2, w - half) and max(j, half) < min(j + 2, h - half):
        box[0], box[1] = min(box[0], max(i, half)), max(box[1], min(i + 1, w - half - 1))
        box[2], box[3] = min(box[2], max(j, half)), max(box[3], min(j + 1, h - half - 1))


@kernel(fastmath=_fast)
def boxes_of_groups(points, owner, groups, half, h, w):
    """(groups,4) int32: first and last column, first and last row of the pixels that each group needs.

    All are inclusive, and the last before the first where a group needs none.
    """
    boxes = np.empty((groups, 4), np.int32)
    boxes[:, 0], boxes[:, 1], boxes[:, 2], boxes[:, 3] = w, -1, h, -1
    for m in range(len(points)):
        if owner[m] >= 0:
            _include(boxes[owner[m]], points, m, half, h, w)
    return boxes


@kernel(fastmath=_fast)
def boxes_of_squares(points, low, high, half, h, w):
    """Boxes as :func:`correlate` wants them, of squares of :data:`TILE` pixels of every plane; and their numbers.

    These are (planes, rows, columns), -1 where a square is not needed; the first plane is the first of all points.
    """
    base, count = low.min(), max(0, high.max() + 1 - low.min())
    boxes = np.empty((count, (h + TILE - 1) // TILE, (w + TILE - 1) // TILE, 4), np.int32)
    boxes[..., 0], boxes[..., 1], boxes[..., 2], boxes[..., 3] = w, -1, h, -1
    for m in range(len(points)):
        if high[m] < low[m]:
            continue
        i, j = int(np.floor(points[m, 0] - 0.5)), int(np.floor(points[m, 1] - 0.5))
        for y in range(max(j, half), min(j + 2, h - half)):
            for x in range(max(i, half), min(i + 2, w - half)):
                for k in range(low[m] - base, high[m] - base + 1):
                    box = boxes[k, y // TILE, x // TILE]
                    box[0], box[1] = min(box[0], x), max(box[1], x)
                    box[2], box[3] = min(box[2], y), max(box[3], y)
    number, total = np.full(boxes.shape[:3], -1), 0
    for k, p, q in np.ndindex(number.shape):
        if boxes[k, p, q, 1] >= 0:
            number[k, p, q] = total
            total += 1
    out = np.empty((total, 5), np.int32)
    for k, p, q in np.ndindex(number.shape):
        if number[k, p, q] >= 0:
            out[number[k, p, q], 0], out[number[k, p, q], 1:] = base + k, boxes[k, p, q]
    return out, number


@inlined(fastmath=_fast)
def _sums(values, side, rows, columns, across, out):
    """Sums of values over the squares of ``side``, whose first corners are the first rows and columns."""
    for y in range(rows + side - 1):
        for x in range(columns):
            across[y, x] = values[y, x]
        for a in range(1, side):
            for x in range(columns):
                across[y, x] += values[y, x + a]
    for y in range(rows):
        for x in range(columns):
            out[y, x] = across[y, x]
        for b in range(1, side):
            for x in range(columns):
                out[y, x] += across[y + b, x]


@inlined(fastmath=_fast)
def _inside(A, b, z, left, right, top, bottom, w, h):
    """Whether another view sees all of a rectangle at depth z (1), nothing of it (0), or perhaps a part (-1).

    All of its corners beyond one side of the image is nothing: straight lines stay straight.
    """
    before, behind, above, below, hidden = 0, 0, 0, 0, 0
    for c in range(4):
        x, y = right if c % 2 else left, bottom if c // 2 else top
        depth = z * (A[2, 0] * x + A[2, 1] * y + A[2, 2]) + b[2]
        if depth < CLOSE * z:
            hidden += 1
            continue
        u = (z * (A[0, 0] * x + A[0, 1] * y + A[0, 2]) + b[0]) / depth
        v = (z * (A[1, 0] * x + A[1, 1] * y + A[1, 2]) + b[1]) / depth
        before += u < EDGE
        behind += u >= w - EDGE
        above += v < EDGE
        below += v >= h - EDGE
    if max(before, behind, above, below, hidden) == 4:
        return 0
    return 1 if before + behind + above + below + hidden == 0 else -1


@kernel(fastmath=_fast)
def correlate(image, others, sizes, A, b, boxes, at, step, half, noise):
    """Plane sweep: normalised cross-correlation of the patches around pixels with other views, plane by plane.

    image (h,w), others (V,H,W), of which sizes (V,2), width and height, are each view's own: grey, float32. A (V,3,3),
    b (V,3): a pixel p = (x, y, 1) at depth z lies at ``z A p + b`` in another view. boxes (B,5): number of a plane,
    first and last column, first and last row; at (B+1,): where in the result each box begins, row by row. A patch has 2
    ``half`` + 1 pixels a side and lies in its plane z = i ``step``, parallel to the image. Each value is the mean of
    the two best views, one view's less .2, and -1 where no view sees all of the patch. ``noise``: variance of grey
    levels that keeps flat patches from correlating.

    Patches of neighbouring pixels share their samples: a view is sampled once a plane, and patches are sums over it.
    """
    f = np.float32
    side, most = 2 * half + 1, TILE + 2 * half
    n, offset, least = f(side * side), f(0.5), f(-1)
    out = np.full(at[-1], least)
    seen, beyond = np.empty((most, most), f), np.empty((most, most), f)
    across, total, power = np.empty((most, TILE), f), np.empty((TILE, TILE), f), np.empty((TILE, TILE), f)
    cross, lost = np.empty((TILE, TILE), f), np.empty((TILE, TILE), f)
    down = np.empty((3, most), f)
    best, second = np.empty((TILE, TILE), f), np.empty((TILE, TILE), f)
    # a level near those that occur, so that squares stay small numbers
    level = f(image.mean())
    own = image - level
    own_sum, own_power = np.zeros(image.shape, f), np.zeros(image.shape, f)
    _statistics(own, half, noise, own_sum, own_power)
    for p in range(len(boxes)):
        i, x0, x1, y0, y1 = boxes[p]
        z = i * step
        rows, columns = y1 - y0 + 1, x1 - x0 + 1
        tall, wide = rows + side - 1, columns + side - 1
        left, right = x0 - half + 0.5, x1 + half + 0.5
        top, bottom = y0 - half + 0.5, y1 + half + 0.5
        best[:rows, :columns], second[:rows, :columns] = least, least
        for v in range(len(A)):
            w, h = sizes[v]
            whole = _inside(A[v], b[v], z, left, right, top, bottom, w, h)
            if whole == 0:
                continue
            other = others[v]
            close = f(CLOSE * z)
            du, dv, dz = f(z * A[v, 0, 0]), f(z * A[v, 1, 0]), f(z * A[v, 2, 0])
            for y in range(tall):
                Y = top + y
                u0 = f(z * (A[v, 0, 0] * left + A[v, 0, 1] * Y + A[v, 0, 2]) + b[v, 0])
                v0 = f(z * (A[v, 1, 0] * left + A[v, 1, 1] * Y + A[v, 1, 2]) + b[v, 1])
                z0 = f(z * (A[v, 2, 0] * left + A[v, 2, 1] * Y + A[v, 2, 2]) + b[v, 2])
                for x in range(wide):
                    deep = z0 + f(x) * dz
                    there = f(1) / max(deep, close)
                    U, V = (u0 + f(x) * du) * there, (v0 + f(x) * dv) * there
                    if whole < 0:
                        beyond[y, x] = deep < close or U < EDGE or V < EDGE or w - EDGE <= U or h - EDGE <= V
                        U, V = min(max(U, f(EDGE)), f(w - EDGE)), min(max(V, f(EDGE)), f(h - EDGE))
                    U, V = U - offset, V - offset
                    k, m = np.int32(U), np.int32(V)
                    c, d = U - f(k), V - f(m)
                    above = other[m, k] + c * (other[m, k + 1] - other[m, k])
                    below = other[m + 1, k] + c * (other[m + 1, k + 1] - other[m + 1, k])
                    seen[y, x] = above + d * (below - above) - level
            _compare(seen, own, x0 - half, y0 - half, side, rows, columns, down, total, power, cross)
            if whole < 0:
                _sums(beyond, side, rows, columns, across, lost)
            for y in range(rows):
                for x in range(columns):
                    there = power[y, x] - total[y, x] * total[y, x] / n + n * noise
                    score = cross[y, x] - total[y, x] * own_sum[y0 + y, x0 + x] / n
                    score /= np.sqrt(own_power[y0 + y, x0 + x] * there)
                    if whole < 0 and lost[y, x] > 0:
                        score = least
                    second[y, x] = max(second[y, x], min(score, best[y, x]))
                    best[y, x] = max(best[y, x], score)
        where = at[p]
        for y in range(rows):
            for x in range(columns):
                if second[y, x] > -1:
                    out[where] = f(0.5) * (best[y, x] + second[y, x])
                elif best[y, x] > -1:
                    out[where] = best[y, x] - f(0.2)
                where += 1
    return out


@inlined(fastmath=_fast)
def _compare(seen, own, left, top, side, rows, columns, down, total, power, cross):
    """Sums of the patches of what was seen, of its squares, and of its products with the own image from (left, top).

    Columns of ``side`` pixels are summed by running sums, in ``down``, and rows of these anew, which a processor does
    several at a time.
    """
    wide = columns + side - 1
    down[:, :wide] = np.float32(0)
    for y in range(rows + side - 1):
        for x in range(wide):
            e = seen[y, x]
            down[0, x] += e
            down[1, x] += e * e
            down[2, x] += e * own[top + y, left + x]
        if y >= side:
            for x in range(wide):
                e = seen[y - side, x]
                down[0, x] -= e
                down[1, x] -= e * e
                down[2, x] -= e * own[top + y - side, left + x]
        r = y - side + 1
        if r < 0:
            continue
        for x in range(columns):
            total[r, x], power[r, x], cross[r, x] = down[0, x], down[1, x], down[2, x]
        for a in range(1, side):
            for x in range(columns):
                total[r, x] += down[0, x + a]
                power[r, x] += down[1, x + a]
                cross[r, x] += down[2, x + a]


@inlined(fastmath=_fast)
def _statistics(own, half, noise, total, power):
    """Sums of the patches around all pixels, and those of their squares less the mean's, by running sums."""
    h, w = own.shape
    side = 2 * half + 1
    n = np.float32(side * side)
    one, two = np.zeros(w), np.zeros(w)
    for y in range(h):
        for x in range(w):
            one[x] += own[y, x]
            two[x] += own[y, x] * own[y, x]
            if y >= side:
                one[x] -= own[y - side, x]
                two[x] -= own[y - side, x] * own[y - side, x]
        if y < side - 1:
            continue
        a, b = 0.0, 0.0
        for x in range(w):
            a += one[x]
            b += two[x]
            if x >= side:
                a -= one[x - side]
                b -= two[x - side]
            if x >= side - 1:
                total[y - half, x - half] = a
                power[y - half, x - half] = b - a * a / n + n * noise


@kernel(fastmath=_fast)
def at_points(points, low, high, volume, boxes, at, own, squares, half, h, w):
    """Correlations of the points, plane by plane, one after the other; and where each point's begin, (M+1,).

    low, high: of :func:`planes_of`; volume, boxes, at: what :func:`correlate` gave and was given. own (M,): the number
    of the box of a point's first plane, -1 where squares (planes, rows, columns) tell those of every square. Values are
    interpolated between pixels, of which none counts for less than -.2.
    """
    base = low.min()
    begins = np.zeros(len(points) + 1, np.int64)
    for m in range(len(points)):
        begins[m + 1] = begins[m] + max(0, high[m] - low[m] + 1)
    out = np.zeros(begins[-1], np.float32)
    for m in range(len(points)):
        x, y = points[m, 0] - 0.5, points[m, 1] - 0.5
        i, j = int(np.floor(x)), int(np.floor(y))
        for c in range(4):
            k, r = i + c % 2, j + c // 2
            weight = np.float32((x - i if c % 2 else i + 1 - x) * (y - j if c // 2 else j + 1 - y))
            whole = half <= k < w - half and half <= r < h - half
            for d in range(begins[m + 1] - begins[m]):
                value = np.float32(-0.2)
                if whole:
                    p = own[m] + d if own[m] >= 0 else squares[low[m] - base + d, r // TILE, k // TILE]
                    where = at[p] + (r - boxes[p, 3]) * (boxes[p, 2] - boxes[p, 1] + 1) + k - boxes[p, 1]
                    value = max(volume[where], value)
                out[begins[m] + d] += weight * value
    return out, begins


@kernel(fastmath=_fast)
def choose_depth(start, group, asked, scores, begins, lows, near, step, prior):
    """Depth per group of points, their correlations added up plane by plane.

    asked, lows: planes of the groups and first planes of the points, of :func:`planes_of`, as the rest is; scores,
    begins: of :func:`at_points`.
    ``prior``: score lost per unit behind the hull. Returns depth (N,), 0 unknown, and its score (N,).
    """
    depth, quality = np.zeros(len(group)), np.full(len(group), -1.0)
    total = np.empty(0 if len(asked) == 0 else max(0, (asked[:, 1] - asked[:, 0] + 1).max()))
    for n in range(len(group)):
        low, D = asked[n, 0], asked[n, 1] - asked[n, 0] + 1
        if D < 1:
            continue
        z, count = start[group[n, 0]], 0
        total[:D] = 0.0
        for s in range(group.shape[1]):
            m = group[n, s]
            if start[m] <= 0 or abs(start[m] - z) > near:
                continue
            count += 1
            where = begins[m] + low - lows[m]
            for d in range(D):
                total[d] += scores[where + d]
        best, chosen = -1e9, 0
        for d in range(D):
            value = total[d] / count - prior * ((low + d) * step - z)
            if value > best:
                best, chosen = value, d
        offset = 0.0
        if 0 < chosen < D - 1:
            bend = total[chosen - 1] - 2 * total[chosen] + total[chosen + 1]
            if bend < 0:
                offset = min(max(0.5 * (total[chosen - 1] - total[chosen + 1]) / bend, -0.5), 0.5)
        depth[n] = (low + chosen + offset) * step
        quality[n] = total[chosen] / count
    return depth, quality
