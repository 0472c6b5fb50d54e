"""Clocks that are bent on purpose, so that a fit shows how much of an error it leaves.

The scene that a fit begins with was made with the start's clocks, of each video's own tracks and depth. So each video
agrees with itself, however wrong its clock, and a short fit keeps a share of that error; nothing in its answer tells
which. So the scene is made with every clock bent as well, by a wave, and the fit unbends it: what it leaves of the
known error it leaves of the unknown one, too (:func:`recon.fit.witnesses.told_by_bends`). Other fields call that signal
injection.

No offset may take up the wave. Frames tell of time as far as something moves in them, so the wave runs in the time that
motion makes: it is even where motion is, and stands where there is none. (A wave by the clock of a video that moves for
a third of its time looks like an offset there: clocks were .35 frame off that were .03 off without bends.)
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from otsync.types import TrackSet, Video
from recon.footage.footage import Footage

LEAST, MOST = 0.1, 5.0  # of a frame's motion, by the mean over the video
STEEPEST = 0.5  # of the time between two frames that a bend may take away or add
FOREGROUND = 127  # of a soft mask, from which on a pixel belongs to what moves


def motion_of(footage: Footage) -> Float[np.ndarray, " T"]:
    """How much moves in every frame, by its mean over the video, :data:`LEAST` to :data:`MOST`.

    That is the squared difference to the frames before and after, where masks say that something may move.
    """
    if len(footage) < 2:
        return np.ones(len(footage))
    good = ~footage.bad[1:] & ~footage.bad[:-1]
    between = np.zeros(len(good))
    for k in np.flatnonzero(good):
        change = np.square(footage.images[k + 1].astype(np.float32) - footage.images[k]).sum(-1)
        if footage.masks is not None:
            change = change * ((footage.masks[k] > FOREGROUND) | (footage.masks[k + 1] > FOREGROUND))
        between[k] = change.sum()
    footage.release()
    around = np.convolve(between, [0.5, 0.5])  # of a frame, those on either side
    return np.clip(around / max(float(around.mean()), 1e-9), LEAST, MOST) if around.any() else np.ones(len(footage))


def wave(motion: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """The bend of one second at every frame: of mean 0 and rms 1 over the motion.

    Args:
        motion: of every frame, see :func:`motion_of`.
    """
    return math.sqrt(2) * np.cos(2 * np.pi * (np.cumsum(motion) - motion / 2) / motion.sum())


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


def bent(video: Video, seconds: float, wave: Float[np.ndarray, " T"]) -> tuple[Video, float]:
    """The video with its clock bent, and by how many seconds: less than was asked for where time would stand still."""
    if not seconds or len(video.frames) < 2:
        return video, 0.0
    slope = float((np.abs(np.diff(wave)) / np.diff(video.times)).max())
    seconds = float(np.clip(seconds, -STEEPEST / slope, STEEPEST / slope)) if slope else 0.0
    return replace(video, timestamps=video.times + seconds * wave), seconds


def bent_tracks(tracks: TrackSet, video: Video, seconds: float, wave: Float[np.ndarray, " T"]) -> TrackSet:
    """Tracks of a video with its clock bent. video: before that."""
    if not seconds:
        return tracks
    return replace(tracks, timestamps=tracks.times + seconds * np.interp(tracks.times, video.times, wave))
