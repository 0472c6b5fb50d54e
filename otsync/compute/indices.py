"""Which of many to take when a few will do, and how many at once."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int


def evenly(count: int, most: int) -> Int[np.ndarray, " n"]:
    """Indices of at most ``most`` of ``count`` things: evenly spread, ascending, with the first and the last.

    All of them where ``most`` are enough. Of an even spread between two whole numbers the even one is taken.

    Example:
        >>> evenly(10, 4).tolist(), evenly(3, 10).tolist()
        ([0, 3, 6, 9], [0, 1, 2])
    """
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))


def blocks(rows: int, columns: int, at_once: int = 2**20) -> Iterator[slice]:
    """Slices of rows, each of about ``at_once`` entries, one row at least: what is copied of them stays small.

    Example:
        >>> [(s.start, s.stop) for s in blocks(5, 10, at_once=20)]
        [(0, 2), (2, 4), (4, 5)]
    """
    many = max(1, at_once // max(columns, 1))
    for first in range(0, rows, many):
        yield slice(first, min(first + many, rows))
