"""The pool of threads that runs nogil kernels over parts of their work, in both packages.

Numba's own `parallel=True` is not used: its default layer aborts the process when two Python threads enter it at once.
"""

from __future__ import annotations

import functools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from .interrupts import uninterrupted

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


FEW = 1000
"""Rows of matrices up to which threads of BLAS do not pay."""

_inside, _inside_lock = 0, threading.Lock()
_own = threading.local()
_before: list[int] = []


@contextmanager
def blas_for(rows: int) -> Iterator[None]:
    """Matrix products on one thread within, where matrices have few rows; behind the last one, as before the first.

    For some hundred rows BLAS's threads wait for each other, spinning, for several times as long as they compute, and
    take the processors from other pairs. Where several of the caller's threads are inside, and the first one leaves,
    those that are left may get BLAS's threads back.
    """
    if rows > FEW or getattr(_own, "inside", False):
        yield
        return
    _enter()
    try:
        yield
    finally:
        _leave()


def _enter() -> None:
    global _inside, _before
    libraries = _blas()
    with _inside_lock:
        if _inside == 0:
            _before = [library.get_num_threads() for library in libraries]
        _inside += 1
        for library in libraries:
            library.set_num_threads(1)
    _own.inside = True


def _leave() -> None:
    from threadpoolctl import OpenBLASController

    global _inside
    _own.inside = False
    with _inside_lock:
        _inside -= 1
        if _inside == 0:  # whoever began: threadpoolctl listens to the first thread alone while that lives
            OpenBLASController.clear_controlling_thread(force=True)
        for library, threads in zip(_blas(), _before, strict=True):
            library.set_num_threads(threads)
        if _inside == 0:
            OpenBLASController.clear_controlling_thread(force=True)


@functools.cache
def _blas() -> list[Any]:
    """numpy's and scipy's BLAS, and what else was loaded by the first call; torch, loaded later, keeps its own.

    To look for them among all that a process has loaded takes some ten milliseconds.
    """
    import scipy.linalg  # noqa: F401  # it brings one of its own
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas").lib_controllers


def _after_fork() -> None:
    # the child has the pool but none of its threads, and nobody else in it is inside anything
    global _pool, _pool_lock, _inside, _inside_lock
    _pool, _pool_lock = None, threading.Lock()
    _inside, _inside_lock = 0, threading.Lock()
    _own.inside = False


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def pool_of(threads: int, name: str = "otsync.map") -> ThreadPoolExecutor:
    """A pool whose threads have all begun: an interrupt while one begins leaves it unknown to the pool for good, and
    the process waits for it without end.
    """
    pool = ThreadPoolExecutor(threads, thread_name_prefix=name)
    with uninterrupted():
        begun = threading.Barrier(threads + 1)
        try:
            for _ in range(threads):
                pool.submit(begun.wait)
            begun.wait()
        except RuntimeError:  # the system gives no more threads: those that have begun must not wait for them
            begun.abort()
            pool.shutdown(wait=False)
            raise
    return pool


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
            _pool = pool_of(max(1, _threads - 1), "otsync")
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
