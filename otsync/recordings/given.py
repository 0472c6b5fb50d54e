"""Points that another program found, as tracks: in place of our own."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ..io.keypoints import Detections
from ..priors.linking import Linker

LONGEST_GAP = 10 / 30
"""Seconds that a point that nobody follows may be missing from one frame to the next it is found in."""

GATE, FASTEST, LEAST_GATE = 2.0, 4.0, 3.0
"""Of the linking: median steps of a point that it may miss the place where its velocity leads, and that it may move at
the beginning; and the least gate, in pixels at 640 of width."""


def tracks_of(found: Detections, frames: int, fps: float, unit: float, names: Sequence[str]) -> dict[str, np.ndarray]:
    """``uv`` (N,T,2) pixels, nan unseen, and ``features`` (N,D), as tracking gives them.

    Points that are followed (``who``) become a track for every name; others are joined, name by name, by where their
    velocity leads. The features tell the names apart: they mean the same thing in every video.

    Args:
        frames: T of the video. fps: of it. unit: pixels per pixel at 640 of width. names: of all videos.
    """
    tracks: list[np.ndarray] = []
    parts: list[int] = []
    for n, name in enumerate(found.names):
        own = found.take(found.part == n)
        for who in np.unique(own.who[own.who >= 0]):
            one = own.take(own.who == who)
            best = one.take(np.argsort(one.score, kind="stable"))  # of two in one frame the surer one
            uv = np.full((frames, 2), np.nan, np.float32)
            uv[best.frame] = best.xy
            tracks.append(uv[None])
            parts.append(names.index(name))
        loose = own.take(own.who < 0)
        if len(loose):
            by_frame = [loose.xy[loose.frame == k] for k in range(frames)]
            joined = _linker(by_frame, fps, unit)(by_frame)
            tracks.append(joined)
            parts += [names.index(name)] * len(joined)
    uv = np.concatenate([*tracks, np.zeros((0, frames, 2), np.float32)])
    features = np.zeros((len(uv), max(1, len(names))), np.float32)
    features[np.arange(len(uv)), parts] = 1.0
    return {"uv": uv, "features": features, "seconds": np.zeros(3)}


def names_of(points: Sequence[Detections | None]) -> tuple[str, ...]:
    """The names of the parts in all videos."""
    return tuple(sorted({name for found in points if found is not None for name in found.names}))


def _linker(by_frame: Sequence[np.ndarray], fps: float, unit: float) -> Linker:
    """A linker whose gates follow how far points move from frame to frame, the median."""
    from scipy.spatial import cKDTree

    steps = [cKDTree(after).query(before)[0] for before, after in pairwise(by_frame) if len(before) and len(after)]
    step = float(np.median(np.concatenate(steps))) if steps else 0.0
    gate = max(GATE * step, LEAST_GATE * unit)
    return Linker(gate, max(FASTEST * step, 2 * gate), round(LONGEST_GAP * fps))
