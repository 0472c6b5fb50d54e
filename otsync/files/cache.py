"""Results on disk, named by what they were made from: a run that was killed continues, a changed parameter does not."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .arrays import read_npz, write_npz
from .digest import content_key

log = logging.getLogger("otsync")

VERSION = 2
"""Part of every key: raise it when a prior computes something else with the same parameters."""


@dataclass(frozen=True)
class Cache:
    """Arrays by stage and key under ``root``; ``None``: nothing is kept.

    Files are written under a temporary name and renamed, so a file that exists is whole. One that does not read
    (a disk's fault, a stranger's edit) is computed anew.
    """

    root: Path | None = None

    def __post_init__(self) -> None:
        if self.root is not None:
            object.__setattr__(self, "root", Path(self.root))  # from a script, a str

    def arrays(self, stage: str, key: tuple[Any, ...], compute: Callable[[], dict[str, np.ndarray]]) -> dict:
        """``compute()``, or what it returned when it was last called with the same ``key``.

        The key's items are told apart by their content (:func:`otsync.files.digest.content_key`).
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
        return self.root / f"{stage}-{content_key(VERSION, stage, *key)}.npz"

    def holds(self, stage: str, key: tuple[Any, ...]) -> bool:
        return self.root is not None and self.path(stage, key).is_file()
