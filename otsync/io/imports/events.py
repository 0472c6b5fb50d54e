"""A flash, a clap, a lamp: a CSV of when each video shows one and the same event, on its own clock."""

from __future__ import annotations

import math
from pathlib import Path

from .slot import Filmed, Known, heads_of, number, rows_of, star

UNIFORM = 1 / math.sqrt(12)
"""Frames: sigma of an event of which only the frame is known."""


class Events:
    """``event`` (its name), ``video`` and ``at_seconds`` or ``at_frame``; one line a video and event."""

    name = "events"
    looks_for = "a CSV with event, video and at_seconds or at_frame: when each video shows a flash or a clap"

    def claims(self, path: Path) -> bool:
        heads = heads_of(path)
        return "video" in heads and bool({"at_seconds", "at_frame"} & set(heads))

    def edges(self, path: Path, filmed: Filmed) -> list[Known]:
        heads, rows = rows_of(path)
        column = [head for head in ("at_seconds", "at_frame") if head in heads]
        if "video" not in heads or len(column) != 1:
            raise ValueError(f"{path}: expected headings video and at_seconds or at_frame; found {', '.join(heads)}.")
        events: dict[str, list[tuple[int, float, float, str]]] = {}
        for n, row in rows:
            where = f"{path}: line {n}"
            v = filmed.index(row["video"], where)
            at = number(row[column[0]], f"{where}: {column[0]}")
            frame = 1 / filmed.rate(v, where)
            if at < 0:
                raise ValueError(f"{where}: {column[0]}: expected 0 or more; found {at:g}. Correct it.")
            seconds = at * frame if column[0] == "at_frame" else at
            # who shows it early began late
            events.setdefault(row.get("event", ""), []).append((v, -seconds, UNIFORM * frame, where))
        return [edge for told in events.values() for edge in star(told, path)]
