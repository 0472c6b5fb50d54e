"""Whether an alignment deserves trust: a second opinion for aligners without flags, and places in one world frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Int

from ..compute.indices import evenly
from ..costs.linear import binary_scale
from ..costs.places import apart
from ..types import Alignment, Matches, Status, TrackSet, in_order
from .likelihood import LikelihoodScan
from .slot import Aligner

AGREES = 1.5 / 30
"""Seconds within which an aligner without flags and the likelihood scan are of one opinion: two sigmas of an answer in
whole frames. Of 24 fresh worlds by the paper's method (mid, hard, like people) 14 are trusted, 2 of them off by more
than a frame; with 3 frames it was 20 and 8. All 12 right ones are trusted either way."""

APART = 1.2
"""Median distance of matched tracks at the answer, in units of the median distance between the tracks of one video,
above which two videos of one world frame do not show the same points. Measured at true offsets: real cameras .09 to
.40, presets mid .36, hard .71, brutal 1.01 at most (36 pairs each); somebody else, later: 2.2 to 2.5."""


AS_ONE, LITTLE = 0.8, 0.3
"""Share of the motion that all matched tracks of a video have in common, and its size in units of the scene's extent:
more of the one and less of the other is how a calibration or a tracker drifts, not how things move. Drifts of .1 to .5
m over a static scene: share .96 to .997, size .02 to .1; the moving classes, all presets: a share of .8 is reached with
sizes of .6 and more (a box that flies), sizes below .3 with shares of .1 to .55."""

LOOKS, ENOUGH = 30, 6
"""Moments at which the common motion is taken, and tracks that must be seen at one."""


def vouch(alignment: Alignment, a: TrackSet, b: TrackSet, matches: Matches, aligner: Aligner) -> Alignment:
    """``alignment`` with the flags that its aligner did not raise.

    Args:
        aligner: whose answer it is. That of one which raises no flags itself (DTW, a constant shift, somebody else's)
            is compared with the likelihood scan's over the same shifts: it carries its flags, and DISAGREE where that
            answers otherwise.
    """
    if not np.isfinite(alignment.offset) or a.xyz is None or b.xyz is None or not len(matches):
        return alignment
    flags = list(alignment.flags)
    if not aligner.flags_itself:
        same = {name: getattr(aligner, name) for name in ("max_lag", "min_overlap") if hasattr(aligner, name)}
        scan = LikelihoodScan(**same)(a, b, matches)
        flags += scan.flags
        if not abs(scan.offset - alignment.offset) <= AGREES + 1e-9:
            flags.append(Status.DISAGREE)
    if all(drifts(tracks, index) for tracks, index in zip((a, b), matches.pairs.T, strict=True)):
        flags.append(Status.STATIC)
    if a.frame is not None and a.frame == b.frame:
        distance = apart(a, b, matches, alignment.offset)
        if distance > APART:
            flags.append(Status.AMBIGUOUS)
        alignment = replace(alignment, stats=alignment.stats | {"apart": distance})
    return replace(alignment, flags=in_order(flags))


def drifts(tracks: TrackSet, index: Int[np.ndarray, " M"]) -> bool:
    """Whether the tracks move as one rigid body, all of them, and by little: evidence of a drift, not of a time."""
    x = tracks.positions()[np.unique(index)]
    x = x[:, evenly(x.shape[1], LOOKS)]
    seen = np.isfinite(x[..., 0])
    use = seen.sum(0) >= ENOUGH
    if not use.any():
        return False
    x, seen = x[:, use], seen[:, use]
    there = seen.any(1)
    x, seen = x[there], seen[there]
    filled = np.where(seen[..., None], x, 0.0)
    filled = filled / binary_scale(filled)  # squares of lengths overflow in some units
    rest = filled.sum(1) / seen.sum(1)[:, None]
    extent = float(np.sqrt(((rest - rest.mean(0)) ** 2).sum(1).mean()))
    if not extent > 0:
        return False
    weight = seen.T[..., None] / seen.sum(0)[:, None, None]  # (S,M,1)
    p, q = np.broadcast_to(rest, (x.shape[1], *rest.shape)), filled.transpose(1, 0, 2)
    p, q = p - (weight * p).sum(1, keepdims=True), q - (weight * q).sum(1, keepdims=True)
    U, _, Vt = np.linalg.svd((weight * p).transpose(0, 2, 1) @ q)
    Vt[:, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    left = np.where(seen.T[..., None], q - p @ U @ Vt, 0.0)
    moved = np.where(seen.T[..., None], filled.transpose(1, 0, 2) - rest, 0.0)
    power, rest_of_it = float((moved**2).sum()), float((left**2).sum())
    common = power - rest_of_it
    return common > AS_ONE * power and np.sqrt(common / seen.sum()) < LITTLE * extent
