"""Depth order and tile lists: which splats touch which tile, front to back.

Splats of all cameras are sorted once by depth; from then on a splat is known by its *rank* in that order, and everything
the compositing reads lies in rank order. Tiles are numbered over all cameras. A list is an ascending run of ranks, so
parts of the rank range can be counted and filled by different threads: part p writes behind part p - 1 in every list.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from recon.raster.cpu.threads import for_each, kernel, ranges
from recon.raster.rendering import ALPHA_MIN

TILE_WIDTH, TILE_HEIGHT = 32, 16  # pixels
RECORD = 8  # floats of a packed splat
MEAN_X, MEAN_Y, PER_VAR_X, SLOPE, PER_VAR_Y, OPACITY, REACH2, VAR_X = range(RECORD)
PART = 8192  # splats of one part

F32 = np.float32
MARGIN = F32(0.01)  # pixels added to every extent: a splat at the rounding edge of a row is tested, not lost


class TileLists(NamedTuple):
    """Intersections of splats and tiles. R splats drawn, T tiles over all cameras, I intersections."""

    splat_of_rank: np.ndarray  # [R] camera * N + Gaussian
    rank_of_splat: np.ndarray  # [C * N], -1 where not drawn
    records: np.ndarray  # [R * RECORD] packed splats, see the names above
    tile_starts: np.ndarray  # [T + 1] tile t owns ranks[tile_starts[t] : tile_starts[t + 1]]
    ranks: np.ndarray  # [I] ascending within each tile
    slots: np.ndarray  # [I] where the gradient of this intersection is put: all those of one splat lie together
    slot_starts: np.ndarray  # [R + 1]
    tiles_across: int
    tiles_per_camera: int


def build(means2d, rows, depths, opacities, radii, width: int, height: int) -> TileLists:
    """Sort the splats of all cameras and list them by tile; shapes as in :class:`recon.raster.rendering.Splats`."""
    n_cameras, n = depths.shape
    order = depth_order(depths.reshape(-1), radii.reshape(-1, 2))
    r = len(order)
    across, down = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    n_tiles = n_cameras * across * down

    records = np.empty(r * RECORD, F32)
    rank_of_splat = np.full(n_cameras * n, -1, np.int32)
    parts = ranges(r, PART)
    counts = np.zeros((len(parts), n_tiles), np.int64)
    slot_starts = np.zeros(r + 1, np.int64)
    numbered = [(*part, p) for p, part in enumerate(parts)]
    grid = (n, across, down)
    flat = (means2d.reshape(-1, 2), rows.reshape(-1, 3), opacities.reshape(-1))
    for_each(_pack_and_count, numbered, order, *flat, grid, records, rank_of_splat, counts, slot_starts)

    np.cumsum(slot_starts, out=slot_starts)
    tile_starts = np.zeros(n_tiles + 1, np.int64)
    np.cumsum(counts.sum(0), out=tile_starts[1:])
    cursors = tile_starts[:-1] + np.cumsum(counts, axis=0) - counts
    total = int(tile_starts[-1])
    ranks, slots = np.empty(total, np.int32), np.empty(total, np.int64)
    for_each(_fill, numbered, order, records, grid, cursors, slot_starts, ranks, slots)
    return TileLists(order, rank_of_splat, records, tile_starts, ranks, slots, slot_starts, across, across * down)


def depth_order(depths: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Indices of the drawn splats, nearest first; equal depths keep their order.

    One sort of 64-bit keys: for positive floats the bits order like the values, and the index below them breaks ties.
    """
    drawn = np.flatnonzero(radii.max(-1) > 0) if len(radii) else np.zeros(0, np.int64)
    keys = (depths[drawn].view(np.uint32).astype(np.uint64) << np.uint64(32)) | drawn.astype(np.uint64)
    keys.sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)


_list_kernel = kernel(fastmath={"contract", "nsz"})
_inline = kernel(fastmath={"contract", "nsz"}, inline="never")


@_inline
def _tile_rows(record, at, down):
    """First and past-the-last tile row that the splat's ellipse reaches."""
    half = math.sqrt(record[at + REACH2] / record[at + PER_VAR_Y]) + MARGIN
    y = record[at + MEAN_Y]
    low = max(F32(0), math.floor((y - half) / F32(TILE_HEIGHT)))
    high = min(F32(down), math.floor((y + half) / F32(TILE_HEIGHT)) + F32(1))
    return np.int64(low), np.int64(max(high, low))


@_inline
def _tile_columns(record, at, tile_row, across):
    """First and past-the-last tile column of the ellipse within one row of tiles.

    The ellipse's rightmost point lies at dy = slope var_y sqrt(reach2 / A), A = var_x + slope^2 var_y, its leftmost
    opposite; outside the tile row the extreme is on the row's edge, as the ellipse is convex.
    """
    reach2, var_x, slope = record[at + REACH2], record[at + VAR_X], record[at + SLOPE]
    per_y = record[at + PER_VAR_Y]
    top = F32(tile_row * TILE_HEIGHT) - record[at + MEAN_Y]
    bottom = top + F32(TILE_HEIGHT)
    extreme = slope / per_y * math.sqrt(reach2 / (var_x + slope * slope / per_y))
    right, left = min(max(extreme, top), bottom), min(max(-extreme, top), bottom)
    half_right = math.sqrt(max((reach2 - right * right * per_y) * var_x, F32(0))) + MARGIN
    half_left = math.sqrt(max((reach2 - left * left * per_y) * var_x, F32(0))) + MARGIN
    x = record[at + MEAN_X]
    low = math.floor((x + slope * left - half_left) / F32(TILE_WIDTH))
    high = math.floor((x + slope * right + half_right) / F32(TILE_WIDTH)) + F32(1)
    low, high = max(low, F32(0)), min(high, F32(across))
    return np.int64(low), np.int64(max(high, low))


@_list_kernel
def _pack_and_count(
    first, last, part, order, means2d, rows, opacities, grid, records, rank_of_splat, counts, slot_starts
):
    n, across, down = grid
    for r in range(first, last):
        m = order[r]
        rank_of_splat[m] = r
        at = r * RECORD
        records[at + MEAN_X] = means2d[m, 0]
        records[at + MEAN_Y] = means2d[m, 1]
        records[at + PER_VAR_X] = F32(1) / rows[m, 0]
        records[at + SLOPE] = rows[m, 1]
        records[at + PER_VAR_Y] = F32(1) / rows[m, 2]
        records[at + OPACITY] = opacities[m]
        records[at + REACH2] = F32(2) * math.log(max(opacities[m] / F32(ALPHA_MIN), F32(1)))
        records[at + VAR_X] = rows[m, 0]
        base = (m // n) * down
        touched = 0
        row_low, row_high = _tile_rows(records, at, down)
        for row in range(row_low, row_high):
            low, high = _tile_columns(records, at, row, across)
            for column in range(low, high):
                counts[part, (base + row) * across + column] += 1
            touched += high - low
        slot_starts[r + 1] = touched


@_list_kernel
def _fill(first, last, part, order, records, grid, cursors, slot_starts, ranks, slots):
    n, across, down = grid
    for r in range(first, last):
        at = r * RECORD
        base = (order[r] // n) * down
        slot = slot_starts[r]
        row_low, row_high = _tile_rows(records, at, down)
        for row in range(row_low, row_high):
            low, high = _tile_columns(records, at, row, across)
            for column in range(low, high):
                tile = (base + row) * across + column
                i = cursors[part, tile]
                cursors[part, tile] = i + 1
                ranks[i] = r
                slots[i] = slot
                slot += 1
