"""Feature lifting: one time-invariant feature per Gaussian from the feature maps of many frames and cameras.

No optimisation is needed. A rendered feature is ``F(p) = sum_g w_g(p) f_g`` with compositing weights w. The f_g that
the maps suggest are the averages over all pixels with these very weights,

    f_g = sum_p w_g(p) F(p) / sum_p w_g(p).

The renderer's backward pass gives the two sums as gradients of the colours, when the gradient of the image is the map,
and 1. So a frame costs one forward and one backward pass with C + 1 channels.

Together with positions over time these are dense 4D feature tracks: a second source for the matcher, beside lifted 2D
tracks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from otsync.types import Camera, TrackSet
from recon.raster import render
from recon.scene.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class FeatureFrame:
    """One frame whose features are to be lifted.

    Args:
        t: world seconds.
        camera: at the size of the map, one pose; without distortion.
        features: [h,w,C] of any extractor, or a function without arguments that makes them when they are needed, so
            that only one map is in memory.
        weight: [h,w] how much each pixel counts, such as the foreground mask; None: all alike.
    """

    t: float
    camera: Camera
    features: Any
    weight: Any = None


@dataclass(frozen=True, eq=False)
class Lifted:
    """Features of N Gaussians.

    Args:
        features: [N,C] weighted means over all frames; zero for Gaussians that were not seen.
        weight: [N] sums of compositing weights, in pixels: how much of each Gaussian was seen.
    """

    features: Tensor
    weight: Tensor


def lift_features(
    gaussians_at: Callable[[float], Gaussians],
    frames: Iterable[FeatureFrame],
    count: int | None = None,
    **options: Any,
) -> Lifted:
    """Average the feature maps of all ``frames`` onto the Gaussians.

    Args:
        gaussians_at: the Gaussians at a world time, always as many and in the same order: ``Gaussians4D.moving``, or
            ``Gaussians4D.at`` where static ones may stand in front.
        count: lift to the first ``count`` Gaussians, which the others may hide; None: to all.
        options: of :func:`recon.raster.render`: near_plane, backend, ...
    """
    total: Tensor | None = None
    target: Tensor | None = None
    for frame in frames:
        with torch.no_grad():
            gaussians = gaussians_at(frame.t)
        n = len(gaussians) if count is None else count
        target = _target(frame, gaussians.means, target)
        sums = _accumulate(gaussians, frame.camera, target, options)[:n]
        if total is not None and total.shape != sums.shape:
            raise ValueError(
                f"frames: expected {list(total.shape)} sums (Gaussians x channels + 1) of every frame; found "
                f"{list(sums.shape)} at t = {frame.t:g}. Lift maps of one extractor onto one scene."
            )
        total = sums if total is None else total + sums
    if total is None:
        raise ValueError("frames: expected at least one frame with a feature map; found none.")
    weight = total[:, -1]
    return Lifted(torch.where(weight[:, None] > 0, total[:, :-1] / weight[:, None].clamp_min(1e-12), 0.0), weight)


def _target(frame: FeatureFrame, like: Tensor, buffer: Tensor | None) -> Tensor:
    """[h,w,C+1]: the frame's features and ones, times the pixels' weights; in ``buffer`` where it fits.

    Fresh memory for every frame (15 MB for 64 channels at 320 x 180) would take a sixth of the time of lifting.
    """
    camera = frame.camera
    size = (camera.height, camera.width)
    maps = torch.as_tensor(frame.features() if callable(frame.features) else frame.features)
    if maps.ndim != 3 or tuple(maps.shape[:2]) != size:
        raise ValueError(
            f"features: expected a map [{size[0]},{size[1]},C] like the camera at t = {frame.t:g}; found "
            f"{list(maps.shape)}. Resize the camera (K, width, height) to the map."
        )
    if camera.w2c.ndim != 2 or (camera.distortion is not None and np.any(camera.distortion)):
        raise ValueError(
            "camera: expected one pose without distortion; found several, or coefficients. Undistort the image first."
        )
    shape = (*size, maps.shape[2] + 1)
    target = buffer if buffer is not None and buffer.shape == shape else like.new_empty(shape)
    target[..., :-1] = maps
    target[..., -1] = 1
    if frame.weight is not None:
        target *= torch.as_tensor(frame.weight).to(like)[..., None]
    return target


def _accumulate(gaussians: Gaussians, camera: Camera, target: Tensor, options: dict[str, Any]) -> Tensor:
    """Sums over the pixels of one frame of compositing weight * target, [N,C+1]."""
    like = gaussians.means
    with torch.enable_grad():
        colors = torch.zeros(len(gaussians), target.shape[-1]).to(like).requires_grad_()
        splats = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors)
        views, Ks = (torch.as_tensor(m)[None].to(like) for m in (camera.w2c, camera.K))
        out = render(*splats, views, Ks, camera.width, camera.height, **{"depth": None, **options})
        (sums,) = torch.autograd.grad(out.colors, colors, target[None])
    return sums


def as_tracks(
    positions: Float[np.ndarray, "N T 3"],
    lifted: Lifted,
    *,
    fps: float | None = None,
    timestamps: Float[np.ndarray, " T"] | None = None,
    visible: Bool[np.ndarray, "N T"] | None = None,
    least_weight: float = 1.0,
    name: str = "",
    frame: str | None = None,
) -> TrackSet:
    """Dense 4D feature tracks for the matcher: the Gaussians that were seen, with unit features.

    Args:
        positions: world units, over the T frames of the video (``Gaussians4D.tracks`` at its frames' world times).
        lifted: features of the same N Gaussians, from that video alone.
        fps, timestamps: the video's own clock, as of TrackSet.
        visible: where Gaussians count as observed; None: everywhere.
        least_weight: Gaussians of which fewer pixels were seen, over all frames, are left out, as are those without a
            feature.
        name, frame: of the video, and of the world frame.
    """
    features, weight = (t.detach().cpu().double().numpy() for t in (lifted.features, lifted.weight))
    if len(positions) != len(features):
        raise ValueError(f"positions: expected those of the {len(features)} lifted Gaussians; found {len(positions)}.")
    norm = np.linalg.norm(features, axis=1)
    keep = (weight >= least_weight) & (norm > 0) & np.isfinite(norm)
    return TrackSet(
        np.asarray(positions)[keep],
        visible=None if visible is None else np.asarray(visible)[keep],
        features=features[keep] / norm[keep, None],
        fps=fps,
        timestamps=timestamps,
        name=name,
        frame=frame,
    )
