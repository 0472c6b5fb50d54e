"""Structural similarity of images, and the mean of L1 and SSIM that a fit minimises.

The definitions are in torch, for any float type and device; the loss in float32 on the CPU runs through a fused kernel.
"""

from __future__ import annotations

import importlib.util
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from recon.losses.window import C1, C2, STANDARD, Window


def ssim_map(x: Tensor, y: Tensor, window: Window = STANDARD) -> Tensor:
    """SSIM of every pixel and channel of x against y, [h,w,c] each, colours in 0..1.

    Beyond the border images are black (zero padding), in both alike.
    """
    blur = _shifted_sums if x.device.type == "cpu" else _convolved
    mean_x, mean_y, xx, yy, xy = blur(torch.cat([x, y, x * x, y * y, x * y], -1), window).split(x.shape[-1], -1)
    var_x, var_y, covariance = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    similar = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    return similar / ((mean_x**2 + mean_y**2 + C1) * (var_x + var_y + C2))


def _shifted_sums(image: Tensor, window: Window) -> Tensor:
    """Windowed means [h,w,c]. On a CPU 20 times faster than a convolution of single channels."""
    k, radius = window.weights().tolist(), window.radius
    h, w = image.shape[:2]
    image = F.pad(image, (0, 0, radius, radius, radius, radius))
    down = sum((k[i] * image[i : i + h] for i in range(1, window.taps)), k[0] * image[:h])
    return sum((k[i] * down[:, i : i + w] for i in range(1, window.taps)), k[0] * down[:, :w])


def _convolved(image: Tensor, window: Window) -> Tensor:
    """The same in one convolution: a GPU waits for its orders, not for sums.

    In full precision: variances are small differences of large means. Of channels that lie apart in memory torch's own
    kernel does that; where colours lie together it is cuDNN's, in TF32.
    """
    layers = image.permute(2, 0, 1).contiguous()
    kernel = _kernel(window, image.dtype, image.device).expand(len(layers), 1, -1, -1)
    return F.conv2d(layers, kernel, padding=window.radius, groups=len(layers)).permute(1, 2, 0)


@lru_cache(maxsize=8)
def _kernel(window: Window, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The window [taps,taps], put on the device once."""
    k = window.weights()
    return (k[:, None] * k).to(device, dtype)


ROWS_PER_PART = 64  # of the CPU kernel: fixed, so that sums do not depend on the threads


def photometric(x: Tensor, y: Tensor, usable: Tensor | None, share: float, window: Window) -> Tensor | None:
    """Weighted mean of ``|x - y| + share * (1 - SSIM)`` over pixels and channels; None when no pixel is usable.

    x: [h,w,c] rendered, differentiable. y: [h,w,c] filmed. usable: [h,w] weights 0..1, or None: all 1. Where they are
    below 1, x is mixed with y first, ``x' = y + usable (x - y)``, so that an unusable pixel cannot reach the windows of
    its neighbours either: the loss is ``(sum |x' - y| + share * sum usable (1 - SSIM(x', y))) / (c sum usable)``.

    float32 on the CPU runs through one fused kernel, forward and backward at once; everything else through torch.
    """
    if x.ndim != 3 or y.shape != x.shape or (usable is not None and usable.shape != x.shape[:2]):
        found = ", ".join(str(list(t.shape)) for t in (x, y, usable) if t is not None)
        raise ValueError(f"x, y, usable: expected [h,w,c], [h,w,c] and [h,w]; found {found}.")
    total = x.shape[-1] * (x.shape[0] * x.shape[1] if usable is None else float(usable.sum()))
    if not total > 0:
        return None
    if x.dtype == torch.float32 and x.device.type == "cpu" and not y.requires_grad and _has_numba():
        return _Fused.apply(x, y, usable, share, window, total)
    return photometric_reference(x, y, usable, share, window)


def photometric_reference(x: Tensor, y: Tensor, usable: Tensor | None, share: float, window: Window) -> Tensor:
    """:func:`photometric` in torch, for any float type and device: oracle of the kernel and its fallback."""
    weight = torch.ones_like(x[..., :1]) if usable is None else usable.to(x)[..., None]
    mixed = y + weight * (x - y) if usable is not None else x
    loss = (mixed - y).abs().sum()
    if share:
        loss = loss + share * (weight * (1 - ssim_map(mixed, y, window))).sum()
    return loss / (weight.sum() * x.shape[-1])


class _Fused(torch.autograd.Function):
    """The gradient is made on the way forward, while the rows are in the cache; backward only scales it."""

    @staticmethod
    def forward(ctx, x, y, usable, share, window, total):
        from otsync.compute.threads import for_each, ranges
        from recon.losses.ssim_kernels import photometric as kernel

        images = tuple(_flat(t) for t in (x, y, usable))
        with_gradient = ctx.needs_input_grad[0]
        gradient = np.empty(x.numel() if with_gradient else 0, np.float32)
        parts = [(*rows, i) for i, rows in enumerate(ranges(x.shape[0], ROWS_PER_PART))]
        sums = np.zeros((len(parts), 2))
        weights = window.weights().numpy().astype(np.float32)
        options = (tuple(x.shape), weights, np.float32(share), with_gradient)
        for_each(kernel, parts, images, *options, gradient, sums)
        ctx.gradient, ctx.total = gradient.reshape(x.shape if with_gradient else 0), total
        difference, dissimilar = sums.sum(0)
        return x.new_tensor((difference + share * dissimilar) / total)

    @staticmethod
    @once_differentiable
    def backward(ctx, g):
        return torch.from_numpy(ctx.gradient * np.float32(float(g) / ctx.total)), *[None] * 5


def _flat(t: Tensor | None) -> np.ndarray:
    if t is None:
        return np.empty(0, np.float32)
    return t.detach().to(torch.float32).contiguous().numpy().reshape(-1)


def _has_numba() -> bool:
    return importlib.util.find_spec("numba") is not None
