"""The CPU back end as two autograd nodes: Gaussians -> splats, and splats -> images.

Two nodes, because densification reads the gradient of the loss with respect to the 2-D means between them.
Everything is computed in float32 (the projection inside in float64); float64 tensors are accepted and given back.
"""

from __future__ import annotations

import logging
import threading

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from otsync.compute.simd import LANES
from otsync.compute.threads import for_each, ranges
from recon.raster.cpu import kernels, lists
from recon.raster.cpu import project as projection
from recon.raster.rendering import Settings, Splats

# fixed, so that sums over parts do not depend on the threads; fewer are done sooner than another thread is woken
GAUSSIANS_PER_PART = 2048
logger = logging.getLogger("recon.raster")

DEPTH_MODES = {None: kernels.NO_DEPTH, "accumulated": kernels.ACCUMULATED, "expected": kernels.EXPECTED}
PARTS = 64  # of the tiles: many, because the work per tile differs by orders of magnitude


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
    if not _warm:
        warmup()
    return Splats(*_Project.apply(means, quats, scales, opacities, viewmats, Ks, width, height, settings))


def rasterize(
    splats: Splats, features: Tensor, width: int, height: int, depth: str | None
) -> tuple[Tensor, Tensor | None, Tensor]:
    """As :func:`recon.raster.torch_backend.rasterize`."""
    image, depths, alphas = _Rasterize.apply(*splats, features, width, height, DEPTH_MODES[depth])
    return image, depths if depth else None, alphas


_warm = False
_warming = threading.Lock()


def warmup() -> None:
    """Load every kernel from numba's cache (a fraction of a second), or compile it (some seconds, once per machine).

    The first rendering does it; call this to do it earlier. It says so where it takes long.
    """
    global _warm
    with _warming:
        if _warm:
            return
        timer = threading.Timer(1.0, _announce_compilation)
        timer.daemon = True
        timer.start()
        try:
            _exercise()
        finally:
            timer.cancel()
        _warm = True


def _announce_compilation() -> None:
    every = (projection.forward, projection.backward, kernels.forward, kernels.backward)
    if any(k.stats.cache_misses or (not k.stats.cache_hits and k.signatures) for k in every):
        logger.warning("recon.raster compiles its CPU kernels: about 15 seconds, once per machine and version")


def _exercise() -> None:
    """One Gaussian, one camera, forward and backward: every kernel with the types it always has."""
    gaussian = [torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1)]
    K = torch.tensor([[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]])
    with torch.enable_grad():
        leaves = [t.requires_grad_() for t in gaussian]
        splats = Splats(*_Project.apply(*leaves, torch.eye(4)[None], K, 8, 8, Settings()))
        image, _, _ = _Rasterize.apply(*splats, torch.ones(1, 3), 8, 8, kernels.ACCUMULATED)
        torch.autograd.grad(image.sum(), leaves, allow_unused=True)


def _array(t: Tensor, dtype: torch.dtype = torch.float32) -> np.ndarray:
    return t.detach().to(dtype).contiguous().numpy()


def _gradient(t: Tensor | None, shape: tuple[int, ...]) -> np.ndarray:
    """The gradient as an array, zeros where the loss does not use this output.

    Autograd could make the zeros (`materialize_grads`), on threads of torch that then spin on the kernels' cores.
    """
    return np.zeros(shape, np.float32) if t is None else _array(t)


def _tile_parts(n_tiles: int) -> list[tuple[int, int]]:
    return ranges(n_tiles, max(1, n_tiles // PARTS))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, opacities, viewmats, Ks, width, height, settings):
        ctx.set_materialize_grads(False)
        n, c = len(means), len(viewmats)
        means2d, rows = np.empty((c, n, 2), np.float32), np.empty((c, n, 3), np.float32)
        depths, seen = np.empty((c, n), np.float32), np.empty((c, n), np.float32)
        radii, residuals = np.empty((c, n, 2), np.int32), np.empty((c, n, 3), np.float32)
        limits = (
            np.float32(settings.near_plane),
            np.float32(min(settings.far_plane, np.finfo(np.float32).max)),
            float(settings.radius_clip),
            float(settings.eps2d),
        )
        gaussians = tuple(_array(t) for t in (means, quats, scales, opacities))
        cameras = (_array(viewmats, torch.float64), _array(Ks), float(width), float(height))
        outputs = (means2d, rows, depths, seen, radii, residuals)
        parts = ranges(n, GAUSSIANS_PER_PART)
        for_each(projection.forward, parts, gaussians, cameras, limits, settings.antialiased, outputs)
        ctx.save_for_backward(means, quats, scales, opacities, viewmats, Ks)
        ctx.radii, ctx.size, ctx.settings = radii, (float(width), float(height)), settings
        floats = [torch.from_numpy(a).to(means.dtype) for a in (means2d, rows, depths, seen)]
        fixed = torch.from_numpy(radii.copy()), torch.from_numpy(residuals)
        ctx.mark_non_differentiable(*fixed)
        return *floats, *fixed

    @staticmethod
    @once_differentiable
    def backward(ctx, g_means2d, g_rows, g_depths, g_seen, *_):
        means, quats, scales, opacities, viewmats, Ks = ctx.saved_tensors
        n, c = len(means), len(viewmats)
        gaussians = tuple(_array(t) for t in (means, quats, scales, opacities))
        cameras = (_array(viewmats, torch.float64), _array(Ks), *ctx.size)
        shapes = (c, n, 2), (c, n, 3), (c, n), (c, n)
        incoming = tuple(map(_gradient, (g_means2d, g_rows, g_depths, g_seen), shapes))
        outgoing = tuple(np.empty(a.shape, np.float32) for a in gaussians)
        parts = [(*part, p) for p, part in enumerate(ranges(n, GAUSSIANS_PER_PART))]
        g_views = np.zeros((len(parts), c, 3, 4))
        options = (float(ctx.settings.eps2d), ctx.settings.antialiased, ctx.radii)
        for_each(projection.backward, parts, gaussians, cameras, *options, incoming, outgoing, g_views)
        g_viewmats = np.zeros((c, 4, 4))
        g_viewmats[:, :3] = g_views.sum(0)
        gradients = (torch.from_numpy(a).to(means.dtype) for a in (*outgoing, g_viewmats))
        return *gradients, None, None, None, None


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, rows, depths, opacities, radii, residuals, features, width, height, depth_mode):
        ctx.set_materialize_grads(False)
        n_cameras, n = depths.shape
        splats = (*(_array(t) for t in (means2d, rows, depths, opacities)), radii.numpy(), residuals.numpy())
        tiles = lists.build(splats, width, height)
        with_depth = depth_mode != kernels.NO_DEPTH
        channels = _in_rank_order(_array(features), splats[2].reshape(-1), tiles.splat_of_rank, n, with_depth)
        d = features.shape[-1]
        image = np.empty((n_cameras, height, width, d), np.float32)
        depth = np.empty((n_cameras, height, width, 1) if with_depth else 0, np.float32)
        alphas, transmittance = (np.empty((n_cameras, height, width, 1), np.float32) for _ in range(2))
        last_drawn = np.empty(n_cameras * height * width, np.int32)
        tiling = (width, height, tiles.tiles_across, tiles.tiles_per_camera)
        for_each(
            kernels.forward,
            _tile_parts(n_cameras * tiles.tiles_per_camera),
            *((tiles.tile_starts, tiles.ranks, tiles.records), channels, d + with_depth, depth_mode, tiling),
            tuple(a.reshape(-1) for a in (image, depth, alphas, transmittance, last_drawn)),
        )
        outputs = [torch.from_numpy(a).to(means2d.dtype) for a in (image, depth, alphas)]
        if not with_depth:
            ctx.mark_non_differentiable(outputs[1])
        # a copy, because the caller owns the depth and may change it
        kept_depth = depth.reshape(-1).copy() if depth_mode == kernels.EXPECTED else np.empty(0, np.float32)
        ctx.saved = (kept_depth, transmittance.reshape(-1), last_drawn)
        ctx.tiles, ctx.channels, ctx.tiling, ctx.depth_mode = tiles, channels, tiling, depth_mode
        ctx.features_shape, ctx.splats_shape, ctx.dtype = features.shape, (n_cameras, n), means2d.dtype
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_image, g_depth, g_alphas):
        tiles, (n_cameras, n), with_depth = ctx.tiles, ctx.splats_shape, ctx.depth_mode != kernels.NO_DEPTH
        n_channels = ctx.features_shape[-1] + with_depth
        row = kernels.SHAPE_GRADIENTS + n_channels
        pixels = n_cameras * ctx.tiling[0] * ctx.tiling[1]
        sizes = pixels * (n_channels - with_depth), pixels if with_depth else 0, pixels
        incoming = tuple(
            _gradient(t, (size,)).reshape(-1) for t, size in zip((g_image, g_depth, g_alphas), sizes, strict=True)
        )
        gradients = np.empty(len(tiles.ranks) * row + LANES, np.float32)
        for_each(
            kernels.backward,
            _tile_parts(n_cameras * tiles.tiles_per_camera),
            *((tiles.tile_starts, tiles.ranks, tiles.records), tiles.slots, ctx.channels, n_channels),
            *(ctx.depth_mode, ctx.tiling, ctx.saved, incoming, gradients),
        )
        shapes = [(n_cameras, n, 2), (n_cameras, n, 3), (n_cameras, n), (n_cameras, n), ctx.features_shape]
        outgoing = [np.empty(shape, np.float32) for shape in shapes]
        if not with_depth:
            outgoing[2][:] = 0
        for_each(
            kernels.reduce,
            ranges(n, GAUSSIANS_PER_PART),
            *(n_cameras, len(ctx.features_shape) == 2, with_depth),
            *((tiles.rank_of_splat, tiles.slot_starts, tiles.records), gradients, row),
            tuple(a.reshape(-1) for a in outgoing),
        )
        means2d, rows, depths, opacities, features = (torch.from_numpy(a).to(ctx.dtype) for a in outgoing)
        return means2d, rows, depths, opacities, None, None, features, None, None, None


def _in_rank_order(features: np.ndarray, depths: np.ndarray, order: np.ndarray, n: int, with_depth: bool) -> np.ndarray:
    """Features [N,D] or [C,N,D] of the drawn splats in depth order, with their depth as last channel: flat [R * D]."""
    d = features.shape[-1]
    channels = np.empty((len(order), d + with_depth), np.float32)
    for_each(
        kernels.gather_channels,
        ranges(len(order), GAUSSIANS_PER_PART),
        *(order, features.reshape(-1, d), n if features.ndim == 2 else 0, depths, channels),
    )
    return channels.reshape(-1)
