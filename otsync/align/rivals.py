"""Whether all tracks would fit as well at another time, were they matched anew: what the matches of one answer hide.

Matches that were made for one offset agree with it. Like things that take each other's places (a carousel, parcels on a
belt, a motion that repeats) fit as well at another one, with other partners.
"""

from __future__ import annotations

import math
import warnings

import numpy as np

from ..compute.indices import evenly
from ..costs.linear import cosine_distance, unit_features
from ..types import Matches, TrackSet

PARTNERS = 10
"""Tracks of the other video whose features are likest: one of them is the partner."""

TRACKS, MOMENTS = 120, 24
"""Tracks of one video that are asked, and moments at which they are compared."""

NEAREST, FEWEST = 0.15, 30
"""Quantile of the tracks' distances that tells, and of how many tracks at least."""

STEP, REACH = 2 / 30, 4.0
"""Seconds between the offsets that are tried, and how far from the answer they go."""

NEAR = 8 / 30
"""Seconds beside the answer that are the answer's own."""

LEAST_COMMON, LEAST_SEEN = 40 / 30, 8
"""Seconds that must be common, and moments at which both must be seen."""


def rival(a: TrackSet, b: TrackSet, matches: Matches, offset: float) -> float:
    """The least distance of tracks to their nearest likely partners at any other offset, over that at ``offset``.

    Distances are those of the nearest :data:`NEAREST` of the tracks in the better half of the matches: others may show
    what the other video does not see. Positions are in one declared world frame; both sets have features. 1: another
    time fits as well; inf: none is far enough to be tried.
    """
    some = np.unique(matches.best(max((len(matches) + 1) // 2, FEWEST)).pairs[:, 0])
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of tracks that are never seen
        moved = np.nan_to_num(np.nanstd(a.positions()[some], 1).sum(1))
    some = some[moved >= np.median(moved)]  # what rests is as near at any time
    some = some[evenly(len(some), TRACKS)]
    assert a.features is not None and b.features is not None
    fa, fb = unit_features(a.features, center=True), unit_features(b.features, center=True)
    likely = np.argsort(cosine_distance(fa[some], fb), 1, kind="stable")[:, :PARTNERS]
    xa, xb = a.positions()[some], b.positions()
    here = _distance(xa, xb, a.times, b.times, likely, offset)
    steps = np.arange(math.ceil(NEAR / STEP), round(REACH / STEP) + 1)
    others = [
        _distance(xa, xb, a.times, b.times, likely, offset + s * k * STEP) for k in steps.tolist() for s in (-1, 1)
    ]
    known = [d for d in others if math.isfinite(d)]
    if not known or not here > 0:
        return math.inf
    return min(known) / here


def _distance(
    xa: np.ndarray, xb: np.ndarray, ta: np.ndarray, tb: np.ndarray, likely: np.ndarray, offset: float
) -> float:
    """Rms distance of a's tracks to the nearest of their likely partners, the quantile :data:`NEAREST` of the tracks;
    nan where too little is common.
    """
    at = np.flatnonzero((ta - offset >= tb[0]) & (ta - offset <= tb[-1]))
    if not len(at) or ta[at[-1]] - ta[at[0]] < LEAST_COMMON:
        return math.nan
    at = at[evenly(len(at), MOMENTS)]
    with_b = np.abs(np.interp(ta[at] - offset, tb, np.arange(len(tb)))).round().astype(np.int64)
    apart = xa[:, None, at] - xb[:, with_b][likely]
    square = (apart**2).sum(3)
    seen = np.isfinite(square)
    count = seen.sum(2)
    rms = np.sqrt(np.where(seen, square, 0.0).sum(2) / np.maximum(count, 1))
    nearest = np.where(count >= LEAST_SEEN, rms, np.inf).min(1)
    known = nearest[np.isfinite(nearest)]
    return float(np.quantile(known, NEAREST)) if len(known) >= LEAST_SEEN else math.nan
