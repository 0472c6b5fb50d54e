"""Projection of 3-D Gaussians to splats, forward and backward, one Gaussian at a time.

The maths is that of :mod:`recon.raster.projection`, by hand. Local arithmetic is float64: it costs little here, and
keeps scenes far from the origin and needles exact until the result is rounded to float32.

Notation: p = (x, y, z) the mean in the camera frame; k, l the rows of J R before, u, v after the scales; the pixel
covariance is S = [u, v][u, v]^T + eps I; c = u x v, so that |c|^2 = det of the sharp covariance.
"""

from __future__ import annotations

import math

import numpy as np

from recon.raster.cpu.threads import kernel
from recon.raster.projection import FRUSTUM_MARGIN, MAX_RADIUS
from recon.raster.rendering import ALPHA_MIN, QUAT_NORM2_MIN, RADIUS_SIGMAS

F64 = np.float64
ALPHA_MIN32 = np.float32(ALPHA_MIN)

_project_kernel = kernel(fastmath={"contract", "nsz"})
_inline = kernel(fastmath={"contract", "nsz"}, inline="never")


@_inline
def _camera_point(V, c, px, py, pz):
    x = V[c, 0, 0] * px + V[c, 0, 1] * py + V[c, 0, 2] * pz + V[c, 0, 3]
    y = V[c, 1, 0] * px + V[c, 1, 1] * py + V[c, 1, 2] * pz + V[c, 1, 3]
    z = V[c, 2, 0] * px + V[c, 2, 1] * py + V[c, 2, 2] * pz + V[c, 2, 3]
    return x, y, z


@_inline
def _rotation(w, x, y, z):
    """The nine entries of the rotation of a unit quaternion, row by row."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@_inline
def _clamp_limits(K, c, width, height):
    """Range of x/z and y/z that the Jacobian follows: the image and a margin around it."""
    fx, fy, cx, cy = F64(K[c, 0, 0]), F64(K[c, 1, 1]), F64(K[c, 0, 2]), F64(K[c, 1, 2])
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
    return -(cx / fx + margin_x), (width - cx) / fx + margin_x, -(cy / fy + margin_y), (height - cy) / fy + margin_y


@_inline
def _jacobian_rows(V, c, jx, jy, tx, ty):
    """The two rows of J R in the world: jx (R0 - tx R2) and jy (R1 - ty R2)."""
    return (
        jx * (V[c, 0, 0] - tx * V[c, 2, 0]),
        jx * (V[c, 0, 1] - tx * V[c, 2, 1]),
        jx * (V[c, 0, 2] - tx * V[c, 2, 2]),
        jy * (V[c, 1, 0] - ty * V[c, 2, 0]),
        jy * (V[c, 1, 1] - ty * V[c, 2, 1]),
        jy * (V[c, 1, 2] - ty * V[c, 2, 2]),
    )


@_project_kernel
def forward(
    first, last, means, quats, scales, opacities, V, K, width, height, limits, antialiased,
    means2d, rows, depths, seen, radii, residuals,
):  # fmt: skip
    """Project Gaussians first..last into every camera; limits = (near, far, radius_clip, eps2d).

    V [C,4,4] and all arithmetic float64. Guards are written `not (x >= limit)`, so that a NaN is not drawn.
    """
    near, far, radius_clip, eps = limits
    for c in range(V.shape[0]):
        fx, fy, cx, cy = F64(K[c, 0, 0]), F64(K[c, 1, 1]), F64(K[c, 0, 2]), F64(K[c, 1, 2])
        low_x, high_x, low_y, high_y = _clamp_limits(K, c, width, height)
        for i in range(first, last):
            radii[c, i, 0] = 0
            radii[c, i, 1] = 0
            means2d[c, i, 0] = 0
            means2d[c, i, 1] = 0
            rows[c, i, 0] = 1
            rows[c, i, 1] = 0
            rows[c, i, 2] = 1
            depths[c, i] = 0
            seen[c, i] = 0
            x, y, z = _camera_point(V, c, F64(means[i, 0]), F64(means[i, 1]), F64(means[i, 2]))
            depth = np.float32(z)
            if not (near <= depth <= far):
                continue
            qw, qx, qy, qz = F64(quats[i, 0]), F64(quats[i, 1]), F64(quats[i, 2]), F64(quats[i, 3])
            norm2 = qw * qw + qx * qx + qy * qy + qz * qz
            if not (norm2 >= QUAT_NORM2_MIN):
                continue
            n = 1 / math.sqrt(norm2)
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(qw * n, qx * n, qy * n, qz * n)
            per_z = 1 / z
            tan_x, tan_y = x * per_z, y * per_z
            tx, ty = min(max(tan_x, low_x), high_x), min(max(tan_y, low_y), high_y)
            a0, a1, a2, b0, b1, b2 = _jacobian_rows(V, c, fx * per_z, fy * per_z, tx, ty)
            s0, s1, s2 = F64(scales[i, 0]), F64(scales[i, 1]), F64(scales[i, 2])
            u0, u1, u2 = (a0 * r00 + a1 * r10 + a2 * r20) * s0, (a0 * r01 + a1 * r11 + a2 * r21) * s1, (a0 * r02 + a1 * r12 + a2 * r22) * s2
            v0, v1, v2 = (b0 * r00 + b1 * r10 + b2 * r20) * s0, (b0 * r01 + b1 * r11 + b2 * r21) * s1, (b0 * r02 + b1 * r12 + b2 * r22) * s2
            uu, vv, uv = u0 * u0 + u1 * u1 + u2 * u2, v0 * v0 + v1 * v1 + v2 * v2, u0 * v0 + u1 * v1 + u2 * v2
            c0, c1, c2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
            det_sharp = c0 * c0 + c1 * c1 + c2 * c2
            det = det_sharp + eps * (uu + vv) + eps * eps
            var_y = vv + eps
            if not (det > 0 and det < np.inf and var_y > 0):
                continue
            opacity = F64(opacities[i])
            if antialiased:
                opacity *= math.sqrt(det_sharp / det)
            if not (np.float32(opacity) >= ALPHA_MIN32):
                continue
            reach = min(RADIUS_SIGMAS, math.sqrt(2 * math.log(max(opacity / ALPHA_MIN, 1.0))))
            radius_x = math.ceil(min(reach * math.sqrt(uu + eps), F64(MAX_RADIUS)))
            radius_y = math.ceil(min(reach * math.sqrt(var_y), F64(MAX_RADIUS)))
            if not (radius_x > radius_clip or radius_y > radius_clip):
                continue
            mx, my = fx * tan_x + cx, fy * tan_y + cy
            if not (mx + radius_x > 0 and mx - radius_x < width and my + radius_y > 0 and my - radius_y < height):
                continue
            radii[c, i, 0] = np.int32(radius_x)
            radii[c, i, 1] = np.int32(radius_y)
            means2d[c, i, 0] = mx
            means2d[c, i, 1] = my
            rows[c, i, 0] = det / var_y
            rows[c, i, 1] = uv / var_y
            rows[c, i, 2] = var_y
            residuals[c, i, 0] = mx - means2d[c, i, 0]
            residuals[c, i, 1] = my - means2d[c, i, 1]
            residuals[c, i, 2] = uv / var_y - rows[c, i, 1]
            depths[c, i] = depth
            seen[c, i] = opacity


@_inline
def _covariance_gradient(u, v, eps, v_var_x, v_slope, v_var_y, v_opacity, antialiased):
    """Gradients with respect to u and v, and of the compensated opacity with respect to the opacity.

    With w = u - slope * v, the part of u that v does not explain (computed as (v x c + eps u) / var_y, without the
    subtraction), and because slope minimises |u - slope v|^2 + eps (1 + slope^2) = var_x:
        d var_x = 2 w.du - 2 slope w.dv,    d slope = (v.du + (w - slope v).dv) / var_y,    d var_y = 2 v.dv
    For the compensation r = |c| / sqrt(det), with |c| and not |c|^2 differentiated so that thin splats keep digits:
        dr = (1 - r^2) d|c| / sqrt(det) - r eps (u.du + v.dv) / det,    1 - r^2 = (eps (|u|^2 + |v|^2) + eps^2) / det
    """
    u0, u1, u2 = u
    v0, v1, v2 = v
    uu, vv, uv = u0 * u0 + u1 * u1 + u2 * u2, v0 * v0 + v1 * v1 + v2 * v2, u0 * v0 + u1 * v1 + u2 * v2
    c0, c1, c2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    per_y = 1 / (vv + eps)
    slope = uv * per_y
    n0, n1, n2 = v1 * c2 - v2 * c1, v2 * c0 - v0 * c2, v0 * c1 - v1 * c0  # v x c
    w0, w1, w2 = (n0 + eps * u0) * per_y, (n1 + eps * u1) * per_y, (n2 + eps * u2) * per_y
    gw, gs = 2 * v_var_x, v_slope * per_y
    gu0, gu1, gu2 = gw * w0 + gs * v0, gw * w1 + gs * v1, gw * w2 + gs * v2
    hw, hv = gs - slope * gw, 2 * v_var_y - gs * slope
    gv0, gv1, gv2 = hw * w0 + hv * v0, hw * w1 + hv * v1, hw * w2 + hv * v2
    ratio = 1.0
    if antialiased:
        sharp2 = c0 * c0 + c1 * c1 + c2 * c2
        blur = eps * (uu + vv) + eps * eps
        det = sharp2 + blur
        sharp = math.sqrt(sharp2)
        ratio = sharp / math.sqrt(det)
        if sharp > 0:
            along = v_opacity * (blur / det) / (math.sqrt(det) * sharp)  # times (v x c) and (c x u): d|c|
            back = v_opacity * ratio * eps / det
            m0, m1, m2 = c1 * u2 - c2 * u1, c2 * u0 - c0 * u2, c0 * u1 - c1 * u0  # c x u
            gu0, gu1, gu2 = gu0 + along * n0 - back * u0, gu1 + along * n1 - back * u1, gu2 + along * n2 - back * u2
            gv0, gv1, gv2 = gv0 + along * m0 - back * v0, gv1 + along * m1 - back * v1, gv2 + along * m2 - back * v2
    return gu0, gu1, gu2, gv0, gv1, gv2, ratio


@_project_kernel
def backward(
    first, last, part, means, quats, scales, opacities, V, K, width, height, eps, antialiased, radii,
    v_means2d, v_rows, v_depths, v_seen, v_means, v_quats, v_scales, v_opacities, v_views,
):  # fmt: skip
    """Gradients of Gaussians first..last, summed over the cameras; those of the cameras go to v_views[part] [C,3,4].

    Partial sums per part, with parts of a fixed size, make the sum independent of the number of threads.
    """
    for i in range(first, last):
        px, py, pz = F64(means[i, 0]), F64(means[i, 1]), F64(means[i, 2])
        qw, qx, qy, qz = F64(quats[i, 0]), F64(quats[i, 1]), F64(quats[i, 2]), F64(quats[i, 3])
        norm2 = qw * qw + qx * qx + qy * qy + qz * qz
        n = 1 / math.sqrt(max(norm2, QUAT_NORM2_MIN))
        qw, qx, qy, qz = qw * n, qx * n, qy * n, qz * n
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(qw, qx, qy, qz)
        s0, s1, s2 = F64(scales[i, 0]), F64(scales[i, 1]), F64(scales[i, 2])
        gm0, gm1, gm2, go = 0.0, 0.0, 0.0, 0.0
        gs0, gs1, gs2 = 0.0, 0.0, 0.0
        R00, R01, R02, R10, R11, R12, R20, R21, R22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for c in range(V.shape[0]):
            if radii[c, i, 0] <= 0 and radii[c, i, 1] <= 0:
                continue
            fx, fy = F64(K[c, 0, 0]), F64(K[c, 1, 1])
            low_x, high_x, low_y, high_y = _clamp_limits(K, c, width, height)
            x, y, z = _camera_point(V, c, px, py, pz)
            per_z = 1 / z
            tan_x, tan_y = x * per_z, y * per_z
            tx, ty = min(max(tan_x, low_x), high_x), min(max(tan_y, low_y), high_y)
            jx, jy = fx * per_z, fy * per_z
            a0, a1, a2, b0, b1, b2 = _jacobian_rows(V, c, jx, jy, tx, ty)
            k0, k1, k2 = a0 * r00 + a1 * r10 + a2 * r20, a0 * r01 + a1 * r11 + a2 * r21, a0 * r02 + a1 * r12 + a2 * r22
            l0, l1, l2 = b0 * r00 + b1 * r10 + b2 * r20, b0 * r01 + b1 * r11 + b2 * r21, b0 * r02 + b1 * r12 + b2 * r22
            gu0, gu1, gu2, gv0, gv1, gv2, ratio = _covariance_gradient(
                (k0 * s0, k1 * s1, k2 * s2), (l0 * s0, l1 * s1, l2 * s2), eps,
                F64(v_rows[c, i, 0]), F64(v_rows[c, i, 1]), F64(v_rows[c, i, 2]),
                F64(v_seen[c, i]) * F64(opacities[i]), antialiased,
            )  # fmt: skip
            go += ratio * v_seen[c, i]
            gs0, gs1, gs2 = gs0 + gu0 * k0 + gv0 * l0, gs1 + gu1 * k1 + gv1 * l1, gs2 + gu2 * k2 + gv2 * l2
            # from here on the gradients of k and l
            gu0, gu1, gu2, gv0, gv1, gv2 = gu0 * s0, gu1 * s1, gu2 * s2, gv0 * s0, gv1 * s1, gv2 * s2
            R00, R01, R02 = R00 + a0 * gu0 + b0 * gv0, R01 + a0 * gu1 + b0 * gv1, R02 + a0 * gu2 + b0 * gv2
            R10, R11, R12 = R10 + a1 * gu0 + b1 * gv0, R11 + a1 * gu1 + b1 * gv1, R12 + a1 * gu2 + b1 * gv2
            R20, R21, R22 = R20 + a2 * gu0 + b2 * gv0, R21 + a2 * gu1 + b2 * gv1, R22 + a2 * gu2 + b2 * gv2
            # gradients of the rows a, b of J R, then of jx, jy, tx, ty
            ga0, ga1, ga2 = r00 * gu0 + r01 * gu1 + r02 * gu2, r10 * gu0 + r11 * gu1 + r12 * gu2, r20 * gu0 + r21 * gu1 + r22 * gu2
            gb0, gb1, gb2 = r00 * gv0 + r01 * gv1 + r02 * gv2, r10 * gv0 + r11 * gv1 + r12 * gv2, r20 * gv0 + r21 * gv1 + r22 * gv2
            g_jx = (a0 * ga0 + a1 * ga1 + a2 * ga2) / jx
            g_jy = (b0 * gb0 + b1 * gb1 + b2 * gb2) / jy
            g_tx = -jx * (V[c, 2, 0] * ga0 + V[c, 2, 1] * ga1 + V[c, 2, 2] * ga2)
            g_ty = -jy * (V[c, 2, 0] * gb0 + V[c, 2, 1] * gb1 + V[c, 2, 2] * gb2)
            # the 2-D mean follows x/z everywhere, the Jacobian only inside its limits
            g_tan_x = fx * v_means2d[c, i, 0] + (g_tx if low_x <= tan_x <= high_x else 0.0)
            g_tan_y = fy * v_means2d[c, i, 1] + (g_ty if low_y <= tan_y <= high_y else 0.0)
            gx, gy = g_tan_x * per_z, g_tan_y * per_z
            gz = v_depths[c, i] - (g_tan_x * tan_x + g_tan_y * tan_y + g_jx * jx + g_jy * jy) * per_z
            gm0 += V[c, 0, 0] * gx + V[c, 1, 0] * gy + V[c, 2, 0] * gz
            gm1 += V[c, 0, 1] * gx + V[c, 1, 1] * gy + V[c, 2, 1] * gz
            gm2 += V[c, 0, 2] * gx + V[c, 1, 2] * gy + V[c, 2, 2] * gz
            ga0, ga1, ga2, gb0, gb1, gb2 = jx * ga0, jx * ga1, jx * ga2, jy * gb0, jy * gb1, jy * gb2
            gV = v_views[part, c]
            gV[0, 0] += gx * px + ga0
            gV[0, 1] += gx * py + ga1
            gV[0, 2] += gx * pz + ga2
            gV[0, 3] += gx
            gV[1, 0] += gy * px + gb0
            gV[1, 1] += gy * py + gb1
            gV[1, 2] += gy * pz + gb2
            gV[1, 3] += gy
            gV[2, 0] += gz * px - tx * ga0 - ty * gb0
            gV[2, 1] += gz * py - tx * ga1 - ty * gb1
            gV[2, 2] += gz * pz - tx * ga2 - ty * gb2
            gV[2, 3] += gz
        v_means[i, 0], v_means[i, 1], v_means[i, 2] = gm0, gm1, gm2
        v_scales[i, 0], v_scales[i, 1], v_scales[i, 2] = gs0, gs1, gs2
        v_opacities[i] = go
        gw = 2 * (qx * (R21 - R12) + qy * (R02 - R20) + qz * (R10 - R01))
        gx = 2 * (-2 * qx * (R11 + R22) + qy * (R10 + R01) + qz * (R20 + R02) + qw * (R21 - R12))
        gy = 2 * (qx * (R10 + R01) - 2 * qy * (R00 + R22) + qz * (R21 + R12) + qw * (R02 - R20))
        gz = 2 * (qx * (R20 + R02) + qy * (R21 + R12) - 2 * qz * (R00 + R11) + qw * (R10 - R01))
        radial = gw * qw + gx * qx + gy * qy + gz * qz  # the normalisation forgets the length
        v_quats[i, 0], v_quats[i, 1] = (gw - radial * qw) * n, (gx - radial * qx) * n
        v_quats[i, 2], v_quats[i, 3] = (gy - radial * qy) * n, (gz - radial * qz) * n
