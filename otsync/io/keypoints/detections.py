"""What a file of detections says of one video, whoever wrote it."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int

from ...files.arrays import existing
from ...files.strict import shown

MAX_BYTES, MAX_ROWS = 512 * 2**20, 20_000_000
"""Of a table."""

HEAD = 4
"""Rows of a table that tell whose it is."""


@dataclass(frozen=True, eq=False)
class Detections:
    """Points of single frames.

    Args:
        frame: (M,) frames, counted from 0. xy: (M,2) the camera's pixels; the middle of the first pixel at .5.
        part: (M,) which of ``names`` a point is. who: (M,) which animal, person or track; -1 where nobody says.
        score: (M,) from 0 to 1; 1 where nobody says. names: of the parts, the same thing in every video.
    """

    frame: Int[np.ndarray, " M"]
    xy: Float[np.ndarray, "M 2"]
    part: Int[np.ndarray, " M"]
    who: Int[np.ndarray, " M"]
    score: Float[np.ndarray, " M"]
    names: tuple[str, ...]

    @classmethod
    def of(cls, rows: Iterable[tuple[int, float, float, str, int, float]]) -> Detections:
        """From rows (frame, x, y, name, who, score); those without a place are left out."""
        kept = [row for row in rows if math.isfinite(row[1]) and math.isfinite(row[2]) and row[0] >= 0]
        names = tuple(dict.fromkeys(row[3] for row in kept))
        index = {name: n for n, name in enumerate(names)}
        score = np.array([row[5] for row in kept], float)
        return cls(
            np.array([row[0] for row in kept], int),
            np.array([row[1:3] for row in kept], float).reshape(-1, 2),
            np.array([index[row[3]] for row in kept], int),
            np.array([row[4] for row in kept], int),
            np.where(np.isfinite(score), score, 0.0),
            names,
        )

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, index: np.ndarray) -> Detections:
        """The points at ``index`` (a mask or integers)."""
        return Detections(
            self.frame[index], self.xy[index], self.part[index], self.who[index], self.score[index], self.names
        )

    def surer(self, least: float) -> Detections:
        """The points with a score of ``least`` and more."""
        return self.take(self.score >= least)

    def within(self, frames: Sequence[int]) -> Detections:
        """The points of some frames, in their order: the n-th of ``frames`` becomes frame n."""
        place = {int(k): n for n, k in enumerate(frames)}
        new = np.array([place.get(int(k), -1) for k in self.frame], int)
        found = replace(self, frame=new)
        return found.take(new >= 0)

    @property
    def last(self) -> int:
        """The last frame with a point; -1 without any."""
        return int(self.frame.max(initial=-1))


class KeypointReader(Protocol):
    """The ``keypoints`` slot: one way of writing detections."""

    name: str
    """As scene.json spells it."""
    looks_for: str
    """What the reader expects, in one line."""

    def claims(self, files: Sequence[Path]) -> bool:
        """Whether the files are written this way; cheap."""
        ...

    def read(self, files: Sequence[Path]) -> Detections:
        """The detections of one video. ValueError names the file and what is wrong with it."""
        ...


def read_detections(files: Sequence[Path], readers: Sequence[KeypointReader]) -> Detections:
    """The detections in the files by the first reader that claims them. ValueError lists what the readers expect."""
    for reader in readers:
        if reader.claims(files):
            found = reader.read(files)
            if len(found) == 0:
                raise ValueError(f"{files[0]}: expected points; found none ({reader.name}). Leave the file out.")
            return found
    wanted = "; ".join(f"{reader.name}: {reader.looks_for}" for reader in readers)
    raise ValueError(f"{files[0]}: expected points as a reader knows them ({wanted}); found something else.")


def head_of(files: Sequence[Path]) -> list[list[str]]:
    """The first rows of a single .csv file; none of anything else."""
    if len(files) != 1 or files[0].suffix.lower() not in (".csv", ".txt", ".tsv"):
        return []
    rows = []
    for row in rows_of(files[0]):
        rows.append(row)
        if len(rows) == HEAD:
            break
    return rows


def rows_of(path: Path) -> Iterable[list[str]]:
    """The rows of a table, separated by commas, semicolons or tabs. ValueError for one that is too large or no text."""
    size = existing(path).stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"{path}: expected a table of at most {MAX_BYTES} bytes; found {size}. Cut it.")
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            first = stream.readline(100_000)
            separator = max(",;\t", key=first.count)
            stream.seek(0)
            for n, row in enumerate(csv.reader(stream, delimiter=separator)):
                if n > MAX_ROWS:
                    raise ValueError(f"{path}: expected at most {MAX_ROWS} rows; found more. Cut it.")
                if row and any(cell.strip() for cell in row):
                    yield [cell.strip() for cell in row]
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected a table of text; {error}. Save it as CSV (UTF-8).") from None


def number(cell: Any, where: str) -> float:
    """A number of a cell, nan where it is empty. ValueError names the place."""
    if cell in ("", None) or (isinstance(cell, str) and cell.lower() in ("nan", "na", "null", "none")):
        return math.nan
    try:
        return float(cell)
    except (TypeError, ValueError):
        raise ValueError(f"{where}: expected a number; found {shown(cell)}. Mend the file.") from None


def whole(cell: Any, where: str) -> int:
    """A whole number of a cell. ValueError names the place."""
    value = number(cell, where)
    if not (math.isfinite(value) and value == int(value) and abs(value) < 2**31):
        raise ValueError(f"{where}: expected a whole number; found {shown(cell)}. Mend the file.")
    return int(value)
