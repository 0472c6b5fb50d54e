"""Feature maps for lifting: for the slot of :func:`recon.features.tracks.feature_tracks`.

Any callable of an image and its soft mask fits there. Those of OpenCV need no weights; a backbone reads its cells.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from recon.footage.footage import FOREGROUND, Footage


@dataclass(frozen=True)
class LabMaps:
    """Colours of the foreground around every pixel: Gaussian-windowed histograms in CIE Lab, square-rooted.

    The mean of such vectors over frames and pixels is nearly that of :class:`otsync.priors.features.LabHistogram`, with
    the same constants; but the root is taken before the mean.

    Args:
        sigma: of the window, pixels at 640 of width. bins: per axis of Lab; bins^3 channels.
    """

    sigma: float = 8.0
    bins: int = 4

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w C"]:
        """Unit vectors; zero where no foreground is near."""
        import cv2

        h, w = mask.shape
        n, unit = self.bins, w / 640
        lab = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
        lightness = np.clip(lab[..., 0] * n / 100, 0, n - 1).astype(int)
        green, blue = (np.clip((lab[..., c] + 20) * n / 60, 0, n - 1).astype(int) for c in (1, 2))
        bin_of = np.where(mask > 255 * FOREGROUND, (lightness * n + green) * n + blue, -1)
        # a blur at a lower resolution costs less, and over a window of several pixels it is nearly the same
        shrink = max(1, round(self.sigma * unit / 2))
        size = (max(1, round(w / shrink)), max(1, round(h / shrink)))
        out = np.zeros((h, w, n**3), np.float32)
        for b in np.unique(bin_of[bin_of >= 0]):
            plane = cv2.resize((bin_of == b).astype(np.float32), size, interpolation=cv2.INTER_AREA)
            plane = cv2.GaussianBlur(plane, (0, 0), self.sigma * unit / shrink)
            out[..., b] = cv2.resize(plane, (w, h), interpolation=cv2.INTER_LINEAR)
        total = out.sum(-1, keepdims=True)
        return np.sqrt(np.divide(out, total, out=np.zeros_like(out), where=total > 1e-6))


@dataclass(frozen=True)
class DaisyMaps:
    """DAISY (Tola et al., PAMI 2010): histograms of gradient directions on rings around every foreground pixel.

    For tracks instead of maps: :class:`otsync.priors.Daisy`.

    Args:
        radius: of the outer ring, pixels at 640 of width. rings, spokes, directions: (rings * spokes + 1) * directions
            channels, 64 as it is.
    """

    radius: float = 24.0
    rings: int = 3
    spokes: int = 5
    directions: int = 4

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w C"]:
        """Every ring's histogram has unit norm; zero outside the mask. ValueError where OpenCV lacks DAISY."""
        import cv2

        if not hasattr(cv2, "xfeatures2d"):
            raise ValueError(
                "DaisyMaps: expected OpenCV's contributed modules; found OpenCV without them. pip install "
                "opencv-contrib-python-headless, or use LabMaps."
            )
        radius = max(2.0, self.radius * mask.shape[1] / 640)
        contributed: Any = cv2.xfeatures2d
        daisy = contributed.DAISY_create(
            radius, self.rings, self.spokes, self.directions, contributed.DAISY_NRM_PARTIAL
        )
        out = np.zeros((*mask.shape, (self.rings * self.spokes + 1) * self.directions), np.float32)
        row, column = np.nonzero(mask)
        if len(row):
            points = [cv2.KeyPoint(float(x), float(y), 1.0) for x, y in zip(column, row, strict=True)]
            _, descriptors = daisy.compute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), points)
            out[row, column] = np.nan_to_num(descriptors)
        return out


@dataclass(frozen=True)
class Backbone:
    """Cells of a backbone, read between them at every pixel: unit vectors, foreground or not.

    Args:
        of: an object with ``dense(image) -> (rows, columns, C)``, such as :class:`otsync.priors.learned.Dinov3`.
    """

    of: Any

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w C"]:
        """ValueError where the image becomes a single row or column of cells."""
        import cv2

        cells = np.ascontiguousarray(self.of.dense(image), np.float32)
        if min(cells.shape[:2]) < 2:
            raise ValueError(
                f"features: expected 2 x 2 cells and more of an image of {mask.shape[1]} x {mask.shape[0]} pixels; "
                f"found {cells.shape[1]} x {cells.shape[0]}. Use a larger scale, or a larger --width."
            )
        rows, columns = np.indices(mask.shape, np.float32)
        h, w = mask.shape
        x = (columns + 0.5) * (cells.shape[1] / w) - 0.5
        y = (rows + 0.5) * (cells.shape[0] / h) - 0.5
        out = np.empty((h, w, cells.shape[2]), np.float32)
        for first in range(0, cells.shape[2], CHANNELS):
            part = np.ascontiguousarray(cells[..., first : first + CHANNELS])
            whole = cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            out[..., first : first + CHANNELS] = whole.reshape(h, w, -1)
        return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-12)


CHANNELS = 4
"""Channels that OpenCV's ``remap`` takes at once."""


class KeptMaps(Mapping[int, np.ndarray]):
    """The feature maps [h,w,C] of one video by frame, made when they are asked for; the last ones are kept.

    Args:
        footage: with masks. maps: the extractor. most: bytes of half-precision maps that are kept.
    """

    def __init__(self, footage: Footage, maps: Any, most: int = 256 << 20):
        self._footage, self._maps, self._most = footage, maps, most
        self._frames = [int(k) for k in np.flatnonzero(~footage.bad)]
        self._there = frozenset(self._frames)
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[int]:
        return iter(self._frames)

    def __contains__(self, k: object) -> bool:
        return k in self._there

    def __getitem__(self, k: int) -> np.ndarray:
        if k not in self._there:
            raise KeyError(k)
        with self._lock:
            if k in self._kept:
                self._kept.move_to_end(k)
                return self._kept[k].astype(np.float32)
        assert self._footage.masks is not None
        found = self._maps(self._footage.images[k], self._footage.masks[k]).astype(np.float16)
        with self._lock:
            self._kept[k] = found
            while len(self._kept) > 1 and sum(m.nbytes for m in self._kept.values()) > self._most:
                self._kept.popitem(last=False)
        return found.astype(np.float32)  # in half precision, kept or not: the same fit comes out
