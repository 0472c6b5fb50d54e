"""Foreground masks: which pixels of a video move, at working resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ..compute.indices import evenly
from ..files.digest import sequence_key
from ..geometry import fundamental, sampson
from ..types import Camera
from .flow import DISFlow
from .working import WorkingFrames


@dataclass(frozen=True)
class MedianBackground:
    """Static camera: what differs from the temporal median. IoU .72-.79 with given masks on basketball.

    Args:
        threshold: grey levels (of 255) in any channel.
        min_area: pixels of a component at 640 of width; None: 300, or less where what moves is small (:func:`tidied`).
        samples: frames that the median is taken of; bounds the memory (50 frames of 640 x 360 are 35 MB).
    """

    threshold: int = 12
    min_area: int | None = None
    samples: int = 50

    def __call__(self, frames: WorkingFrames, camera: Camera) -> Bool[np.ndarray, "T h w"]:
        import cv2

        picks = evenly(len(frames), self.samples)
        looks = {int(k): frames[int(k)] for k in picks}
        background = median_of(list(looks.values()))
        out = np.zeros((len(frames), frames.size[1], frames.size[0]), bool)
        for k in range(len(frames)):
            frame = looks[k] if k in looks else frames[k]
            near = cv2.inRange(cv2.absdiff(frame, background), (0,) * 3, (self.threshold,) * 3)
            out[k] = near == 0  # in any channel
        return tidied(out, frames.unit, self.min_area)


AT_ONCE = 8192
"""Values of every image that are sorted together: of 50 images they fit into the second cache."""


def median_of(images: Sequence[UInt8[np.ndarray, "*S"]]) -> UInt8[np.ndarray, "*S"]:
    """The median of images, value by value; of an even number the mean of both in the middle, rounded down.

    Batcher's merge exchange sorts whole stretches of the images by minima and maxima: a fifth of numpy's time.
    """
    n = len(images)
    out = np.empty(images[0].shape, np.uint8)
    order, flat, rows = exchanges(n), out.reshape(-1), [np.asarray(image).reshape(-1) for image in images]
    for start in range(0, len(flat), AT_ONCE):
        part = [row[start : start + AT_ONCE].copy() for row in rows]
        spare = np.empty_like(part[0])
        for i, j in order:
            np.minimum(part[i], part[j], out=spare)
            np.maximum(part[i], part[j], out=part[j])
            part[i], spare = spare, part[i]
        low, high = part[(n - 1) // 2], part[n // 2]
        flat[start : start + AT_ONCE] = (low.astype(np.uint16) + high) >> 1
    return out


def exchanges(n: int) -> list[tuple[int, int]]:
    """Pairs (i, j) that a list of ``n`` is sorted by, the smaller to i, as far as its middle depends on them (Knuth,
    The Art of Computer Programming 3, 5.2.2, algorithm M).
    """
    pairs, p = [], 1
    while p < n:
        k = p
        while k:
            for j in range(k % p, n - k, 2 * k):
                for i in range(j, min(j + k, n - k)):
                    if i // (2 * p) == (i + k) // (2 * p):
                        pairs.append((i, i + k))
            k //= 2
        p *= 2
    needed, kept = {(n - 1) // 2, n // 2}, []
    for i, j in reversed(pairs):
        if i in needed or j in needed:
            needed |= {i, j}
            kept.append((i, j))
    return kept[::-1]


@dataclass(frozen=True)
class GivenMasks:
    """Masks that came with the recording, brought to working resolution."""

    masks: Sequence[np.ndarray]

    @property
    def cache_key(self) -> tuple[str, str]:
        """The pixels of the masks, wherever they come from."""
        return "given", sequence_key(self.masks)

    def __call__(self, frames: WorkingFrames, camera: Camera) -> Bool[np.ndarray, "T h w"]:
        return np.stack([frames.mask(np.asarray(m)) for m in self.masks])


@dataclass(frozen=True)
class FlowResidual:
    """Moving camera with known poses: pixels whose flow leaves the epipolar line that a static point would follow.

    A static point seen at x moves along the line F x of the next frame. The Sampson distance of x and x + flow to
    that geometry is 0 for it at any depth; a point that moves along its own epipolar line is missed.

    Args:
        threshold: pixels of distance at 640 of width, over ``step`` frames (a longer step sees slower motion).
        min_area: as of :class:`MedianBackground`.
        back: look at the frame before as well as at the one after: what moves along its own line in the one pair of
            frames seldom does in the other. Of fast balls before a phone in a hand 101 tracks lived long enough with
            it, 13 without.
    """

    threshold: float = 1.0
    min_area: int | None = None
    step: int = 1
    back: bool = True
    flow: DISFlow = field(default_factory=DISFlow)

    def __call__(self, frames: WorkingFrames, camera: Camera) -> Bool[np.ndarray, "T h w"]:
        T, (w, h) = len(frames), frames.size
        grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2).astype(float)
        here = frames.to_full(grid)
        out = np.zeros((T, h, w), bool)

        def leaves(k: int, other: int, flow: np.ndarray) -> Bool[np.ndarray, "h w"]:
            """Pixels of frame k whose flow to the other frame leaves their lines."""
            F = fundamental(camera, camera, k, other)
            residual = np.abs(sampson(F, here, frames.to_full(grid + flow.reshape(-1, 2)))) * frames.scale
            return (residual > self.threshold * frames.unit).reshape(h, w)

        for k in range(T):
            ahead = k + self.step
            if ahead < T:
                forward, backward = self.flow.pair(frames.gray(k), frames.gray(ahead))
                out[k] |= leaves(k, ahead, forward)
                if self.back or ahead + self.step >= T:  # the last frames have none after them
                    out[ahead] |= leaves(ahead, k, backward)
        return tidied(out, frames.unit, self.min_area)


LEAST_AREA, CLOSING = 300, 9
"""Pixels (at 640 of width) of the smallest component, and side of the square that closes holes, where things are as
large as people at 640 columns."""

PART = 10
"""A component is at least such a part of the area of what typically moves; smaller ones are specks."""

LOOKS = 40
"""Frames that the size of what moves is measured in."""


def tidied(changed: Bool[np.ndarray, "T h w"], unit: float, min_area: int | None = None) -> Bool[np.ndarray, "T h w"]:
    """:func:`tidy` of every frame, in place, with an area and a closing that suit the size of what moves.

    Args:
        unit: working pixels per pixel at 640 of width. min_area: pixels at 640 of width; None: 300, or the tenth part
            of a typical component where those are smaller than 3000 (people have 9000): things of ten pixels stay, and
            neighbours among them are not closed to one.
    """
    typical = typical_area(changed, unit, closing=True)
    small = typical < PART * LEAST_AREA * unit**2
    if small:  # what was closed may be several things
        typical = typical_area(changed, unit, closing=False)
    least: float = LEAST_AREA if min_area is None else min_area
    if min_area is None and small:
        least = min(LEAST_AREA, typical / unit**2 / PART)
    closing = min(CLOSING, 0.3 * np.sqrt(typical) / unit) if small else CLOSING
    for k in range(len(changed)):
        changed[k] = tidy(changed[k], unit, least, closing)
    return changed


def typical_area(changed: Sequence[np.ndarray] | np.ndarray, unit: float, closing: bool = False) -> float:
    """Area (pixels) of the component that a changed pixel lies in, the median; 0 where nothing changes.

    ``changed``: (h,w) a frame. Specks are removed first; ``closing``: holes are closed, too.
    """
    areas = [
        np.sort(components(cleaned(changed[int(k)], unit, CLOSING if closing else 0))[:, 2])
        for k in evenly(len(changed), LOOKS)
    ]
    area = np.sort(np.concatenate([*areas, np.zeros(0)]))
    return float(area[np.searchsorted(np.cumsum(area), 0.5 * area.sum())]) if len(area) else 0.0


def components(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n 3"]:
    """Middle (pixel indices) and area of every component."""
    box, _, stats, middle = _labelled(mask)
    return np.column_stack([middle[1:] + np.array([box[1].start, box[0].start]), stats[1:, AREA]])


def tidy(changed: Bool[np.ndarray, "h w"], unit: float, min_area: float, closing: float = CLOSING) -> np.ndarray:
    """Specks removed (3 px opening), holes closed (``closing`` px), components of at most ``min_area`` dropped.

    Pixels are at 640 of width; (h,w) bool.
    """
    box, component, stats, _ = _labelled(cleaned(changed, unit, closing))
    large = stats[:, AREA] > min_area * unit**2
    large[0] = False
    out = np.zeros(changed.shape, bool)
    out[box] = large[component]
    return out


AREA = 4
"""Column of OpenCV's statistics of components."""


def _labelled(
    mask: Bool[np.ndarray, "h w"],
) -> tuple[tuple[slice, slice], Int[np.ndarray, "a b"], Int[np.ndarray, "n 5"], Float[np.ndarray, "n 2"]]:
    """Components in the box around all of them: the box, their numbers there, their statistics and middles."""
    import cv2

    pixels = mask.view(np.uint8)
    x, y, w, h = cv2.boundingRect(pixels)
    box = np.s_[y : y + max(h, 1), x : x + max(w, 1)]  # of nothing one pixel, since OpenCV takes no empty image
    # twice as fast as the default
    way = cv2.CCL_GRANA
    _, component, stats, middle = cv2.connectedComponentsWithStatsWithAlgorithm(pixels[box], 8, cv2.CV_32S, way)
    return box, component, stats, middle


def cleaned(changed: Bool[np.ndarray, "h w"], unit: float, closing: float) -> Bool[np.ndarray, "h w"]:
    """Specks removed and holes closed, as :func:`tidy` does."""
    import cv2

    def square(pixels: float) -> np.ndarray:
        return np.ones((max(1, round(pixels * unit)),) * 2, np.uint8)

    mask = cv2.morphologyEx(changed.astype(np.uint8), cv2.MORPH_OPEN, square(3))
    return cv2.morphologyEx(mask, cv2.MORPH_CLOSE, square(closing)).view(bool)
