"""The sound of a video file on the common clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..io.frames import CONTAINERS, FrameRange, VideoFrames
from .slot import Clip

RATE = 48_000
"""Samples a second that sound is written with."""

MARGIN = 0.5
"""Seconds of sound that are read before and after what is wanted: frames of sound begin where they like."""


def sound_of(clip: Clip, start: float, stop: float) -> tuple[Float[np.ndarray, "C N"] | None, str]:
    """Samples of world seconds ``start`` to ``stop``, and why there are none ("" where there are).

    The k-th sample is what was heard at ``start + k / RATE``; silence where the file has no sound.
    """
    path = clip.file
    if path is None:
        return None, ""
    if clip.broken:
        return None, f"{clip.name}: its clock breaks, so its sound is left out"
    world = start + np.arange(max(1, round((stop - start) * RATE))) / RATE
    inside = container_seconds(clip, np.asarray(clip.clock.own(world), float))
    samples, first = _decoded(path, float(inside[0]), float(inside[-1]))
    return (None, "") if samples is None else (_sampled(samples, (inside - first) * RATE), "")


def container_seconds(clip: Clip, own: np.ndarray) -> np.ndarray:
    """Seconds of the file's own timestamps, where a recording declares another rate than the file does."""
    frames, picks = clip.video.frames, np.arange(len(clip.video.frames))
    while isinstance(frames, FrameRange):
        picks, frames = np.asarray(frames.picks)[picks], frames.base
    assert isinstance(frames, VideoFrames)
    inside, times = frames.timestamps[picks], clip.video.times
    if np.abs(inside - times).max() < 1e-9:
        return own
    if len(times) < 2:
        return own + (inside[0] - times[0])
    found = np.interp(own, times, inside)
    for end, side in ((0, own < times[0]), (-1, own > times[-1])):  # beyond the frames at their mean rate
        slope = (inside[-1] - inside[0]) / (times[-1] - times[0])
        found[side] = inside[end] + slope * (own[side] - times[end])
    return found


def _sampled(samples: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Samples [C,N] at fractional indices, in between by a straight line; silence beyond."""
    whole = np.floor(at).astype(np.int64)
    share = (at - whole).astype(np.float32)
    padded = np.pad(samples, ((0, 0), (1, 2)))
    whole = np.clip(whole + 1, 0, padded.shape[1] - 2)
    return (1 - share) * padded[:, whole] + share * padded[:, whole + 1]


def _decoded(path: Path, start: float, stop: float) -> tuple[Float[np.ndarray, "C N"] | None, float]:
    """The samples of a file from ``start`` to ``stop`` of its own timestamps at RATE, one or two channels, and the
    second of the first of them."""
    import av

    with av.open(f"file:{path.resolve()}", options={"format_whitelist": CONTAINERS}) as container:
        if not container.streams.audio:
            return None, 0.0
        stream = container.streams.audio[0]
        layout = "mono" if stream.codec_context.channels == 1 else "stereo"
        resampler = av.AudioResampler(format="fltp", layout=layout, rate=RATE)
        pieces: list[tuple[float, np.ndarray]] = []
        for frame in container.decode(stream):
            seconds = frame.time
            if seconds is None or seconds < start - MARGIN:
                continue
            if seconds > stop + MARGIN:
                break
            pieces += [
                (seconds if part.time is None else part.time, part.to_ndarray()) for part in resampler.resample(frame)
            ]
    if not pieces:
        return None, 0.0
    first, (last, tail) = pieces[0][0], pieces[-1]
    samples = np.zeros((len(tail), round((last - first) * RATE) + tail.shape[1]), np.float32)
    for seconds, piece in pieces:  # by timestamp: a gap in the recording stays a gap
        n = max(0, round((seconds - first) * RATE))
        piece = piece[:, : max(0, samples.shape[1] - n)]
        samples[:, n : n + piece.shape[1]] = piece
    return samples, first
