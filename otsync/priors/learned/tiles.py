"""Dense features of large images in tiles that overlap: memory is bounded by a tile, and no border shows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Run = Callable[[Float[np.ndarray, "B h w 3"]], Float[np.ndarray, "B hs ws D"]]
"""Features of a batch of images of one size."""


def positions(length: int, tile: int, overlap: int, stride: int) -> list[int]:
    """Where tiles begin, multiples of ``stride``: neighbours share ``overlap`` and more, the last one ends with it.

    ValueError for an overlap that leaves no progress.
    """
    if length <= tile:
        return [0]
    step = (tile - overlap) // stride * stride
    if step < stride:
        raise ValueError(
            f"tile, overlap: expected a tile larger than its overlap by {stride}; found {tile} and {overlap}."
        )
    count = -(-(length - tile) // step)
    last = length - tile
    return sorted({min(k * step, last) // stride * stride for k in range(count)} | {last // stride * stride})


def ramp(n: int, before: int, behind: int) -> Float[np.ndarray, " n"]:
    """Weights of a tile's cells: they rise over ``before`` cells and fall over ``behind``, 1 between; never 0."""
    rise = np.ones(n)
    k = np.arange(n)
    if before:
        rise = np.minimum(rise, (k + 0.5) / before)
    if behind:
        rise = np.minimum(rise, (n - k - 0.5) / behind)
    # a cosine has no kink where the overlap begins
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(rise, 0, 1))


def tiled(
    image: Float[np.ndarray, "H W 3"], run: Run, *, tile: tuple[int, int], overlap: int, stride: int, batch: int = 1
) -> Float[np.ndarray, "Hs Ws D"]:
    """Features of every ``stride``-th pixel; one tile's are blended into its neighbour's over their overlap.

    Args:
        image: height and width multiples of ``stride``, and not below the tile's where that is larger than the image.
        tile: (height, width). batch: tiles at once.
    """
    H, W = image.shape[:2]
    th, tw = min(tile[0], H), min(tile[1], W)
    tops, lefts = positions(H, th, overlap, stride), positions(W, tw, overlap, stride)
    places = [(y, x) for y in tops for x in lefts]
    total: np.ndarray | None = None
    weight = np.zeros((H // stride, W // stride, 1), np.float32)
    for first in range(0, len(places), max(1, batch)):
        own = places[first : first + max(1, batch)]
        for (y, x), cells in zip(own, run(np.stack([image[y : y + th, x : x + tw] for y, x in own])), strict=True):
            if total is None:
                total = np.zeros((*weight.shape[:2], cells.shape[-1]), np.float32)
            vertical = ramp(len(cells), *_shared(tops, y, th, stride))
            across = ramp(cells.shape[1], *_shared(lefts, x, tw, stride))
            w = (vertical[:, None] * across[None])[..., None].astype(np.float32)
            at = np.s_[y // stride : y // stride + len(cells), x // stride : x // stride + cells.shape[1]]
            total[at] += w * cells
            weight[at] += w
    assert total is not None
    return total / weight


def _shared(begins: list[int], own: int, tile: int, stride: int) -> tuple[int, int]:
    """Cells that a tile shares with the one before and the one behind."""
    k = begins.index(own)
    before = (begins[k - 1] + tile - own) // stride if k else 0
    behind = (own + tile - begins[k + 1]) // stride if k + 1 < len(begins) else 0
    return max(0, before), max(0, behind)
