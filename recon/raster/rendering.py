"""Values that the back ends share: thresholds, Settings, Splats, Rendering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from torch import Tensor

ALPHA_MIN = 1.0 / 255.0  # a splat fainter than this at a pixel does not touch the pixel
ALPHA_MAX = 0.999  # a splat never covers a pixel completely: the transmittance stays invertible
TRANSMITTANCE_MIN = 1e-4  # a pixel is finished before the splat that would bring it to or below this
RADIUS_SIGMAS = 3.33  # cap of the reported radius, in standard deviations
QUAT_NORM2_MIN = 1e-24  # a quaternion with a squared norm below this is no rotation: the Gaussian is not drawn


@dataclass(frozen=True)
class Settings:
    """How to project and what to return, with gsplat's names and defaults.

    near_plane, far_plane: a Gaussian is kept when near <= z <= far (z of its mean, camera frame, world units).
    radius_clip: Gaussians whose two pixel radii are both at most this are dropped.
    eps2d: variance in square pixels added to both axes of every projected Gaussian.
    rasterize_mode: "classic", or "antialiased": the opacity is multiplied by sqrt(det(cov) / det(cov + eps2d I)),
        so that eps2d widens a splat without brightening it (Mip-Splatting, Yu et al. 2024).
    sh_degree: None where `colors` are colours; else they are spherical-harmonics coefficients, used up to this degree.
    depth: "expected" (sum of weight * z over the alpha), "accumulated" (sum of weight * z), or None: not computed.
    """

    near_plane: float = 0.01
    far_plane: float = 1e10
    radius_clip: float = 0.0
    eps2d: float = 0.3
    rasterize_mode: Literal["classic", "antialiased"] = "classic"
    sh_degree: int | None = None
    depth: Literal["expected", "accumulated"] | None = "expected"

    def __post_init__(self) -> None:
        if self.rasterize_mode not in ("classic", "antialiased"):
            raise ValueError(f"rasterize_mode: expected 'classic' or 'antialiased'; found {self.rasterize_mode!r}.")
        if self.depth not in ("expected", "accumulated", None):
            raise ValueError(f"depth: expected 'expected', 'accumulated' or None; found {self.depth!r}.")
        if not 0 <= self.near_plane < self.far_plane:
            raise ValueError(
                f"near_plane, far_plane: expected 0 <= near < far; found {self.near_plane}, {self.far_plane}."
            )
        if not 0 <= self.eps2d < float("inf"):
            raise ValueError(f"eps2d: expected a variance >= 0 in square pixels; found {self.eps2d}.")
        if self.sh_degree is not None and self.sh_degree not in range(5):
            raise ValueError(f"sh_degree: expected 0 to 4 or None (plain colours); found {self.sh_degree}.")

    @property
    def antialiased(self) -> bool:
        """True when the opacity is compensated for the blur of eps2d."""
        return self.rasterize_mode == "antialiased"


class Splats(NamedTuple):
    """Projected Gaussians, which the projection node hands to the rasterization node. C cameras, N Gaussians.

    The 2x2 pixel covariance S = [[A, B], [B, C]] travels in the *centred-row form* (its LDL factors): on the pixel row
    dy below the mean, the splat is a 1-D Gaussian centred at dx = slope * dy,

        sigma(dx, dy) = (dx - slope * dy)^2 / (2 var_x) + dy^2 / (2 var_y),   alpha = opacity * exp(-sigma)

    with var_y = C, slope = B / C and var_x = det S / C, the variance of x given y. It is never negative and, unlike the
    conic (the inverse of S), loses no digits for needles.
    """

    means2d: Tensor  # [C,N,2] pixels; the centre of the top left pixel is (0.5, 0.5)
    rows: Tensor  # [C,N,3] var_x (pixel^2), slope (pixels per pixel), var_y (pixel^2)
    depths: Tensor  # [C,N] z in the camera frame
    opacities: Tensor  # [C,N] compensated when antialiased
    radii: Tensor  # [C,N,2] int32 pixels; 0 where the Gaussian is not drawn
    residuals: Tensor  # [C,N,3] rounding errors of means2d (x, y) and of the slope; no gradient

    # Without the residuals a needle a hundredth of a pixel wide would be 10^-3 wrong: its position on a row is
    # mean_x + slope * dy, and float32 knows that to 10^-6 pixels only.


@dataclass(frozen=True)
class Rendering:
    """Images of C cameras, with the means and radii that densification asks for.

    `means2d` takes part in the graph: call `rendering.means2d.retain_grad()` before `backward()`, or pass it to
    `torch.autograd.grad`, to read the gradient of the loss with respect to the 2-D means (per pixel); `radii > 0` are
    the Gaussians that were drawn. It is the very tensor that was rasterized: a view of it would not be in the graph and
    would have no gradient. So it keeps gsplat's own shape, which is [C,1,M,2] where means are [C,N,3], one set per
    camera, and M may exceed N by rows that are not drawn; `grad.reshape(C, -1, 2)[:, :N]` is [C,N,2] everywhere.
    """

    colors: Tensor  # [C,H,W,D]
    alphas: Tensor  # [C,H,W,1] 1 - transmittance
    depths: Tensor | None  # [C,H,W,1] z in the camera frame, expected or accumulated; None when not asked for
    means2d: Tensor  # [C,N,2] pixels; by gsplat [C,1,M,2], M >= N, where means are per camera
    radii: Tensor  # [C,N,2] int32 pixels
    backend: str  # "torch", "cpu" or "gsplat"
