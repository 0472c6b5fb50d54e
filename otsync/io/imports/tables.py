"""A CSV of offsets: ``video``, ``seconds`` (or ``milliseconds``, ``frames``), perhaps ``reference`` and ``sigma``."""

from __future__ import annotations

from pathlib import Path

from .slot import Filmed, Known, heads_of, number, rows_of

UNITS = {"seconds": 1.0, "milliseconds": 1e-3, "frames": None}
"""Columns with the offset; frames are of the video itself."""

ROUNDING = 0.5
"""Frames: sigma of an offset without one. Whoever wrote it down counted frames."""


class Table:
    """Offsets as somebody wrote them down: positive where the video started later than its reference."""

    name = "table"
    looks_for = "a CSV with video and seconds, milliseconds or frames; perhaps reference and sigma (same unit)"

    def claims(self, path: Path) -> bool:
        heads = heads_of(path)
        return "video" in heads and any(unit in heads for unit in UNITS)

    def edges(self, path: Path, filmed: Filmed) -> list[Known]:
        heads, rows = rows_of(path)
        units = [unit for unit in UNITS if unit in heads]
        if "video" not in heads or len(units) != 1:
            raise ValueError(
                f"{path}: expected headings video and one of {', '.join(UNITS)}; found {', '.join(heads)}. Correct the "
                "first line."
            )
        out, seen = [], set()
        for n, row in rows:
            where = f"{path}: line {n}"
            b = filmed.index(row["video"], where)
            a = filmed.index(row["reference"], where) if row.get("reference") else 0
            late = number(row[units[0]], f"{where}: {units[0]}")
            factor = UNITS[units[0]]
            unit = 1 / filmed.rate(b, where) if factor is None else factor
            if a == b:
                if late != 0:
                    raise ValueError(
                        f"{where}: expected 0 of the reference itself; found {late:g}. Name another in the column "
                        "reference, or begin with it."
                    )
                continue
            if (a, b) in seen:
                raise ValueError(f"{where}: expected each video once; {filmed.names[b]} occurs twice. Keep one line.")
            seen.add((a, b))
            if row.get("sigma"):
                sigma = number(row["sigma"], f"{where}: sigma") * unit
                if sigma <= 0:
                    raise ValueError(f"{where}: sigma: expected a number above 0; found {row['sigma']}. Leave it out.")
            else:
                sigma = ROUNDING / filmed.rate(b, f"{where}: sigma, which is missing")
            out.append(Known(a, b, late * unit, sigma, where))
        if not out:
            raise ValueError(f"{path}: expected offsets of videos; found none. Write one line a video.")
        return out
