"""Whether a video's frames are shown better at another time of the scene.

A fit looks for each clock near where it began, and its votes (:mod:`recon.fit.parts`) tell of a frame or less. Of a
video that began many frames off, shows a second twice, stands still or runs backwards, the votes are noise beside that,
and an offset that shows few of its frames well is found surely. The scene follows the other videos, though. So the
frames of each video that are shown worst are held against what its camera would see earlier and later: where that is
far better, its clock is wrong there.

What repeats itself looks alike at two times, and equally well. A scene of few videos takes in the one that is wrong and
then shows it well (:mod:`recon.fit.leave_one_out` asks these); a scene of many takes in some of it, and others are
shown worse there, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True)
class OtherTimes:
    """Frames beside what their camera would see earlier and later.

    Args:
        look, target: as of :func:`recon.fit.uncertainty.cast`. empty: (video, frame) -> the image that the scene gives
            without what moves. time: (video, frame) -> seconds of the scene.
        frame_step: seconds of a frame, the least lag. ahead: lags in seconds; as many are behind.
    """

    look: Look
    empty: Target
    target: Target
    time: Time
    frame_step: float
    ahead: tuple[float, ...] = LAGS

    @property
    def lags(self) -> np.ndarray:
        """[L] seconds, 0 among them."""
        ahead = sorted({max(lag, self.frame_step) for lag in self.ahead})
        return np.array([*(-lag for lag in reversed(ahead)), 0.0, *ahead])

    def errors(self, key: tuple[int, int], first: float, last: float) -> np.ndarray:
        """(1+L,) sums of squares of a frame: without what moves, and by lag; nan before ``first`` and after ``last``,
        seconds of the scene.
        """
        at = float(self.time(*key)) + self.lags
        row = np.full(1 + len(at), np.nan)
        with torch.no_grad():  # per thread
            own = self.target(*key)
            row[0] = _squares(self.empty(*key), own)
            for n in np.flatnonzero((self.lags == 0) | (at >= first) & (at <= last)).tolist():
                row[1 + n] = _squares(self.look(*key, float(self.lags[n])), own)
        return row

    def of(self, frames: Sequence[int], rows: Sequence[np.ndarray]) -> Lagged:
        """Some frames of a video, whose :meth:`errors` are known."""
        told = np.array(rows).reshape(-1, 1 + len(self.lags))
        return Lagged(np.array(frames, int), self.lags, told[:, 1:], told[:, 0])


def lagged(times: OtherTimes, votes: Sequence[Votes], map: MapLike = map) -> list[Lagged]:
    """The frames of each video that its scene shows worst, at other times.

    Args:
        votes, map: as of :func:`recon.fit.uncertainty.cast`. The first and the last frame that voted bound the lags.
    """
    ends = [float(times.time(v, own.frames[n])) for v, own in enumerate(votes) if len(own.frames) for n in (0, -1)]
    worst = [own.frames[np.argsort(-_misfit(own), kind="stable")[:FRAMES]].tolist() for own in votes]
    found: dict[tuple[int, int], np.ndarray] = {}

    def ask(keys: list[tuple[int, int]]) -> list[Lagged]:
        found.update(zip(keys, map(lambda key: times.errors(key, min(ends), max(ends)), keys), strict=True))
        asked = [[k for k in own if (v, k) in found] for v, own in enumerate(worst)]
        return [times.of(own, [found[v, k] for k in own]) for v, own in enumerate(asked)]

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
