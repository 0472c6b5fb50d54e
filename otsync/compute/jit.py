"""The one way in which kernels are compiled.

Importing this module imports numba, so algorithms import their kernels when they run.
"""

from __future__ import annotations

import functools
import logging
import pathlib
from collections.abc import Callable
from typing import Any

import numba

from .interrupts import uninterrupted

log = logging.getLogger("otsync")

_uncached_announced = False


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """numba.njit for kernels: no GIL, division by zero gives infinity, compiled code cached on disk where possible.

    Numba looks for a writable folder: beside the source, else the user's cache folder, so that a read-only installation
    is compiled once per user. Where neither can be written (a container without a home), it is compiled per process.
    """
    settings = {"nogil": True, "error_model": "numpy", **options}

    def compile_lazily(function: Callable[..., Any]) -> Any:
        global _uncached_announced
        try:
            dispatcher = numba.njit(cache=True, **settings)(function)
            _tie_to_sources(dispatcher)
            return _untorn(dispatcher)
        except RuntimeError:  # "cannot cache function: no locator available"
            if not _uncached_announced:
                _uncached_announced = True
                log.warning(
                    "no writable folder for compiled code: every process compiles it again. Set NUMBA_CACHE_DIR to a "
                    "folder of your own."
                )
            return _untorn(numba.njit(**settings)(function))

    return compile_lazily


def inlined(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """:func:`kernel` for what other kernels call, inlined by force.

    Otherwise the process that compiles it calls the helper that stands alone, and later ones, which load their caller
    from disk, the caller's own copy of it. The two may round otherwise, and a first run would not be like those after.
    """
    return kernel(forceinline=True, **options)


def _untorn(dispatcher: Any) -> Any:
    """The kernel, whose compilation no interrupt tears: LLVM's lock would stay closed, and other threads wait for it
    without end.
    """
    compiled = dispatcher._compile_for_args

    def whole(*args: Any, **named: Any) -> Any:
        with uninterrupted():
            return compiled(*args, **named)

    dispatcher._compile_for_args = whole
    return dispatcher


_folder = pathlib.Path(__file__).parent


@functools.cache
def _stamps(folder: pathlib.Path) -> tuple[tuple[str, int, int], ...]:
    return tuple((p.name, p.stat().st_mtime_ns, p.stat().st_size) for p in sorted(folder.glob("*.py")))


def _tie_to_sources(dispatcher: Any) -> None:
    """Make the cached code of one kernel stale when any file of this folder, or of its own, changes.

    Numba compares the kernel's own file only, but constants and functions of the others are compiled into it.
    """
    file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if file is not None and hasattr(file, "_source_stamp"):
        own = pathlib.Path(dispatcher.py_func.__code__.co_filename).parent
        file._source_stamp = (file._source_stamp, _stamps(_folder), _stamps(own))
