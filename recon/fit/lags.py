"""Whether a video's frames are shown better at another time of the scene.

A fit looks for each clock near where it began, and its votes (:mod:`recon.fit.parts`) tell of a frame or less. Of a
video that began many frames off, shows a second twice, stands still or runs backwards, the votes are noise beside that,
and an offset that shows few of its frames well is found surely. The scene follows the other videos, though. So the
frames of each video that are shown worst are held against what its camera would see earlier and later: where that is
far better, its clock is wrong there.

What repeats itself looks alike at two times, and equally well. A scene of few videos takes in the one that is wrong and
then shows it well; a scene of many takes in some of it, and others are shown worse there, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, SupportsFloat

import numpy as np
import torch
from torch import Tensor

from otsync.compute.threads import MapLike
from recon.fit.uncertainty import Look, Target, Votes

Time = Callable[[int, int], SupportsFloat]

FIRST = 4
"""Frames of each video that are held against other times: those that are shown worst."""

FRAMES = 8
"""The same, of a video of which another time shows one of the first ones better."""

LAGS = tuple(n / 30 for n in (1, 2, 4, 7, 11, 15, 20, 25, 30))
"""Seconds, earlier and later; those below a frame are one. Things are about where they were for longer than the gaps
between them; one clock in three that was half a second off was missed by lags of 11 and 19 frames (seeds 584 to
586)."""

STILL = 0.1
"""Of the usual rate of change, that a frame is taken to have more than its own."""

PROMISING = 1.0
"""Of the sum of squares at a frame's own time, below which another time shows it better."""

LEAST = 2
"""Frames that are shown far better at other times, from which on a clock is wrong."""

BETTER = 0.8
"""Of the sum of squares at its own time, below which another time shows a frame far better. After short and poor fits
the second lowest of eight was .88 and more in 58 videos of films (``otsync bench films --seeds 12 --first-seed
80172``); of three frames and fewer lags it was 1.6 and more in fourteen cameras of basketball. It is .2 to .7 in most
clocks that are 5 to 30 frames off."""

NOTHING = 0.9
"""Of the sum of squares of the scene without what moves, that another time must be below as well. Where a post stands
before what moves, and the scene draws that over it, a time at which it is elsewhere is better, and nothing is best."""


class Lagged(NamedTuple):
    """How badly frames of one video are shown at other times.

    frames: [K] which. lags: [L] seconds, 0 among them. errors: [K,L] sum of squares of the pixels; nan where the scene
    has no such time. nothing: [K] the same of the scene without what moves.
    """

    frames: np.ndarray
    lags: np.ndarray
    errors: np.ndarray
    nothing: np.ndarray


def lagged(
    look: Look,
    empty: Target,
    target: Target,
    time: Time,
    votes: Sequence[Votes],
    frame_step: float,
    map: MapLike = map,
) -> list[Lagged]:
    """The frames of each video that its scene shows worst, at other times.

    Args:
        look, target, votes, map: as of :func:`recon.fit.uncertainty.cast`.
        empty: (video, frame) -> the image that the scene gives without what moves.
        time: (video, frame) -> seconds of the scene. The first and the last frame that voted bound the lags.
        frame_step: seconds of a frame, the least lag.
    """
    ahead = sorted({max(lag, frame_step) for lag in LAGS})
    lags = np.array([*(-lag for lag in reversed(ahead)), 0.0, *ahead])
    ends = [float(time(v, own.frames[n])) for v, own in enumerate(votes) if len(own.frames) for n in (0, -1)]
    worst = [own.frames[np.argsort(-_misfit(own), kind="stable")[:FRAMES]].tolist() for own in votes]

    def errors(key: tuple[int, int]) -> np.ndarray:
        """(1+L,) of a frame: without what moves, and by lag."""
        at = float(time(*key)) + lags
        row = np.full(1 + len(lags), np.nan)
        with torch.no_grad():  # per thread
            own = target(*key)
            row[0] = _squares(empty(*key), own)
            for n in np.flatnonzero((lags == 0) | (at >= min(ends)) & (at <= max(ends))).tolist():
                row[1 + n] = _squares(look(*key, float(lags[n])), own)
        return row

    found: dict[tuple[int, int], np.ndarray] = {}

    def ask(keys: list[tuple[int, int]]) -> list[Lagged]:
        found.update(zip(keys, map(errors, keys), strict=True))
        asked = [[k for k in own if (v, k) in found] for v, own in enumerate(worst)]
        rows = [np.array([found[v, k] for k in own]).reshape(-1, 1 + len(lags)) for v, own in enumerate(asked)]
        return [Lagged(np.array(own, int), lags, r[:, 1:], r[:, 0]) for own, r in zip(asked, rows, strict=True)]

    at_first = ask([(v, k) for v, own in enumerate(worst) for k in own[:FIRST]])
    doubted = [v for v, one in enumerate(at_first) if (_ratios(one) < PROMISING).any()]
    return ask([(v, k) for v in doubted for k in worst[v][FIRST:]])


def displaced(shown: Sequence[Lagged]) -> list[int]:
    """Videos that show frames of other times of the scene than their clocks say."""
    return [v for v, one in enumerate(shown) if int((_ratios(one) < BETTER).sum()) >= LEAST]


def _ratios(one: Lagged) -> np.ndarray:
    """[K] the least error of another time, as a share of that of a frame's own; inf where it tells nothing."""
    own, other = one.errors[:, one.lags == 0][:, 0], one.errors[:, one.lags != 0]
    least = np.where(np.isfinite(other), other, np.inf).min(1, initial=np.inf)
    tells = (own > 0) & (least < NOTHING * one.nothing)
    return np.divide(least, own, out=np.full(len(own), np.inf), where=tells)


def _misfit(own: Votes) -> np.ndarray:
    """[K] how badly each frame is shown, as seconds² that time would be off; of where nothing moves, little."""
    usual = own.rate.mean() if len(own.rate) else 0.0
    return own.residual / np.maximum(own.rate + STILL * usual, 1e-12)


def _squares(image: Tensor, own: Tensor) -> float:
    return float((image - own).double().square().sum())
