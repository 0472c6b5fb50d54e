"""What an importer of offsets is, what it gives, and what it may know of the recording."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ...files.arrays import existing
from ...files.strict import nearest, shown
from ..scene import Paths, names_of, video_frames

LARGEST = 2**24
"""Bytes of a file with offsets."""


@dataclass(frozen=True)
class Known:
    """What somebody else says of two videos: ``b`` started ``seconds`` later than ``a`` (negative: earlier).

    Args:
        a, b: indices of videos. sigma: one standard deviation, s. source: file and line, for reports.
    """

    a: int
    b: int
    seconds: float
    sigma: float
    source: str


@dataclass(frozen=True, eq=False)
class Filmed:
    """The videos of a recording, as far as importers need them: names, rates (nan unknown), and their files or None."""

    names: tuple[str, ...]
    fps: tuple[float, ...]
    files: tuple[Path | None, ...]

    def index(self, name: str, where: str) -> int:
        """The video of a name, also of a file's name. ValueError lists what there is."""
        for candidate in (name, Path(name).stem):
            if candidate in self.names:
                return self.names.index(candidate)
        close = nearest(name, self.names)
        meant = f" Did you mean {close!r}?" if close else ""
        raise ValueError(f"{where}: expected one of {', '.join(self.names)}; found {shown(name)}.{meant}")

    def rate(self, v: int, where: str) -> float:
        """Frames per second. ValueError where nobody knows them."""
        if not self.fps[v] > 0:
            raise ValueError(
                f"{where}: expected a frame rate of {self.names[v]}; the recording has none. Add fps to scene.json, or "
                "give seconds."
            )
        return self.fps[v]


class Importer(Protocol):
    """A way in which others write offsets down."""

    name: str
    """As ``otsync import-offsets --kind`` spells it."""
    looks_for: str
    """What it reads, in one line."""

    def claims(self, path: Path) -> bool:
        """Whether the file or folder is of this kind; cheap."""
        ...

    def edges(self, path: Path, filmed: Filmed) -> list[Known]:
        """What it says. ValueError names file and line."""
        ...


def filmed(document: dict[str, Any], root: Path, *, allow_outside: bool = False) -> Filmed:
    """The videos of a scene document, calibrated or not."""
    paths, rates, files = Paths(root, allow_outside), [], []
    for entry in document["videos"]:
        fps = entry.get("fps")
        stamps = entry.get("timestamps")
        if fps is None and stamps is None and "file" in entry:
            _, stamps, _ = video_frames(entry, paths)
        if fps is None and stamps is not None and len(stamps) > 1:
            fps = 1.0 / float(np.median(np.diff(np.asarray(stamps, float))))
        rates.append(float(fps) if fps is not None else math.nan)
        files.append(paths.one(entry["file"]) if "file" in entry else None)
    return Filmed(tuple(names_of(document["videos"])), tuple(rates), tuple(files))


def rows_of(path: Path) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Headings in lower case, and lines with their numbers, of a CSV."""
    path = existing(path)
    if path.stat().st_size > LARGEST:
        raise ValueError(f"{path}: expected at most {LARGEST} bytes; found {path.stat().st_size}. Another file?")
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream, strict=True)
            heads = [head.strip().lower() for head in reader.fieldnames or ()]
            if len(set(heads)) < len(heads):
                raise ValueError(f"{path}: expected every heading once; found {shown(', '.join(heads))}. Rename one.")
            reader.fieldnames = heads
            return heads, [
                (n, {k: (v or "").strip() for k, v in row.items() if k is not None and isinstance(v, str | None)})
                for n, row in enumerate(reader, 2)
            ]
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected a CSV in UTF-8; {error}. Save it again.") from None


def heads_of(path: Path) -> list[str]:
    """Headings of a CSV; none of what is no CSV."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return []
    with open(path, "rb") as stream:
        first = stream.readline(10_000).decode("utf-8-sig", "replace")
    return [head.strip().lower() for head in first.split(",")]


def number(text: str, where: str) -> float:
    """A finite number of a line."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{where}: expected a number; found {shown(text)}. Correct it.")
    return value


def star(times: Sequence[tuple[int, float, float, str]], path: Path) -> list[Known]:
    """Edges from the first video to the others: (video, seconds that it started, sigma, source) each.

    ValueError for a video that occurs twice, and for fewer than two.
    """
    seen = [v for v, *_ in times]
    if len(set(seen)) < len(seen):
        raise ValueError(f"{path}: expected every video once; some occur twice. Keep one line of each.")
    if len(times) < 2:
        raise ValueError(f"{path}: expected two videos or more; found {len(times)}. Add the others.")
    a, first, own, _ = times[0]
    return [Known(a, b, late - first, math.hypot(own, sigma), source) for b, late, sigma, source in times[1:]]
