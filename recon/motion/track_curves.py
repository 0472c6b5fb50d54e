"""Splines through lifted tracks, each fitted by itself: motion without a scaffold begins with them, and how far apart
knots may stand is read off them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.spatial import cKDTree

from otsync.types import TrackSet
from recon.motion.nodes import world_clocks
from recon.motion.paths import SPLINES, WINDOW, Path
from recon.motion.solve import FRAME, Bands, Products, along, smoothness, solved

ROUNDS = 3  # of reweighting
STILL = (
    0.005  # weight of the knots' first differences: beyond its ends a track loses two thirds of its speed in two knots
)
WIDEST = 8 / 3 * FRAME  # seconds between knots, at most: docs/reconstruction.md
FINER = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)  # by which it is divided, in turn
SAMPLES = 16  # of a piece of a track by which spacings are told apart, at least
LONG = 6  # and at least so many of the widest spacing
FULL = 0.8  # knots by samples of such a piece, at most: beyond, a curve follows anything
NEEDED = 2.0  # times that what a wider spacing leaves must be more than what a finer one does
SEEN = 0.5  # footprints, rms, below which nobody sees what a spacing leaves
FAST = 0.1  # share of the pieces that must ask for a finer spacing
MOST_PIECES = 4000
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
        always = smoothness(path.count, acceleration, STILL)
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
        first, weights, _ = self.path.basis(t)
        at = np.tensordot(weights, self.knots[int(first) : int(first) + WINDOW], 1)
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


def knot_spacing(
    tracks: Sequence[TrackSet], *, spline: str, footprint: float, rates: Float[np.ndarray, " V"] | None = None
) -> float:
    """Seconds between the knots of a motion: :data:`WIDEST`, or less where things move too fast for that.

    Pieces of tracks are fitted by least squares with knots at several distances. What a spacing leaves unexplained is
    judged by generalised cross-validation (Craven and Wahba 1979), which knows that more knots follow more noise. A
    finer spacing is taken where a share of the pieces, :data:`FAST`, is left with half as much by it, and with a
    part less that can be seen. A thing that swings in .3 s needs it; knots cannot follow what is faster than they are,
    and the clocks of a fit then lie wherever the rest is least.

    Args:
        tracks: one set a video, on its own clock. footprint: world size of a working pixel. rates: world seconds per
            second of each clock; default: 1.
    """
    rates = np.ones(len(tracks)) if rates is None else np.asarray(rates, float)
    alike: dict[float, list[np.ndarray]] = {}
    for one, rate in zip(tracks, rates, strict=True):
        if len(one) and len(one.times) > 1:
            step = float(np.median(np.diff(one.times)) * rate)
            alike.setdefault(round(step, 6), []).append(_pieces(one.positions(), _length(step)))
    spacings = (_spacing_of(np.concatenate(pieces), step, spline, footprint) for step, pieces in alike.items())
    return min(spacings, default=WIDEST)


def _length(step: float) -> int:
    """Samples of a piece."""
    return max(SAMPLES, math.ceil(LONG * WIDEST / step - 0.01))


def _spacing_of(pieces: Float[np.ndarray, "m L 3"], step: float, spline: str, footprint: float) -> float:
    found, least, length = WIDEST, None, pieces.shape[1]
    if not len(pieces):
        return found
    for finer in FINER:
        path = SPLINES[spline].of(0.0, (length - 1) * step, WIDEST / finer)
        basis, size, _ = np.linalg.svd(path.design(step * np.arange(length)).toarray(), full_matrices=False)
        basis = basis[:, size > 1e-9 * size[0]]
        knots = basis.shape[1]
        if knots > FULL * length:
            break
        rest = pieces - basis @ (basis.T @ pieces)
        left = np.square(rest).sum((1, 2)) / length / (1 - knots / length) ** 2
        if least is None:
            least = left
        elif np.mean((least > NEEDED * left) & (least - left > (SEEN * footprint) ** 2)) >= FAST:
            found, least = WIDEST / finer, left
    return found


def _pieces(xyz: Float[np.ndarray, "n T 3"], length: int) -> Float[np.ndarray, "m L 3"]:
    """Pieces of so many samples of tracks, seen throughout, that have none in common; about their middles."""
    seen, found = np.isfinite(xyz[..., 0]), []
    for track, there in zip(xyz, seen, strict=True):
        edges = np.flatnonzero(np.diff(np.r_[0, there, 0]))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            found += [track[k : k + length] for k in range(begin, end - length + 1, length)]
    pieces = np.array(found[:: max(1, math.ceil(len(found) / MOST_PIECES))], float).reshape(-1, length, 3)
    return pieces - pieces.mean(1, keepdims=True)


def _solved(
    xyz: Float[np.ndarray, "n T 3"],
    times: Float[np.ndarray, " T"],
    design: sparse.csr_array,
    always: Bands,
    robust: float,
) -> Float[np.ndarray, "P n 3"]:
    """Knots of n tracks that were sampled at T world seconds, nan where unseen."""
    frame = float(np.median(np.diff(times))) if len(times) > 1 else FRAME
    centre = np.nanmean(xyz, axis=1, keepdims=True)
    present, samples = np.isfinite(xyz[..., 0]) * (frame / FRAME), np.nan_to_num(xyz - centre)
    products, weights = Products.of(design, always.width), present
    for _ in range(ROUNDS):
        blocks = Bands(always.diagonals + products.weighted(weights))
        knots = solved(blocks.factor(), along(design.T, weights[..., None] * samples))
        weights = present / (1 + (np.linalg.norm(along(design, knots) - samples, axis=2) / robust) ** 2)
    return (knots + centre).transpose(1, 0, 2)
