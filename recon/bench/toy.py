"""A toy photometric synchronisation through the renderer, small enough to run in seconds.

Gaussians move on cubic splines in world time; static cameras film them, each with a clock of its own. Frame k of camera
v shows the world at time k + offset_v (in frames). The fit starts from wrong offsets and a perturbed motion and renders
one frame after another: the images alone tell both, since a spline can be differentiated in time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from recon.raster import render

KNOT_SPACING = 5.0  # frames between control points


@dataclass(frozen=True)
class World:
    """N Gaussians on splines, and what V cameras filmed of them in F frames."""

    control: Tensor  # [N,P,3] positions at times (p - 1) * KNOT_SPACING
    quats: Tensor  # [N,4]
    scales: Tensor  # [N,3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N,3]
    viewmats: Tensor  # [V,4,4]
    K: Tensor  # [3,3]
    offsets: Tensor  # [V] frames; positive: the camera started later than the world's clock
    videos: Tensor  # [V,F,H,W,3]


@dataclass(frozen=True)
class Recovered:
    """Offsets that a fit recovered, relative to camera 0, and how far they are off, both in frames."""

    offsets: Tensor  # [V]
    errors: Tensor  # [V]
    loss: Tensor  # [steps] mean squared colour difference
    steps: int


def positions(control: Tensor, time: Tensor) -> Tensor:
    """Positions [N,3] at `time` (frames), differentiable in both: a Catmull-Rom spline, cubic Hermite pieces whose
    tangents are central differences of the control points [N,P,3]. Constant beyond the ends."""
    at = (time / KNOT_SPACING + 1).clamp(1, control.shape[1] - 2 - 1e-4)
    i = int(at.detach())
    s = at - i
    before, here, there, after = control[:, i - 1 : i + 3].unbind(1)
    leave, arrive = (there - before) / 2, (after - here) / 2
    return (
        (2 * s**3 - 3 * s**2 + 1) * here
        + (s**3 - 2 * s**2 + s) * leave
        + (3 * s**2 - 2 * s**3) * there
        + (s**3 - s**2) * arrive
    )


def world(n: int = 300, cameras: int = 5, frames: int = 40, width: int = 128, height: int = 96, seed: int = 0) -> World:
    """A cloud of moving Gaussians filmed from an arc of cameras, with offsets of up to one frame."""
    g = torch.Generator().manual_seed(seed)
    knots = math.ceil(frames / KNOT_SPACING) + 4
    rest = torch.randn(n, 1, 3, generator=g) * torch.tensor([0.9, 0.7, 0.7])
    common = 0.25 * torch.randn(1, knots, 3, generator=g)  # the cloud sways
    own = 0.25 * torch.randn(n, knots, 3, generator=g)
    f = 0.9 * width
    views = []
    for v in range(cameras):
        angle = 0.25 * (v - (cameras - 1) / 2)
        c, s = math.cos(angle), math.sin(angle)
        views.append(torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 5], [0, 0, 0, 1.0]]))
    offsets = 2 * torch.rand(cameras, generator=g) - 1
    offsets[0] = 0
    empty = torch.empty(0)
    truth = World(
        control=rest + common + own,
        quats=torch.randn(n, 4, generator=g),
        scales=0.12 * torch.exp(0.3 * torch.randn(n, 3, generator=g)),
        opacities=0.3 + 0.6 * torch.rand(n, generator=g),
        colors=torch.rand(n, 3, generator=g),
        viewmats=torch.stack(views),
        K=torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]]),
        offsets=offsets,
        videos=empty,
    )
    with torch.no_grad():
        videos = torch.stack(
            [
                torch.stack([_film(truth, truth.control, v, k + offsets[v], (width, height)) for k in range(frames)])
                for v in range(cameras)
            ]
        )
    return World(**{**vars(truth), "videos": videos})


def _film(w: World, control: Tensor, v: int, time: Tensor, size: tuple[int, int]) -> Tensor:
    """The image [H,W,3] that camera v sees at world time `time` (frames)."""
    gaussians = (positions(control, time), w.quats, w.scales, w.opacities, w.colors)
    return render(*gaussians, w.viewmats[v : v + 1], w.K[None], *size, depth=None).colors[0]


def fit(w: World, steps: int = 1500, perturbation: float = 0.05, seed: int = 1) -> Recovered:
    """Recover offsets and motion from the videos, from offsets of zero and a motion off by `perturbation` units.

    Only differences of offsets are seen: a common shift of all cameras moves into the motion and is taken out.
    """
    g = torch.Generator().manual_seed(seed)
    cameras, frames, height, width = w.videos.shape[:4]
    control = (w.control + perturbation * torch.randn(w.control.shape, generator=g)).requires_grad_()
    offsets = torch.zeros(cameras, requires_grad=True)
    optimizer = torch.optim.Adam([{"params": [control], "lr": 0.01}, {"params": [offsets], "lr": 0.03}])
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.01 ** (1 / steps))
    losses = []
    order = torch.cat([torch.randperm(cameras * frames, generator=g) for _ in range(steps // (cameras * frames) + 1)])
    for pick in order[:steps].tolist():
        v, k = divmod(pick, frames)
        image = _film(w, control, v, k + offsets[v], (width, height))
        loss = (image - w.videos[v, k]).square().mean()
        optimizer.zero_grad(set_to_none=False)  # so that Adam's averages of the other cameras go on
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.detach())
    recovered = (offsets - offsets[0]).detach()
    return Recovered(recovered, recovered - (w.offsets - w.offsets[0]), torch.stack(losses), steps)
