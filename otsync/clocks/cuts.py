"""Cuts that a video shows by itself: between two frames everything is elsewhere at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

from ..types import Break, TrackSet

BESIDE = 3
"""Frames on either side of a step that it is compared with."""

SUDDEN = 2.5
"""Times the largest step beside it that the step of a cut is, the median over the tracks. A frame that was lost makes
two of one; whoever moves fast comes from slower, and goes on."""

LEAST = 5
"""Tracks that must be seen on both sides of a step."""

RHYTHM = 30
"""Frames that a cut must be worth: where more steps are sudden, pictures repeat (6 a second in a file of 30)."""

BLOCK = 4096
"""Frames at a time: all steps of an hour would take a gigabyte."""


def cuts(tracks: TrackSet) -> Float[np.ndarray, " K"]:
    """The moments, s of the video's own clock, of the frames behind its cuts; none where there are no positions.

    A recorder that was paused, frames that were lost, a picture that froze and then caught up: whatever happened to the
    clock, it happened here. A freeze and its end, where the file goes on with what came next, are no cuts.
    """
    if tracks.xyz is None or tracks.n_frames < 2 * BESIDE + 2:
        return np.zeros(0)
    told = _median_steps(tracks)
    around = sliding_window_view(told, 2 * BESIDE + 1)
    largest = np.delete(around, BESIDE, 1).max(1)  # nan beside what is not seen: nothing is said there
    sudden = np.flatnonzero(around[:, BESIDE] > SUDDEN * largest) + BESIDE
    if len(sudden) * RHYTHM > len(told):
        return np.zeros(0)
    return tracks.times[sudden + 1]


def _median_steps(tracks: TrackSet) -> Float[np.ndarray, " T-1"]:
    """How far the tracks go from each frame to the next, in the middle; nan where few are seen."""
    told = np.full(tracks.n_frames - 1, np.nan)
    for first in range(0, len(told), BLOCK):
        x = tracks.positions(frames=slice(first, first + BLOCK + 1))
        step = np.sqrt(np.square(np.diff(x, axis=1)).sum(2))
        known = np.flatnonzero(np.isfinite(step).sum(0) >= LEAST)
        told[first + known] = np.nanmedian(step[:, known], 0)
    return told


EXPLAINED = 0.2
"""Seconds within which a break explains a cut: it is measured by motion, which is slow."""


def unexplained(at: Float[np.ndarray, " K"], breaks: Sequence[Break]) -> Float[np.ndarray, " K"]:
    """The cuts of a video that none of the breaks of its clock explains."""
    known = np.array([b.at for b in breaks])
    far = [not len(known) or bool(np.abs(known - cut).min() > EXPLAINED) for cut in at]
    return at[np.array(far, bool)]
