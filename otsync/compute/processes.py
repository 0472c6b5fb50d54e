"""Work spread over processes, where threads would wait for each other's interpreter."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from types import TracebackType
from typing import Any, TypeVar

from .threads import get_threads, set_threads

log = logging.getLogger("otsync")

Item = TypeVar("Item")
Answer = TypeVar("Answer")


class Processes:
    """Calls of functions in other processes, from threads that wait for the answers.

    They begin with the first call, which takes some seconds, and end with the block. Answers are those of this process,
    to the last bit. The work is done in this one where the system gives no processes, or ends one, and where the
    function or the item cannot be sent (a matcher that holds a lambda).

    Args:
        workers: processes; 1: calls are made in this one.
    """

    def __init__(self, workers: int) -> None:
        if workers < 1:
            raise ValueError(f"workers: expected at least one process; found {workers}.")
        self.workers = workers
        self._pool: ProcessPoolExecutor | None = None
        self._lock = threading.Lock()

    def __enter__(self) -> Processes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            pool, self._pool, self.workers = self._pool, None, 1
        if pool is not None:
            pool.shutdown(cancel_futures=True)

    def __call__(self, function: Callable[[Item], Answer], item: Item) -> Answer:
        """``function(item)``, whose exceptions are raised here."""
        try:
            packed = pickle.dumps((function, item))
        except Exception:  # what an object raises that cannot be pickled is its own affair
            return function(item)
        pool = self._begun()
        if pool is None:
            return function(item)
        try:
            with _interrupts_kept_from_children():
                asked = pool.submit(_unpacked, packed)
            read, answer = asked.result()
            if read:
                return answer
        except BrokenProcessPool as error:
            self._forget(pool, error)
        except RuntimeError:
            if self._pool is pool:
                raise
            # another thread saw first that a process has ended, and the pool takes nothing any more
        return function(item)

    def _begun(self) -> ProcessPoolExecutor | None:
        with self._lock:
            if self._pool is None and self.workers > 1:
                from multiprocessing import get_context

                own = max(1, get_threads() // self.workers)
                try:
                    context = get_context("spawn")  # forks of a process with threads may wait for ever
                    self._pool = ProcessPoolExecutor(
                        self.workers, mp_context=context, initializer=_begin, initargs=(own,)
                    )
                except (OSError, ImportError, NotImplementedError) as error:  # no semaphores, no memory
                    self.workers = 1
                    log.info("pairs are compared in one process: %s", error)
            return self._pool

    def _forget(self, pool: ProcessPoolExecutor, error: Exception) -> None:
        with self._lock:
            if self._pool is pool:
                log.warning("a process that compares pairs has ended (%s); going on in one process", error)
                self._pool, self.workers = None, 1
                pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def process_pool(
    workers: int, begin: Callable[..., object] | None = None, arguments: tuple[Any, ...] = ()
) -> Iterator[ProcessPoolExecutor]:
    """An executor for independent jobs: where the block ends by an exception its processes end, whatever they do.

    They begin anew, since a fork beside threads may wait for one forever; they never see Ctrl-C, which is the parent's;
    and they end where that is killed.

    Args:
        workers: processes, each on as many threads as this one. begin: is called in each of them, with the arguments.
    """
    from multiprocessing import active_children, get_context

    others = set(active_children())
    pool = ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_begin_with, initargs=(get_threads(), begin, arguments)
    )
    own: set[Any] = set()
    try:
        with _interrupts_kept_from_children():
            for _ in range(workers):  # each begins with a call
                pool.submit(os.getpid)
            own = set(active_children()) - others
        yield pool
    except BaseException:  # what they are at would be waited for
        pool.shutdown(wait=False, cancel_futures=True)
        for child in own:
            child.terminate()
        raise
    finally:
        pool.shutdown()


def _begin_with(threads: int, begin: Callable[..., object] | None, arguments: tuple[Any, ...]) -> None:
    _begin(threads)
    if begin is not None:
        begin(*arguments)


def _unpacked(packed: bytes) -> tuple[bool, Any]:
    """In another process: whether it can read what it was sent, and the answer."""
    try:
        function, item = pickle.loads(packed)
    except Exception:  # what is defined in a session alone is not found here
        return False, None
    return True, function(item)


@contextmanager
def _interrupts_kept_from_children() -> Iterator[None]:
    """Processes that begin within never see Ctrl-C, which a terminal sends to all of a group; here it waits."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(threads: int) -> None:
    """In a new process: Ctrl-C is its parent's, and it ends where the parent is killed."""
    from multiprocessing import parent_process
    from multiprocessing.connection import wait

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_threads(threads)
    parent = parent_process()
    if parent is None:
        return

    def follow() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, name="otsync.parent", daemon=True).start()
