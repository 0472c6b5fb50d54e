"""Results on disk, named by what they were made from: a run that was killed continues, a changed parameter does not."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..files import read_npz, write_npz

log = logging.getLogger("otsync")

VERSION = 1
"""Part of every key: raise it when a prior computes something else with the same parameters."""


@dataclass(frozen=True)
class Cache:
    """Arrays by stage and key under ``root``; ``None``: nothing is kept.

    Files are written under a temporary name and renamed, so a file that exists is whole. One that does not read
    (a disk's fault, a stranger's edit) is computed anew.
    """

    root: Path | None = None

    def arrays(self, stage: str, key: tuple[Any, ...], compute: Callable[[], dict[str, np.ndarray]]) -> dict:
        """``compute()``, or what it returned when it was last called with the same ``key``.

        The key's items are told apart by their ``repr``: digests, numbers, frozen dataclasses of those.
        """
        if self.root is None:
            return compute()
        path = self.path(stage, key)
        if path.is_file():
            try:
                return read_npz(path)
            except (ValueError, OSError) as error:
                log.warning("%s; computing it again", error)
        arrays = compute()
        write_npz(path, arrays)
        return arrays

    def path(self, stage: str, key: tuple[Any, ...]) -> Path:
        assert self.root is not None
        return self.root / f"{stage}-{digest_of(VERSION, stage, *key)}.npz"

    def holds(self, stage: str, key: tuple[Any, ...]) -> bool:
        return self.root is not None and self.path(stage, key).is_file()


def digest_of(*key: Any) -> str:
    """A short hash of the items; arrays count by their bytes."""
    total = hashlib.blake2b(digest_size=12)
    for item in key:
        if isinstance(item, np.ndarray):
            total.update(f"{item.dtype.str}{item.shape}".encode() + np.ascontiguousarray(item).tobytes())
        else:
            total.update(repr(item).encode() + b"\0")
    return total.hexdigest()
