"""Which of many to take when a few will do, and how many at once."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int


def evenly(count: int, most: int) -> Int[np.ndarray, " n"]:
    """Indices of at most ``most`` of ``count`` things: evenly spread, ascending, with the first and the last.

    All of them where ``most`` are enough. Of an even spread between two whole numbers the even one is taken.

    Example:
        >>> evenly(10, 4).tolist(), evenly(3, 10).tolist()
        ([0, 3, 6, 9], [0, 1, 2])
    """
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))


def blocks(rows: int, columns: int, at_once: int = 2**20) -> Iterator[slice]:
    """Slices of rows, one row at least: all at once where that is at most ``at_once`` entries, else pieces of a quarter
    of that, so that what is copied of long clips stays small.

    Example:
        >>> [(s.start, s.stop) for s in blocks(2, 10, at_once=20)]
        [(0, 2)]
        >>> [(s.start, s.stop) for s in blocks(5, 10, at_once=80)], len(list(blocks(5, 10, at_once=40)))
        ([(0, 5)], 5)
    """
    many = rows if rows * columns <= at_once else max(1, at_once // 4 // max(columns, 1))
    for first in range(0, rows, max(many, 1)):
        yield slice(first, min(first + many, rows))


def lives(seen: Bool[np.ndarray, "N T"]) -> Int[np.ndarray, "N 2"]:
    """The frames from which on, and before which, every track is seen; 0 and 0 of one that never is.

    Of a long clip a track lives in a small part: loops over lags and frames read nothing beside it.

    Example:
        >>> lives(np.array([[False, True, False, True, False], [False] * 5])).tolist()
        [[1, 4], [0, 0]]
    """
    ends = np.stack([seen.argmax(1), seen.shape[1] - seen[:, ::-1].argmax(1)], 1)
    ends[~seen.any(1)] = 0
    return ends


def ascending(values: Float[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """The stable order of float32 values, nan as large as infinity: several times as fast as numpy's stable sort.

    The bits of a float ascend with it, once those of negative ones are turned; with the place behind them no two keys
    are equal, so any sort is stable. TypeError for other numbers: they would be rounded.

    Example:
        >>> ascending(np.array([2, -1, 0, -0.0, -np.inf, -1], np.float32)).tolist()
        [4, 1, 5, 2, 3, 0]
    """
    if values.dtype != np.float32:
        raise TypeError(f"values: expected float32; found {values.dtype}.")
    values = np.where(np.isnan(values), np.float32(np.inf), values + np.float32(0))  # -0 equals 0
    bits = values.view(np.uint32)
    key = np.where(bits >> 31, ~bits, bits | np.uint32(1 << 31)).astype(np.uint64) << np.uint64(32)
    key |= np.arange(len(bits), dtype=np.uint64)
    key.sort()
    return (key & np.uint64(0xFFFFFFFF)).astype(np.int64)
