"""The report of a recording: the same page, with pictures of what was filmed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .figures import effort
from .page import stage_bars, write_report

if TYPE_CHECKING:
    from ..io.scene import Scene
    from ..recordings.synchronized import Synchronized
    from ..types import Offsets


def write_recording_report(
    path: str | os.PathLike[str], scene: Scene, answer: Synchronized, *, truth: Sequence[float] | None = None
) -> None:
    """The report page with what the run did and what it looks like; still one file without a script."""
    known = None if truth is None else np.asarray(truth, float)
    figure = effort(answer.seconds, answers(answer), known)
    write_report(
        path,
        answer.offsets,
        answer.tracks,
        truth=truth,
        title="Synchronisation of a recording",
        videos=scene.videos,
        why=answer.why,
        cost=f"<div class=figs><div>{stage_bars(answer.seconds)}</div><div>{figure}</div></div>",
        costs=answer.route != "epipolar",
    )


def answers(answer: Synchronized) -> dict[str, Offsets]:
    """The offsets that there were after a stage."""
    if answer.route == "epipolar":
        return {"epipolar": answer.offsets}
    last = {"synchronise": answer.offsets}
    return last if answer.first is None else {"epipolar": answer.first} | last
