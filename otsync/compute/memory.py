"""What the allocator does with memory that was freed."""

from __future__ import annotations

import ctypes
import sys

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Of mallopt: bytes that may stay free at the end of the heap; bytes from which on an array gets pages of its own."""

LARGE = 8 * 2**20


def give_back_large_arrays() -> bool:
    """From now on arrays of 8 MiB and more go back to the system when they are freed; whether that could be asked for.

    The GNU allocator keeps such arrays on its heap once some were freed, where holes between them add up: long clips
    took a sixth more memory than they need. It costs little time where arrays are large; other allocators do so anyway.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
        return all([mallopt(which, LARGE) == 1 for which in (TRIM_THRESHOLD, MMAP_THRESHOLD)])
    except (OSError, AttributeError):  # another C library
        return False
