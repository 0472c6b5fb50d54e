"""Progress: bars on a terminal, lines on stderr, and the wall time of stages. Knows nothing of the rest."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from tqdm import tqdm

T = TypeVar("T")

_quiet = False


def be_quiet(quiet: bool) -> None:
    """Show neither bars nor lines of progress from now on, or show them again."""
    global _quiet
    _quiet = quiet


def tell(text: str) -> None:
    """A line of progress on stderr, unless progress is not to be shown."""
    if not _quiet:
        print(text, file=sys.stderr, flush=True)


PATIENCE = 2.0
"""Seconds before a bar shows: what ends sooner needs none."""


EVERY = 30.0
"""Seconds between lines of progress where stderr is no terminal but a log or a pipe."""


def counted(items: Iterable[T], what: str, unit: str, total: int | None = None) -> Iterable[T]:
    """The items, counted as :func:`bar` counts; total: how many, where they do not tell."""
    return bar(what, unit, total, items=items)


def bar(
    what: str,
    unit: str,
    total: int | None = None,
    *,
    items: Iterable[Any] | None = None,
    initial: int = 0,
    shown: bool = True,
) -> tqdm:
    """A bar on stderr where it is a terminal; a line now and then where it is a log or a pipe."""
    tqdm = _tqdm()
    known: dict[str, Any] = {"desc": what, "unit": unit, "total": total, "initial": initial, "leave": False}
    if _quiet or not shown:
        return tqdm(items, disable=True, **known)
    if sys.stderr.isatty():
        return tqdm(items, delay=PATIENCE, **known)
    # miniters: else a thread of tqdm's own would draw between
    return tqdm(items, delay=EVERY, mininterval=EVERY, miniters=1, ncols=0, file=Lines(), **known)


class Lines:
    """A file for a bar where nothing can be drawn over: each of its states is a line on stderr."""

    def write(self, text: str) -> int:
        state = text.strip("\r\n ")
        if state:
            print(state, file=sys.stderr, flush=True)
        return len(text)

    def flush(self) -> None:
        """Each line is flushed as it is written."""


def say(text: str) -> None:
    """Print a line without tearing a bar."""
    _tqdm().write(text, file=sys.stdout)
    sys.stdout.flush()


@cache
def _tqdm() -> type[tqdm]:
    """With a lock for threads alone. Its own is for processes, too: a semaphore that one which is ended leaves behind,
    and no two processes of ours draw.
    """
    from tqdm import tqdm

    class Bar(tqdm):
        """A class of its own, since whoever calls this library may have set the lock of tqdm's."""

    Bar.set_lock(threading.RLock())
    return Bar


Tell = Callable[[str], None]
"""Receives lines of progress."""


class Deadline:
    """Wall time that a whole job may take. Its stages ask what is left, and leave out what would take too much of it.

    Args:
        seconds: from now on.
    """

    def __init__(self, seconds: float):
        self.seconds = seconds
        self._ends = time.perf_counter() + seconds

    @property
    def left(self) -> float:
        """Seconds that are left; 0 when none are."""
        return max(0.0, self._ends - time.perf_counter())


class Progress:
    """Says what happens, remembers what the user should know, and times the stages.

    Args:
        tell: receives one line a note, and two a stage: as it begins and as it ends.

    ``notes``: what was noted, in order. ``seconds``: wall time per stage.
    """

    def __init__(self, tell: Tell = lambda text: None):
        self.tell = tell
        self.notes: list[str] = []
        self.seconds: dict[str, float] = {}

    def note(self, text: str) -> None:
        """Something that the user should know when reading the result; told once, however often it is noted."""
        if text not in self.notes:
            self.notes.append(text)
            self.tell(f"note: {text}")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what happens inside; times of the same name add up. Tells its beginning, and the total at its end."""
        self.tell(f"{name} ...")
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started
        self.tell(f"{name}: {self.seconds[name]:.1f} s")
