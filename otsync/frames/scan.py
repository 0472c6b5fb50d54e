"""The search over whole-frame shifts: at each, the similarity that most matches agree on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import CommonClock
from ..types import Similarity

STEP = 3 / 30
"""Seconds between the frames that similarities are fitted to; neighbours in time say the same."""

COARSE = 9 / 30
"""Seconds between the frames that a drawn triple is judged by."""

LEAST = 5
"""Common samples that a match, or the distance of two, needs to count."""

STRIDE = 4 / 30
"""Seconds between shifts that are tried: the fits that follow reach a third of a second."""

MIN_OVERLAP = 24 / 30
"""Seconds that two videos must share for an offset to be considered."""

NEAREST = 0.08
"""Units of the scene: matches nearer to each other than this tell no direction."""

APART = np.cos(np.radians(25.0))
"""Similarities turned by more than this are different answers."""

ANSWERS = 4
"""Different similarities that are kept at each shift."""

GROWTH = 2.0
"""The scale lies within this factor of what the extents of both track sets say."""


@dataclass(frozen=True, eq=False)
class Shifts:
    """What the scan found. lags (K,) frames; scores (K,H) matches that agree; found (K,H,13) scale, R, t in units."""

    lags: Int[np.ndarray, " K"]
    scores: Float[np.ndarray, "K H"]
    found: Float[np.ndarray, "K H 13"]

    def similarity(self, k: int, h: int) -> Similarity:
        f = self.found[k, h]
        return Similarity(float(f[0]), f[1:10].reshape(3, 3).copy(), f[10:].copy())


def scan(pair: CommonClock, *, draws: int, near: float, seed: int, max_lag: float | None = None) -> Shifts:
    """Robust similarities at every :data:`STRIDE`-th shift.

    Args:
        pair: matched tracks in units of the scene, b's in a frame of its own. draws: triples at each shift.
        near: distance, units, up to which a match agrees; worth less the nearer it comes to it.
        seed: of the draws. max_lag: s.
    """
    from ..compute.threads import for_each, ranges
    from . import kernels

    def frames(seconds: float) -> int:
        return max(1, round(seconds * pair.fps))

    lags = pair.lags(frames(MIN_OVERLAP), max_lag)
    lags = lags[:: frames(STRIDE)]
    arrays, within = [], []
    for x in (pair.a, pair.b):
        seen = np.isfinite(x[..., 0])
        filled = np.where(seen[..., None], x, 0.0)
        apart = np.empty((len(x) * (len(x) - 1) // 2, x.shape[1]), np.float32)
        kernels.distances_within(filled, seen, apart)
        arrays += [filled, seen]
        within.append(apart)
    scores, found = np.zeros((len(lags), ANSWERS)), np.zeros((len(lags), ANSWERS, 13))

    def work(k0: int, k1: int) -> None:
        kernels.scan_shifts(
            *arrays,
            *within,
            lags,
            frames(STEP),
            frames(COARSE),
            LEAST,
            draws,
            NEAREST,
            near,
            near,
            GROWTH,
            APART,
            seed,
            k0,
            k1,
            scores,
            found,
        )

    for_each(work, ranges(len(lags), 8))
    return Shifts(lags, scores, found)
