"""Losses of a fit: a tuple of objects with weights, on images (:mod:`.image`) and on the motion (:mod:`.motion`).

:mod:`.rigidity` holds those of Dynamic3DGaussians.

To add a loss: one class in one file, and its name in :data:`LOSSES`; or ``@register("losses")`` in a file of your own.
"""

from recon.losses.image import Depth, Feature, ImageLoss, Mask, Photometric, ScaleHinge, Track
from recon.losses.motion import (
    Acceleration,
    Arap,
    Length,
    MotionLoss,
    RotationAcceleration,
    RotationVelocity,
    Velocity,
)
from recon.losses.rigidity import Isometry, Rigidity, RotationSimilarity

Loss = ImageLoss | MotionLoss

LOSSES: tuple[type[Loss], ...] = (
    Photometric,
    Mask,
    Depth,
    Track,
    Feature,
    ScaleHinge,
    Arap,
    Length,
    Velocity,
    Acceleration,
    RotationVelocity,
    RotationAcceleration,
    Rigidity,
    RotationSimilarity,
    Isometry,
)
"""Our own losses."""

__all__ = [
    "LOSSES",
    "Acceleration",
    "Arap",
    "Depth",
    "Feature",
    "ImageLoss",
    "Isometry",
    "Length",
    "Loss",
    "Mask",
    "MotionLoss",
    "Photometric",
    "Rigidity",
    "RotationAcceleration",
    "RotationSimilarity",
    "RotationVelocity",
    "ScaleHinge",
    "Track",
    "Velocity",
]
