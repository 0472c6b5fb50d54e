"""What losses compare with beyond images and masks: a recording's depth maps and point tracks, in its footage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from otsync.geometry import undistort
from otsync.io import Scene
from otsync.types import Offsets, TrackSet
from recon.features.maps import KeptMaps
from recon.features.tracks import FeatureMaps
from recon.footage.depth import working_depth
from recon.footage.footage import Footage
from recon.losses import ImageLoss, Loss
from recon.losses.image import Sightings, tie_tracks
from recon.scene.gaussians4d import Gaussians4D

OF_ITSELF = ("depth", "tracks")
"""Fields of footage that a recording fills, where a loss reads them."""

SUPPLIED = (*OF_ITSELF, "features")
"""The same, and what it fills where an extractor is named."""

REACH = 8.0
"""Footprints from a tracked point to the last of the Gaussians that carry it: some three voxels of the seeding."""

SAME_FRAME = 0.1
"""Share of a frame within which a track's sample is of a frame of the footage."""


def read_by(losses: Sequence[Loss], features: str | None = None) -> frozenset[str]:
    """The fields of footage that losses read. ValueError for one that no recording fills.

    features: the extractor of feature maps, as the shell spells it; None: there is none.
    """
    for loss in losses:
        if isinstance(loss, ImageLoss) and loss.reads is not None and loss.reads not in SUPPLIED:
            raise ValueError(
                f"losses: {type(loss).__name__} compares with {loss.reads}, which are not made of a recording; "
                f"expected losses that read {' or '.join(SUPPLIED)}. Call recon.fit.fit with footage of your own, or "
                "leave it out."
            )
        if isinstance(loss, ImageLoss) and loss.reads == "features" and features is None:
            raise ValueError(
                f"losses, features: expected feature maps for {type(loss).__name__} to compare with; found none. Name "
                "some (--features daisy), or leave the loss out."
            )
    return frozenset(loss.reads for loss in losses if isinstance(loss, ImageLoss) and loss.reads is not None)


def with_readings(
    wanted: frozenset[str],
    scene: Scene,
    footage: Sequence[Footage],
    tracks: Sequence[TrackSet],
    initial: Gaussians4D,
    offsets: Offsets,
    width: int,
    maps: FeatureMaps | None = None,
) -> tuple[Footage, ...]:
    """The footage with the depth maps that the recording gives, the tracks tied to the initial scene, feature maps.

    wanted: of :func:`read_by`. What is not wanted is not read. maps: the extractor, where features are.
    """
    by_name = {t.name: t for t in tracks}
    out = []
    for v, (video, one) in enumerate(zip(scene.videos, footage, strict=True)):
        if "depth" in wanted and video.depth is not None:
            at = working_depth(video, width=width)
            known = {k: z for k in range(len(one)) if not one.bad[k] and (z := at(k)) is not None}
            one = replace(one, depth=known)
        if "tracks" in wanted and video.name in by_name:
            one = replace(one, tracks=sightings(by_name[video.name], one, initial, offsets, v))
        if "features" in wanted and maps is not None and one.masks is not None:
            one = replace(one, features=KeptMaps(one, maps))
        out.append(one)
    return tuple(out)


def sightings(
    tracks: TrackSet, footage: Footage, initial: Gaussians4D, offsets: Offsets, video: int
) -> dict[int, Sightings]:
    """What a tracker saw of one video, by frame of its footage, tied to the Gaussians of the initial scene."""
    if tracks.xyz is None or tracks.uv is None or tracks.camera is None:
        return {}
    straight = replace(tracks, uv=undistort(tracks.camera, np.where(tracks.seen[..., None], tracks.uv, 0.0)))
    paths = initial.tracks(offsets.clock(video).world(tracks.times))
    scale = footage.size[0] / tracks.camera.width
    frames = tie_tracks(straight, paths, REACH * initial.footprint, scale=scale)
    near = np.abs(footage.times[:, None] - tracks.times[None])
    step = float(np.median(np.diff(footage.times))) if len(footage) > 1 else 1.0
    own = {int(near[:, j].argmin()): seen for j, seen in enumerate(frames) if near[:, j].min() <= SAME_FRAME * step}
    return {k: seen for k, seen in own.items() if seen is not None}
