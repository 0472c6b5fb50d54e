"""The window and the constants of structural similarity."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

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
