"""Figures of a reconstruction: images against held-out ones, tracks against tracks.

Figures of images are those of the literature's tables: PSNR for colours in 0..1 clipped as in a file, SSIM with the
11 x 11 Gaussian window (sigma 1.5) over the pixels whose window lies inside the image, as scikit-image and torchmetrics
define it. Every figure exists for the whole image and for a mask, since what moves fills a small part of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from recon.evaluate.lpips import Lpips
from recon.losses.ssim import ssim_map
from recon.losses.window import STANDARD
from recon.scene.gaussians4d import Gaussians4D

WINDOW = 48 / 30  # seconds over which distances of neighbours are compared
FAINT = 0.1  # opacity from which on a Gaussian is seen
SMALLEST_MASK = 50  # pixels: with fewer, a frame has no figures for what moves


def psnr(image: Any, reference: Any, mask: Any = None) -> float:
    """Peak signal-to-noise ratio in dB: ``-10 log10`` of the mean squared colour difference; inf for equal images.

    Args:
        image, reference: [h,w,3], uint8 or floats in 0..1; floats beyond are clipped.
        mask: [h,w] weights, or None: the whole image. nan when they are all zero.
    """
    x, y, w = _pair(image, reference, mask)
    error = ((x - y).square().mean(-1) * w).sum() / w.sum()
    return float(-10 * error.log10())


def ssim(image: Any, reference: Any, mask: Any = None) -> float:
    """Mean structural similarity (Wang et al. 2004), at most 1; arguments as of :func:`psnr`.

    Pixels nearer than 5 to the border do not count: their windows are cut.
    """
    x, y, w = _pair(image, reference, mask)
    r = STANDARD.radius
    if min(x.shape[:2]) <= 2 * r:
        raise ValueError(
            f"image: expected more than {2 * r} pixels on a side; found {list(x.shape[:2])}. Score a larger image."
        )
    inside = slice(r, -r)
    w = w[inside, inside]
    return float((ssim_map(x, y, STANDARD).mean(-1)[inside, inside] * w).sum() / w.sum())


def score_image(image: Any, reference: Any, mask: Any = None, lpips: Lpips | None = None) -> dict[str, float]:
    """All figures of one frame: psnr, ssim, lpips, mask_psnr, mask_ssim; nan for those that cannot be had.

    mask: [h,w] of what moves; with fewer than 50 pixels there are no figures for it.
    """
    x, y, _ = _pair(image, reference, None)
    scores = {"psnr": psnr(x, y), "ssim": ssim(x, y), "lpips": (lpips or Lpips())(x, y)}
    moving = mask is not None and float(_floats(mask).sum()) >= SMALLEST_MASK
    scores["mask_psnr"] = psnr(x, y, mask) if moving else math.nan
    scores["mask_ssim"] = ssim(x, y, mask) if moving else math.nan
    return scores


def mean_scores(frames: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of every figure over the frames that have it; nan where none has."""
    out = {}
    for name in dict.fromkeys(key for frame in frames for key in frame):
        known = [frame[name] for frame in frames if not math.isnan(frame.get(name, math.nan))]
        out[name] = math.fsum(known) / len(known) if known else math.nan
    return out


def coherence(tracks: Float[np.ndarray, "N T 3"], neighbours: int = 3, moment: int | None = None) -> float:
    """How much the distances of neighbouring tracks change over time: the median, in units of ``tracks``.

    Neighbours are the nearest tracks at frame ``moment`` (None: the middle one); a pair's change is the mean over time
    of ``| |x_i(t) - x_j(t)| - |x_i(moment) - x_j(moment)| |``. Zero for any rigid motion.
    """
    n, frames = tracks.shape[:2]
    if n <= neighbours or frames < 1:
        raise ValueError(
            f"tracks: expected more than {neighbours} tracks of at least one frame; found {n} of {frames}."
        )
    moment = frames // 2 if moment is None else moment
    _, near = cKDTree(tracks[:, moment]).query(tracks[:, moment], k=neighbours + 1)
    apart = np.linalg.norm(tracks[near[:, 1:]] - tracks[:, None], axis=-1)
    return float(np.median(np.abs(apart - apart[..., moment : moment + 1]).mean(2)))


def coherence_of(scene: Gaussians4D, seconds: float = WINDOW) -> float | None:
    """:func:`coherence` of a scene's own Gaussians in working pixels: the mean over windows of ``seconds``.

    Faint ones do not count. None for a scene that is too small, or shorter than a window of two frames.
    """
    times = np.arange(math.ceil(scene.span[0] / scene.frame_step), scene.span[1] / scene.frame_step) * scene.frame_step
    length = min(round(seconds / scene.frame_step), len(times))
    seen = scene.dynamic.opacities.detach().numpy() > FAINT
    if length < 2 or seen.sum() < 4:
        return None
    starts = range(0, len(times) - length + 1, length)
    told = [coherence(scene.tracks(times[k : k + length])[seen]) for k in starts]
    return float(np.mean(told)) / scene.footprint


@dataclass(frozen=True)
class Following:
    """Distances of predicted points from held-out tracks: median, 90th percentile (units of the tracks), count."""

    median: float
    p90: float
    count: int


def following_error(
    held_out: Float[np.ndarray, "M T 3"],
    tracks: Float[np.ndarray, "N T 3"],
    reach: float,
    *,
    horizons: Sequence[int] = (10, 20, 30),
    every: int = 4,
    neighbours: int = 3,
) -> dict[int, Following]:
    """Errors of held-out tracks that are predicted by the nearest reconstructed ones, by horizon in frames.

    From every ``every``-th frame t, a held-out point seen at t and t + h is moved by the mean displacement of the
    ``neighbours`` tracks nearest to it at t. Points whose nearest track is ``reach`` or further away do not count.

    Args:
        held_out: nan where a track was not observed; tracks that the fit has not seen.
        tracks: of the Gaussians, same frames and units.
    """
    if held_out.shape[1:] != tracks.shape[1:] or len(tracks) < neighbours:
        raise ValueError(
            f"held_out, tracks: expected (M,T,3) and (N,T,3) with N >= {neighbours}; found {held_out.shape} and "
            f"{tracks.shape}."
        )
    seen = np.isfinite(held_out).all(-1)
    frames = tracks.shape[1]
    errors: dict[int, list[np.ndarray]] = {h: [] for h in horizons}
    for t in range(0, frames - min(horizons, default=frames), every):
        rows = np.flatnonzero(seen[:, t])
        if not len(rows):
            continue
        distance, near = cKDTree(tracks[:, t]).query(held_out[rows, t], k=range(1, neighbours + 1))
        for h in horizons:
            if t + h >= frames:
                continue
            use = seen[rows, t + h] & (distance[:, 0] < reach)
            moved = (tracks[near[use], t + h] - tracks[near[use], t]).mean(1)
            errors[h].append(np.linalg.norm(held_out[rows[use], t] + moved - held_out[rows[use], t + h], axis=1))
    return {h: _following(np.concatenate(e) if e else np.zeros(0)) for h, e in errors.items()}


def acceleration(tracks: Float[np.ndarray, "N T 3"]) -> float:
    """Median size of the second difference over time: units of ``tracks`` per frame squared; nan below 3 frames."""
    if tracks.shape[1] < 3:
        return math.nan
    return float(np.median(np.linalg.norm(np.diff(tracks, 2, axis=1), axis=-1)))


def _following(errors: np.ndarray) -> Following:
    if not len(errors):
        return Following(math.nan, math.nan, 0)
    return Following(float(np.median(errors)), float(np.percentile(errors, 90)), len(errors))


def _floats(values: Any) -> Tensor:
    """float64 in 0..1 of bytes, booleans or floats; floats beyond are clipped."""
    t = torch.as_tensor(values).detach().cpu()
    return t.double() / 255 if t.dtype == torch.uint8 else t.double().clamp(0, 1)


def _pair(image: Any, reference: Any, mask: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Two images and a weight per pixel as float64 in 0..1."""
    x, y = _floats(image), _floats(reference)
    if x.ndim != 3 or x.shape != y.shape:
        raise ValueError(f"image, reference: expected [h,w,3] of one size; found {list(x.shape)} and {list(y.shape)}.")
    w = torch.ones(x.shape[:2], dtype=x.dtype) if mask is None else _floats(mask)
    if w.shape != x.shape[:2]:
        raise ValueError(f"mask: expected {list(x.shape[:2])} like the image; found {list(w.shape)}.")
    return x, y, w
