"""Progress bars on a terminal, for what takes longer than a moment; nowhere else. A leaf."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

_quiet = False


def be_quiet(quiet: bool) -> None:
    """Show neither bars nor lines of progress from now on, or show them again."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    """Whether progress is not to be shown."""
    return _quiet


def tell(text: str) -> None:
    """A line of progress on stderr, unless progress is not to be shown."""
    if not _quiet:
        print(text, file=sys.stderr, flush=True)


PATIENCE = 2.0
"""Seconds before a bar shows: what ends sooner needs none."""


def counted(items: Iterable[T], what: str, unit: str, total: int | None = None) -> Iterable[T]:
    """The items, counted on stderr while it is a terminal; total: how many, where they do not tell."""
    from tqdm import tqdm

    return tqdm(items, desc=what, unit=unit, total=total, disable=True if _quiet else None, leave=False, delay=PATIENCE)


def say(text: str) -> None:
    """Print a line without tearing a bar."""
    from tqdm import tqdm

    tqdm.write(text, file=sys.stdout)
    sys.stdout.flush()


Tell = Callable[[str], None]


class Stopwatch:
    """Wall seconds per stage."""

    def __init__(self, tell: Tell):
        self.tell, self.seconds, self._last = tell, {}, time.perf_counter()  # type: Tell, dict[str, float], float

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = now - self._last
        self._last = now
        self.tell(f"{stage}: {self.seconds[stage]:.1f} s")


class Progress:
    """Says what happens, remembers what was lacking, and times the stages."""

    def __init__(self, tell: Tell = lambda text: None):
        self.tell, self.notes, self.seconds = tell, [], {}  # type: Tell, list[str], dict[str, float]

    def note(self, text: str) -> None:
        """Something that the user should know when reading the result; said once, however often it is found."""
        if text not in self.notes:
            self.notes.append(text)
            self.tell(f"note: {text}")

    @contextmanager
    def stage(self, name: str):
        """Time what happens inside."""
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started
        self.tell(f"{name}: {self.seconds[name]:.1f} s")
