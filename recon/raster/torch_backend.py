"""Rasterization in plain torch, batches of tiles at a time: the oracle in float64, the fallback without numba.

Every tile composites its depth-sorted splats at once as a [splats, pixels] block. Tiles are taken in order of the
length of their lists, so that a batch wastes little on padding; blocks are recomputed in the backward pass where
keeping them all would take too much memory.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from recon.raster.projection import project
from recon.raster.rendering import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Splats

__all__ = ["project", "rasterize"]

TILE = 8  # pixels: small enough that most splats of a list touch most of the tile
BLOCK_ELEMENTS = 1_000_000  # splat-pixel pairs composited at once; the temporaries of a block stay in the cache
KEEP_ELEMENTS = 20_000_000  # pairs of a whole rendering above which blocks are recomputed, about 500 MB


def rasterize(
    splats: Splats, features: Tensor, width: int, height: int, depth: str | None
) -> tuple[Tensor, Tensor | None, Tensor]:
    """Composite splats front to back; differentiable in everything but the radii.

    features [N,D] or [C,N,D]; depth as in :class:`Settings`. Returns sums of weight * feature [C,H,W,D], the depth
    [C,H,W,1] (or None), and the alpha [C,H,W,1], one minus the transmittance that is left.
    """
    n_cameras, n = splats.depths.shape
    channels = features.expand(n_cameras, n, features.shape[-1])
    if depth:
        channels = torch.cat([channels, splats.depths[..., None]], -1)
    across, down = -(-width // TILE), -(-height // TILE)
    flat = Splats(*(t.flatten(0, 1) for t in splats))
    channels = channels.flatten(0, 1)

    tile_of, splat_of = _tile_lists(flat, n, across, down)
    counts = torch.bincount(tile_of, minlength=n_cameras * across * down)
    starts = counts.cumsum(0) - counts
    by_length = counts.argsort(descending=True, stable=True)
    by_length = by_length[counts[by_length] > 0]
    lengths = counts[by_length].tolist()
    grad = torch.is_grad_enabled() and any(t.requires_grad for t in (*flat[:4], channels))
    recompute = grad and sum(lengths) * TILE * TILE > KEEP_ELEMENTS

    images, lefts, i = [], [], 0
    while i < len(lengths):
        longest = lengths[i]
        tiles = by_length[i : i + max(1, BLOCK_ELEMENTS // (longest * TILE * TILE))]
        i += len(tiles)
        rank = torch.arange(longest)
        listed = rank < counts[tiles, None]
        ids = splat_of[(starts[tiles, None] + rank).clamp_max(len(splat_of) - 1)]
        corners = torch.stack([tiles % across, tiles % (across * down) // across], -1) * TILE
        block = (corners, ids, listed, flat.means2d, flat.rows, flat.opacities, flat.residuals, channels)
        image, left = checkpoint(_composite, *block, use_reentrant=False) if recompute else _composite(*block)
        images.append(image)
        lefts.append(left)

    d = channels.shape[-1]
    full = channels.new_zeros(n_cameras * across * down, TILE * TILE, d)
    left_full = channels.new_ones(n_cameras * across * down, TILE * TILE, 1)
    if images:
        full = full.index_copy(0, by_length, torch.cat(images))
        left_full = left_full.index_copy(0, by_length, torch.cat(lefts))

    def untile(t: Tensor) -> Tensor:
        t = t.reshape(n_cameras, down, across, TILE, TILE, -1).transpose(2, 3)
        return t.reshape(n_cameras, down * TILE, across * TILE, -1)[:, :height, :width]

    image, alphas = untile(full), 1 - untile(left_full)
    if depth is None:
        return image, None, alphas
    sums = image[..., -1:]
    return image[..., :-1], sums if depth == "accumulated" else sums / alphas.clamp_min(1e-10), alphas


@torch.no_grad()
def _tile_lists(flat: Splats, n: int, across: int, down: int) -> tuple[Tensor, Tensor]:
    """(tile, splat) pairs, sorted by tile and front to back within each; tiles are numbered over all cameras."""
    var_x, slope, var_y = flat.rows.unbind(-1)
    drawn = (flat.radii > 0).any(-1).nonzero().squeeze(-1)
    # ties in depth keep the order of the Gaussians; float32 as in the other back ends, so that ties are the same ones
    drawn = drawn[flat.depths[drawn].float().argsort(stable=True)]
    reach = (2 * (flat.opacities[drawn] / ALPHA_MIN).clamp_min(1).log())[:, None]
    extent = (reach * torch.stack([var_x + slope * slope * var_y, var_y], -1)[drawn]).sqrt()
    limit = torch.tensor([across, down])
    centre = flat.means2d[drawn]
    # a margin of 0.1 pixel: pixel centres are half a pixel inside the box, so rounding cannot lose one
    low = ((centre - extent - 0.1) / TILE).floor().clamp_min(0).minimum(limit).long()
    high = ((centre + extent + 0.1) / TILE).ceil().clamp_min(0).minimum(limit).long()
    wide, tall = (high - low).clamp_min(0).unbind(-1)
    counts = wide * tall
    owner = torch.repeat_interleave(torch.arange(len(drawn)), counts)
    k = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
    column, row = low[owner, 0] + k % wide[owner], low[owner, 1] + k // wide[owner]
    tile = drawn[owner] // n * (across * down) + row * across + column
    tile, order = tile.sort(stable=True)
    return tile, drawn[owner[order]]


def _composite(
    corners: Tensor,
    ids: Tensor,
    listed: Tensor,
    means2d: Tensor,
    rows: Tensor,
    opacities: Tensor,
    residuals: Tensor,
    channels: Tensor,
) -> tuple[Tensor, Tensor]:
    """Composite B tiles whose upper left pixels are `corners` [B,2] and whose lists `ids` [B,K] are padded.

    Returns the tiles [B,P,D] and the transmittance left [B,P,1].
    """
    dtype, steps = means2d.dtype, torch.arange(TILE)
    rest = residuals[ids].double()
    centre = means2d[ids].double() + rest[..., :2] - corners[:, None]
    var_x, slope, var_y = rows[ids].split(1, -1)
    dy = steps + 0.5 - centre[..., 1:]  # [B,K,rows]
    # where the splat is centred on each row: a whole number of pixels and an exact rest, see Splats.residuals
    on_row = centre[..., :1] + (slope.double() + rest[..., 2:]) * dy
    whole = on_row.detach().round()
    dx = ((steps + 0.5).to(dtype) - whole.to(dtype)[..., None]) - (on_row - whole).to(dtype)[..., None]
    dy = dy.to(dtype)
    power = dx * dx * (-0.5 / var_x)[..., None] + (dy * dy * (-0.5 / var_y))[..., None]
    power = power.flatten(2)  # [B,K,P]
    alpha = ((opacities[ids] * listed)[..., None] * power.exp()).clamp_max(ALPHA_MAX)
    alpha = alpha * (alpha.detach() >= ALPHA_MIN)
    after = (1 - alpha).cumprod(1)
    alive = after.detach() > TRANSMITTANCE_MIN  # stops before the splat that would finish the pixel
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    weight = alpha * before * alive
    # the transmittance after the last splat drawn; the first splat alone never finishes a pixel
    left = after.gather(1, alive.sum(1, keepdim=True).sub(1).clamp_min(0))
    return weight.transpose(1, 2) @ channels[ids], left.transpose(1, 2)
