"""A tiny simulated recording on disk, shared by the tests of the pipeline and of the command line."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np

from recon.fit.run import Run
from recon.fit.uncertainty import Votes
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


def votes_at_once(run: Run, values: Mapping[str, object], map: object) -> list[Votes]:
    """In the place of ``Run.votes``: every frame agrees, to the last bit, and none is rendered."""
    alike = Votes(np.arange(2), np.zeros(2), np.ones(2), np.zeros(2), np.ones(2))
    return [alike] * len(run.problem.clips)
