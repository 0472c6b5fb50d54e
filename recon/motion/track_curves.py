"""Splines through lifted tracks, each fitted by itself: motion without a scaffold begins with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from otsync.types import TrackSet
from recon.motion.nodes import world_clocks
from recon.motion.paths import Path
from recon.motion.solve import FRAME, RIDGE

ROUNDS = 3  # of reweighting
STILL = (
    0.005  # weight of the knots' first differences: beyond its ends a track loses two thirds of its speed in two knots
)
NEAREST, LONGEST = 8, 3  # tracks that a point chooses among, and those of them, seen longest, that have a say


@dataclass(frozen=True, eq=False)
class TrackCurves:
    """Splines through M lifted tracks of several videos; none knows of another.

    Args:
        path: the curve in world time that the knots make. knots float64 [P,M,3]: world units.
        first, last float64 [M]: world seconds between which each was seen. Beyond them it slows down to rest.
    """

    path: Path
    knots: Float[np.ndarray, "P M 3"]
    first: Float[np.ndarray, " M"]
    last: Float[np.ndarray, " M"]

    @classmethod
    def of(
        cls,
        tracks: Sequence[TrackSet],
        offsets: Float[np.ndarray, " V"],
        path: Path,
        *,
        robust: float,
        acceleration: float,
        rates: Float[np.ndarray, " V"] | None = None,
    ) -> TrackCurves:
        """Knots of every track by iteratively reweighted least squares with Cauchy's weights.

        tracks: one set a video; world second = rate · own second + offset.
        robust: distance at which a sample counts half, world units. acceleration: weight of second differences of the
        knots, where a sample per 1/30 s has weight 1.

        ValueError where no track was ever seen.
        """
        clocks = world_clocks(tracks, offsets, rates)
        first, second = np.diff(np.eye(path.count), axis=0), np.diff(np.eye(path.count), 2, axis=0)
        always = acceleration * second.T @ second + STILL * first.T @ first + RIDGE * np.eye(path.count)
        knots, seen_from, seen_to = [], [], []
        for times, one in zip(clocks, tracks, strict=True):
            own = one.take(np.flatnonzero(one.seen.any(1)))
            if not len(own):
                continue
            seen, design = own.seen, path.design(times)
            knots.append(_solved(own.positions(), times, design, always, robust))
            seen_from.append(times[seen.argmax(1)])
            seen_to.append(times[seen.shape[1] - 1 - seen[:, ::-1].argmax(1)])
        if not knots:
            raise ValueError("tracks: expected at least one visible sample; found none in any of the videos.")
        return cls(path, np.concatenate(knots, 1), np.concatenate(seen_from), np.concatenate(seen_to))

    def __len__(self) -> int:
        """Number of tracks."""
        return self.knots.shape[1]

    def displacements(self, points: Float[np.ndarray, "n 3"], t: float) -> Float[np.ndarray, "P n 3"]:
        """Knots of how far `points`, which are there at world second `t`, are moved from there; 0 at `t`.

        Every point goes with one track. Of the nearest that were seen then, the three that were seen longest have a
        say, and the one that moves most like the other two is followed: so a track that went astray is not. Where no
        track was seen then, all take part.
        """
        at = np.einsum("p,pmk->mk", self.path.design(np.array([t]))[0], self.knots)
        slack = self.path.spacing / 2
        alive = np.flatnonzero((self.first - slack <= t) & (t <= self.last + slack))
        alive = alive if len(alive) else np.arange(len(self))
        near = cKDTree(at[alive]).query(points, k=range(1, min(NEAREST, len(alive)) + 1))[1]
        life = (self.last - self.first)[alive][near]
        longest = np.take_along_axis(near, np.argsort(-life, axis=1, kind="stable")[:, :LONGEST], 1)
        moved = (self.knots - at)[:, alive[longest]]  # [P,n,3 tracks,3]
        apart = np.linalg.norm(moved[:, :, :, None] - moved[:, :, None], axis=-1).mean(0).sum(2)
        middle = apart.argmin(1)
        return np.take_along_axis(moved, middle[None, :, None, None], 2)[:, :, 0]


def _solved(
    xyz: Float[np.ndarray, "n T 3"],
    times: Float[np.ndarray, " T"],
    design: Float[np.ndarray, "T P"],
    always: Float[np.ndarray, "P P"],
    robust: float,
) -> Float[np.ndarray, "P n 3"]:
    """Knots of n tracks that were sampled at T world seconds, nan where unseen."""
    frame = float(np.median(np.diff(times))) if len(times) > 1 else FRAME
    centre = np.nanmean(xyz, axis=1, keepdims=True)
    present, samples = np.isfinite(xyz[..., 0]) * (frame / FRAME), np.nan_to_num(xyz - centre)
    outer, size = (design[:, :, None] * design[:, None]).reshape(len(design), -1), design.shape[1]
    weights, knots = present, np.zeros((len(xyz), size, 3))
    for _ in range(ROUNDS):
        blocks = always + (weights @ outer).reshape(-1, size, size)
        knots = np.linalg.solve(blocks, design.T @ (weights[..., None] * samples))
        weights = present / (1 + (np.linalg.norm(design @ knots - samples, axis=2) / robust) ** 2)
    return (knots + centre).transpose(1, 0, 2)
