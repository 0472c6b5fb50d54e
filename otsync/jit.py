"""How compiled kernels are declared. A leaf: importing it imports numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba as nb


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """numba's njit without the GIL, cached on disk where there is a writable place, else compiled in every process.

    A read-only installation without a cache folder would otherwise fail at import.
    """

    def declare(function: Callable[..., Any]) -> Callable[..., Any]:
        settings = {"nogil": True, "error_model": "numpy", **options}
        try:
            return nb.njit(cache=True, **settings)(function)
        except RuntimeError:
            return nb.njit(**settings)(function)

    return declare
