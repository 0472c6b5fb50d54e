"""How sure a refined clock is: every frame votes, and the spread of the votes tells.

At the end of a fit each frame of a video proposes one Gauss-Newton step of that video's offset,

    g_k = sum_pixels r dI/dt,   h_k = sum_pixels (dI/dt)^2,   step = - sum_k g_k / sum_k h_k

with the residuals r of its pixels. Pixels of one frame err together (a wrong shape, a highlight), frames further apart
much less: so frames, not pixels, are taken as independent (a sandwich estimate, White 1980). What the frames agree on
beyond the answer is a bias that the fit did not follow, and is added. The motion is held, so this is a lower bound.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from otsync.compute.indices import evenly

Look = Callable[[int, int, float], Tensor]
Target = Callable[[int, int], Tensor]

FRAMES = 12
STEP = 0.1  # frames between the instants of the central difference, half


def newton_sigma(
    look: Look,
    target: Target,
    keys: np.ndarray,
    reference: int,
    n_videos: int,
    frame_step: float,
    frames: int = FRAMES,
) -> np.ndarray:
    """[V] standard deviations in seconds, of each offset relative to the reference's; 0 there, nan where nothing moves.

    Args:
        look: (video, frame, seconds) -> the image [h,w,3] that the scene gives, that much later than the frame.
        target: (video, frame) -> the frame's own pixels [h,w,3].
        keys: (K,2) the (video, frame) that took part in the fit.
    """
    variance = np.full(n_videos, np.nan)
    with torch.no_grad():
        for v in range(n_videos):
            own = keys[keys[:, 0] == v, 1]
            if len(own) < 2:
                continue
            chosen = own[evenly(len(own), frames)]
            votes = np.array([_vote(look, target, v, int(k), STEP * frame_step) for k in chosen])
            variance[v] = sandwich(votes[:, 0], votes[:, 1])
    sigma = np.sqrt(variance + variance[reference])
    sigma[reference] = 0.0
    return sigma


def sandwich(g: np.ndarray, h: np.ndarray) -> float:
    """Variance of -sum(g)/sum(h) about zero, with the terms taken as independent; nan when h vanishes."""
    total = h.sum()
    if not total > 0 or len(g) < 2:
        return float("nan")
    step = -g.sum() / total
    spread = len(g) / (len(g) - 1) * np.square(g + h * step).sum() / total**2
    return float(spread + step**2)


def _vote(look: Look, target: Target, v: int, k: int, step: float) -> tuple[float, float]:
    """(g, h) of one frame."""
    residual = (look(v, k, 0.0) - target(v, k)).double()
    rate = (look(v, k, step) - look(v, k, -step)).double() / (2 * step)
    return float((residual * rate).sum()), float(rate.square().sum())
