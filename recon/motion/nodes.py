"""Nodes from lifted tracks: tracks on one grid of world time, D_track, the greedy pick, and neighbours.

D_track (MoSca, Lei et al. 2024) of two tracks is nearly their largest distance over the times at which both are seen:
the k-th largest, so that k - 1 frames of a lost track do not separate two. Things that merely touch are far apart.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from otsync.types import TrackSet, check_same_world
from recon.motion import nodes_kernels
from recon.motion.paths import MAX_KNOTS

logger = logging.getLogger("recon.motion")

REACH = 5.0  # units of D_track from which nodes are no neighbours
TIE_WIDTH = 1.5  # units: sigma of the weight of a neighbour
TOP = 3  # D_track is the third largest distance
BRIDGE_FRAMES = 2.5  # of the video's own: a longer gap is not interpolated
MAX_FRAMES = 4 * MAX_KNOTS  # of a grid
COMPARED_FRAMES = 256  # at which tracks are compared at most


@dataclass(frozen=True, eq=False)
class Grid:
    """N tracks of V videos in world time: as they were sampled, and interpolated on a grid common to all.

    times float64 [G] world seconds, evenly spaced by frame_step; xyz float32 [N,G,3] relative to `centre`, 0 where not
    seen; seen [N,G]; video int [N]; samples: per video the world seconds [T], positions float64 [n,T,3] (nan where not
    seen) of its n tracks, which lie one video after another.
    """

    times: Float[np.ndarray, " G"]
    xyz: Float[np.ndarray, "N G 3"]
    seen: Bool[np.ndarray, "N G"]
    video: Int[np.ndarray, " N"]
    centre: Float[np.ndarray, " 3"]
    samples: tuple[tuple[np.ndarray, np.ndarray], ...]

    @classmethod
    def of(
        cls, tracks: Sequence[TrackSet], offsets: np.ndarray, frame_step: float, rates: np.ndarray | None = None
    ) -> Grid:
        """World time is rate · own time + offset. ValueError for tracks or offsets from which no grid can be made."""
        clocks = world_clocks(tracks, offsets, rates)
        if not (np.isfinite(frame_step) and frame_step > 0):
            raise ValueError(f"frame_step: expected the seconds of one frame, > 0; found {frame_step}.")
        samples = tuple(
            (t, s.positions() if len(s) else np.zeros((0, len(t), 3))) for t, s in zip(clocks, tracks, strict=True)
        )
        spans = [(t[x.any(0)][0], t[x.any(0)][-1]) for t, s in zip(clocks, tracks, strict=True) if (x := s.seen).any()]
        if not spans:
            raise ValueError("tracks: expected at least one visible sample; found none in any of the videos.")
        first, last = min(a for a, _ in spans), max(b for _, b in spans)
        if not last - first < MAX_FRAMES * frame_step:
            raise ValueError(
                f"offsets: expected videos within {MAX_FRAMES * frame_step:.0f} seconds of each other; found tracks "
                f"that span {last - first:.6g}. Offsets are in seconds of world time: check them."
            )
        times = first + frame_step * np.arange(int(np.floor((last - first) / frame_step + 1e-6)) + 1)
        everything = np.concatenate([p.reshape(-1, 3) for _, p in samples])
        centre = np.median(everything[np.isfinite(everything[:, 0])], axis=0)
        parts = [_on_grid(t, p - centre, times) for t, p in samples]
        video = np.repeat(np.arange(len(samples)), [len(p) for _, p in samples])
        xyz, seen = (np.concatenate(part) for part in zip(*parts, strict=True))
        empty = np.flatnonzero(~seen.any(0))
        if len(empty):
            logger.warning(
                "%d of %d frames of world time show no track, the first at second %.2f: the motion is bridged there. "
                "Are the offsets right?",
                *(len(empty), len(times), times[empty[0]]),
            )
        return cls(times, xyz, seen, video, centre, samples)

    def __len__(self) -> int:
        return len(self.video)

    def compared(self) -> tuple[np.ndarray, np.ndarray]:
        """xyz and seen at enough frames to compare tracks."""
        stride = -(-len(self.times) // COMPARED_FRAMES)
        return np.ascontiguousarray(self.xyz[:, ::stride]), np.ascontiguousarray(self.seen[:, ::stride])


def world_clocks(tracks: Sequence[TrackSet], offsets: np.ndarray, rates: np.ndarray | None) -> list[np.ndarray]:
    """World seconds of the frames of every video. ValueError for tracks, offsets or rates that do not fit together."""
    offsets = np.asarray(offsets, float)
    rates = np.ones(len(tracks)) if rates is None else np.asarray(rates, float)
    if not len(tracks) or offsets.shape != (len(tracks),) or rates.shape != offsets.shape:
        raise ValueError(
            f"tracks, offsets, rates: expected one offset (and rate) for each of one or more track sets; found "
            f"{len(tracks)} sets, offsets of shape {offsets.shape}, rates of shape {rates.shape}."
        )
    if not (np.isfinite(offsets).all() and np.isfinite(rates).all() and (rates > 0).all()):
        raise ValueError(
            f"offsets, rates: expected finite seconds and rates > 0; found {offsets.tolist()}, {rates.tolist()}. "
            "Leave a video without an offset out."
        )
    for v, one in enumerate(tracks):
        if len(one):
            one.check(f"tracks[{v}]")
        check_same_world(tracks[0], one)
    return [rate * one.times + offset for one, offset, rate in zip(tracks, offsets, rates, strict=True)]


def _on_grid(t: np.ndarray, xyz: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tracks [n,T,3], nan where unseen, linearly interpolated at `grid`: values (0 where unseen) and seen."""
    if len(t) == 1:
        right, left = np.zeros(len(grid), np.int64), np.zeros(len(grid), np.int64)
    else:
        left = np.clip(np.searchsorted(t, grid + 1e-9, side="right") - 1, 0, len(t) - 2)
        right = left + 1
    width = np.where(right > left, t[right] - t[left], 1.0)
    u = (grid - t[left]) / width
    frame = np.median(np.diff(t)) if len(t) > 1 else 1.0
    u = np.where(np.abs(u) < 1e-3, 0.0, np.where(np.abs(u - 1) < 1e-3, 1.0, u))  # a grid point on a sample
    inside = (u >= 0) & (u <= 1) & ((width <= BRIDGE_FRAMES * frame) | (u == 0) | (u == 1))
    if len(t) == 1:
        inside = np.abs(grid - t[0]) < 1e-6
    a, b = xyz[:, left], xyz[:, right]
    # a sample of weight zero may be missing
    value = np.where(u[:, None] == 0, a, np.where(u[:, None] == 1, b, (1 - u[:, None]) * a + u[:, None] * b))
    seen = inside & np.isfinite(value[..., 0])
    return np.where(seen[..., None], value, 0).astype(np.float32), seen


def pick(
    xyz: Float[np.ndarray, "N G 3"],
    seen: Bool[np.ndarray, "N G"],
    order: Int[np.ndarray, " n"],
    unit: float,
    most: int,
) -> Int[np.ndarray, " m"]:
    """Tracks picked greedily in `order`: those whose D_track to all picked before exceeds `unit`; at most `most`."""
    return nodes_kernels.pick(xyz, seen, order.astype(np.int64), np.float32(unit) ** 2, TOP, most)


def neighbours(
    xyz: Float[np.ndarray, "M G 3"], seen: Bool[np.ndarray, "M G"], k: int
) -> tuple[Int[np.ndarray, "M K"], Float[np.ndarray, "M K"]]:
    """The k nearest curves by D_track of each, the nearest first, and their D_track: inf where never seen together.

    Where there are fewer than k others, the curve itself fills up, at distance inf.
    """
    D = nodes_kernels.track_distances(np.ascontiguousarray(xyz, np.float32), np.ascontiguousarray(seen), TOP)
    np.fill_diagonal(D, np.inf)
    m = len(D)
    index = np.tile(np.arange(m)[:, None], (1, k))
    distance = np.full((m, k), np.inf)
    others = min(k, m - 1)
    index[:, :others] = np.argsort(D, axis=1, kind="stable")[:, :others]
    distance[:, :others] = np.take_along_axis(D, index[:, :others], 1)
    return np.where(np.isfinite(distance), index, np.arange(m)[:, None]), distance


def edge_weights(distances: np.ndarray, unit: float, reach: float = REACH) -> np.ndarray:
    """Weights of edges of D_track `distances`: exp(-D²/2(1.5 unit)²), 0 beyond `reach` units."""
    near = distances < reach * unit
    return np.where(near, np.exp(-(np.where(near, distances, 0) ** 2) / (2 * (TIE_WIDTH * unit) ** 2)) + 1e-6, 0.0)
