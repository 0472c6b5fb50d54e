"""Which of many to take when a few will do."""

from __future__ import annotations

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
