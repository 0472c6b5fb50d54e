"""Tracks of things too small for optical flow: one point a thing, its middle; and the choice between both ways."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from .linking import Linker
from .masks import components, typical_area
from .points import ChainedFlow
from .slots import Tracker
from .working import WorkingFrames


@dataclass(frozen=True)
class Blobs:
    """Every component of the foreground is one thing, tracked by its middle: insects, bats, balls, far-off animals.

    The middle is that of the grey values that differ from what surrounds the component, to a tenth of a pixel where
    things are small and clear. Detections of neighbouring frames are joined by :class:`otsync.priors.linking.Linker`.

    Args:
        size: pixels across at 640 of width; None: as measured.
        gate: sizes by which a thing may miss the place that its velocity leads to. fastest: sizes a frame at which a
            track may begin. Both at 30 frames a second: at half the rate things go twice as far.
        largest: a component of more than so many times the typical area is several things, or none.
        max_gap, min_life: frames at 30 fps, as of :class:`ChainedFlow`. most: tracks that are returned.
    """

    size: float | None = None
    gate: float = 0.6
    fastest: float = 3.0
    largest: float = 4.0
    max_gap: int = 3
    min_life: int = 8
    most: int = 4000

    def __call__(self, frames: WorkingFrames, masks: Sequence[np.ndarray], fps: float) -> Float[np.ndarray, "N T 2"]:
        """Working pixel indices of every track, nan where it is not seen."""
        area = typical_area(masks, frames.unit)
        size = np.sqrt(area) if self.size is None else self.size * frames.unit
        if size == 0:
            return np.zeros((0, len(frames), 2), np.float32)
        found, areas = [], []
        for k in range(len(frames)):
            parts = components(masks[k])
            parts = parts[parts[:, 2] <= self.largest * size**2]
            found.append(middles(frames.gray(k), parts, size))
            areas.append(parts[:, 2])
        slow = max(1.0, 30 / fps)
        pace = Linker(self.gate * size * slow, self.fastest * size * slow, round(self.max_gap * fps / 30))
        uv = pace(found, areas)
        life = np.isfinite(uv[..., 0]).sum(1)
        chosen = np.flatnonzero(life >= min(lives(self.min_life, fps), len(frames)))
        return uv[np.sort(chosen[np.argsort(-life[chosen], kind="stable")[: self.most]])]


@dataclass(frozen=True)
class BySize:
    """Optical flow where things are large enough for it, blobs where they are not: the default.

    Args:
        small: pixels across (the root of the area of a typical component) below which a thing is a blob. It does not
            scale with the image: flow needs so many pixels.
        large, blobs: what is chosen from.
    """

    small: float = 16.0
    large: Tracker = field(default_factory=ChainedFlow)
    blobs: Tracker = field(default_factory=Blobs)

    def __call__(self, frames: WorkingFrames, masks: Sequence[np.ndarray], fps: float) -> Float[np.ndarray, "N T 2"]:
        """Working pixel indices of every track, nan where it is not seen."""
        area = typical_area(masks, frames.unit)
        chosen = self.blobs if 0 < area < self.small**2 else self.large
        return chosen(frames, masks, fps)


def lives(frames: int, fps: float) -> int:
    """Frames of a life that is given at 30 fps: three and more, whatever the rate."""
    return max(3, round(frames * fps / 30))


def middles(gray: UInt8[np.ndarray, "h w"], parts: Float[np.ndarray, "n 3"], size: float) -> Float[np.ndarray, "n 2"]:
    """Middles of components, weighted by what differs from their surroundings: pixel indices.

    ``parts``: middle and area of each; ``size``: pixels across.
    """
    h, w = gray.shape
    out = parts[:, :2].copy()
    for n, (x, y, area) in enumerate(parts):
        reach = int(np.ceil(0.75 * max(size, np.sqrt(area)))) + 1
        x0, x1, y0, y1 = int(x) - reach, int(x) + reach + 2, int(y) - reach, int(y) + reach + 2
        if x0 < 0 or y0 < 0 or x1 > w or y1 > h:
            continue
        box = gray[y0:y1, x0:x1].astype(float)
        edge = np.concatenate([box[0], box[-1], box[1:-1, 0], box[1:-1, -1]])
        level = np.median(edge)
        noise = 3 * 1.4826 * np.median(np.abs(edge - level))
        weight = np.maximum(np.abs(box - level) - noise, 0)
        total = weight.sum()
        if total > 0:
            at = np.array([(weight.sum(0) * np.arange(x0, x1)).sum(), (weight.sum(1) * np.arange(y0, y1)).sum()])
            refined = at / total
            if np.abs(refined - (x, y)).max() < 0.5 * size:  # else a neighbour is in the box
                out[n] = refined
    return out
