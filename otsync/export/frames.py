"""Which frames belong together."""

from __future__ import annotations

import csv
from pathlib import Path

from ..files.arrays import atomic_write
from .slot import Aligned, Export, grid


class FrameList(Export):
    """A table with a row for every moment of the common clock, and the frame of each video that is nearest to it."""

    name = "frames"
    heeds = frozenset({"fps"})

    def targets(self, videos: Aligned, folder: Path) -> list[Path]:
        return [folder / "frames.csv"]

    def write(self, videos: Aligned, folder: Path, *, width: int, fps: float) -> list[str]:
        with atomic_write(folder / "frames.csv", "w") as stream:
            rows = csv.writer(stream, lineterminator="\n")
            columns = ("frame", "own_seconds", "late_seconds")
            rows.writerow(["world_seconds", *(f"{c.name} {column}" for c in videos.clips for column in columns)])
            places = [{int(k): n for n, k in enumerate(c.index)} for c in videos.clips]
            for t in grid(videos, videos.span, fps):
                row: list[str | int] = [f"{t:.6f}"]
                for clip, place in zip(videos.clips, places, strict=True):
                    k = clip.nearest(float(t))
                    if k < 0:
                        row += ["", "", ""]
                        continue
                    n = place[k]
                    row += [k, f"{clip.video.times[k]:.6f}", f"{clip.world[n] - t:.6f}"]
                rows.writerow(row)
        return []
