"""A tiny simulated recording on disk, shared by the tests of the pipeline and of the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from otsync.types import TrackSet
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


def filmed_anew(capture: Capture, video: int, shown: Sequence[int]) -> Capture:
    """The capture of which one video shows these frames, at its constant rate: frames are lost, or stand still."""
    f, t, z = capture.footage[video], capture.tracks[video], capture.depth[video]
    keep = np.asarray(shown)
    assert f.masks is not None and t.uv is not None
    other = replace(
        f,
        images=f.images[keep],
        masks=f.masks[keep],
        boxes=f.boxes[keep],
        bad=f.bad[keep],
        times=f.times[0] + np.arange(len(keep)) * capture.frame_step,
    )
    tracks = TrackSet(
        t.positions()[:, keep], t.seen[:, keep], t.features, t.fps, None, t.name, t.uv[:, keep], camera=t.camera
    )

    def put(items, item):
        return (*items[:video], item, *items[video + 1 :])

    return replace(
        capture,
        footage=put(capture.footage, other),
        tracks=put(capture.tracks, tracks),
        depth=put(capture.depth, [z[k] for k in keep.tolist()]),
    )
