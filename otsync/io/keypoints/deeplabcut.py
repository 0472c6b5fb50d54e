"""DeepLabCut's CSV: three rows of header (scorer, bodyparts, coords), four with several animals (individuals)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from .detections import Detections, head_of, number, rows_of


class DeepLabCut:
    """As DeepLabCut writes it beside its .h5 (``save_as_csv``): a row a frame, x, y and likelihood of every part."""

    name = "deeplabcut"
    looks_for = "a .csv file whose first rows begin with scorer, (individuals,) bodyparts and coords"

    def claims(self, files: Sequence[Path]) -> bool:
        first = [row[0].lower() for row in head_of(files)]
        return first[:1] == ["scorer"] and "bodyparts" in first and "coords" in first

    def read(self, files: Sequence[Path]) -> Detections:
        return Detections.of(self._rows(files[0]))

    def _rows(self, path: Path) -> Iterator[tuple[int, float, float, str, int, float]]:
        header: dict[str, list[str]] = {}
        rows = iter(rows_of(path))
        for row in rows:
            header[row[0].lower()] = row
            if row[0].lower() == "coords":
                break
        parts, coords = header["bodyparts"], [cell.lower() for cell in header["coords"]]
        animals = header.get("individuals", ["single"] * len(parts))
        if not len(parts) == len(coords) == len(animals):
            raise ValueError(f"{path}: expected header rows of one length; found {len(parts)} and {len(coords)} cells.")
        who = {animal: n for n, animal in enumerate(dict.fromkeys(animals[1:]))}
        triples = [
            (c, parts[c], who[animals[c]])
            for c in range(1, len(coords) - 1)
            if coords[c] == "x" and coords[c + 1] == "y"
        ]
        first = next((c for c in range(1, len(coords)) if coords[c] == "x"), None)
        if first is None or not triples:
            raise ValueError(f"{path}: expected columns x and y under coords; found none. Export it again.")
        for k, row in enumerate(rows):
            if len(row) < len(coords):
                raise ValueError(f"{path}: frame {k}: expected {len(coords)} columns; found {len(row)}. Mend the file.")
            # the first cell is the frame, or the name of an image, which are in order
            frame = int(row[0]) if row[0].isdigit() else k
            for c, part, animal in triples:
                sure = c + 2 < len(coords) and coords[c + 2] == "likelihood"
                where = f"{path}: frame {frame}, {part}"
                yield (
                    frame,
                    number(row[c], where),
                    number(row[c + 1], where),
                    part[:200],
                    animal,
                    number(row[c + 2], where) if sure else 1.0,
                )
