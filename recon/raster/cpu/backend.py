"""The CPU back end as two autograd nodes: Gaussians -> splats, and splats -> images.

Two nodes, because densification reads the gradient of the loss with respect to the 2-D means between them.
Everything is computed in float32 (the projection inside in float64); float64 tensors are accepted and given back.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from recon.raster.cpu import kernels, lists
from recon.raster.cpu import project as projection
from recon.raster.cpu.simd import LANES
from recon.raster.cpu.threads import for_each, ranges
from recon.raster.rendering import Settings, Splats

GAUSSIANS_PER_PART = 1024  # of the projection: fixed, so that sums over parts do not depend on the threads
PARTS = 64  # of the tiles: many, because tiles differ by orders of magnitude in their work


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    settings: Settings,
) -> Splats:
    """As :func:`recon.raster.projection.project`."""
    return Splats(*_Project.apply(means, quats, scales, opacities, viewmats, Ks, width, height, settings))


def rasterize(
    splats: Splats, features: Tensor, width: int, height: int, with_depth: bool
) -> tuple[Tensor, Tensor | None, Tensor]:
    """As :func:`recon.raster.torch_backend.rasterize`."""
    image, depth, transmittance = _Rasterize.apply(*splats, features, width, height, with_depth)
    return image, depth if with_depth else None, transmittance


def _array(t: Tensor, dtype: torch.dtype = torch.float32) -> np.ndarray:
    return t.detach().to(dtype).contiguous().numpy()


def _tile_parts(n_tiles: int) -> list[tuple[int, int]]:
    return ranges(n_tiles, max(1, n_tiles // PARTS))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, opacities, viewmats, Ks, width, height, settings):
        n, c = len(means), len(viewmats)
        gaussians = [_array(t) for t in (means, quats, scales, opacities)]
        cameras = [_array(viewmats, torch.float64), _array(Ks)]
        means2d, rows = np.empty((c, n, 2), np.float32), np.empty((c, n, 3), np.float32)
        depths, seen = np.empty((c, n), np.float32), np.empty((c, n), np.float32)
        radii = np.empty((c, n, 2), np.int32)
        limits = (
            np.float32(settings.near_plane),
            np.float32(min(settings.far_plane, np.finfo(np.float32).max)),
            float(settings.radius_clip),
            float(settings.eps2d),
        )
        size = (float(width), float(height))
        for_each(
            projection.forward,
            ranges(n, GAUSSIANS_PER_PART),
            *(*gaussians, *cameras, *size, limits, settings.antialiased, means2d, rows, depths, seen, radii),
        )
        out_radii = torch.from_numpy(radii)
        ctx.mark_non_differentiable(out_radii)
        ctx.save_for_backward(means, quats, scales, opacities, viewmats, Ks, out_radii)
        ctx.size, ctx.settings = size, settings
        floats = (torch.from_numpy(a).to(means.dtype) for a in (means2d, rows, depths, seen))
        return *floats, out_radii

    @staticmethod
    @once_differentiable
    def backward(ctx, v_means2d, v_rows, v_depths, v_seen, _):
        means, quats, scales, opacities, viewmats, Ks, radii = ctx.saved_tensors
        n, c = len(means), len(viewmats)
        gaussians = [_array(t) for t in (means, quats, scales, opacities)]
        incoming = [_array(t) for t in (v_means2d, v_rows, v_depths, v_seen)]
        outgoing = [np.empty((n, *t.shape[1:]), np.float32) for t in (means, quats, scales, opacities)]
        parts = [(*part, p) for p, part in enumerate(ranges(n, GAUSSIANS_PER_PART))]
        v_views = np.zeros((len(parts), c, 3, 4))
        for_each(
            projection.backward,
            parts,
            *(*gaussians, _array(viewmats, torch.float64), _array(Ks), *ctx.size, float(ctx.settings.eps2d)),
            *(ctx.settings.antialiased, radii.numpy(), *incoming, *outgoing, v_views),
        )
        v_viewmats = np.zeros((c, 4, 4))
        v_viewmats[:, :3] = v_views.sum(0)
        gradients = (torch.from_numpy(a).to(means.dtype) for a in (*outgoing, v_viewmats))
        return *gradients, None, None, None, None


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, rows, depths, opacities, radii, features, width, height, with_depth):
        n_cameras, n = depths.shape
        arrays = [_array(t) for t in (means2d, rows, depths, opacities)]
        tiles = lists.build(*arrays, radii.numpy(), width, height)
        channels = _in_rank_order(_array(features), arrays[2].reshape(-1), tiles.splat_of_rank, n, with_depth)
        d = features.shape[-1]
        image = np.empty((n_cameras, height, width, d), np.float32)
        depth = np.empty((n_cameras, height, width, 1), np.float32) if with_depth else np.empty(0, np.float32)
        transmittance = np.empty((n_cameras, height, width, 1), np.float32)
        last_drawn = np.empty(n_cameras * height * width, np.int32)
        tiling = (width, height, tiles.tiles_across, tiles.tiles_per_camera)
        for_each(
            kernels.forward,
            _tile_parts(n_cameras * tiles.tiles_per_camera),
            *(tiles.tile_starts, tiles.ranks, tiles.records, channels, d + with_depth, with_depth, tiling),
            *(image.reshape(-1), depth.reshape(-1), transmittance.reshape(-1), last_drawn),
        )
        dtype = means2d.dtype
        outputs = [torch.from_numpy(a).to(dtype) for a in (image, depth, transmittance)]
        ctx.tiles, ctx.channels, ctx.tiling, ctx.with_depth = tiles, channels, tiling, with_depth
        ctx.last_drawn, ctx.features_shape, ctx.splats_shape = last_drawn, features.shape, (n_cameras, n)
        ctx.transmittance = transmittance.reshape(-1)
        if not with_depth:
            ctx.mark_non_differentiable(outputs[1])
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_image, v_depth, v_transmittance):
        tiles, (n_cameras, n) = ctx.tiles, ctx.splats_shape
        d = ctx.features_shape[-1]
        row = kernels.SHAPE_GRADIENTS + d + ctx.with_depth
        incoming = [_array(t).reshape(-1) for t in (v_image, v_depth, v_transmittance)]
        gradients = np.empty(len(tiles.ranks) * row + LANES, np.float32)
        for_each(
            kernels.backward,
            _tile_parts(n_cameras * tiles.tiles_per_camera),
            *(tiles.tile_starts, tiles.ranks, tiles.slots, tiles.records, ctx.channels, d + ctx.with_depth),
            *(ctx.with_depth, ctx.tiling, ctx.transmittance, ctx.last_drawn, *incoming, gradients),
        )
        v_means2d, v_rows = np.empty((n_cameras, n, 2), np.float32), np.empty((n_cameras, n, 3), np.float32)
        v_opacities = np.empty((n_cameras, n), np.float32)
        v_depths = np.empty((n_cameras, n), np.float32) if ctx.with_depth else np.zeros((n_cameras, n), np.float32)
        v_features = np.empty(ctx.features_shape, np.float32)
        shared = len(ctx.features_shape) == 2
        for_each(
            kernels.reduce,
            ranges(n, GAUSSIANS_PER_PART),
            *(n_cameras, n, shared, ctx.with_depth, tiles.rank_of_splat, tiles.slot_starts, tiles.records),
            *(gradients, row),
            *(a.reshape(-1) for a in (v_means2d, v_rows, v_opacities, v_depths, v_features)),
        )
        means2d, rows, depths, opacities, features = (
            torch.from_numpy(a).to(v_image.dtype) for a in (v_means2d, v_rows, v_depths, v_opacities, v_features)
        )
        return means2d, rows, depths, opacities, None, features, None, None, None


def _in_rank_order(features: np.ndarray, depths: np.ndarray, order: np.ndarray, n: int, with_depth: bool) -> np.ndarray:
    """Features [N,D] or [C,N,D] of the drawn splats in depth order, with their depth as last channel: flat [R * D]."""
    d = features.shape[-1]
    channels = np.empty((len(order), d + with_depth), np.float32)
    for_each(
        kernels.gather_channels,
        ranges(len(order), lists.PART),
        *(order, features.reshape(-1, d), n if features.ndim == 2 else 0, depths, channels),
    )
    return channels.reshape(-1)
