"""One video's tracks as the search reads them: in the scene's own unit, with their curves; and two of them in order."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ..clocks.splines import TrackSplines
from ..costs.linear import binary_scale, track_distance
from ..match.synchronous import longest_seen
from ..types import Similarity, TrackSet

HOP = 6 / 30
"""Seconds over which the distance that a track goes is taken: above the jitter of a tracker."""

FASTER, FARTHER = 0.75, 0.9
"""Quantiles of those distances, and of D_track, that the unit is made of."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Tracks of one video, divided by the unit of its scene.

    Args:
        tracks: at most ``limit`` of the video's, without a declared frame. index: where they stand in the video's.
        unit: of the scene, in the video's own units. curves: of all of them, in units.
        sight: unit vectors from the camera to the tracks, in the video's frame; None where no camera is known.
    """

    tracks: TrackSet
    index: Int[np.ndarray, " N"]
    unit: float
    curves: TrackSplines
    sight: Float[np.ndarray, "N 3"] | None

    def __len__(self) -> int:
        return len(self.index)


def clouds(a: TrackSet, b: TrackSet, limit: int) -> tuple[Cloud, Cloud] | None:
    """Both videos' tracks, each in the unit of its scene; None where one shows no extent.

    Two measures of a scene's size agree across views, though each view sees a part of its own: how far apart tracks
    get (the ninth decile of D_track), and how fast they move (the third quartile over 0.2 s). Measured on all pairs of
    basketball: off by 6 % and 8 % (median), 15 % and 21 % (p90); the median of D_track by 56 % and a factor 2.9. The
    mean of both logarithms is the ratio of the units, where anything moves; it only has to be near, since the search
    frees the scale.
    """
    chosen = [longest_seen(t, limit) for t in (a, b)]
    parts = [t.take(i) for t, i in zip((a, b), chosen, strict=True)]
    extents, hops = zip(*(sizes(t) for t in parts), strict=True)
    if not all(e > 0 for e in extents):
        return None
    units = list(extents)
    if all(h > 1e-3 * e for h, e in zip(hops, extents, strict=True)):
        tilt = np.sqrt(hops[1] / hops[0] * extents[0] / extents[1])
        units[1] = extents[1] * float(tilt)
    made = []
    for tracks, index, unit in zip(parts, chosen, units, strict=True):
        x = tracks.positions() / unit
        scaled = replace(tracks, xyz=np.where(tracks.seen[..., None], x, 0.0), frame=None, camera=None, sigma=None)
        made.append(Cloud(scaled, index, unit, TrackSplines(tracks.times, x), line_of_sight(tracks)))
    return made[0], made[1]


def line_of_sight(tracks: TrackSet) -> Float[np.ndarray, "N 3"] | None:
    """Where the camera saw each track, on average: unit vectors in the video's frame."""
    if tracks.camera is None:
        return None
    away = tracks.positions() - tracks.camera.center
    away /= np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-300)
    mean = np.where(tracks.seen[..., None], np.nan_to_num(away), 0.0).sum(1)
    return mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)


def sizes(tracks: TrackSet) -> tuple[float, float]:
    """(how far apart tracks get, how far they go in 0.2 s), in the video's units; 0 where unknown."""
    x = tracks.positions()
    scale = binary_scale(x)
    d = track_distance(x, tracks.seen)
    d = d[np.isfinite(d) & (d > 0)]
    fps = tracks.fps or 30.0
    hop = min(max(1, round(HOP * fps)), max(1, x.shape[1] - 1))
    gone = np.linalg.norm((x[:, hop:] - x[:, :-hop]) / scale, axis=2)
    gone = gone[np.isfinite(gone)]
    extent = float(np.quantile(d, FARTHER)) if d.size else 0.0
    return extent, scale * float(np.quantile(gone, FASTER)) if gone.size else 0.0


def comes_first(a: TrackSet, b: TrackSet) -> bool:
    """An order of two videos that no frame of reference changes: the search starts from the same one either way."""

    def key(t: TrackSet) -> tuple[int, int, bytes]:
        digest = hashlib.blake2b(np.packbits(t.seen).tobytes(), digest_size=16)
        for part in (t.features, t.labels, t.times):
            if part is not None:
                digest.update(np.ascontiguousarray(part).tobytes())
        return len(t), t.n_frames, digest.digest()

    return key(a) <= key(b)


def in_units(transform: Similarity, a: Cloud, b: Cloud) -> Similarity:
    """A similarity from b's frame to a's, between their units."""
    return Similarity(transform.scale * b.unit / a.unit, transform.R, transform.t / a.unit)


def from_units(found: Similarity, a: Cloud, b: Cloud) -> Similarity:
    """The other way round; the covariance of the translation is in a's units."""
    grow = np.diag([1.0] * 4 + [a.unit] * 3)
    covariance = None if found.covariance is None else grow @ found.covariance @ grow
    return Similarity(found.scale * a.unit / b.unit, found.R, found.t * a.unit, covariance)


def seen_and_filled(x: Float[np.ndarray, "N S 3"]) -> tuple[Float[np.ndarray, "N S 3"], Bool[np.ndarray, "N S"]]:
    """Positions with 0 for nan, and where they were known."""
    seen = np.isfinite(x[..., 0])
    return np.where(seen[..., None], x, 0.0), seen
