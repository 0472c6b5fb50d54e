"""Projection of 3-D Gaussians to splats in plain torch: the definition that the other back ends are held to.

EWA splatting (Zwicker et al. 2002) as in 3DGS: the covariance is carried through the linearised pinhole projection.
Everything runs in float64 whatever the input: the projection is a small part of the work, and in float32 a scene 10^4
units from the origin would miss its pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from recon.raster.rendering import ALPHA_MIN, QUAT_NORM2_MIN, RADIUS_SIGMAS, Settings, Splats
from recon.rotations import rotation_matrices

FRUSTUM_MARGIN = 0.3  # of tan(fov / 2): how far outside the image the Jacobian still follows x / z
MAX_RADIUS = 2**30  # radii are int32


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
    """Project N Gaussians into C cameras; differentiable in everything but `Ks`.

    means [N,3], quats [N,4] wxyz (any length), scales [N,3], opacities [N], viewmats [C,4,4] world-to-camera in OpenCV
    axes, Ks [C,3,3]. All entries finite. Gaussians that are not drawn have radii 0 and harmless values.
    """
    dtype = means.dtype
    means, quats, scales, opacities, viewmats, K = (
        t.to(torch.float64) for t in (means, quats, scales, opacities, viewmats, Ks.detach())
    )
    eps = settings.eps2d
    fx, fy, cx, cy = (K[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))

    camera = torch.einsum("cij,nj->cni", viewmats[:, :3, :3], means) + viewmats[:, None, :3, 3]
    x, y, z = camera.unbind(-1)
    depths = z.to(dtype)
    norm2 = (quats * quats).sum(-1)
    drawn = (depths >= torch.tensor(settings.near_plane, dtype=dtype)) & (depths <= settings.far_plane)
    drawn = drawn & (norm2 >= QUAT_NORM2_MIN)
    # what is not drawn is replaced *before* the division: where() alone would let 0 * inf into the gradient
    z = torch.where(drawn, z, 1.0)
    unit = quats / torch.where(norm2 >= QUAT_NORM2_MIN, norm2, 1.0).sqrt()[:, None]

    # u, v: rows of J R M, the two pixel axes of the Gaussian; S = [u, v][u, v]^T + eps I
    axes = viewmats[:, None, :3, :3] @ (rotation_matrices(unit) * scales[:, None, :])
    tan_x, tan_y = x / z, y / z
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
    clamped_x = torch.maximum(torch.minimum(tan_x, (width - cx) / fx + margin_x), -(cx / fx + margin_x))
    clamped_y = torch.maximum(torch.minimum(tan_y, (height - cy) / fy + margin_y), -(cy / fy + margin_y))
    u = (fx / z)[..., None] * (axes[..., 0, :] - clamped_x[..., None] * axes[..., 2, :])
    v = (fy / z)[..., None] * (axes[..., 1, :] - clamped_y[..., None] * axes[..., 2, :])

    # determinants as sums of squares: nothing is subtracted, so needles keep their width
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    det_sharp = torch.linalg.cross(u, v).square().sum(-1)
    det = det_sharp + eps * (uu + vv) + eps * eps
    var_y = vv + eps
    drawn = drawn & (det > 0) & (det < torch.finfo(torch.float64).max) & (var_y > 0)
    det, var_y = torch.where(drawn, det, 1.0), torch.where(drawn, var_y, 1.0)
    rows = torch.stack([det / var_y, uv / var_y, var_y], -1)

    seen = opacities.expand(len(viewmats), -1)
    if settings.antialiased:
        sharp = drawn & (det_sharp > 0)
        seen = seen * torch.where(sharp, (torch.where(sharp, det_sharp, 1.0) / det).sqrt(), 0.0)
    means2d = torch.stack([fx * tan_x + cx, fy * tan_y + cy], -1)
    with torch.no_grad():
        drawn = drawn & (seen >= ALPHA_MIN)
        reach = (2 * (seen / ALPHA_MIN).clamp_min(1).log()).sqrt().clamp_max(RADIUS_SIGMAS)
        radii = (reach[..., None] * torch.stack([uu + eps, vv + eps], -1).sqrt()).ceil().clamp_max(MAX_RADIUS)
        inside = (means2d + radii > 0) & (means2d - radii < torch.tensor([width, height]))
        drawn = drawn & inside.all(-1) & (radii > settings.radius_clip).any(-1)
        radii = torch.where(drawn[..., None], radii, 0.0).to(torch.int32)
        exact = torch.cat([means2d, rows[..., 1:2]], -1)
        residuals = torch.where(drawn[..., None], exact - exact.to(dtype).to(torch.float64), 0.0).to(dtype)
    harmless = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
    return Splats(
        residuals=residuals,
        means2d=torch.where(drawn[..., None], means2d, 0.0).to(dtype),
        rows=torch.where(drawn[..., None], rows, harmless).to(dtype),
        depths=torch.where(drawn, z, 0.0).to(dtype),
        opacities=torch.where(drawn, seen, 0.0).to(dtype),
        radii=radii,
    )
