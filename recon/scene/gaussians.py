"""3D Gaussians in the parametrisation of 3DGS (Kerbl et al. 2023), and their rendering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from otsync.types import Camera
from recon.raster import Rendering, render, sh


@dataclass(frozen=True, repr=False)
class Gaussians:
    """N Gaussians as 3DGS optimises them: unconstrained numbers; their activated values are properties.

    means [N,3] world units; quats [N,4] wxyz, any length; log_scales [N,3]; opacity_logits [N];
    sh [N,K,3] spherical-harmonics coefficients of the colour, the constant (DC) first, K = (degree + 1)^2.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor

    def __post_init__(self) -> None:
        n = len(self.means)
        expected = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,)}
        for name, shape in expected.items():
            actual = tuple(getattr(self, name).shape)
            if actual != shape:
                raise ValueError(f"{name}: expected shape {shape} for {n} means; found {actual}.")
        if (
            self.sh.ndim != 3
            or self.sh.shape[0] != n
            or self.sh.shape[2] != 3
            or self.sh.shape[1] not in (1, 4, 9, 16, 25)
        ):
            raise ValueError(f"sh: expected shape ({n}, 1 | 4 | 9 | 16 | 25, 3); found {tuple(self.sh.shape)}.")

    @classmethod
    def from_colors(
        cls, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, *, sh_degree: int = 0
    ) -> Gaussians:
        """From activated values: scales >= 0 [N,3], opacities in 0..1 [N], colours [N,3], alike from all sides.

        sh_degree: 0..4, the degree to leave room for; coefficients above the constant are 0.

        Scales below 1e-12 and opacities within 1e-6 of 0 and 1 become these limits, whose logarithms are finite.
        """
        if (scales < 0).any() or (opacities < 0).any() or (opacities > 1).any():
            raise ValueError("scales, opacities: expected scales >= 0 and opacities in 0..1; found values beyond.")
        scales, opacities = scales.clamp_min(1e-12), opacities.clamp(1e-6, 1 - 1e-6)
        if sh_degree not in range(sh.MAX_DEGREE + 1):
            raise ValueError(f"sh_degree: expected 0 to {sh.MAX_DEGREE}; found {sh_degree}.")
        constant = ((colors - 0.5) / sh.C0)[:, None]
        rest = constant.new_zeros(len(means), (sh_degree + 1) ** 2 - 1, 3)
        return cls(means, quats, scales.log(), opacities.logit(), torch.cat([constant, rest], 1))

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"Gaussians({len(self)}, sh_degree={self.sh_degree}, {self.means.device})"

    @property
    def scales(self) -> Tensor:
        """Standard deviations along the axes, world units [N,3]."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities in 0..1 [N]."""
        return self.opacity_logits.sigmoid()

    @property
    def sh_degree(self) -> int:
        """Degree of the colour's spherical harmonics."""
        return int(self.sh.shape[1] ** 0.5) - 1

    def render(self, camera: Camera | Sequence[Camera], **options: Any) -> Rendering:
        """Render them as `camera` sees them; options are those of :func:`recon.raster.render`.

        Several cameras of one image size, and the T poses of a moving camera, become the C images of the rendering.
        A Camera is a pinhole here: one with distortion is refused (undistort its images), readout is ignored.
        """
        cameras = [camera] if isinstance(camera, Camera) else list(camera)
        sizes = {(c.width, c.height) for c in cameras}
        if len(sizes) != 1:
            raise ValueError(
                f"camera: expected one or more cameras of one image size; found sizes {sorted(sizes)}. "
                "Render each size by itself."
            )
        if any(c.distortion is not None and np.any(c.distortion) for c in cameras):
            raise ValueError("camera: expected no distortion; found coefficients. Undistort the images and drop them.")
        w2c = [np.atleast_3d(c.w2c).reshape(-1, 4, 4) for c in cameras]
        Ks = np.concatenate([np.repeat(c.K[None], len(v), 0) for c, v in zip(cameras, w2c, strict=True)])
        viewmats = torch.as_tensor(np.concatenate(w2c)).to(self.means)
        options.setdefault("sh_degree", self.sh_degree)
        (size,) = sizes
        splats = (self.means, self.quats, self.scales, self.opacities, self.sh)
        return render(*splats, viewmats, torch.as_tensor(Ks).to(self.means), *size, **options)

    def detach(self) -> Gaussians:
        """The same Gaussians without their graph, on the CPU in float32: what files hold."""
        return Gaussians(*(getattr(self, f.name).detach().float().cpu() for f in fields(self)))

    def to(self, device: torch.device | str) -> Gaussians:
        """The same Gaussians on another device."""
        return Gaussians(*(getattr(self, f.name).to(device) for f in fields(self)))

    def finite(self) -> Gaussians:
        """These Gaussians; ValueError where a parameter is NaN or infinite, which no file should hold."""
        for f in fields(self):
            if not getattr(self, f.name).isfinite().all():
                raise ValueError(
                    f"gaussians.{f.name}: expected finite values; found NaN or infinity. The fit has diverged."
                )
        return self
