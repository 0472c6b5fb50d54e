"""Compositing of one tile after another, forward and backward, any number of channels.

A tile's state is a stack of planes of TILE_HEIGHT x TILE_WIDTH floats: transmittance, then channels. A splat visits the
rows of the tile that its ellipse crosses, and on each row only the chunks of LANES pixels that cover the exact span.
The pixels of a chunk are the lanes; channels are a loop. A chunk that would stick out of the tile is moved to the left:
pixels beside the span are too faint to be drawn, so they may be computed in vain but never twice.
"""

from __future__ import annotations

import math

import numpy as np

from recon.raster.cpu import simd
from recon.raster.cpu.lists import (
    HALF_Y,
    MARGIN,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    PER_VAR_Y,
    REACH2,
    RECORD,
    REST_SLOPE,
    REST_X,
    REST_Y,
    SLOPE,
    TILE_HEIGHT,
    TILE_WIDTH,
    VAR_X,
)
from recon.raster.cpu.simd import LANES
from recon.raster.cpu.threads import kernel
from recon.raster.rendering import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

F32, F64, I32 = np.float32, np.float64, np.int32
PIXELS = TILE_WIDTH * TILE_HEIGHT
# planes do not start a power of two apart: their lines would all fall into the same two sets of the L1 cache
PLANE = PIXELS + LANES
ZERO, ONE, HALF = F32(0), F32(1), F32(0.5)
LEAST, MOST, FINISHED = F32(ALPHA_MIN), F32(ALPHA_MAX), F32(TRANSMITTANCE_MIN)
HALF_LOG2E = F32(-0.5 * math.log2(math.e))  # sigma to a power of two: exp(-d^2 / (2 var)) = 2^(HALF_LOG2E d^2 / var)
LAST_X = F32(TILE_WIDTH - 1)
NO_DEPTH, ACCUMULATED, EXPECTED = 0, 1, 2
LEAST_WEIGHT = F32(1e-10)  # of an expected depth: the floor of the alpha that it is divided by
FAR = 1e6  # pixels: whole numbers of pixels are kept within int32
LINE = 16  # floats of a cache line
SHAPE_GRADIENTS = 6  # moments kept per intersection, before the channels

_raster_kernel = kernel(fastmath={"contract", "reassoc", "arcp", "nsz"})
_inline = kernel(fastmath={"contract", "reassoc", "arcp", "nsz"}, inline="never")


@_inline
def _aligned(size):
    """Uninitialised float32 array that begins on a cache line."""
    spare = np.empty(size + LINE, np.float32)
    offset = (LINE - (spare.ctypes.data // 4) % LINE) % LINE
    return spare[offset : offset + size]


@_inline
def _row_spans(records, at, mx, my, last_x, lefts, rights):
    """For every row of the tile the first and last pixel of the splat's span.

    mx, my: the mean, with the centre of the tile's first pixel as origin.
    """
    reach2, per_y = records[at + REACH2], records[at + PER_VAR_Y]
    var_x, slope = records[at + VAR_X], records[at + SLOPE]
    for y in range(0, TILE_HEIGHT, LANES):
        dy = simd.counting_from(F32(y)) - my
        centre = dy * slope + mx
        half = simd.square_root(simd.maximum((reach2 - dy * dy * per_y) * var_x, ZERO)) + MARGIN
        # limited before the conversion: a huge splat leaves the range of int32
        simd.store(lefts, y, simd.to_int(simd.round_up(simd.minimum(simd.maximum(centre - half, ZERO), LAST_X + ONE))))
        simd.store(rights, y, simd.to_int(simd.round_down(simd.maximum(simd.minimum(centre + half, last_x), -ONE))))


@_inline
def _row_centres(records, at, mx, my, top, bottom, wholes, rests):
    """Where the splat is centred on rows top..bottom: the nearest pixel, and the rest to full precision."""
    slope = F64(records[at + SLOPE]) + F64(records[at + REST_SLOPE])
    for y in range(top, bottom + 1):
        centre = mx + slope * (y - my)
        whole = np.rint(min(max(centre, -FAR), FAR))
        wholes[y] = I32(whole)
        rests[y] = F32(centre - whole)


@_inline
def _rows_reached(records, at, my, last_y):
    """First and last row of the tile that the splat reaches."""
    half = records[at + HALF_Y]
    top = max(math.ceil(my - half), ZERO)
    bottom = min(math.floor(my + half), last_y)
    return I32(min(top, F32(TILE_HEIGHT))), I32(max(bottom, -ONE))


@_raster_kernel
def forward(
    first, last, tile_starts, ranks, records, features, n_channels, depth_mode, tiling, image, depth, alphas,
    transmittance, last_drawn,
):  # fmt: skip
    """Composite tiles first..last front to back.

    features [R * D] in rank order, the depth as the last channel unless depth_mode is NO_DEPTH. tiling = (width, height,
    tiles across, tiles per camera). Writes image, depth, alphas, transmittance, and last_drawn: per pixel the position
    in `ranks` of the last splat that was drawn, or -1. All arrays flat.
    """
    width, height, across, per_camera = tiling
    n_colors = n_channels if depth_mode == NO_DEPTH else n_channels - 1
    planes = _aligned((1 + n_channels) * PLANE)
    drawn_last = np.empty(PLANE, np.int32)
    wholes, rests = np.empty(TILE_HEIGHT, np.int32), np.empty(TILE_HEIGHT, np.float32)
    lefts, rights = np.empty(TILE_HEIGHT, np.int32), np.empty(TILE_HEIGHT, np.int32)
    for tile in range(first, last):
        camera = tile // per_camera
        tile_y = (tile - camera * per_camera) // across
        tile_x = tile - camera * per_camera - tile_y * across
        wide, tall = min(TILE_WIDTH, width - tile_x * TILE_WIDTH), min(TILE_HEIGHT, height - tile_y * TILE_HEIGHT)
        planes[:] = ZERO
        drawn_last[:] = -1
        for y in range(tall):
            planes[y * TILE_WIDTH : y * TILE_WIDTH + wide] = ONE  # outside the image stays 0: finished
        origin_x, origin_y = tile_x * TILE_WIDTH + 0.5, tile_y * TILE_HEIGHT + 0.5
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            if (k - tile_starts[tile]) & 31 == 31 and not _any_alive(planes):
                break
            rank = ranks[k]
            at = rank * RECORD
            mx = F64(records[at + MEAN_X]) + F64(records[at + REST_X]) - origin_x
            my = F64(records[at + MEAN_Y]) + F64(records[at + REST_Y]) - origin_y
            opacity = records[at + OPACITY]
            fall_x, fall_y = HALF_LOG2E / records[at + VAR_X], HALF_LOG2E * records[at + PER_VAR_Y]
            top, bottom = _rows_reached(records, at, F32(my), F32(tall - 1))
            _row_spans(records, at, F32(mx), F32(my), F32(wide - 1), lefts, rights)
            _row_centres(records, at, mx, my, top, bottom, wholes, rests)
            for y in range(top, bottom + 1):
                chunks = (rights[y] - lefts[y] + LANES) // LANES
                if rights[y] < lefts[y]:
                    continue
                dy = F32(y - my)
                power_y = fall_y * dy * dy
                x = min(lefts[y], I32(TILE_WIDTH - chunks * LANES))
                for _ in range(chunks):
                    i = y * TILE_WIDTH + x
                    before = simd.load(planes, i)
                    dx = simd.counting_from(I32(x - wholes[y])) - rests[y]
                    alpha = simd.minimum(simd.exp2_nonpositive(dx * dx * fall_x + power_y) * opacity, MOST)
                    touched = (alpha >= LEAST) & (before > ZERO)
                    weight = alpha * before
                    after = before - weight
                    goes_on = after > FINISHED
                    drawn = touched & goes_on
                    # a finished pixel keeps its transmittance with a negative sign
                    simd.store(planes, i, simd.select(touched, simd.select(goes_on, after, ZERO - before), before))
                    simd.store(drawn_last, i, simd.select(drawn, I32(k), simd.load(drawn_last, i)))
                    weight = simd.select(drawn, weight, ZERO)
                    for c in range(n_channels):
                        j = i + (c + 1) * PLANE
                        simd.store(planes, j, simd.load(planes, j) + weight * features[rank * n_channels + c])
                    x += LANES
        for y in range(tall):
            pixel = (camera * height + tile_y * TILE_HEIGHT + y) * width + tile_x * TILE_WIDTH
            for x in range(wide):
                i = y * TILE_WIDTH + x
                left = abs(planes[i])
                transmittance[pixel + x] = left
                alphas[pixel + x] = ONE - left
                last_drawn[pixel + x] = drawn_last[i]
                for c in range(n_colors):
                    image[(pixel + x) * n_colors + c] = planes[i + (c + 1) * PLANE]
                if depth_mode == ACCUMULATED:
                    depth[pixel + x] = planes[i + n_channels * PLANE]
                elif depth_mode == EXPECTED:
                    depth[pixel + x] = planes[i + n_channels * PLANE] / max(ONE - left, LEAST_WEIGHT)


@_inline
def _any_alive(planes):
    """True while a pixel of the tile can still take a splat."""
    alive = simd.spread(ZERO) > ZERO
    highest = simd.spread(ZERO)
    for i in range(0, PIXELS, LANES):
        highest = simd.maximum(simd.load(planes, i), highest)
    alive = highest > ZERO
    return simd.any_lane(alive)


@_raster_kernel
def backward(
    first, last, tile_starts, ranks, slots, records, features, n_channels, depth_mode, tiling, depth, transmittance,
    last_drawn, v_image, v_depth, v_alphas, gradients,
):  # fmt: skip
    """Walk tiles first..last back to front; writes one row of `gradients` [I * (6 + D)] per intersection.

    The transmittance before a splat is recovered by dividing by 1 - alpha. What lies behind a splat enters its alpha's
    gradient only through one number per pixel, `behind` = (colour behind, background included) . dL/dcolour.

    A row holds sums over the pixels of s = alpha dL/dalpha times 1, d, dy, d^2, d dy, dy^2, where d = dx - slope dy;
    then dL/dfeature. :func:`reduce` turns sums of rows into gradients.
    """
    width, height, across, per_camera = tiling
    n_colors = n_channels if depth_mode == NO_DEPTH else n_channels - 1
    row = SHAPE_GRADIENTS + n_channels
    planes = _aligned((2 + n_channels) * PLANE)  # transmittance, behind, dL/dchannel
    drawn_last = np.empty(PLANE, np.int32)
    v_features = _aligned(n_channels * LANES)
    wholes, rests = np.empty(TILE_HEIGHT, np.int32), np.empty(TILE_HEIGHT, np.float32)
    lefts, rights = np.empty(TILE_HEIGHT, np.int32), np.empty(TILE_HEIGHT, np.int32)
    none = simd.spread(ZERO)
    for tile in range(first, last):
        camera = tile // per_camera
        tile_y = (tile - camera * per_camera) // across
        tile_x = tile - camera * per_camera - tile_y * across
        wide, tall = min(TILE_WIDTH, width - tile_x * TILE_WIDTH), min(TILE_HEIGHT, height - tile_y * TILE_HEIGHT)
        planes[:] = ZERO
        planes[:PLANE] = ONE
        drawn_last[:] = -1
        furthest = -1
        for y in range(tall):
            pixel = (camera * height + tile_y * TILE_HEIGHT + y) * width + tile_x * TILE_WIDTH
            for x in range(wide):
                i = y * TILE_WIDTH + x
                planes[i] = transmittance[pixel + x]
                v_left = -v_alphas[pixel + x]
                if depth_mode == ACCUMULATED:
                    planes[i + (n_channels + 1) * PLANE] = v_depth[pixel + x]
                elif depth_mode == EXPECTED:
                    covered = ONE - transmittance[pixel + x]
                    v_sum = v_depth[pixel + x] / max(covered, LEAST_WEIGHT)
                    planes[i + (n_channels + 1) * PLANE] = v_sum
                    if covered > LEAST_WEIGHT:
                        v_left += v_sum * depth[pixel + x]
                planes[i + PLANE] = v_left * transmittance[pixel + x]
                drawn_last[i] = last_drawn[pixel + x]
                furthest = max(furthest, last_drawn[pixel + x])
                for c in range(n_colors):
                    planes[i + (c + 2) * PLANE] = v_image[(pixel + x) * n_colors + c]
        origin_x, origin_y = tile_x * TILE_WIDTH + 0.5, tile_y * TILE_HEIGHT + 0.5
        for k in range(max(furthest + 1, tile_starts[tile]), tile_starts[tile + 1]):
            gradients[slots[k] * row : (slots[k] + 1) * row] = ZERO
        for k in range(furthest, tile_starts[tile] - 1, -1):
            rank = ranks[k]
            at = rank * RECORD
            mx = F64(records[at + MEAN_X]) + F64(records[at + REST_X]) - origin_x
            my = F64(records[at + MEAN_Y]) + F64(records[at + REST_Y]) - origin_y
            opacity = records[at + OPACITY]
            fall_x, fall_y = HALF_LOG2E / records[at + VAR_X], HALF_LOG2E * records[at + PER_VAR_Y]
            top, bottom = _rows_reached(records, at, F32(my), F32(tall - 1))
            _row_spans(records, at, F32(mx), F32(my), F32(wide - 1), lefts, rights)
            _row_centres(records, at, mx, my, top, bottom, wholes, rests)
            m, m_x, m_y, m_xx, m_xy, m_yy = none, none, none, none, none, none
            for c in range(0, n_channels * LANES, LANES):
                simd.store(v_features, c, none)
            for y in range(top, bottom + 1):
                chunks = (rights[y] - lefts[y] + LANES) // LANES
                if rights[y] < lefts[y]:
                    continue
                dy = F32(y - my)
                power_y = fall_y * dy * dy
                x = min(lefts[y], I32(TILE_WIDTH - chunks * LANES))
                for _ in range(chunks):
                    i = y * TILE_WIDTH + x
                    x += LANES
                    dx = simd.counting_from(I32(x - LANES - wholes[y])) - rests[y]
                    uncapped = simd.exp2_nonpositive(dx * dx * fall_x + power_y) * opacity
                    alpha = simd.minimum(uncapped, MOST)
                    drawn = (alpha >= LEAST) & (simd.load(drawn_last, i) >= I32(k))
                    alpha = simd.select(drawn, alpha, ZERO)
                    per_left = ONE / (ONE - alpha)
                    before = simd.load(planes, i) * per_left
                    simd.store(planes, i, before)
                    weight = alpha * before
                    inner = none
                    for c in range(n_channels):
                        v_channel = simd.load(planes, i + (c + 2) * PLANE)
                        inner = inner + v_channel * features[rank * n_channels + c]
                        v_feature = simd.load(v_features, c * LANES) + weight * v_channel
                        simd.store(v_features, c * LANES, v_feature)
                    behind = simd.load(planes, i + PLANE)
                    simd.store(planes, i + PLANE, behind + inner * weight)
                    v_alpha = inner * before - behind * per_left
                    # at the cap alpha no longer depends on the splat's shape or opacity
                    s = simd.select(drawn & (uncapped <= MOST), uncapped * v_alpha, ZERO)
                    s_x, s_y = s * dx, s * dy
                    m, m_x, m_y = m + s, m_x + s_x, m_y + s_y
                    m_xx, m_xy, m_yy = m_xx + s_x * dx, m_xy + s_x * dy, m_yy + s_y * dy
            out = slots[k] * row
            gradients[out] = simd.total(m)
            gradients[out + 1] = simd.total(m_x)
            gradients[out + 2] = simd.total(m_y)
            gradients[out + 3] = simd.total(m_xx)
            gradients[out + 4] = simd.total(m_xy)
            gradients[out + 5] = simd.total(m_yy)
            for c in range(n_channels):
                gradients[out + SHAPE_GRADIENTS + c] = simd.total(simd.load(v_features, c * LANES))


@_raster_kernel
def gather_channels(first, last, order, features, period, depths, channels):
    """channels[r] = features of splat order[r], and its depth when there is one more column.

    `period`: N when all cameras share the features, 0 when every splat has its own.
    """
    d = features.shape[1]
    for r in range(first, last):
        splat = order[r]
        source = splat % period if period > 0 else splat
        for c in range(d):
            channels[r, c] = features[source, c]
        if channels.shape[1] > d:
            channels[r, d] = depths[splat]


@_raster_kernel
def reduce(
    first, last, n_cameras, n, shared, with_depth, rank_of_splat, slot_starts, records, gradients, row,
    v_means2d, v_rows, v_opacities, v_depths, v_features,
):  # fmt: skip
    """Sum the rows of Gaussians first..last and turn moments into gradients; arrays flat.

    `shared`: the features are the same in every camera, so that their gradients add up over the cameras.
    """
    n_colors = row - SHAPE_GRADIENTS - (1 if with_depth else 0)
    total = np.empty(row + LANES, np.float32)
    for g in range(first, last):
        if shared:
            v_features[g * n_colors : (g + 1) * n_colors] = ZERO
        for camera in range(n_cameras):
            splat = camera * n + g
            rank = rank_of_splat[splat]
            begin, end = 0, 0
            per_x, slope, per_y, opacity = ZERO, ZERO, ZERO, ONE
            if rank >= 0:
                begin, end = slot_starts[rank], slot_starts[rank + 1]
                at = rank * RECORD
                per_x, slope, per_y = ONE / records[at + VAR_X], records[at + SLOPE], records[at + PER_VAR_Y]
                opacity = records[at + OPACITY]
            for j in range(0, row, LANES):  # the last vector runs into the next row; its spare lanes are not used
                column = simd.spread(ZERO)
                for slot in range(begin, end):
                    column = column + simd.load(gradients, slot * row + j)
                simd.store(total, j, column)
            # sigma = d^2 / (2 var_x) + dy^2 / (2 var_y), s = -dL/dsigma, d = dx - slope dy
            v_means2d[splat * 2] = per_x * total[1]
            v_means2d[splat * 2 + 1] = per_y * total[2] - slope * per_x * total[1]
            v_rows[splat * 3] = HALF * per_x * per_x * total[3]
            v_rows[splat * 3 + 1] = per_x * total[4]
            v_rows[splat * 3 + 2] = HALF * per_y * per_y * total[5]
            v_opacities[splat] = total[0] / opacity
            if with_depth:
                v_depths[splat] = total[row - 1]
            out = g * n_colors if shared else splat * n_colors
            for c in range(n_colors):
                if shared:
                    v_features[out + c] += total[SHAPE_GRADIENTS + c]
                else:
                    v_features[out + c] = total[SHAPE_GRADIENTS + c]
