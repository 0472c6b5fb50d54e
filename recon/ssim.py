"""Structural similarity of images: the definition in torch, for any float type and device."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

C1, C2 = 0.01**2, 0.03**2  # of Wang et al. 2004, for images in 0..1


@dataclass(frozen=True)
class Window:
    """The Gaussian window that local means, variances and covariances are taken over.

    taps: pixels on a side, odd. sigma: standard deviation in pixels.
    """

    taps: int = 7
    sigma: float = 1.2

    def __post_init__(self) -> None:
        if self.taps < 1 or self.taps % 2 == 0 or not self.sigma > 0:
            raise ValueError(f"Window: expected an odd number of taps and sigma > 0, found {self.taps}, {self.sigma}")

    @property
    def radius(self) -> int:
        """Pixels from the middle to the edge."""
        return self.taps // 2

    def weights(self) -> Tensor:
        """The window along one axis, [taps], sum 1, float64."""
        x = torch.arange(self.taps, dtype=torch.float64) - self.radius
        w = torch.exp(-0.5 * (x / self.sigma) ** 2)
        return w / w.sum()


SMALL, STANDARD = Window(7, 1.2), Window(11, 1.5)
"""What a fit compares with (the study's; 3 times cheaper), and the window of the literature's tables."""


def ssim_map(x: Tensor, y: Tensor, window: Window = STANDARD) -> Tensor:
    """SSIM of every pixel and channel of x against y, [h,w,c] each, colours in 0..1.

    Beyond the border images are black (zero padding), in both alike.
    """
    c, radius = x.shape[-1], window.radius
    k = window.weights().to(x)
    down, across = k.view(1, 1, -1, 1), k.view(1, 1, 1, -1)

    def blur(image: Tensor) -> Tensor:
        planes = image.movedim(-1, 0)[:, None]
        planes = F.conv2d(F.conv2d(planes, down, padding=(radius, 0)), across, padding=(0, radius))
        return planes[:, 0].movedim(0, -1)

    mean_x, mean_y, xx, yy, xy = blur(torch.cat([x, y, x * x, y * y, x * y], -1)).split(c, -1)
    var_x, var_y, covariance = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    similar = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    return similar / ((mean_x**2 + mean_y**2 + C1) * (var_x + var_y + C2))
