"""Losses of one rendered frame against the filmed one.

Every loss is a frozen dataclass ``(seen) -> scalar | None``, unweighted; None says that the frame lacks what the loss
compares with. What is not in a fit's tuple of losses is not computed, and ``needs`` tells the renderer which extra
channels it must render. Colours are in 0..1; lengths enter in footprints, pixels or ratios, so a scene's unit does not
matter.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from otsync.types import TrackSet
from recon.losses.ssim import photometric
from recon.losses.window import SMALL, Window


@dataclass(frozen=True, eq=False)
class Sightings:
    """Tracked points of one video in one frame, tied to Gaussians.

    A point stands at ``mean_k means[nearest[k]] + shift``: it goes where its nearest Gaussians go.

    Args:
        nearest: [m,K] indices of Gaussians. shift: [m,3] world units.
        uv: [m,2] where the point was seen, pixels of the whole working image.
    """

    nearest: Tensor
    shift: Tensor
    uv: Tensor


@dataclass(frozen=True, eq=False)
class Seen:
    """One frame as rendered and as filmed, cropped to ``box``; h x w pixels. What is absent is None.

    Args:
        rendered: [h,w,3], backdrop included. alpha: [h,w,1] of the dynamic Gaussians. image: [h,w,3] filmed, 0..1.
        video, frame: which. t: world seconds, float64 scalar. box: (x0, y0, x1, y1), pixels of the working image.
        mask: [h,w] soft foreground 0..1. usable: [h,w] weight of a pixel, 0 where it says nothing.
        depth: [h,w,1] expected z, world units. given_depth: [h,w] z, world units; 0 or NaN where unknown.
        features, given_features: [h,w,C] rendered (weighted by alpha) and extracted.
        view: (K [3,3] of the whole working image, w2c [4,4]).
        means: [N,3] of the Gaussians at t. scales: [N,3] standard deviations. footprint: world units.
        tracks: what a tracker saw in this frame.
    """

    rendered: Tensor
    alpha: Tensor
    image: Tensor
    video: int
    frame: int
    t: Tensor
    box: tuple[int, int, int, int]
    mask: Tensor | None = None
    usable: Tensor | None = None
    depth: Tensor | None = None
    given_depth: Tensor | None = None
    features: Tensor | None = None
    given_features: Tensor | None = None
    view: tuple[Tensor, Tensor] | None = None
    means: Tensor | None = None
    scales: Tensor | None = None
    footprint: float = 1.0
    tracks: Sightings | None = None


class ImageLoss(ABC):
    """A comparison of one rendered frame with the filmed one. Inherit from it: a frozen dataclass with a ``weight``."""

    weight: float
    """Its share in the sum of losses."""

    needs: ClassVar[frozenset[str]] = frozenset()
    """What must be rendered besides colour and alpha: "depth", "features"."""

    reads: ClassVar[str | None] = None
    """The field of :class:`recon.footage.Footage` that it compares with, beyond images and masks: "depth", "tracks",
    "features". A fit refuses the loss where no video has it."""

    @abstractmethod
    def __call__(self, seen: Seen) -> Tensor | None:
        """The loss, unweighted: a scalar; None when the frame lacks what it compares with."""


@dataclass(frozen=True)
class Photometric(ImageLoss):
    """Mean absolute colour difference + ``ssim`` * (1 - mean SSIM), over the usable pixels.

    Where ``usable`` is below 1, the rendered colour is mixed with the filmed one before the comparison, so that an
    unusable pixel weighs nothing in the windows of its neighbours either.
    """

    weight: float = 1.0
    ssim: float = 0.2
    window: Window = SMALL

    def __post_init__(self) -> None:
        if not isinstance(self.window, Window):
            raise ValueError(f"window: expected a recon.losses.window.Window, from Python; found {self.window!r}.")

    def __call__(self, seen: Seen) -> Tensor | None:
        return photometric(seen.rendered, seen.image, seen.usable, self.ssim, self.window)


@dataclass(frozen=True)
class Mask(ImageLoss):
    """Mean absolute difference of alpha and the soft foreground mask."""

    weight: float = 0.1

    def __call__(self, seen: Seen) -> Tensor | None:
        if seen.mask is None:
            return None
        return (seen.alpha[..., 0] - seen.mask).abs().mean()


@dataclass(frozen=True)
class Depth(ImageLoss):
    """Relative difference of the expected depth from the given one, robust, over the pixels where both are known.

    A pixel counts when a depth is given, the foreground mask (if any) is above 1/2, and so is alpha. The error is
    ``e = depth / (s * given) - 1`` and costs ``tolerance * (sqrt(1 + (e / tolerance)^2) - 1)``: squared near zero,
    absolute beyond ``tolerance``.

    Args:
        tolerance: relative error beyond which a given depth counts as an outlier.
        scale: "given": depths are in world units, s = 1; "median": known up to a factor per frame (of a monocular
            estimator), s = the median ratio over the frame, through which no gradient flows.
    """

    weight: float = 0.01
    tolerance: float = 0.05
    scale: Literal["given", "median"] = "given"
    needs: ClassVar[frozenset[str]] = frozenset({"depth"})
    reads: ClassVar[str | None] = "depth"

    def __call__(self, seen: Seen) -> Tensor | None:
        if seen.depth is None or seen.given_depth is None:
            return None
        known = (seen.given_depth > 0) & seen.given_depth.isfinite() & (seen.alpha[..., 0] > 0.5)
        if seen.mask is not None:
            known &= seen.mask > 0.5
        if not known.any():
            return None
        ratio = seen.depth[..., 0][known] / seen.given_depth[known].to(seen.depth)
        if self.scale == "median":
            ratio = ratio / ratio.detach().median()
        return robust(ratio - 1, self.tolerance).mean()


@dataclass(frozen=True)
class Track(ImageLoss):
    """Distance in pixels between where tracked points project and where the tracker saw them, robust.

    Args:
        tolerance: pixels; quadratic below, absolute beyond.
    """

    weight: float = 0.01
    tolerance: float = 2.0
    reads: ClassVar[str | None] = "tracks"

    def __call__(self, seen: Seen) -> Tensor | None:
        if seen.tracks is None or seen.means is None or seen.view is None or not len(seen.tracks.uv):
            return None
        s = seen.tracks
        points = seen.means[s.nearest.to(seen.means.device)].mean(1) + s.shift.to(seen.means)
        K, w2c, seen_at = (m.to(points) for m in (*seen.view, s.uv))
        camera = points @ w2c[:3, :3].T + w2c[:3, 3]
        front = camera[:, 2] > 1e-6 * seen.footprint
        if not front.any():
            return None
        camera = camera[front]
        uv = camera[:, :2] / camera[:, 2:] @ K[:2, :2].T + K[:2, 2]
        return robust((uv - seen_at[front]).square().sum(1), self.tolerance, squared=True).mean()


@dataclass(frozen=True)
class Feature(ImageLoss):
    """Mean absolute difference of rendered features from extracted ones, over the foreground."""

    weight: float = 0.1
    needs: ClassVar[frozenset[str]] = frozenset({"features"})
    reads: ClassVar[str | None] = "features"

    def __call__(self, seen: Seen) -> Tensor | None:
        if seen.features is None or seen.given_features is None:
            return None
        difference = (seen.features - seen.given_features).abs().mean(-1)
        if seen.mask is None:
            return difference.mean()
        return (difference * seen.mask).sum() / seen.mask.sum().clamp_min(1)


@dataclass(frozen=True)
class ScaleHinge(ImageLoss):
    """Mean of what the Gaussians' scales exceed ``limit`` by, in footprints: keeps blobs from swallowing the scene.

    The weight is the study's .05 per metre, whose footprint was 1.33 cm.
    """

    weight: float = 7e-4
    limit: float = 3.8

    def __call__(self, seen: Seen) -> Tensor | None:
        if seen.scales is None or not len(seen.scales):
            return None
        return (seen.scales / seen.footprint - self.limit).relu().mean()


def robust(e: Tensor, tolerance: float, squared: bool = False) -> Tensor:
    """``c (sqrt(1 + (e/c)^2) - 1)``: e^2 / (2c) near zero, |e| - c beyond c (pseudo-Huber; Charbonnier 1997).

    squared: `e` holds e^2.
    """
    e2 = e if squared else e * e
    return tolerance * ((1 + e2 / tolerance**2).sqrt() - 1)


def tie_tracks(
    tracks: TrackSet,
    gaussians: Float[np.ndarray, "N T 3"],
    reach: float,
    *,
    neighbours: int = 3,
    scale: float = 1.0,
) -> list[Sightings | None]:
    """One video's tracks for :class:`Track`: tied to their nearest Gaussians where they were first seen.

    Args:
        tracks: lifted (``xyz``) and seen (``uv``), over T frames.
        gaussians: where the Gaussians are at the world times of the same T frames (``Gaussians4D.tracks``). Ties hold
            as long as the Gaussians keep their order: tie anew after pruning.
        reach: world units; a track further from its last neighbour than this is left out. Some footprints will do.
        neighbours: Gaussians that carry a point.
        scale: working pixels per pixel of ``tracks.uv``.

    Returns:
        Sightings per frame; None where no tied track was seen.
    """
    if tracks.xyz is None or tracks.uv is None:
        raise ValueError("tracks: expected positions (xyz) and pixels (uv), found only one of them. Lift them first.")
    if gaussians.shape[1:] != (tracks.n_frames, 3) or len(gaussians) < neighbours:
        raise ValueError(
            f"gaussians: expected at least {neighbours} of them over the tracks' {tracks.n_frames} frames, (N,T,3); "
            f"found shape {gaussians.shape}"
        )
    nearest = np.zeros((len(tracks), neighbours), np.int64)
    shift = np.zeros((len(tracks), 3), np.float32)
    tied = np.zeros(len(tracks), bool)
    first = np.where(tracks.seen.any(1), tracks.seen.argmax(1), -1)
    for frame in np.unique(first[first >= 0]):
        rows = np.flatnonzero(first == frame)
        points = tracks.xyz[rows, frame]
        distance, near = cKDTree(gaussians[:, frame]).query(points, k=range(1, neighbours + 1))
        nearest[rows], tied[rows] = near, distance[:, -1] <= reach
        shift[rows] = points - gaussians[near, frame].mean(1)
    out: list[Sightings | None] = []
    for frame in range(tracks.n_frames):
        rows = np.flatnonzero(tied & tracks.seen[:, frame])
        uv = (tracks.uv[rows, frame] * scale).astype(np.float32)
        parts = (torch.from_numpy(a) for a in (nearest[rows], shift[rows], uv))
        out.append(Sightings(*parts) if len(rows) else None)
    return out
