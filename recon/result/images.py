"""Images of a finished reconstruction: as a camera saw it, or from a path around what moves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from otsync.types import Camera
from recon.result.folder import MAX_SIDE, SavedReconstruction, check_size
from recon.result.orbit import orbit


def rendered(
    result: SavedReconstruction,
    times: Sequence[float],
    camera: str | None = None,
    *,
    turns: float = 1.0,
    width: int | None = None,
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """One image per world second of ``times``.

    Args:
        camera: name of a video, to render from its place and with its colours; None: from a path around what moves.
        turns: of the path. width: in pixels; None: the working size of the fit.
    """
    if camera is not None:
        video = result.video(camera)
        lens = at_width(video.camera, width)
        poses = [video.pose(t) for t in times]
    else:
        video, lens = None, at_width(result.videos[0].camera, width)
        with torch.no_grad():
            moving = result.scene.moving(float(times[len(times) // 2]))
            middle = moving.means.median(0).values.double().numpy()
        poses = list(orbit([v.camera for v in result.videos], middle, len(times), turns=turns))
    for t, pose in zip(times, poses, strict=True):
        image = seen_by(result, replace(lens, w2c=pose), float(t))
        if video is not None:
            yield video.coloured(image, lens)
        else:
            yield (image.numpy() * 255).clip(0, 255).round().astype(np.uint8)


def seen_by(result: SavedReconstruction, camera: Camera, t: float) -> Tensor:
    """The image [h,w,3] of a static camera at world second ``t``, layered as in the fit."""
    return result.scene.seen_by(camera, t, layered=result.layered)


def at_width(camera: Camera, width: int | None) -> Camera:
    """The same camera with images of another width, and a height to match."""
    if width is None or width == camera.width:
        return camera
    if not 1 <= width <= MAX_SIDE:
        raise ValueError(f"width: expected 1 to {MAX_SIDE} pixels; found {width}.")
    height = max(1, round(camera.height * width / camera.width))
    check_size(width, height)
    K = camera.K * np.array([[width / camera.width], [height / camera.height], [1.0]])
    return replace(camera, K=K, width=width, height=height)


def stretched(span: tuple[float, float], frames: int) -> list[float]:
    """``frames`` world seconds, evenly from the first to the last of the span."""
    if frames < 1:
        raise ValueError(f"frames: expected at least 1; found {frames}.")
    return np.linspace(*span, frames).tolist()
