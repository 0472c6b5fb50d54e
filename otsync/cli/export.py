"""``otsync export``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from ..export import EXPORTS
from ..progress import tell

WIDTH = 320


@dataclass
class Export:
    """Write the videos of a recording on their common clock, for eyes and for other programs.

    Example: otsync export recording/ --offsets result/offsets.json --out synchronised

    For nerfstudio, with exact times: otsync export recording/ --offsets result/offsets.json --what nerfstudio

    Only a mosaic, as filmed beside synchronised: otsync export recording/ --offsets result/offsets.json --what mosaic
    """

    recording: tyro.conf.Positional[Path]
    """A scene.json, or a folder that holds one, or a folder in Panoptic layout."""
    offsets: Path
    """offsets.json as otsync sync and otsync run write it."""
    out: Path = Path("synchronised")
    """Folder for mosaic.mp4, clips/, frames.csv, timeline.otio, timeline.fcpxml, and folders of datasets."""
    what: tuple[Literal[tuple(e.name for e in EXPORTS)], ...] = tuple(e.name for e in EXPORTS if e.default)
    """mosaic: one video of all, as filmed beside synchronised. clips: every video, cut to what all show, with its
    sound. copies: the same from a key frame on, nothing encoded anew. frames: a table of the frames that belong
    together. timeline: OpenTimelineIO, for editors. fcpxml: the same for Final Cut Pro and DaVinci Resolve, in whole
    frames. nerfstudio, dynamic3dgs, colmap: images, cameras and times in the layouts that other reconstructions
    read."""
    cameras: tuple[str, ...] = ()
    """Names of the videos to write; default: all that have an offset."""
    width: int | None = None
    """Pixels of one video in the mosaic; default: 320."""
    fps: float | None = None
    """Frames per second of the mosaic and the table; default: the reference's."""
    force: bool = False
    """Replace files that are there already."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""

    def run(self) -> int:
        from ..export import aligned
        from ..files.claim import claimed
        from ..io import open_scene
        from ..types import Offsets

        chosen = [e for e in EXPORTS if e.name in self.what]
        if not chosen:
            raise ValueError(f"--what: expected some of {', '.join(e.name for e in EXPORTS)}; found none.")
        for option in ("width", "fps"):
            heeding = [e.name for e in EXPORTS if option in e.heeds]
            if getattr(self, option) is not None and not any(option in e.heeds for e in chosen):
                raise ValueError(
                    f"--{option}: expected with {' or '.join(heeding)} in --what; found {' '.join(self.what)}."
                )
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise ValueError(f"--fps: expected frames per second above 0, at most 1000; found {self.fps:g}.")
        if self.width is not None and not 16 <= self.width <= 4096:
            raise ValueError(f"--width: expected 16 to 4096 pixels; found {self.width}.")
        scene = open_scene(self.recording, allow_outside=self.allow_outside)
        if self.cameras:
            scene = scene.take(self.cameras)
        videos = aligned(scene, Offsets.load(self.offsets))
        for name, why in videos.left_out.items():
            tell(f"note: {name} is left out: {why}")
        there = [path for e in chosen for path in e.targets(videos, self.out) if path.exists()]
        if there and not self.force:
            raise ValueError(f"{there[0]}: exists already. Pass --force to replace it, or --out for another place.")
        with claimed(self.out, "otsync export", keep=False):
            for export in chosen:
                notes = export.write(videos, self.out, width=self.width or WIDTH, fps=self.fps or videos.fps)
                for note in notes:
                    tell(f"note: {note}")
                written = [path for path in export.targets(videos, self.out) if path.exists()]
                if written:
                    files = written[0] if len(written) == 1 else f"{len(written)} files to {written[0].parent}"
                    print(f"wrote {files}")
        return 0
