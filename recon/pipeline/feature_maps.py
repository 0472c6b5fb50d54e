"""``--features NAME``: feature maps by the shell's names, and the Gaussians' features lifted from them.

The paper gives every Gaussian one feature that time does not change (Sec. 3.2). Here it begins in closed form, as the
mean of all maps under the compositing weights (:mod:`recon.features.lift`); the loss ``feature`` trains it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from otsync.plugins import available, made
from otsync.priors import DESCRIBERS
from otsync.priors.slots import cache_key
from otsync.types import Camera, Offsets
from recon.features.lift import FeatureFrame, lift_features
from recon.features.maps import Backbone, DaisyMaps, LabMaps
from recon.features.tracks import FeatureMaps, lifted_frames
from recon.footage.footage import Footage
from recon.scene.gaussians4d import Gaussians4D

EVERY = 4 / 30
"""Seconds between the frames of a video whose features are lifted."""


def choices() -> dict[str, Any]:
    """What ``--features`` offers by name: maps of our own, and describers of tracks that can make maps."""
    learned = {n: d for n, d in available("describers", DESCRIBERS).items() if hasattr(d, "dense")}
    return {"lab": LabMaps, "daisy": DaisyMaps, **learned}


def maps_from(text: str) -> FeatureMaps:
    """The extractor that the shell spells ``name`` or ``name:field=value,...``. ValueError lists the choices.

    Example:
        >>> maps_from("daisy:radius=12").radius
        12
    """
    found = made(text, choices(), "--features")
    return Backbone(found) if hasattr(found, "dense") else found


def key_of(maps: FeatureMaps) -> Any:
    """What the cache tells an extractor's results by: of a backbone also its weights."""
    return ("backbone", cache_key(maps.of)) if isinstance(maps, Backbone) else cache_key(maps)


def with_features(
    scene: Gaussians4D, footage: Sequence[Footage], offsets: Offsets, maps: FeatureMaps, every: float = EVERY
) -> Gaussians4D:
    """The scene with unit features of its moving Gaussians, lifted from every video at its believed world times.

    Zero for those that nobody sees. ValueError where no video has masks.

    Args:
        footage: in the order of ``offsets``. every: seconds between the frames of a video that are lifted.
    """

    def frames() -> Any:
        for v, one in enumerate(footage):
            if one.masks is None:
                continue
            world = offsets.clock(v).world(one.times)
            for k in lifted_frames(one, every):
                camera = Camera(one.K, one.pose(k), *one.size)
                weight = one.masks[k] / np.float32(255)
                yield FeatureFrame(float(world[k]), camera, maps(one.images[k], one.masks[k]), weight)

    if all(one.masks is None for one in footage):
        raise ValueError("features: expected masks, which tell what moves; found none of any video. Add them.")
    with torch.no_grad():
        lifted = lift_features(scene.moving, frames(), near_plane=scene.moving_near)
        length = lifted.features.norm(dim=1, keepdim=True)
        features = torch.where(length > 0, lifted.features / length.clamp_min(1e-12), 0.0)
    return replace(scene, features=features.to(scene.dynamic.means))
