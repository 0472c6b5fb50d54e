"""L1 + SSIM of two images and its gradient in one sweep over the rows, for the CPU.

Images are [h,w,c] as they come, a row of w * c floats: the horizontal neighbour of a value lies c floats further, so
that neither channels nor pixels need to be moved. A handful of rows is alive at a time and stays in the cache: row i +
r enters, local moments and the derivatives of SSIM appear at row i, the gradient at row i - r (r: the window's radius).
"""

from __future__ import annotations

import numpy as np

from otsync.compute import simd
from otsync.compute.jit import inlined, kernel
from otsync.compute.simd import LANES
from recon.losses.window import C1, C2

F32 = np.float32
ZERO, ONE, TWO = F32(0), F32(1), F32(2)
FIRST, SECOND = F32(C1), F32(C2)
MOMENTS = 5  # blurred x, y, x^2, y^2, x y
SLOPES = 3  # derivatives of SSIM with respect to the blurred x, x^2 and x y

_fast = kernel(fastmath={"contract", "reassoc", "arcp", "nsz"})
_inline = inlined(fastmath={"contract", "reassoc", "arcp", "nsz"})


@_inline
def _enter(q, rows, images, size, start, stride):
    """Put row q into the rings: x mixed with y where it is unusable, y, and the weight per value."""
    ring_x, ring_y, ring_w = rows
    x, y, usable = images
    height, width, channels = size
    n = width * channels
    if q < 0 or q >= height:
        for ring in rows:
            ring[start : start + stride] = ZERO
        return
    at = q * n
    if len(usable) == 0:
        for j in range(n):
            ring_x[start + j] = x[at + j]
            ring_y[start + j] = y[at + j]
            ring_w[start + j] = ONE
        return
    for i in range(width):
        w = usable[q * width + i]
        for j in range(i * channels, (i + 1) * channels):
            ring_y[start + j] = y[at + j]
            ring_x[start + j] = y[at + j] + w * (x[at + j] - y[at + j])
            ring_w[start + j] = w


@_inline
def _blur_moments_down(i, rows, window, base, stride, span, moments):
    """Moments of row i, blurred over the rows around it: `moments` [MOMENTS * stride]."""
    ring_x, ring_y, _ = rows
    taps = len(window)
    radius = taps // 2
    for j in range(base, base + span, LANES):
        x, y = simd.load(ring_x, (i % taps) * stride + j), simd.load(ring_y, (i % taps) * stride + j)
        k = window[radius]
        mx, my, xx, yy, xy = x * k, y * k, x * x * k, y * y * k, x * y * k
        for d in range(1, radius + 1):
            above, below = ((i - d) % taps) * stride + j, ((i + d) % taps) * stride + j
            x, y = simd.load(ring_x, above), simd.load(ring_y, above)
            u, v = simd.load(ring_x, below), simd.load(ring_y, below)
            k = window[radius + d]
            mx, my = mx + (x + u) * k, my + (y + v) * k
            xx, yy, xy = xx + (x * x + u * u) * k, yy + (y * y + v * v) * k, xy + (x * y + u * v) * k
        simd.store(moments, j, mx)
        simd.store(moments, stride + j, my)
        simd.store(moments, 2 * stride + j, xx)
        simd.store(moments, 3 * stride + j, yy)
        simd.store(moments, 4 * stride + j, xy)


@_inline
def _blur_along(row, at, window, step):
    """LANES values of a row, blurred along it; neighbours are `step` floats apart."""
    radius = len(window) // 2
    out = simd.load(row, at) * window[radius]
    for d in range(1, radius + 1):
        out = out + (simd.load(row, at - d * step) + simd.load(row, at + d * step)) * window[radius + d]
    return out


@_inline
def _compare(moments, weights, at, window, step, base, stride, span, slopes, out):
    """SSIM of a row: returns the sum of weight * (1 - SSIM); writes weighted derivatives to `slopes` from `out` on."""
    total = simd.spread(ZERO)
    for j in range(base, base + span, LANES):
        mx, my = _blur_along(moments, j, window, step), _blur_along(moments, stride + j, window, step)
        xx, yy = _blur_along(moments, 2 * stride + j, window, step), _blur_along(moments, 3 * stride + j, window, step)
        xy = _blur_along(moments, 4 * stride + j, window, step)
        a, b = TWO * mx * my + FIRST, TWO * (xy - mx * my) + SECOND
        means, variances = mx * mx + my * my + FIRST, (xx - mx * mx) + (yy - my * my) + SECOND
        per = ONE / (means * variances)
        similar = a * b * per
        weight = simd.load(weights, at + j - base)
        total = total + weight * (ONE - similar)
        per_means, per_variances = variances * per, means * per
        g_mean = TWO * (my * (b - a) * per + mx * similar * (per_variances - per_means))
        simd.store(slopes, out + j, g_mean * weight)
        simd.store(slopes, out + stride + j, (ZERO - similar) * per_variances * weight)
        simd.store(slopes, out + 2 * stride + j, TWO * a * per * weight)
    return simd.total(total)


@_inline
def _blur_slopes_down(i, slopes, window, base, stride, span, blurred):
    """Derivatives around row i, blurred over the rows: `blurred` [SLOPES * stride]."""
    taps = len(window)
    radius = taps // 2
    for s in range(SLOPES):
        for j in range(base, base + span, LANES):
            out = simd.load(slopes, ((i % taps) * SLOPES + s) * stride + j) * window[radius]
            for d in range(1, radius + 1):
                above = (((i - d) % taps) * SLOPES + s) * stride + j
                below = (((i + d) % taps) * SLOPES + s) * stride + j
                out = out + (simd.load(slopes, above) + simd.load(slopes, below)) * window[radius + d]
            simd.store(blurred, s * stride + j, out)


@_inline
def _gradient_row(rows, at, blurred, window, step, share, base, stride, span, out):
    """dL/dx of a row into `out`, and the sum of its absolute differences."""
    ring_x, ring_y, ring_w = rows
    total = simd.spread(ZERO)
    for j in range(0, span, LANES):
        x, y, w = simd.load(ring_x, at + j), simd.load(ring_y, at + j), simd.load(ring_w, at + j)
        k = base + j
        g_mean, g_xx = _blur_along(blurred, k, window, step), _blur_along(blurred, stride + k, window, step)
        g_xy = _blur_along(blurred, 2 * stride + k, window, step)
        difference = x - y
        total = total + simd.magnitude(difference)
        sign = simd.select(difference > ZERO, ONE, simd.select(difference < ZERO, -ONE, ZERO))
        simd.store(out, j, w * (sign - (g_mean + TWO * x * g_xx + y * g_xy) * share))
    return simd.total(total)


@_fast
def photometric(first, last, part, images, size, window, share, with_gradient, gradient, sums):
    """Sums and gradient over rows first..last.

    images = (x, y, usable), flat float32; usable [h * w] in 0..1, or empty: all 1. size = (h, w, c). window [taps].
    gradient: [h * w * c] of sum |x - y| + share * sum (1 - SSIM), weighted by usable. sums[part] = those two sums.
    """
    height, width, channels = size
    taps = len(window)
    radius = taps // 2
    n = width * channels
    span = (n + LANES - 1) // LANES * LANES
    base = (radius * channels + LANES - 1) // LANES * LANES
    stride = base + span + base
    size3 = (np.int64(height), np.int64(width), np.int64(channels))
    rows = (np.zeros(taps * stride, F32), np.zeros(taps * stride, F32), np.zeros(taps * stride, F32))
    moments, blurred = np.zeros(MOMENTS * stride, F32), np.zeros(SLOPES * stride, F32)
    slopes = np.zeros(taps * SLOPES * stride, F32)
    line = np.empty(span, F32)
    halo = radius if with_gradient else 0
    difference, dissimilar = 0.0, 0.0
    for q in range(first - halo - radius, first - halo + radius):
        _enter(q, rows, images, size3, (q % taps) * stride + base, span)
    for i in range(first - halo, last + halo):
        _enter(i + radius, rows, images, size3, ((i + radius) % taps) * stride + base, span)
        into = (i % taps) * SLOPES * stride
        if 0 <= i < height:
            _blur_moments_down(i, rows, window, base, stride, span, moments)
            lost = _compare(
                moments, rows[2], (i % taps) * stride + base, window, channels, base, stride, span, slopes, into
            )
            if first <= i < last:
                dissimilar += lost
        else:
            slopes[into : into + SLOPES * stride] = ZERO
        done = i - halo
        if not first <= done < last:
            continue
        if with_gradient:
            _blur_slopes_down(done, slopes, window, base, stride, span, blurred)
        at = (done % taps) * stride + base
        difference += _gradient_row(rows, at, blurred, window, channels, share, base, stride, span, line)
        if with_gradient:
            gradient[done * n : (done + 1) * n] = line[:n]
    sums[part, 0], sums[part, 1] = difference, dissimilar
