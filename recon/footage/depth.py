"""Depth maps for a fit: of all frames or of some, in memory or made on demand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from otsync.compute.indices import evenly
from otsync.types import Video
from recon.footage.footage import FOREGROUND, Footage, Lens

Depths = Sequence[Any] | Callable[[int], Any]
"""Of one video: (H,W) maps of z in world units, one per frame, or a function of the frame; 0 or None where unknown."""


def working_depth(
    video: Video, depth: Depths | None = None, *, width: int = 320, frames: slice | None = None
) -> Callable[[int], Float[np.ndarray, "h w"] | None]:
    """Depth maps to go with :func:`recon.footage.footage_of` at the same ``width`` and ``frames``, distortion undone.

    Args:
        depth: maps of the whole video, of any size over the image's field of view; None: the video's own.

    The nearest sample is taken, never a mean: between a body and the wall behind it there is nothing.
    ValueError where there is no depth.
    """
    depth = video.depth if depth is None else depth
    if depth is None:
        raise ValueError(f"depth of {video.name!r}: expected depth maps; found none. Estimate depth, or give a folder.")
    lens = Lens.of(video.camera, width)
    picks = range(len(video.frames))[frames or slice(None)]
    _check_count(depth, len(video.frames), video.name)

    def at(frame: int) -> Float[np.ndarray, "h w"] | None:
        given = _map(depth, picks[frame], video.name)
        return None if given is None else lens.pick(given)

    return at


def depth_at(depths: Depths | None, footage: Footage, frame: int) -> Float[np.ndarray, "h w"] | None:
    """The depth map of a frame of ``footage`` at its working size, 0 where unknown; None where the frame has none.

    ValueError, naming the video, where the video has no depth at all or something else stands for a map.
    """
    if depths is None:
        raise ValueError(
            f"depth of {footage.name!r}: expected depth maps of some of its frames; found none. Estimate depth, give a "
            "folder, or leave the video out."
        )
    _check_count(depths, len(footage), footage.name)
    given = _map(depths, frame, footage.name)
    if given is None or given.shape == footage.images.shape[1:3]:
        return given
    rows, columns = (
        ((np.arange(n) + 0.5) * given.shape[i] / n).astype(int) for i, n in enumerate(footage.images.shape[1:3])
    )
    return given[rows[:, None], columns]


def background_depth(
    depths: Depths, footage: Footage, samples: int = 12
) -> tuple[Float[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """(median depth over time of the background, count of the samples that know it); both 0 where none does."""
    good = np.flatnonzero(~footage.bad)
    values = []
    for k in good[evenly(len(good), samples)]:
        z = depth_at(depths, footage, int(k))
        if z is not None:
            covered = z <= 0 if footage.masks is None else (z <= 0) | (footage.masks[k] > 255 * FOREGROUND)
            values.append(np.where(covered, np.inf, z))
    if not values:
        empty = np.zeros(footage.images.shape[1:3])
        return empty, empty.astype(np.uint8)
    ordered = np.sort(np.stack(values), axis=0)
    count = np.isfinite(ordered).sum(0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, 0)[0]
    return np.where(count > 0, middle, 0), count.astype(np.uint8)


def _check_count(depths: Depths, frames: int, name: str) -> None:
    if not callable(depths) and len(depths) != frames:
        raise ValueError(
            f"depth of {name!r}: expected {frames} maps, one per frame (None where there is none); found {len(depths)}."
        )


def _map(depths: Depths, frame: int, name: str) -> Float[np.ndarray, "H W"] | None:
    given = depths(frame) if callable(depths) else depths[frame]
    if given is None:
        return None
    z = np.asarray(given, np.float32)
    if z.ndim != 2 or 0 in z.shape:
        raise ValueError(f"depth of {name!r}, frame {frame}: expected a map (H,W); found shape {z.shape}.")
    return np.where(np.isfinite(z) & (z > 0), z, np.float32(0))
