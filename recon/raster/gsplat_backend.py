"""The CUDA back end: gsplat's kernels behind :func:`recon.raster.render`. Imported only when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from recon.raster.rendering import QUAT_NORM2_MIN, Rendering, Settings

RENDER_MODES = {None: "RGB", "accumulated": "RGB+D", "expected": "RGB+ED"}
WARP = 32
"""Threads that gsplat 1.5.3 sums a gradient over: it takes two entries of a batch for one where they share a warp."""


def render(
    gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    size: tuple[int, int],
    backgrounds: Tensor | None,
    options: Settings,
) -> Rendering:
    """Render (means, quats, scales, opacities, colors), checked and finite, with `gsplat.rasterization`.

    gsplat computes in float32 only: float64 tensors are converted, and so is the result.
    """
    try:
        import gsplat
    except ImportError as error:
        raise ValueError("backend: expected gsplat; found none. pip install 'otsync[cuda]', or use 'cpu'.") from error
    if not gaussians[0].is_cuda:
        raise ValueError(
            "backend: expected CUDA tensors for 'gsplat'; found CPU tensors. Move them with .cuda(), or use 'cpu'."
        )
    return rasterize(gsplat.rasterization, gaussians, viewmats, Ks, size, backgrounds, options)


def rasterize(
    rasterization: Callable[..., tuple[Tensor, Tensor, dict[str, Any]]],
    gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    size: tuple[int, int],
    backgrounds: Tensor | None,
    options: Settings,
) -> Rendering:
    """Translate to and from `rasterization`, a function with the signature of gsplat's."""
    means, quats, scales, opacities, colors = gaussians
    dtype, n, c = means.dtype, means.shape[-2], len(viewmats)
    width, height = size
    if n == 0:  # gsplat would launch no kernel and leave its outputs unset
        return _empty(gaussians, viewmats, size, backgrounds, options)
    # gsplat normalises by 1/|q|: a quaternion that is no rotation must not reach it
    rotates = (quats * quats).sum(-1) >= QUAT_NORM2_MIN
    quats = torch.where(rotates[..., None], quats, torch.ones_like(quats))
    opacities = torch.where(rotates, opacities, 0.0)
    moving = means.ndim == 3
    if moving:  # every camera becomes an entry of gsplat's batch, of one camera
        scales = scales.expand(c, n, 3)
        if colors.ndim == (2 if options.sh_degree is None else 3):
            colors = colors.expand(c, *colors.shape)
        if n % WARP and (n < WARP or viewmats.requires_grad):
            means, quats, scales, opacities, colors = _padded(-n % WARP, means, quats, scales, opacities, colors)
        viewmats, Ks = viewmats[:, None], Ks[:, None]
        backgrounds = None if backgrounds is None else backgrounds[:, None]
    tensors = [t.float() for t in (means, quats, scales, opacities, colors, viewmats, Ks)]
    image, alphas, meta = rasterization(
        *tensors,
        width,
        height,
        near_plane=options.near_plane,
        far_plane=options.far_plane,
        radius_clip=options.radius_clip,
        eps2d=options.eps2d,
        sh_degree=options.sh_degree,
        packed=False,  # so that means2d and radii are [C,N,2] whatever is visible
        backgrounds=None if backgrounds is None else backgrounds.float(),
        render_mode=RENDER_MODES[options.depth],
        rasterize_mode=options.rasterize_mode,
    )
    if moving:
        image, alphas = image[:, 0], alphas[:, 0]
    depths = None
    if options.depth is not None:
        image, depths = image[..., :-1], image[..., -1:].to(dtype)
    radii = meta["radii"].reshape(c, -1, 2)[:, :n].to(torch.int32)
    # means2d in gsplat's own shape: a reshaped one would not be in the graph and would have no gradient
    return Rendering(image.to(dtype), alphas.to(dtype), depths, meta["means2d"], radii, "gsplat")


def _padded(
    more: int, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The Gaussians [C,N,...] and, behind them, so many that are not drawn."""

    def longer(t: Tensor, value: float) -> Tensor:
        return torch.cat([t, t.new_full((len(t), more, *t.shape[2:]), value)], 1)

    return longer(means, 0.0), longer(quats, 1.0), longer(scales, 1.0), longer(opacities, 0.0), longer(colors, 0.0)


def _empty(
    gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    viewmats: Tensor,
    size: tuple[int, int],
    backgrounds: Tensor | None,
    options: Settings,
) -> Rendering:
    """What no Gaussians look like. It depends on them all the same: their gradients are zeros, as elsewhere."""
    means, colors, shape = gaussians[0], gaussians[4], (len(viewmats), size[1], size[0])
    nothing = sum((t.sum() for t in gaussians), 0.0 * viewmats.sum()).to(means.dtype)
    image = nothing.expand(*shape, 3 if options.sh_degree is not None else colors.shape[-1])
    if backgrounds is not None:
        image = image + backgrounds[:, None, None, :]
    alphas = nothing.expand(*shape, 1)
    depths = None if options.depth is None else nothing.expand(*shape, 1)
    splats = means.new_zeros(len(viewmats), 0, 2)
    return Rendering(image, alphas, depths, splats, splats.to(torch.int32), "gsplat")
