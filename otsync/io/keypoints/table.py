"""Tables of any program: a row a detection, columns named frame, x and y."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from .detections import Detections, head_of, number, rows_of, whole

COLUMNS = {
    "frame": ("frame", "frame_idx", "frame_index", "image", "t"),
    "x": ("x", "u", "cx", "x_px"),
    "y": ("y", "v", "cy", "y_px"),
    "name": ("name", "part", "bodypart", "keypoint", "label", "class"),
    "who": ("id", "track", "track_id", "particle", "individual", "object"),
    "score": ("score", "confidence", "likelihood", "conf", "probability"),
}
"""What a column may be called, in small letters."""


class Table:
    """A row a detection; ``name``, ``id`` and ``score`` may be missing. trackpy's tables are such ones."""

    name = "table"
    looks_for = "a .csv file whose first row names the columns frame, x and y (and name, id, score)"

    def claims(self, files: Sequence[Path]) -> bool:
        rows = head_of(files)
        return bool(rows) and {"frame", "x", "y"} <= set(columns(rows[0]))

    def read(self, files: Sequence[Path]) -> Detections:
        return Detections.of(self._rows(files[0]))

    def _rows(self, path: Path) -> Iterator[tuple[int, float, float, str, int, float]]:
        rows = iter(rows_of(path))
        at = columns(next(rows))
        ids: dict[str, int] = {}
        for n, row in enumerate(rows, 2):
            where = f"{path}: row {n}"
            if len(row) <= max(at.values()):
                raise ValueError(f"{where}: expected {max(at.values()) + 1} columns; found {len(row)}. Mend the file.")
            who = row[at["who"]] if "who" in at else ""
            yield (
                whole(row[at["frame"]], f"{where}, frame"),
                number(row[at["x"]], f"{where}, x"),
                number(row[at["y"]], f"{where}, y"),
                row[at["name"]][:200] if "name" in at else "",
                ids.setdefault(who, len(ids)) if who not in ("", "-1") else -1,
                number(row[at["score"]], f"{where}, score") if "score" in at else 1.0,
            )


def columns(first: Sequence[str]) -> dict[str, int]:
    """Where the columns are, by what they mean."""
    names = [cell.lower() for cell in first]
    found = {}
    for meaning, spellings in COLUMNS.items():
        there = next((names.index(s) for s in spellings if s in names), None)
        if there is not None:
            found[meaning] = there
    return found
