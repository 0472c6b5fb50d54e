"""The log of Pose2Sim's synchronisation: ``logs.txt`` with a line a camera, of whole frames.

Pose2Sim numbers the frames of a camera down by its offset (frame k becomes k - offset), so a positive offset of theirs
is a camera that started *earlier*: the sign turns around here.
"""

from __future__ import annotations

import re
from pathlib import Path

from ...files.arrays import existing
from .slot import LARGEST, Filmed, Known

LINE = re.compile(
    r"--> Camera (.+?) and (.+?): (-?\d+) frames offset(?: \([^)]*\))?, correlation (-?\d+(?:\.\d+)?|nan)"
)
SIGMA = 1.0
"""Frames: whole frames, of the correlation of one vertical speed."""

DOUBTFUL, WIDER = 0.5, 10.0
"""Correlation below which sigma is so many times larger."""


class Pose2Sim:
    """Pose2Sim's synchronisation."""

    name = "pose2sim"
    looks_for = "logs.txt of Pose2Sim, with the offsets of its synchronisation"

    def claims(self, path: Path) -> bool:
        file = _log(path)
        return file.is_file() and file.stat().st_size <= LARGEST and LINE.search(_text(file)) is not None

    def edges(self, path: Path, filmed: Filmed) -> list[Known]:
        file = existing(_log(path))
        if file.stat().st_size > LARGEST:
            raise ValueError(f"{file}: expected at most {LARGEST} bytes; found {file.stat().st_size}. Another file?")
        # a log grows: the last run counts
        last: dict[tuple[int, int], Known] = {}
        for match in LINE.finditer(_text(file)):
            a, b = (filmed.index(match[k].removesuffix("_json"), str(file)) for k in (1, 2))
            rate = filmed.rate(b, str(file))
            sound = match[4] != "nan" and float(match[4]) >= DOUBTFUL
            sigma = SIGMA / rate * (1 if sound else WIDER)
            last[a, b] = Known(a, b, -int(match[3]) / rate, sigma, f"{file}: {match[0][4:]}")
        if not last:
            raise ValueError(f"{file}: expected lines '--> Camera a and b: n frames offset'; found none. Run Pose2Sim.")
        return list(last.values())


def _log(path: Path) -> Path:
    return path / "logs.txt" if path.is_dir() else path


def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8", errors="replace")
