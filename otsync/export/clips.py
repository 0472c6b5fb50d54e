"""Every video cut to what all of them show, on the common clock."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..progress import counted
from .encode import write_video
from .slot import Aligned, Clip, Export, file_names
from .sound import sound_of


class Clips(Export):
    """Every video from the first to the last moment that all show, with its sound: second 0 is the same in all.

    Frames are encoded anew and none is moved: each has its own world second as timestamp, so clips are aligned to a
    fraction of a frame, and a variable frame rate stays variable.
    """

    name = "clips"

    def targets(self, videos: Aligned, folder: Path) -> list[Path]:
        return [folder / "clips" / name for name in file_names([c.name for c in videos.clips], ".mp4")]

    def write(self, videos: Aligned, folder: Path, *, width: int, fps: float) -> list[str]:
        start, stop = videos.shared
        notes = []
        for clip, out in zip(videos.clips, self.targets(videos, folder), strict=True):
            chosen = np.flatnonzero((clip.world >= start - 1e-9) & (clip.world <= stop + 1e-9))
            if not len(chosen):
                notes.append(f"{clip.name}: no frame lies between {start:.3f} and {stop:.3f} s; it is left out")
                continue
            sound, why = sound_of(clip, start, stop)
            write_video(out, _frames(clip, chosen, start), 1 / clip.step, sound)
            notes += [why] if why else []
        return notes


def _frames(clip: Clip, chosen: np.ndarray, start: float) -> Iterator[tuple[float, np.ndarray]]:
    for k in counted(chosen, f"cutting {clip.name}", "frame", len(chosen)):
        yield max(0.0, float(clip.world[k]) - start), np.asarray(clip.video.frames[int(clip.index[k])])
