"""Seconds of every frame from a CSV: of cameras that write their times into a file of their own."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path
from typing import Any

from ..files.arrays import existing
from ..files.strict import nearest, shown
from .scene import Paths, names_of, video_frames

UNITS = {
    "seconds": 1.0,
    "milliseconds": 1e-3,
    "microseconds": 1e-6,
    "nanoseconds": 1e-9,
}
"""Names of the column with the times, and seconds a unit of each."""

LARGEST = 2**28
"""Bytes of a CSV: a million frames have some 30 million."""


def read_timestamps(path: str | os.PathLike[str]) -> dict[str | None, list[float]]:
    """Seconds of every frame, by video; None: of a file without a column ``video``.

    The file has a line of headings: one of seconds, milliseconds, microseconds, nanoseconds; perhaps ``video``, and
    ``frame``, which must then count from 0. Times need not begin at 0: they are kept as they are.

    ValueError names the line for anything that is no increasing number, and for frames that are left out.
    """
    path = existing(path)
    if path.stat().st_size > LARGEST:
        raise ValueError(f"{path}: expected at most {LARGEST} bytes; found {path.stat().st_size}. Another file?")
    out: dict[str | None, list[float]] = {}
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            rows = csv.DictReader(stream, strict=True)
            heads = [head.strip().lower() for head in rows.fieldnames or ()]
            rows.fieldnames = heads
            units = [unit for unit in UNITS if unit in heads]
            if len(units) != 1 or len(set(heads)) < len(heads):
                close = nearest(heads[-1], UNITS) if heads else None
                meant = f" Did you mean {close}?" if close else ""
                raise ValueError(
                    f"{path}: expected headings with one of {', '.join(UNITS)}, once; found "
                    f"{shown(', '.join(heads))}.{meant} Name the unit in the first line."
                )
            for number, row in enumerate(rows, 2):
                video = (row["video"] or "").strip() if "video" in heads else None
                own = out.setdefault(video, [])
                seconds = _number(row[units[0]], f"{path}: line {number}: {units[0]}") * UNITS[units[0]]
                if "frame" in heads and _number(row["frame"], f"{path}: line {number}: frame") != len(own):
                    raise ValueError(
                        f"{path}: line {number}: frame: expected {len(own)}; found {shown(row['frame'])}. Every frame "
                        "needs its line, counted from 0."
                    )
                if own and seconds <= own[-1]:
                    raise ValueError(
                        f"{path}: line {number}: expected a time after {own[-1]:g} s; found {seconds:g} s. Sort the "
                        "lines."
                    )
                own.append(seconds)
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected a CSV in UTF-8; {error}. Save it again.") from None
    if not out:
        raise ValueError(f"{path}: expected a line for every frame; found none. Write the times below the headings.")
    return out


def _number(text: str | None, where: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{where}: expected a number; found {shown(text)}. Correct it.")
    return value


def with_timestamps(document: dict[str, Any], folder: Path, path: str | os.PathLike[str]) -> dict[str, Any]:
    """The document with the times of a CSV in its videos, instead of ``fps``.

    ValueError where a video has another number of frames than lines, and for names that no video has.
    """
    told, names = read_timestamps(path), names_of(document["videos"])
    if None in told:
        if len(names) != 1:
            raise ValueError(
                f"{path}: expected a column video, because the folder has {len(names)} videos; found none. Add it."
            )
        told = {names[0]: told[None]}
    unknown = [name for name in told if name not in names]
    if unknown:
        raise ValueError(
            f"{path}: video: expected some of {', '.join(names)}; found {shown(unknown[0])}. Correct the names."
        )
    videos = []
    for name, entry in zip(names, document["videos"], strict=True):
        seconds = told.get(name)
        if seconds is not None:
            frames = len(video_frames({**entry, "fps": 1.0}, Paths(folder))[0])
            if frames != len(seconds):
                raise ValueError(
                    f"{path}: {name}: expected {frames} lines, one a frame; found {len(seconds)}. Bring the times of "
                    "exactly these frames."
                )
            entry = {**{k: v for k, v in entry.items() if k != "fps"}, "timestamps": seconds}
        videos.append(entry)
    missing = [item for item in document.get("missing", ()) if not _given(item, told)]
    rest = {k: v for k, v in document.items() if k != "missing"}
    return {**rest, "videos": videos, **({"missing": missing} if missing else {})}


def _given(item: str, told: dict[Any, Any]) -> bool:
    return any(item == f"{name}: fps or timestamps" for name in told)
