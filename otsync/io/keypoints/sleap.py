"""SLEAP's analysis CSV: columns track, frame_idx, instance.score, then x, y and score of every node."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from .detections import Detections, head_of, number, rows_of, whole


class Sleap:
    """As ``sleap-convert --format analysis.csv`` writes it: a row an instance and frame."""

    name = "sleap"
    looks_for = "a .csv file with the columns track, frame_idx and NODE.x, NODE.y (sleap-convert --format analysis.csv)"

    def claims(self, files: Sequence[Path]) -> bool:
        rows = head_of(files)
        return bool(rows) and "frame_idx" in rows[0] and any(cell.endswith(".x") for cell in rows[0])

    def read(self, files: Sequence[Path]) -> Detections:
        return Detections.of(self._rows(files[0]))

    def _rows(self, path: Path) -> Iterator[tuple[int, float, float, str, int, float]]:
        rows = iter(rows_of(path))
        head = next(rows)
        at = {cell: n for n, cell in enumerate(head)}
        nodes = [cell[:-2] for cell in head if cell.endswith(".x") and f"{cell[:-2]}.y" in at]
        if not nodes:
            raise ValueError(f"{path}: expected columns NODE.x and NODE.y; found none. Export it again.")
        tracks: dict[str, int] = {}
        for n, row in enumerate(rows, 2):
            if len(row) < len(head):
                raise ValueError(f"{path}: row {n}: expected {len(head)} columns; found {len(row)}. Mend the file.")
            where = f"{path}: row {n}"
            track = row[at["track"]] if "track" in at else ""
            who = tracks.setdefault(track, len(tracks)) if track else -1
            frame = whole(row[at["frame_idx"]], f"{where}, frame_idx")
            for node in nodes:
                score = at.get(f"{node}.score")
                yield (
                    frame,
                    number(row[at[f"{node}.x"]], f"{where}, {node}.x"),
                    number(row[at[f"{node}.y"]], f"{where}, {node}.y"),
                    node[:200],
                    who,
                    1.0 if score is None else number(row[score], f"{where}, {node}.score"),
                )
