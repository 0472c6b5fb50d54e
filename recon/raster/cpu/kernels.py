"""Compositing of one tile after another, forward and backward, any number of channels.

A tile's state is a stack of planes of TILE_HEIGHT x TILE_WIDTH floats: transmittance, then channels. A splat visits the
rows of the tile that its ellipse crosses, and on each row only the chunks of LANES pixels that cover the exact span.
The pixels of a chunk are the lanes; channels are a loop. A chunk that would stick out of the tile is moved to the left:
pixels beside the span are too faint to be drawn, so they may be computed in vain but never twice.
"""

from __future__ import annotations

import math

import numpy as np

from otsync.compute import simd
from otsync.compute.jit import kernel
from otsync.compute.simd import LANES
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
from recon.raster.rendering import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

F32, F64, I32, U64 = np.float32, np.float64, np.int32, np.uint64
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

CHUNKS = PIXELS // LANES  # of a tile
FEW_CHANNELS = 8  # up to these a splat's channels are added at once
QUEUE = 16  # splats that wait at a chunk of a tile with many channels

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
def _row_centres(records, at, mx, my, wholes, rests):
    """Where the splat is centred on every row of the tile: the nearest pixel, and the rest to full precision."""
    slope = F64(records[at + SLOPE]) + F64(records[at + REST_SLOPE])
    for y in range(0, TILE_HEIGHT, LANES):
        start = mx + slope * (y - my)
        whole = simd.line_whole(start, slope, FAR)
        simd.store(wholes, y, whole)
        simd.store(rests, y, simd.line_rest(start, slope, whole))


@_inline
def _rows_reached(records, at, my, last_y):
    """First and last row of the tile that the splat reaches."""
    half = records[at + HALF_Y]
    top = max(math.ceil(my - half), ZERO)
    bottom = min(math.floor(my + half), last_y)
    return I32(min(top, F32(TILE_HEIGHT))), I32(max(bottom, -ONE))


@_inline
def _place(tile, tiling):
    """Index of the tile's first pixel in the stack of images, its pixel coordinates, and its size inside the image."""
    width, height, across, per_camera = tiling
    camera = tile // per_camera
    row = (tile - camera * per_camera) // across
    x, y = (tile - camera * per_camera - row * across) * TILE_WIDTH, row * TILE_HEIGHT
    return (camera * height + y) * width + x, x, y, min(TILE_WIDTH, width - x), min(TILE_HEIGHT, height - y)


@_inline
def _visit(records, rank, x, y, wide, tall, spans):
    """Prepare the visit of a splat to the tile at pixel (x, y): the rows and spans it reaches.

    Returns the first and last row, the mean's y relative to the tile's first row of pixel centres, and what the
    exponent of two falls by per squared pixel along the row and across rows.
    """
    lefts, rights, wholes, rests = spans
    at = rank * RECORD
    mx = F64(records[at + MEAN_X]) + F64(records[at + REST_X]) - (x + 0.5)
    my = F64(records[at + MEAN_Y]) + F64(records[at + REST_Y]) - (y + 0.5)
    top, bottom = _rows_reached(records, at, F32(my), F32(tall - 1))
    _row_spans(records, at, F32(mx), F32(my), F32(wide - 1), lefts, rights)
    _row_centres(records, at, mx, my, wholes, rests)
    return top, bottom, my, HALF_LOG2E / records[at + VAR_X], HALF_LOG2E * records[at + PER_VAR_Y]


@_inline
def _new_spans():
    """Scratch for one visit, an entry per row: first and last pixel of the span, whole and rest of the centre."""
    integers = np.empty((3, TILE_HEIGHT), np.int32)
    return integers[0], integers[1], integers[2], np.empty(TILE_HEIGHT, np.float32)


@_inline
def _chunks(left, right, aligned):
    """First pixel and number of the chunks that cover pixels left..right of a row.

    As few as possible; `aligned` ones lie on the grid of LANES pixels.
    """
    if aligned:
        x = I32(left & ~(LANES - 1))
        return x, I32((right - x + LANES) // LANES)
    chunks = I32((right - left + LANES) // LANES)
    return min(left, I32(TILE_WIDTH - chunks * LANES)), chunks


@_inline
def _new_queue(needed):
    """For every chunk of the grid the weights and ranks of up to QUEUE splats, and how many wait there.

    With many channels their planes do not fit into the L1 cache, and to read and write them for each splat takes most
    of the time: splats wait at a chunk until it is worth it. With few channels it is the queue that costs more.
    """
    size = QUEUE * CHUNKS if needed else 0
    return _aligned(size * LANES), np.empty(size, np.int32), np.zeros(CHUNKS, np.int32)


@_inline
def _add_channels(planes, features, n_channels, weights, waiting, chunk, count):
    """Add what waits at a chunk to its channels, four of them at a time in registers."""
    begin, end = chunk * QUEUE, chunk * QUEUE + count
    fours = n_channels - n_channels % 4
    for c in range(0, fours, 4):
        i0 = chunk * LANES + (c + 1) * PLANE
        i1, i2, i3 = i0 + PLANE, i0 + 2 * PLANE, i0 + 3 * PLANE
        s0, s1, s2, s3 = simd.load(planes, i0), simd.load(planes, i1), simd.load(planes, i2), simd.load(planes, i3)
        for q in range(begin, end):
            weight = simd.load(weights, q * LANES)
            f = U64(waiting[q]) * U64(n_channels) + U64(c)  # unsigned: numba need not ask for negative ones
            s0, s1 = s0 + weight * features[f], s1 + weight * features[f + U64(1)]
            s2, s3 = s2 + weight * features[f + U64(2)], s3 + weight * features[f + U64(3)]
        simd.store(planes, i0, s0)
        simd.store(planes, i1, s1)
        simd.store(planes, i2, s2)
        simd.store(planes, i3, s3)
    for c in range(fours, n_channels):
        i0 = chunk * LANES + (c + 1) * PLANE
        s0 = simd.load(planes, i0)
        for q in range(begin, end):
            s0 = s0 + simd.load(weights, q * LANES) * features[U64(waiting[q]) * U64(n_channels) + U64(c)]
        simd.store(planes, i0, s0)


@_inline
def _any_alive(planes):
    """True while a pixel of the tile can still take a splat."""
    highest = simd.spread(ZERO)
    for i in range(0, PIXELS, LANES):
        highest = simd.maximum(simd.load(planes, i), highest)
    return simd.any_lane(highest > ZERO)


@_raster_kernel
def forward(first, last, tile_lists, features, n_channels, depth_mode, tiling, outputs):
    """Composite tiles first..last front to back.

    tile_lists = (tile_starts, ranks, records) of :class:`recon.raster.cpu.lists.TileLists`; features [R * D] in rank
    order, the depth as the last channel unless depth_mode is NO_DEPTH; tiling = (width, height, tiles across, tiles per
    camera). outputs = (image, depth, alphas, transmittance, last_drawn), flat; last_drawn holds per pixel the position
    in `ranks` of the last splat that was drawn, or -1.
    """
    tile_starts, ranks, records = tile_lists
    planes = _aligned((1 + n_channels) * PLANE)  # transmittance, channels
    drawn_last = np.empty(PLANE, np.int32)
    queued = n_channels > FEW_CHANNELS
    weights, waiting, counts = _new_queue(queued)
    spans = _new_spans()
    lefts, rights, wholes, rests = spans
    for tile in range(first, last):
        pixel, tile_x, tile_y, wide, tall = _place(tile, tiling)
        planes[:] = ZERO
        drawn_last[:] = -1
        for y in range(tall):
            planes[y * TILE_WIDTH : y * TILE_WIDTH + wide] = ONE  # outside the image stays 0: finished
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            if (k - tile_starts[tile]) & 31 == 31 and not _any_alive(planes):
                break
            rank = ranks[k]
            opacity = records[rank * RECORD + OPACITY]
            top, bottom, my, fall_x, fall_y = _visit(records, rank, tile_x, tile_y, wide, tall, spans)
            for y in range(top, bottom + 1):
                if rights[y] < lefts[y]:
                    continue
                x, chunks = _chunks(lefts[y], rights[y], queued)
                dy = F32(y - my)
                power_y = fall_y * dy * dy
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
                    if queued:
                        chunk = i // LANES
                        entry = chunk * QUEUE + counts[chunk]
                        simd.store(weights, entry * LANES, weight)
                        waiting[entry] = rank
                        counts[chunk] += 1
                        if counts[chunk] == QUEUE:
                            _add_channels(planes, features, n_channels, weights, waiting, chunk, QUEUE)
                            counts[chunk] = 0
                    else:
                        for c in range(n_channels):
                            j = i + (c + 1) * PLANE
                            simd.store(planes, j, simd.load(planes, j) + weight * features[rank * n_channels + c])
                    x += LANES
        if queued:
            for chunk in range(CHUNKS):
                _add_channels(planes, features, n_channels, weights, waiting, chunk, counts[chunk])
                counts[chunk] = 0
        _store_tile(planes, drawn_last, pixel, wide, tall, tiling[0], n_channels, depth_mode, outputs)


@_inline
def _store_tile(planes, drawn_last, first_pixel, wide, tall, width, n_channels, depth_mode, outputs):
    image, depth, alphas, transmittance, last_drawn = outputs
    n_colors = n_channels if depth_mode == NO_DEPTH else n_channels - 1
    for y in range(tall):
        for x in range(wide):
            i, pixel = y * TILE_WIDTH + x, first_pixel + y * width + x
            left = abs(planes[i])
            transmittance[pixel] = left
            alphas[pixel] = ONE - left
            last_drawn[pixel] = drawn_last[i]
            for c in range(n_colors):
                image[pixel * n_colors + c] = planes[i + (c + 1) * PLANE]
            if depth_mode == ACCUMULATED:
                depth[pixel] = planes[i + n_channels * PLANE]
            elif depth_mode == EXPECTED:
                depth[pixel] = planes[i + n_channels * PLANE] / max(ONE - left, LEAST_WEIGHT)


@_raster_kernel
def backward(first, last, tile_lists, slots, features, n_channels, depth_mode, tiling, saved, incoming, gradients):
    """Walk tiles first..last back to front; writes one row of `gradients` [I * (6 + D)] per intersection.

    saved = (depth, transmittance, last_drawn) of :func:`forward`; incoming = gradients of (image, depth, alphas).

    The transmittance before a splat is recovered by dividing by 1 - alpha. What lies behind a splat enters its alpha's
    gradient only through one number per pixel, `behind` = (colour behind, background included) . dL/dcolour.

    A row holds sums over the pixels of s = alpha dL/dalpha times 1, d, dy, d^2, d dy, dy^2, where d = dx - slope dy;
    then dL/dfeature. :func:`reduce` turns sums of rows into gradients.
    """
    tile_starts, ranks, records = tile_lists
    row = SHAPE_GRADIENTS + n_channels
    planes = _aligned((2 + n_channels) * PLANE)  # transmittance, behind, dL/dchannel
    g_features = _aligned(n_channels * LANES)
    drawn_last = np.empty(PLANE, np.int32)
    spans = _new_spans()
    lefts, rights, wholes, rests = spans
    none = simd.spread(ZERO)
    for tile in range(first, last):
        pixel, tile_x, tile_y, wide, tall = _place(tile, tiling)
        furthest = _load_tile(planes, drawn_last, pixel, wide, tall, tiling[0], n_channels, depth_mode, saved, incoming)
        for k in range(max(furthest + 1, tile_starts[tile]), tile_starts[tile + 1]):
            gradients[slots[k] * row : (slots[k] + 1) * row] = ZERO
        for k in range(furthest, tile_starts[tile] - 1, -1):
            rank = ranks[k]
            opacity = records[rank * RECORD + OPACITY]
            top, bottom, my, fall_x, fall_y = _visit(records, rank, tile_x, tile_y, wide, tall, spans)
            m, m_x, m_y, m_xx, m_xy, m_yy = none, none, none, none, none, none
            for c in range(0, n_channels * LANES, LANES):
                simd.store(g_features, c, none)
            for y in range(top, bottom + 1):
                if rights[y] < lefts[y]:
                    continue
                x, chunks = _chunks(lefts[y], rights[y], False)
                dy = F32(y - my)
                power_y = fall_y * dy * dy
                for _ in range(chunks):
                    i = y * TILE_WIDTH + x
                    dx = simd.counting_from(I32(x - wholes[y])) - rests[y]
                    uncapped = simd.exp2_nonpositive(dx * dx * fall_x + power_y) * opacity
                    alpha = simd.minimum(uncapped, MOST)
                    drawn = (alpha >= LEAST) & (simd.load(drawn_last, i) >= I32(k))
                    alpha = simd.select(drawn, alpha, ZERO)
                    per_left = ONE / (ONE - alpha)
                    before = simd.load(planes, i) * per_left
                    simd.store(planes, i, before)
                    weight = alpha * before
                    inner = none  # the splat's colour . dL/dcolour
                    for c in range(n_channels):
                        g_channel = simd.load(planes, i + (c + 2) * PLANE)
                        inner = inner + g_channel * features[rank * n_channels + c]
                        g_feature = simd.load(g_features, c * LANES) + weight * g_channel
                        simd.store(g_features, c * LANES, g_feature)
                    behind = simd.load(planes, i + PLANE)
                    simd.store(planes, i + PLANE, behind + inner * weight)
                    g_alpha = inner * before - behind * per_left
                    # at the cap alpha no longer depends on the splat's shape or opacity
                    s = simd.select(drawn & (uncapped <= MOST), uncapped * g_alpha, ZERO)
                    s_x, s_y = s * dx, s * dy
                    m, m_x, m_y = m + s, m_x + s_x, m_y + s_y
                    m_xx, m_xy, m_yy = m_xx + s_x * dx, m_xy + s_x * dy, m_yy + s_y * dy
                    x += LANES
            out = slots[k] * row
            gradients[out], gradients[out + 1], gradients[out + 2] = simd.total(m), simd.total(m_x), simd.total(m_y)
            gradients[out + 3], gradients[out + 4] = simd.total(m_xx), simd.total(m_xy)
            gradients[out + 5] = simd.total(m_yy)
            for c in range(n_channels):
                gradients[out + SHAPE_GRADIENTS + c] = simd.total(simd.load(g_features, c * LANES))


@_inline
def _load_tile(planes, drawn_last, first_pixel, wide, tall, width, n_channels, depth_mode, saved, incoming):
    """Fill the planes of :func:`backward`; returns the largest of drawn_last."""
    depth, transmittance, last_drawn = saved
    g_image, g_depth, g_alphas = incoming
    n_colors = n_channels if depth_mode == NO_DEPTH else n_channels - 1
    planes[:] = ZERO
    planes[:PLANE] = ONE
    drawn_last[:] = -1
    furthest = -1
    for y in range(tall):
        for x in range(wide):
            i, pixel = y * TILE_WIDTH + x, first_pixel + y * width + x
            left, g_left = transmittance[pixel], -g_alphas[pixel]
            for c in range(n_colors):
                planes[i + (c + 2) * PLANE] = g_image[pixel * n_colors + c]
            if depth_mode == ACCUMULATED:
                planes[i + (n_channels + 1) * PLANE] = g_depth[pixel]
            elif depth_mode == EXPECTED:
                covered = ONE - left
                g_sum = g_depth[pixel] / max(covered, LEAST_WEIGHT)
                planes[i + (n_channels + 1) * PLANE] = g_sum
                if covered > LEAST_WEIGHT:
                    g_left += g_sum * depth[pixel]
            planes[i] = left
            planes[i + PLANE] = g_left * left
            drawn_last[i] = last_drawn[pixel]
            furthest = max(furthest, last_drawn[pixel])
    return furthest


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
def reduce(first, last, n_cameras, shared, with_depth, splat_lists, gradients, row, outgoing):
    """Sum the rows of Gaussians first..last and turn moments into gradients.

    splat_lists = (rank_of_splat, slot_starts, records); outgoing = gradients of (means2d, rows, depths, opacities,
    features), flat. `shared`: the features are the same in every camera, so that their gradients add up over them.
    """
    rank_of_splat, slot_starts, records = splat_lists
    g_means2d, g_rows, g_depths, g_opacities, g_features = outgoing
    n, n_colors = len(rank_of_splat) // n_cameras, row - SHAPE_GRADIENTS - (1 if with_depth else 0)
    total = np.empty(row + LANES, np.float32)
    for g in range(first, last):
        if shared:
            g_features[g * n_colors : (g + 1) * n_colors] = ZERO
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
            g_means2d[splat * 2] = per_x * total[1]
            g_means2d[splat * 2 + 1] = per_y * total[2] - slope * per_x * total[1]
            g_rows[splat * 3] = HALF * per_x * per_x * total[3]
            g_rows[splat * 3 + 1] = per_x * total[4]
            g_rows[splat * 3 + 2] = HALF * per_y * per_y * total[5]
            g_opacities[splat] = total[0] / opacity
            if with_depth:
                g_depths[splat] = total[row - 1]
            out = (g if shared else splat) * n_colors
            for c in range(n_colors):
                before = g_features[out + c] if shared else ZERO
                g_features[out + c] = before + total[SHAPE_GRADIENTS + c]
