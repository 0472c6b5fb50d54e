"""Progress bars on a terminal, for what takes longer than a moment; nowhere else. A leaf."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TypeVar

T = TypeVar("T")

PATIENCE = 2.0
"""Seconds before a bar shows: what ends sooner needs none."""


def counted(items: Iterable[T], what: str, unit: str, total: int | None = None) -> Iterable[T]:
    """The items, counted on stderr while it is a terminal; total: how many, where they do not tell."""
    from tqdm import tqdm

    return tqdm(items, desc=what, unit=unit, total=total, disable=None, leave=False, delay=PATIENCE)


def say(text: str) -> None:
    """Print a line without tearing a bar."""
    from tqdm import tqdm

    tqdm.write(text, file=sys.stdout)
    sys.stdout.flush()
