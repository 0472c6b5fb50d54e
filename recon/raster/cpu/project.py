"""Projection of 3-D Gaussians to splats, forward and backward, one Gaussian at a time.

The maths is that of :mod:`recon.raster.projection`, by hand. Local arithmetic is float64: it costs little here, and
keeps scenes far from the origin and needles exact until the result is rounded to float32.

Notation: (x, y, z) the mean in the camera frame; a, b the two rows of J R, in the world; k = a Q and l = b Q with Q the
Gaussian's rotation; u = k * scales and v = l * scales. The pixel covariance is S = [u, v][u, v]^T + eps I, and
|u x v|^2 is the determinant of its sharp part. A gradient of the loss with respect to q is called g_q.

Arguments that belong together travel as tuples: gaussians = (means, quats, scales, opacities), all float32;
cameras = (viewmats [C,4,4] float64, Ks [C,3,3] float32, width, height).
"""

from __future__ import annotations

import math

import numpy as np

from otsync.compute.jit import kernel
from otsync.compute.quaternions import rotation, rotation_backward, turned, turned_back, unit_backward
from recon.raster.projection import FRUSTUM_MARGIN, MAX_RADIUS
from recon.raster.rendering import ALPHA_MIN, QUAT_NORM2_MIN, RADIUS_SIGMAS

F64 = np.float64
ALPHA_MIN32 = np.float32(ALPHA_MIN)
HARMLESS_ROW = (1.0, 0.0, 1.0)

# no reassociation, and NaN and infinity keep their meaning: the guards rely on it
_kernel = kernel(fastmath={"contract", "nsz"})


@_kernel
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_kernel
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@_kernel
def _scaled(s, a):
    return s * a[0], s * a[1], s * a[2]


@_kernel
def _times(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@_kernel
def _plus(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@_kernel
def _entry3(array, i):
    return F64(array[i, 0]), F64(array[i, 1]), F64(array[i, 2])


@_kernel
def _unit_quaternion(quats, i):
    """(w, x, y, z) of unit length, and one over the length; zeros when it is no rotation."""
    w, x, y, z = F64(quats[i, 0]), F64(quats[i, 1]), F64(quats[i, 2]), F64(quats[i, 3])
    norm2 = w * w + x * x + y * y + z * z
    if not (norm2 >= QUAT_NORM2_MIN):
        return (0.0, 0.0, 0.0, 0.0), 0.0
    n = 1 / math.sqrt(norm2)
    return (w * n, x * n, y * n, z * n), n


@_kernel
def _view_row(V, c, i):
    return V[c, i, 0], V[c, i, 1], V[c, i, 2]


@_kernel
def _to_camera(V, c, p):
    x = _dot(_view_row(V, c, 0), p) + V[c, 0, 3]
    y = _dot(_view_row(V, c, 1), p) + V[c, 1, 3]
    z = _dot(_view_row(V, c, 2), p) + V[c, 2, 3]
    return x, y, z


@_kernel
def _intrinsics(K, c):
    return F64(K[c, 0, 0]), F64(K[c, 1, 1]), F64(K[c, 0, 2]), F64(K[c, 1, 2])


@_kernel
def _tangent_limits(focal, centre, size):
    """Range of x/z (or y/z) that the Jacobian follows: the image and a margin around it."""
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    return -(centre / focal + margin), (size - centre) / focal + margin


@_kernel
def _jacobian_rows(V, c, jx, jy, tx, ty):
    """a = jx (R0 - tx R2) and b = jy (R1 - ty R2), with R0, R1, R2 the rows of the camera's rotation."""
    back = _view_row(V, c, 2)
    a = _scaled(jx, _plus(_view_row(V, c, 0), _scaled(-tx, back)))
    b = _scaled(jy, _plus(_view_row(V, c, 1), _scaled(-ty, back)))
    return a, b


@_kernel
def _determinants(u, v, eps):
    """det of the sharp covariance and of the blurred one, as sums of squares: nothing is subtracted."""
    cross = _cross(u, v)
    sharp = _dot(cross, cross)
    return sharp, sharp + eps * (_dot(u, u) + _dot(v, v)) + eps * eps


@_kernel
def forward(first, last, gaussians, cameras, limits, antialiased, outputs):
    """Project Gaussians first..last into every camera.

    limits = (near, far, radius_clip, eps2d); outputs as :class:`recon.raster.rendering.Splats`, overwritten.
    Guards are written `not (x >= limit)`, so that a NaN is not drawn.
    """
    means, quats, scales, opacities = gaussians
    V, K, width, height = cameras
    near, far, radius_clip, eps = limits
    means2d, rows, depths, seen, radii, residuals = outputs
    for c in range(V.shape[0]):
        fx, fy, cx, cy = _intrinsics(K, c)
        low_x, high_x = _tangent_limits(fx, cx, width)
        low_y, high_y = _tangent_limits(fy, cy, height)
        for i in range(first, last):
            for j in range(3):
                rows[c, i, j] = HARMLESS_ROW[j]
                residuals[c, i, j] = 0
            for j in range(2):
                means2d[c, i, j] = 0
                radii[c, i, j] = 0
            depths[c, i] = 0
            seen[c, i] = 0
            x, y, z = _to_camera(V, c, _entry3(means, i))
            depth = np.float32(z)
            q, n = _unit_quaternion(quats, i)
            if not (near <= depth <= far and n > 0):
                continue
            tan_x, tan_y = x / z, y / z
            tx, ty = min(max(tan_x, low_x), high_x), min(max(tan_y, low_y), high_y)
            a, b = _jacobian_rows(V, c, fx / z, fy / z, tx, ty)
            Q, s = rotation(q), _entry3(scales, i)
            u, v = _times(turned_back(Q, a), s), _times(turned_back(Q, b), s)
            sharp, det = _determinants(u, v, eps)
            var_x_all, var_y = _dot(u, u) + eps, _dot(v, v) + eps
            if not (det > 0 and det < np.inf and var_y > 0):
                continue
            opacity = F64(opacities[i])
            if antialiased:
                opacity *= math.sqrt(sharp / det)
            if not (np.float32(opacity) >= ALPHA_MIN32):
                continue
            reach = min(RADIUS_SIGMAS, math.sqrt(2 * math.log(max(opacity / ALPHA_MIN, 1.0))))
            radius_x = np.ceil(min(reach * math.sqrt(var_x_all), F64(MAX_RADIUS)))
            radius_y = np.ceil(min(reach * math.sqrt(var_y), F64(MAX_RADIUS)))
            mx, my = fx * tan_x + cx, fy * tan_y + cy
            if not (radius_x > radius_clip or radius_y > radius_clip):
                continue
            if not (mx + radius_x > 0 and mx - radius_x < width and my + radius_y > 0 and my - radius_y < height):
                continue
            slope = _dot(u, v) / var_y
            radii[c, i, 0], radii[c, i, 1] = np.int32(radius_x), np.int32(radius_y)
            means2d[c, i, 0], means2d[c, i, 1] = mx, my
            rows[c, i, 0], rows[c, i, 1], rows[c, i, 2] = det / var_y, slope, var_y
            residuals[c, i, 0], residuals[c, i, 1] = mx - means2d[c, i, 0], my - means2d[c, i, 1]
            residuals[c, i, 2] = slope - rows[c, i, 1]
            depths[c, i] = depth
            seen[c, i] = opacity


@_kernel
def _covariance_gradient(u, v, eps, g_row):
    """Gradients of u and v from those of (var_x, slope, var_y).

    With w = u - slope v, the part of u that v does not explain (computed as (v x c + eps u) / var_y with c = u x v,
    without the subtraction), and because slope minimises |u - slope v|^2 + eps (1 + slope^2) = var_x:
        d var_x = 2 w.du - 2 slope w.dv,    d slope = (v.du + (w - slope v).dv) / var_y,    d var_y = 2 v.dv
    """
    per_y = 1 / (_dot(v, v) + eps)
    slope = _dot(u, v) * per_y
    w = _scaled(per_y, _plus(_cross(v, _cross(u, v)), _scaled(eps, u)))
    along, across = 2 * g_row[0], g_row[1] * per_y
    g_u = _plus(_scaled(along, w), _scaled(across, v))
    g_v = _plus(_scaled(across - slope * along, w), _scaled(2 * g_row[2] - across * slope, v))
    return g_u, g_v


@_kernel
def _compensation_gradient(u, v, eps, g_ratio):
    """The compensation r = |c| / sqrt(det), c = u x v, and its part of the gradients of u and v.

    |c| and not |c|^2 is differentiated, and 1 - r^2 is not subtracted, so that thin splats keep their digits:
        dr = (1 - r^2) d|c| / sqrt(det) - r eps (u.du + v.dv) / det,    1 - r^2 = (eps (|u|^2 + |v|^2) + eps^2) / det
        d|c| = ((v x c).du + (c x u).dv) / |c|
    """
    sharp, det = _determinants(u, v, eps)
    if not (sharp > 0):
        return 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    blur = eps * (_dot(u, u) + _dot(v, v)) + eps * eps
    c, root = _cross(u, v), math.sqrt(sharp * det)
    ratio = sharp / root
    grow = g_ratio * (blur / det) / root
    shrink = -g_ratio * ratio * eps / det
    g_u = _plus(_scaled(grow, _cross(v, c)), _scaled(shrink, u))
    g_v = _plus(_scaled(grow, _cross(c, u)), _scaled(shrink, v))
    return ratio, g_u, g_v


@_kernel
def _add_view_gradient(g_view, p, g_camera, tx, ty, g_a, g_b):
    """Add to g_view [3,4]: the mean's share g_camera (p, 1)^T, and the shares of a / jx and b / jy."""
    for j in range(3):
        g_view[0, j] += g_camera[0] * p[j] + g_a[j]
        g_view[1, j] += g_camera[1] * p[j] + g_b[j]
        g_view[2, j] += g_camera[2] * p[j] - tx * g_a[j] - ty * g_b[j]
    for i in range(3):
        g_view[i, 3] += g_camera[i]


@_kernel
def _add_outer(G, a, g):
    """G + a g^T, row by row."""
    r0, r1, r2 = _scaled(a[0], g), _scaled(a[1], g), _scaled(a[2], g)
    return (
        G[0] + r0[0],
        G[1] + r0[1],
        G[2] + r0[2],
        G[3] + r1[0],
        G[4] + r1[1],
        G[5] + r1[2],
        G[6] + r2[0],
        G[7] + r2[1],
        G[8] + r2[2],
    )


@_kernel
def backward(first, last, part, gaussians, cameras, eps, antialiased, radii, incoming, outgoing, g_views):
    """Gradients of Gaussians first..last, summed over the cameras; those of the cameras go to g_views[part] [C,3,4].

    incoming: gradients of (means2d, rows, depths, opacities) [C,N,...]; outgoing: of the Gaussians, overwritten.
    Partial sums per part, with parts of a fixed size, make the sum independent of the number of threads.
    """
    means, quats, scales, opacities = gaussians
    V, K, width, height = cameras
    g_means2d, g_rows, g_depths, g_seen = incoming
    g_means, g_quats, g_scales, g_opacities = outgoing
    for i in range(first, last):
        p, s = _entry3(means, i), _entry3(scales, i)
        q, n = _unit_quaternion(quats, i)
        Q = rotation(q)
        g_p, g_s, g_o = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
        G = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        for c in range(V.shape[0]):
            if radii[c, i, 0] <= 0 and radii[c, i, 1] <= 0:
                continue
            fx, fy, cx, cy = _intrinsics(K, c)
            low_x, high_x = _tangent_limits(fx, cx, width)
            low_y, high_y = _tangent_limits(fy, cy, height)
            x, y, z = _to_camera(V, c, p)
            tan_x, tan_y = x / z, y / z
            tx, ty = min(max(tan_x, low_x), high_x), min(max(tan_y, low_y), high_y)
            jx, jy = fx / z, fy / z
            a, b = _jacobian_rows(V, c, jx, jy, tx, ty)
            k, l = turned_back(Q, a), turned_back(Q, b)
            u, v = _times(k, s), _times(l, s)
            g_u, g_v = _covariance_gradient(u, v, eps, _entry3(g_rows[c], i))
            ratio = 1.0
            if antialiased:
                ratio, more_u, more_v = _compensation_gradient(u, v, eps, F64(g_seen[c, i]) * opacities[i])
                g_u, g_v = _plus(g_u, more_u), _plus(g_v, more_v)
            g_o += ratio * g_seen[c, i]
            g_s = _plus(g_s, _plus(_times(g_u, k), _times(g_v, l)))
            g_k, g_l = _times(g_u, s), _times(g_v, s)
            G = _add_outer(_add_outer(G, a, g_k), b, g_l)
            g_a, g_b = turned(Q, g_k), turned(Q, g_l)
            back = _view_row(V, c, 2)
            # the 2-D mean follows x/z everywhere, the Jacobian only inside its limits
            g_tan_x, g_tan_y = fx * g_means2d[c, i, 0], fy * g_means2d[c, i, 1]
            if low_x <= tan_x <= high_x:
                g_tan_x -= jx * _dot(back, g_a)
            if low_y <= tan_y <= high_y:
                g_tan_y -= jy * _dot(back, g_b)
            # jx and jy are proportional to a and b, so that g_jx jx = a.g_a
            g_z = g_depths[c, i] - (g_tan_x * tan_x + g_tan_y * tan_y + _dot(a, g_a) + _dot(b, g_b)) / z
            g_camera = (g_tan_x / z, g_tan_y / z, g_z)
            to_world = _plus(_scaled(g_camera[0], _view_row(V, c, 0)), _scaled(g_camera[1], _view_row(V, c, 1)))
            g_p = _plus(g_p, _plus(to_world, _scaled(g_z, back)))
            _add_view_gradient(g_views[part, c], p, g_camera, tx, ty, _scaled(jx, g_a), _scaled(jy, g_b))
        g_q = unit_backward(q, n, rotation_backward(q, G))
        g_opacities[i] = g_o
        for j in range(3):
            g_means[i, j], g_scales[i, j] = g_p[j], g_s[j]
        for j in range(4):
            g_quats[i, j] = g_q[j]
