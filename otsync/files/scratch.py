"""Arrays that lie in files without a name: memory that the system may take back, gone when nobody holds them."""

from __future__ import annotations

import mmap
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np


class Scratch:
    """Rows of an array, appended one by one; then read as an array.

    Where a folder is named, they are written to a file in it that has no name (it goes with the process, however that
    ends), and are read as a private map of it: what is looked at comes into memory, and may leave it. A disk that is
    full is an OSError of :meth:`append`, not a fault while reading.
    """

    def __init__(self, row: Sequence[int], dtype: type = np.uint8, folder: Path | None = None):
        self.row, self.dtype, self.rows = tuple(row), np.dtype(dtype), 0
        self._kept: list[np.ndarray] = []
        self._file = None
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed when it is mapped

    def append(self, row: np.ndarray | None) -> None:
        """Add a row; None: zeros."""
        one = np.zeros(self.row, self.dtype) if row is None else np.ascontiguousarray(row, self.dtype)
        if one.shape != self.row:
            raise ValueError(f"row: expected shape {self.row}; found {one.shape}.")
        self.rows += 1
        if self._file is None:
            self._kept.append(one)
        else:
            self._file.write(one.data)

    def array(self) -> np.ndarray:
        """All rows, (rows, *row), to read: what is written to them is lost when they are released."""
        shape = (self.rows, *self.row)
        if self._file is None or 0 in shape:
            return np.stack(self._kept) if self._kept else np.zeros(shape, self.dtype)
        self._file.flush()
        held = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_COPY)
        self._file.close()
        return np.frombuffer(held, self.dtype).reshape(shape)


def release(array: np.ndarray | None) -> None:
    """Give an array's pages back to the system, which reads them again when they are asked for.

    Nothing happens to arrays that lie in no file of :class:`Scratch`, nor where the system cannot.
    """
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, memoryview):
        base = base.obj
    if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)
