"""Whether a video's frames are shown better at another time of the scene.

A fit looks for each clock near where it began, and its votes (:mod:`recon.fit.parts`) tell of a frame or less. Of a
video that began many frames off, shows a second twice, stands still or runs backwards, the votes are noise beside that,
and an offset that shows few of its frames well is found surely. The scene follows the other videos, though. So the
frames of each video that are shown worst are held against what its camera would see earlier and later: where that is
far better, its clock is wrong there.

Of frames that are shown at their own time, the next ones show even the worst worse, after any fit that shows something
at all. What repeats itself looks alike at two times, and equally well; two videos that see nothing in common are each
shown well by a scene of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, SupportsFloat

import numpy as np
import torch

from otsync.compute.threads import MapLike
from recon.fit.uncertainty import Look, Target, Votes

Time = Callable[[int, int], SupportsFloat]

FIRST = 4
"""Frames of each video that are held against other times: those that are shown worst."""

FRAMES = 8
"""The same, of a video of which another time shows one of the first ones better."""

LAGS = (1, 2, 4, 7, 11, 15, 20, 25, 30)
"""Frames, earlier and later. Things are about where they were for longer than the gaps between them; one clock in three
that was 15 frames off was missed by lags of 11 and 19 (seeds 584 to 586)."""

STILL = 0.1
"""Of the usual rate of change, that a frame is taken to have more than its own."""

PROMISING = 1.0
"""Of the sum of squares at a frame's own time, below which another time shows it better."""

LEAST = 2
"""Frames that are shown far better at other times, from which on a clock is wrong."""

BETTER = 0.8, 0.95
"""Of the sum of squares at its own time, below which another time shows a frame far better: where the other videos'
worst frames are shown little worse at other times, and where they are shown much worse. After short and poor fits the
second lowest of eight was .88 and more in the 35 videos of ``otsync bench films --seeds 6 --first-seed 80172``, and
the others' were about one. It is 1.5 and more in fourteen cameras of basketball, and .2 to .9 in clocks that were 5 to
30 frames off, where the others' were 1.6 and more (seeds 584 to 592)."""

USUAL = 0.6
"""Of the other videos' second lowest, below which a video's own is far better, within these bounds."""


class Lagged(NamedTuple):
    """How badly frames of one video are shown at other times.

    frames: [K] which. lags: [L] frames, 0 among them. errors: [K,L] sum of squares of the pixels; nan where the scene
    has no such time.
    """

    frames: np.ndarray
    lags: np.ndarray
    errors: np.ndarray


def lagged(
    look: Look, target: Target, time: Time, votes: Sequence[Votes], frame_step: float, map: MapLike = map
) -> list[Lagged]:
    """The frames of each video that its scene shows worst, at other times.

    Args:
        look, target, votes, map: as of :func:`recon.fit.uncertainty.cast`.
        time: (video, frame) -> seconds of the scene. The first and the last frame that voted bound the lags.
        frame_step: seconds of a frame, the unit of lags.
    """
    lags = np.array([*(-lag for lag in reversed(LAGS)), 0, *LAGS])
    ends = [float(time(v, own.frames[n])) for v, own in enumerate(votes) if len(own.frames) for n in (0, -1)]
    worst = [own.frames[np.argsort(-_misfit(own), kind="stable")[:FRAMES]].tolist() for own in votes]

    def errors(key: tuple[int, int]) -> np.ndarray:
        at = float(time(*key)) + lags * frame_step
        known = (lags == 0) | (at >= min(ends)) & (at <= max(ends))
        return _errors(look, target, key, np.where(known, lags * frame_step, np.nan))

    found: dict[tuple[int, int], np.ndarray] = {}

    def ask(keys: list[tuple[int, int]]) -> list[Lagged]:
        found.update(zip(keys, map(errors, keys), strict=True))
        asked = [[k for k in own if (v, k) in found] for v, own in enumerate(worst)]
        rows = [np.array([found[v, k] for k in own]).reshape(-1, len(lags)) for v, own in enumerate(asked)]
        return [Lagged(np.array(own, int), lags, row) for own, row in zip(asked, rows, strict=True)]

    at_first = ask([(v, k) for v, own in enumerate(worst) for k in own[:FIRST]])
    doubted = [v for v, one in enumerate(at_first) if (_ratios(one) < PROMISING).any()]
    return ask([(v, k) for v in doubted for k in worst[v][FIRST:]])


def displaced(shown: Sequence[Lagged]) -> list[int]:
    """Videos that show frames of other times of the scene than their clocks say."""
    lowest = [np.sort(_ratios(one))[LEAST - 1] if len(one.frames) >= LEAST else np.inf for one in shown]
    out = []
    for v, own in enumerate(lowest):
        others = [x for u, x in enumerate(lowest) if u != v and np.isfinite(x)]
        if own < np.clip(USUAL * np.median(others) if others else 0.0, *BETTER):
            out.append(v)
    return out


def _ratios(one: Lagged) -> np.ndarray:
    """[K] the least error of another time, as a share of that of a frame's own; inf where nothing can be better."""
    own, other = one.errors[:, one.lags == 0][:, 0], one.errors[:, one.lags != 0]
    least = np.where(np.isfinite(other), other, np.inf).min(1, initial=np.inf)
    return np.divide(least, own, out=np.full(len(own), np.inf), where=own > 0)


def _misfit(own: Votes) -> np.ndarray:
    """[K] how badly each frame is shown, as seconds² that time would be off; of where nothing moves, little."""
    usual = own.rate.mean() if len(own.rate) else 0.0
    return own.residual / np.maximum(own.rate + STILL * usual, 1e-12)


def _errors(look: Look, target: Target, key: tuple[int, int], later: np.ndarray) -> np.ndarray:
    """[L] sum of squares of a frame, by seconds; nan where those are."""
    with torch.no_grad():  # per thread
        own = target(*key)
        return np.array(
            [np.nan if np.isnan(t) else float((look(*key, t) - own).double().square().sum()) for t in later.tolist()]
        )
