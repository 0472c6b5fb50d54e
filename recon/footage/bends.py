"""Clocks that are bent on purpose, so that a fit shows how much of an error it leaves.

The scene that a fit begins with was made with the start's clocks, of each video's own tracks and depth. So each video
agrees with itself, however wrong its clock, and a short fit keeps a share of that error; nothing in its answer tells
which. So the scene is made with every clock bent as well, by a curve that no offset and no rate can take up, and the
fit unbends it: what it leaves of the known error it leaves of the unknown one, too
(:func:`recon.fit.witnesses.told_by_bends`). Other fields call that signal injection.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from otsync.types import TrackSet, Video


def bend_curve(times: Float[np.ndarray, " T"], span: tuple[float, float] | None = None) -> Float[np.ndarray, " T"]:
    """The curve of a bend of one second: a wave over the video, of mean 0 and rms 1, without a slope.

    Args:
        times: seconds on the video's clock. span: its first and last; default: those of ``times``.
    """
    first, last = (float(times[0]), float(times[-1])) if span is None else span
    return math.sqrt(2) * np.cos(2 * np.pi * (times - first) / max(last - first, 1e-9))


def chosen_bends(
    sigma: Float[np.ndarray, " V"], frame_step: float, most: float, seed: int = 0
) -> Float[np.ndarray, " V"]:
    """Seconds by which each video's clock is bent: as far as the clocks may be off, half of them one way.

    All 0 where no clock has a sigma: what a fit keeps of errors that nobody knows the size of is not asked.

    Args:
        sigma: one standard deviation of the offsets that the fit begins with, seconds; nan or 0: none.
        frame_step: seconds of a frame. most: frames of a bend at the most. seed: of the signs.
    """
    known = sigma[np.isfinite(sigma) & (sigma > 0)]
    size = min(most * frame_step, float(np.median(known))) if len(known) else 0.0
    return size * np.random.default_rng([seed, 3]).permutation(np.resize([1.0, -1.0], len(sigma)))


def bent(video: Video, seconds: float) -> Video:
    """The video with its clock bent."""
    if not seconds:
        return video
    return replace(video, fps=None, timestamps=video.times + seconds * bend_curve(video.times))


def bent_tracks(tracks: TrackSet, video: Video, seconds: float) -> TrackSet:
    """Tracks of a video with its clock bent. video: before that."""
    if not seconds:
        return tracks
    span = float(video.times[0]), float(video.times[-1])
    return replace(tracks, fps=None, timestamps=tracks.times + seconds * bend_curve(tracks.times, span))
