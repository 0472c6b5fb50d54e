"""The pool of threads that runs nogil kernels over parts of their work, in both packages.

Numba's own `parallel=True` is not used: its default layer aborts the process when two Python threads enter it at once.
"""

from __future__ import annotations

import functools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from typing import Any

MapLike = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Any callable like the builtin map: an executor's, a cluster's."""

_pool: ThreadPoolExecutor | None = None
_pool_lock = threading.Lock()
_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def set_threads(n: int) -> None:
    """Use `n` threads from now on, the caller's included. Results do not depend on it, to the last bit."""
    global _threads
    if n < 1:
        raise ValueError(f"n: expected at least one thread; found {n}.")
    with _pool_lock:
        _threads = n
        _forget_pool()


def get_threads() -> int:
    """The number of threads in use; at first, that of the processors on which this process may run."""
    return _threads


def _forget_pool() -> None:
    # the old pool's threads end after its last job; jobs that it already has are still done
    global _pool
    if _pool is not None:
        _pool.shutdown(wait=False)
    _pool = None


SMALL = 1000
"""Rows of matrices up to which threads of BLAS do not pay."""


def blas_for(rows: int) -> AbstractContextManager[Any]:
    """Matrix products on one thread within, where matrices have few rows; what was set before comes back behind.

    For some hundred rows BLAS's threads wait for each other, spinning, for several times as long as they compute, and
    take the processors from other pairs. Of threads that overlap the first one decides.
    """
    return nullcontext() if rows > SMALL else _blas().limit(limits=1, user_api="blas")


@functools.cache
def _blas() -> Any:
    """What tells BLAS its threads. To look for it among all that a process has loaded takes some ten milliseconds."""
    import scipy.linalg  # noqa: F401  # it brings a BLAS of its own
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def _after_fork() -> None:
    # the child has the pool but none of its threads
    global _pool, _pool_lock
    _pool, _pool_lock = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def for_each(kernel: Callable[..., Any], parts: Iterable[tuple], *shared: Any) -> None:
    """Call kernel(*part, *shared) for every part, on all threads; parts are taken in order, by whoever is free.

    The caller's thread works too: a single part is not handed over, and on a busy machine nobody waits for a late
    thread.
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
            _pool = ThreadPoolExecutor(max(1, _threads - 1), thread_name_prefix="otsync")
        futures = [_pool.submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        todo.clear()  # after an error: no further part is begun
        for future in futures:
            if not future.cancel():
                future.result()


def ranges(n: int, size: int) -> list[tuple[int, int]]:
    """``[0, n)`` cut into pieces of `size`: the same pieces whatever the number of threads."""
    return [(i, min(i + size, n)) for i in range(0, n, size)]
