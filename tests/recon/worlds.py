"""A tiny simulated recording on disk, shared by the tests of the pipeline and of the command line."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from recon.simulate.capture import Capture, synthetic
from recon.simulate.recording import write_capture

SIZE = (96, 64)
CAMERAS, FRAMES = 3, 14


@cache
def capture() -> Capture:
    return synthetic(5, cameras=CAMERAS, held_out=1, frames=FRAMES, size=SIZE, offsets=0.8)


def write_world(folder: Path, **options: bool) -> Path:
    write_capture(capture(), folder, **options)
    return folder
