"""Answers of a long benchmark, written as they come: an interrupted run goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ...files.arrays import atomic_write

PACKAGE = Path(__file__).parents[2]


class Kept:
    """The rows of every job that is done, in a file of JSON lines.

    Rows of the same code are not measured again, whatever else was asked with them; those of another are dropped.

    Args:
        path: of the file. A job is anything that JSON holds, and says all that its rows depend on.
    """

    def __init__(self, path: Path):
        self.path = path
        self._head = json.dumps({"code": code_digest()})
        self._rows = dict(self._read())
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path, "w") as stream:  # a torn line would spoil the next one
            stream.write("\n".join([self._head, *map(json.dumps, self._rows.items())]) + "\n")

    def __len__(self) -> int:
        return len(self._rows)

    def rows(self, job: Any) -> list[dict[str, Any]] | None:
        """What was measured; None: nothing yet."""
        return self._rows.get(_key(job))

    def keep(self, job: Any, rows: list[dict[str, Any]]) -> None:
        """Write what was measured, at once."""
        self._rows[_key(job)] = rows
        with self.path.open("a") as stream:
            stream.write(json.dumps([_key(job), rows]) + "\n")

    def _read(self) -> Iterator[tuple[str, list[dict[str, Any]]]]:
        try:
            first, *lines = self.path.read_text().splitlines()
        except (OSError, ValueError):
            return
        if first != self._head:
            return
        for line in lines:
            try:
                job, rows = json.loads(line)
            except (TypeError, ValueError):  # the line that was being written
                continue
            yield job, rows


def _key(job: Any) -> str:
    return json.dumps(job)


def code_digest() -> str:
    """A hash of this package's sources: figures are of one code."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
