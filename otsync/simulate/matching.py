"""The world of the matching study: two half-views of one figure, a ball and a box, with outliers."""

from __future__ import annotations

import numpy as np

from ..types import TrackSet
from .effects import Outliers, PositionNoise, RigidFrame
from .features import FeatureModel
from .observation import stream
from .presets import Preset
from .scenes import articulated
from .truth import Truth
from .world import Rig, apply, as_tracks, as_truth, observe

#: the feature model of the study; ``FeatureModel`` says what the parts are
FEATURES = FeatureModel(dim=128, length_scale=0.35, limb=0.8, side=0.15, view=0.6, shift=0.3, person=0.0, noise=0.9)


def matching_world(
    n: int = 2000,
    seed: int = 0,
    *,
    angle: float = 50.0,
    left_right: float = 0.15,
    outliers: float = 0.2,
    noise: float = 0.01,
    n_b: int | None = None,
    frames: int = 150,
    features: FeatureModel = FEATURES,
    shared_frame: bool = False,
) -> tuple[TrackSet, TrackSet, Truth]:
    """Two synchronous track sets (a, b), single precision, and the truth about them.

    Fifteen limbs, ball and box, seen by two cameras; white position noise; part of the tracks belongs to nothing, half
    of those static background and half floaters that carry the feature of a real track.

    Args:
        n, n_b: tracks of a, and of b when they differ.
        angle: degrees between the cameras.
        left_right: strength of the cue that tells left from right in the features; 0: none.
        outliers: share of the tracks that belong to nothing.
        noise: standard deviation of positions, relative to the size of the scene.
        shared_frame: both report positions in the world's frame; else each in a rigid frame of its own.

    >>> from otsync.metrics import match_quality
    >>> from otsync.simulate import matching_world
    >>> a, b, truth = matching_world(2000, seed=1)
    >>> match_quality(truth.matches(0, 1, wrong=0.0, n=100), truth)["precision"] > 0.9
    True
    """
    for name, count in (("n", n), ("n_b", n if n_b is None else n_b), ("frames", frames)):
        if int(count) != count or count < 1:
            raise ValueError(f"{name}: expected a whole number >= 1; found {count}.")
    if not 0 <= outliers < 1:
        raise ValueError(f"outliers: expected a share in [0, 1); found {outliers}.")
    scene = articulated(stream(seed, "motion"))
    rig = Rig(angle=angle, spread=0.0)
    effects = (PositionNoise(noise), Outliers(outliers), *(() if shared_frame else (RigidFrame(),)))
    model = FeatureModel(**{**features.__dict__, "side": left_right})
    made = []
    for v, count in enumerate((n, n if n_b is None else n_b)):
        obs = observe(
            scene,
            rig.camera(scene, v, seed),
            int(count),
            np.arange(frames) / 30.0,
            30.0,
            True,
            rate=1.0,
            offset=0.0,
            features=model,
            seed=seed,
            video=v,
            dtype=np.float32,
        )
        made.append(apply(obs, effects, seed, v))
    level = Preset("matching", effects, model, wrong=0.0, matches=n)
    a, b = (
        as_tracks(obs, name, "world" if shared_frame else None, uv=False) for obs, name in zip(made, "ab", strict=True)
    )
    return a, b, as_truth(scene, made, level, seed)
