"""Dense 4D feature tracks of one video alone: the paper's stage 1 ("Per-Video 4D Feature Track Estimation", Sec. 3.2).

Nothing is known of other videos yet, so everything lives on the video's own clock: a scaffold through its own lifted
tracks, Gaussians from its own depth, a short fit to its own images with the clock frozen. Then feature maps of any
extractor are lifted in closed form to one time-invariant feature per Gaussian (:mod:`recon.features.lift`). The
Gaussians' trajectories with these features, in the frames in which they are seen, are a track set like any other: a
second source for the matcher, beside lifted 2D tracks, and denser.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, UInt8

from otsync.types import Camera, Offsets, TrackSet
from recon.features.lift import FeatureFrame, as_tracks, lift_features
from recon.fit.optimize import RATES, without
from recon.fit.options import DEFAULT_LOSSES
from recon.fit.verb import fit
from recon.footage.depth import Depths
from recon.footage.footage import Footage
from recon.losses import Loss
from recon.motion import ScaffoldOptions, build_scaffold
from recon.observe.recorded import with_declared
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.seed import Seeding, moments
from recon.scene.seed import seed as seeded

FeatureMaps = Callable[[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]], Float[np.ndarray, "h w C"]]
"""The slot of extractors: from a working image and its soft foreground mask (0..255) to a map of the same size."""


@dataclass(frozen=True)
class Alone:
    """How one video is fitted, and which of its Gaussians become tracks.

    Args:
        steps: of the fit, with one image each. 0: Gaussians as they were seeded.
        scaffold, seeding, losses: as for a fit of all videos. rates: without "offsets", since one video has none.
        every: seconds between frames whose features are lifted.
        least_pixels: compositing weight, in pixels, from which a Gaussian counts as seen in a frame.
        least_life: seconds that a Gaussian must be seen to become a track, or a third of the clip.
    """

    steps: int = 300
    scaffold: ScaffoldOptions = field(default_factory=ScaffoldOptions)
    seeding: Seeding = field(default_factory=Seeding)
    losses: tuple[Loss, ...] = DEFAULT_LOSSES
    rates: Mapping[str, float] = field(default_factory=lambda: without(RATES, "offsets"))
    every: float = 4 / 30
    least_pixels: float = 1.0
    least_life: float = 8 / 30

    def __post_init__(self) -> None:
        if "offsets" in self.rates:
            raise ValueError("rates: expected none for offsets; found one. A single video has no offset.")
        if not (self.every > 0 and self.least_pixels > 0 and self.least_life >= 0):
            raise ValueError(
                f"every, least_pixels, least_life: expected numbers > 0 (least_life: 0 or more); found {self.every}, "
                f"{self.least_pixels}, {self.least_life}."
            )


def feature_tracks(
    footage: Footage,
    tracks: TrackSet,
    depth: Depths,
    feature_maps: FeatureMaps,
    *,
    steps: int | None = None,
    options: Alone | None = None,
    seed: int = 0,
) -> TrackSet:
    """Dense 4D feature tracks of one video.

    Args:
        footage: the video at working size, with masks. tracks: its lifted tracks, over the same frames.
        depth: its depth maps, as :func:`recon.footage.depth.working_depth` gives them.
        feature_maps: the extractor. steps: of the fit, instead of those of ``options``.

    Returns:
        One track per Gaussian that was seen long enough, on the video's own clock, with unit features, and ``uv`` and
        ``camera`` at working size; ``frame`` is that of ``tracks``.
    """
    options = options or Alone()
    options = options if steps is None else replace(options, steps=steps)
    scene = fit_alone(footage, tracks, depth, options=options, seed=seed)
    return gaussian_tracks(scene, footage, tracks, feature_maps, options=options)


def fit_alone(
    footage: Footage, tracks: TrackSet, depth: Depths, *, options: Alone | None = None, seed: int = 0
) -> Gaussians4D:
    """A 4D scene of what moves in one video, on that video's own clock; for arguments see :func:`feature_tracks`.

    Where the background is unknown (a moving camera), what moves is fitted in front of black.
    """
    options = options or Alone()
    _check(footage, tracks)
    own = own_clock(footage)
    footprint, frame_step = _footprint(footage, tracks), 1 / float(own.fps[0])
    motion = build_scaffold(
        [tracks], np.zeros(1), footprint=footprint, frame_step=frame_step, options=options.scaffold, seed=seed
    )
    span = (float(footage.times[0]), float(footage.times[-1]))
    scene = seeded(
        motion,
        [footage],
        own,
        [depth],
        footprint=footprint,
        frame_step=frame_step,
        span=span,
        times=moments(span, frame_step),
        options=options.seeding,
    )
    if options.steps == 0:
        return scene
    shown = footage if footage.background is not None else before_black(footage)
    return fit(
        scene,
        [shown],
        own,
        losses=options.losses,
        effects=with_declared((), [footage.readout]),
        rates=options.rates,
        steps=options.steps,
        batch=1,
        seed=seed,
    ).scene


def gaussian_tracks(
    scene: Gaussians4D,
    footage: Footage,
    tracks: TrackSet,
    feature_maps: FeatureMaps,
    *,
    options: Alone | None = None,
    weights: Float[np.ndarray, "N T"] | None = None,
) -> TrackSet:
    """The Gaussians of a scene on ``footage``'s own clock as tracks, with features lifted from ``feature_maps``.

    Args:
        tracks: of the same video; their clock, name and world frame are passed on.
        weights: those of :func:`seen_weights`, where they are known already: features do not change them.
    """
    options = options or Alone()
    _check(footage, tracks)
    weights = seen_weights(scene, footage) if weights is None else weights
    step = float(np.median(np.diff(footage.times))) if len(footage) > 1 else 1.0
    visible = weights >= options.least_pixels
    lasting = visible.sum(1) >= max(1, min(options.least_life / step, len(footage) / 3))
    lifted = lift_features(
        scene.moving,
        [_frame(footage, k, feature_maps) for k in lifted_frames(footage, options.every)],
        near_plane=scene.moving_near,
    )
    dense = as_tracks(
        scene.tracks(footage.times),
        lifted,
        fps=tracks.fps,
        timestamps=tracks.timestamps,
        visible=visible & lasting[:, None],
        least_weight=options.least_pixels,
        name=tracks.name,
        frame=tracks.frame,
    )
    dense = dense.take(np.flatnonzero(dense.seen.any(1)))
    if len(dense) == 0:
        raise ValueError(
            f"video {footage.name}: expected Gaussians that are seen for {options.least_life:g} s; found none. Check "
            "masks and depth, or lower least_life and least_pixels."
        )
    # at the frames' own times, as a shutter that reads all rows at once sees them
    camera = replace(footage.camera, readout=None)
    return replace(dense, uv=camera.project(dense.positions()), camera=camera)


def seen_weights(scene: Gaussians4D, footage: Footage) -> Float[np.ndarray, "N T"]:
    """Compositing weight of every Gaussian in every frame, summed over the foreground, in pixels; 0 in bad frames."""
    out = np.zeros((len(scene), len(footage)), np.float32)

    def nothing(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
        return np.zeros((*mask.shape, 0), np.float32)

    for k in np.flatnonzero(~footage.bad):
        frame = _frame(footage, int(k), nothing)
        out[:, k] = lift_features(scene.moving, [frame], near_plane=scene.moving_near).weight.numpy()
    return out


def lifted_frames(footage: Footage, every: float) -> list[int]:
    """Readable frames about ``every`` seconds apart, half of that from the clip's ends."""
    good = np.flatnonzero(~footage.bad)
    step = float(np.median(np.diff(footage.times))) if len(footage) > 1 else every
    stride = max(1, round(every / step))
    return good[min(stride, len(good)) // 2 :: stride].tolist()


def before_black(footage: Footage) -> Footage:
    """The footage with its foreground alone, in front of black."""
    assert footage.masks is not None
    matte = footage.images * (footage.masks[..., None] / np.float32(255))
    black = np.zeros(footage.images.shape[1:], np.uint8)
    return replace(
        footage,
        images=np.rint(matte).astype(np.uint8),
        background=black,
        background_seen=np.ones(black.shape[:2], bool),
    )


def own_clock(footage: Footage) -> Offsets:
    """One video on its own clock, with nothing in doubt."""
    fps = 1 / float(np.median(np.diff(footage.times))) if len(footage) > 1 else 30.0
    return Offsets.known([footage.name], np.zeros(1), fps)


def _frame(footage: Footage, k: int, feature_maps: FeatureMaps) -> FeatureFrame:
    assert footage.masks is not None
    image, mask = footage.images[k], footage.masks[k]
    camera = Camera(footage.K, footage.pose(k), *footage.size)
    return FeatureFrame(float(footage.times[k]), camera, lambda: feature_maps(image, mask), mask / np.float32(255))


def _footprint(footage: Footage, tracks: TrackSet) -> float:
    """World units that a working pixel covers at the median depth of the tracks."""
    z = Camera(footage.K, footage.w2c, *footage.size).to_camera(tracks.positions())[..., 2]
    z = z[np.isfinite(z) & (z > 0)]
    if not len(z):
        raise ValueError(
            f"tracks of {footage.name}: expected positions in front of the camera; found none. Lift them first."
        )
    return float(np.median(z) / footage.K[0, 0])


def _check(footage: Footage, tracks: TrackSet) -> None:
    """ValueError for footage without masks, and for tracks that are not of its frames."""
    if footage.masks is None:
        raise ValueError(
            f"video {footage.name}: expected foreground masks; found none. Without them nothing tells what moves: give "
            "masks, or measure them (otsync.priors.masks)."
        )
    if tracks.n_frames != len(footage) or not np.allclose(tracks.times, footage.times, rtol=0, atol=1e-4):
        raise ValueError(
            f"tracks of {footage.name}: expected the {len(footage)} frames of the footage, at the same times; found "
            f"{tracks.n_frames} frames. Cut both alike."
        )
