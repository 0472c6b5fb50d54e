"""A pool of threads for nogil kernels, and the one way kernels are compiled.

Numba's own `parallel=True` is not used: its default layer aborts the process when two Python threads enter it at once.
"""

from __future__ import annotations

import functools
import logging
import os
import pathlib
import threading
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba

logger = logging.getLogger("recon.raster")

_pool: ThreadPoolExecutor | None = None
_pool_lock = threading.Lock()
_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_uncached_announced = False


def set_threads(n: int) -> None:
    """Use `n` threads from now on, the caller's included. Results do not depend on it, to the last bit."""
    global _threads
    if n < 1:
        raise ValueError(f"n: expected at least one thread, got {n}")
    with _pool_lock:
        _threads = n
        _forget_pool()


def get_threads() -> int:
    """The number of threads in use; at first the number of processors that this process may run on."""
    return _threads


def _forget_pool() -> None:
    # the old pool's threads end once its last job is done; jobs already handed to it are still carried out
    global _pool
    if _pool is not None:
        _pool.shutdown(wait=False)
    _pool = None


def _after_fork() -> None:
    # the child has the pool but none of its threads
    global _pool, _pool_lock
    _pool, _pool_lock = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def for_each(kernel: Callable[..., Any], parts: Iterable[tuple], *shared: Any) -> None:
    """Call kernel(*part, *shared) for every part, on all threads; parts are taken in order, by whoever is free.

    The caller's thread works too, so a single part costs no hand-over and a busy machine no waiting for a late helper.
    """
    todo = deque(parts)
    helpers = min(_threads, len(todo)) - 1

    def work() -> None:
        while True:
            try:
                part = todo.popleft()
            except IndexError:
                return
            kernel(*part, *shared)

    if helpers < 1:
        return work()
    global _pool
    with _pool_lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max(1, _threads - 1), thread_name_prefix="recon.raster")
        futures = [_pool.submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        todo.clear()  # after an error: no further part is begun
        for future in futures:
            if not future.cancel():
                future.result()


def ranges(n: int, size: int) -> list[tuple[int, int]]:
    """[0, n) cut into pieces of `size`: the same pieces whatever the number of threads."""
    return [(i, min(i + size, n)) for i in range(0, n, size)]


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
            return dispatcher
        except RuntimeError:  # "cannot cache function: no locator available"
            if not _uncached_announced:
                _uncached_announced = True
                logger.warning(
                    "recon.raster finds no writable folder for compiled code and compiles it in every process; "
                    "set NUMBA_CACHE_DIR to a folder of your own"
                )
            return numba.njit(**settings)(function)

    return compile_lazily


_folder = pathlib.Path(__file__).parent


@functools.cache
def _stamps(folder: pathlib.Path, pattern: str) -> tuple[tuple[str, int, int], ...]:
    return tuple((p.name, p.stat().st_mtime_ns, p.stat().st_size) for p in sorted(folder.glob(pattern)))


def _tie_to_sources(dispatcher: Any) -> None:
    """Make the cached code of one kernel stale when any file of this folder, or any *kernels.py of its own, changes.

    Numba compares the kernel's own file only, but kernels compile in the constants and functions of the others.
    """
    file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if file is not None and hasattr(file, "_source_stamp"):
        own = pathlib.Path(dispatcher.py_func.__code__.co_filename).parent
        file._source_stamp = (file._source_stamp, _stamps(_folder, "*.py"), _stamps(own, "*kernels.py"))
