"""Timecodes of the videos' first frames: from a CSV, or from the video files themselves (a scene's folder)."""

from __future__ import annotations

import math
import re
from pathlib import Path

from ...files.strict import shown
from .slot import Filmed, Known, heads_of, rows_of, star

CODE = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})([:;.])(\d{2})")
UNIFORM = 1 / math.sqrt(12)
"""Frames: a timecode tells the frame, not where in it the shutter opened."""

DAY = 86400.0


class Timecode:
    """``video`` and ``timecode`` (HH:MM:SS:FF, with ; of dropped frames), or the tags of the video files."""

    name = "timecode"
    looks_for = "a CSV with video and timecode; or the recording itself, whose video files carry timecodes"

    def claims(self, path: Path) -> bool:
        return path.is_dir() or "timecode" in heads_of(path)

    def edges(self, path: Path, filmed: Filmed) -> list[Known]:
        codes = _tags(filmed) if path.is_dir() or path.name == "scene.json" else _lines(path, filmed)
        if len(codes) < 2:
            raise ValueError(
                f"{path}: expected timecodes of two videos or more; found {len(codes)}. Write them into a CSV (video, "
                "timecode)."
            )
        starts = []
        for v, text, where in codes:
            rate = filmed.rate(v, where)
            starts.append((v, seconds_of(text, rate, where), UNIFORM / rate, where))
        first = starts[0][1]
        # a recording over midnight: nearer than half a day
        starts = [(v, first + (s - first + DAY / 2) % DAY - DAY / 2, sigma, where) for v, s, sigma, where in starts]
        return star(starts, path)


def seconds_of(text: str, fps: float, where: str) -> float:
    """Seconds since midnight of a timecode at a rate. Numbers that are dropped (29.97, 59.94) are counted as they are.

    ValueError for what is no timecode, and for a frame beyond the rate.
    """
    match = CODE.fullmatch(text)
    base = round(fps)
    if match is None or int(match[2]) > 59 or int(match[3]) > 59 or int(match[5]) >= max(base, 1):
        raise ValueError(f"{where}: expected HH:MM:SS:FF with FF below {base}; found {shown(text)}. Correct it.")
    hours, minutes, seconds, frame = (int(match[k]) for k in (1, 2, 3, 5))
    count = ((hours * 60 + minutes) * 60 + seconds) * base + frame
    if match[4] != ":":
        if base not in (30, 60):
            raise ValueError(f"{where}: expected no dropped frames at {fps:.4g} fps; found {shown(text)}. Use a colon.")
        total = hours * 60 + minutes
        count -= base // 15 * (total - total // 10)
    return count / fps


def _lines(path: Path, filmed: Filmed) -> list[tuple[int, str, str]]:
    heads, rows = rows_of(path)
    if not {"video", "timecode"} <= set(heads):
        raise ValueError(
            f"{path}: expected headings video and timecode; found {', '.join(heads)}. Correct the first line."
        )
    return [(filmed.index(row["video"], f"{path}: line {n}"), row["timecode"], f"{path}: line {n}") for n, row in rows]


def _tags(filmed: Filmed) -> list[tuple[int, str, str]]:
    """Timecodes that the containers carry: of the file, or of one of its streams."""
    import av

    found = []
    for v, path in enumerate(filmed.files):
        if path is None:
            continue
        try:
            with av.open(f"file:{path.resolve()}") as container:
                tags = [container.metadata, *(stream.metadata for stream in container.streams)]
        except av.FFmpegError as error:
            raise ValueError(f"{path}: expected a readable video; {error}. Copy or remux the file.") from None
        code = next((tag["timecode"] for tag in tags if tag.get("timecode")), None)
        if code is not None:
            found.append((v, code, str(path)))
    return found
