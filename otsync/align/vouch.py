"""Whether an alignment deserves trust: a second opinion for aligners without flags, and places in one world frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import thinned
from ..compute.indices import evenly
from ..costs.linear import binary_scale
from ..costs.places import apart
from ..types import Alignment, Matches, Status, TrackSet, in_order
from .likelihood import LikelihoodScan
from .rivals import rival
from .slot import Aligner

AGREES = 1 / 30
"""Seconds within which an aligner without flags and the likelihood scan are of one opinion: a frame, which is what an
answer in whole frames may be off. Of 36 worlds by the paper's method (mid, hard, like people; seeds 900-911) 23 of the
24 right answers are trusted, and no wrong one; with a frame and a half 2 of 14 trusted were off by more than one."""

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

MOMENTS, STEP = 200, 5 / 30
"""Moments at which velocities are compared after the common motion is taken out, and half the seconds they are over."""

CORRELATED, RATHER_LITTLE = 0.19, 0.45
"""Correlation of what is left of the best tenth of the matches, and size of what was taken out, below which only a
drift is shared: static scenes with drifts of .2 m have .12 to .17 and at most .36; what moves by as little .5 and more
(mid), .25 (hard), .19 (brutal; 20 pairs each)."""

ANOTHER_TIME = ("likeness", "returning", "another_time")
"""What the scan says of times that no lag shows, in its stats: pairs that may be another time's vouch for no other."""

BEST_TENTH, LEAST_MOMENTS = 0.9, 40


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
        scan = scan_of(aligner)(a, b, matches)
        flags += scan.flags
        told = {name: value for name, value in scan.stats.items() if name in ANOTHER_TIME}
        alignment = replace(alignment, stats=alignment.stats | told)
        if not abs(scan.offset - alignment.offset) <= AGREES + 1e-9:
            flags.append(Status.DISAGREE)
    few_a, few_b = thinned(a), thinned(b)
    if all(drifts(tracks, index) for tracks, index in zip((few_a, few_b), matches.pairs.T, strict=True)) or (
        Status.DISAGREE not in flags and only_drift(few_a, few_b, matches, alignment.offset)
    ):
        flags.append(Status.STATIC)
    if a.frame is not None and a.frame == b.frame:
        distance = apart(a, b, matches, alignment.offset)
        if distance > APART:
            flags.append(Status.AMBIGUOUS)
        told = {"apart": distance}
        if a.features is not None and b.features is not None:
            other = rival(few_a, few_b, matches, alignment.offset)
            told |= {"rival": other.ratio, "rival_as_good": float(other.as_good)}
            if other.as_good:
                flags.append(Status.AMBIGUOUS)
        alignment = replace(alignment, stats=alignment.stats | told)
    return replace(alignment, flags=in_order(flags))


def scan_of(aligner: Aligner) -> LikelihoodScan:
    """The likelihood scan over the shifts that an aligner looks at: itself, if it is one."""
    if isinstance(aligner, LikelihoodScan):
        return aligner
    same = {name: getattr(aligner, name) for name in ("max_lag", "min_overlap") if hasattr(aligner, name)}
    return LikelihoodScan(**same)


def drifts(tracks: TrackSet, index: Int[np.ndarray, " M"]) -> bool:
    """Whether the tracks move as one rigid body, all of them, and by little: evidence of a drift, not of a time."""
    body = as_one_body(tracks.positions(np.unique(index), evenly(tracks.n_frames, LOOKS)))
    return body is not None and body.share > AS_ONE and body.size < LITTLE


def only_drift(a: TrackSet, b: TrackSet, matches: Matches, offset: float) -> bool:
    """Whether two videos have nothing in common but a little motion that all tracks of each share.

    That motion is taken out of both; what is left must correlate at the answer, or nothing but a drift was aligned.
    """
    times = a.times[(a.times >= offset + b.times[0]) & (a.times <= offset + b.times[-1])]
    if len(times) < 3:
        return False
    times = times[evenly(len(times), MOMENTS)]
    left, seen = [], []
    for tracks, column, t in ((a, 0, times), (b, 1, times - offset)):
        ends = [np.abs(tracks.times[:, None] - (t + s * STEP)[None]).argmin(0) for s in (-1, 1)]
        body = as_one_body(tracks.positions(matches.pairs[:, column], np.concatenate(ends)))
        if body is None or body.size > RATHER_LITTLE:
            return False
        n = len(t)
        step = body.left[:, n:] - body.left[:, :n]
        known = np.isfinite(step[..., 0])
        left.append(np.where(known[..., None], step, 0.0))
        seen.append(known)
    both = seen[0] & seen[1]
    told = both.sum(1) >= LEAST_MOMENTS
    if told.sum() < ENOUGH:
        return False
    u, v = left[0] * both[..., None], left[1] * both[..., None]
    power = np.sqrt((u**2).sum((1, 2)) * (v**2).sum((1, 2)))[told]
    correlation = (u * v).sum((1, 2))[told] / np.maximum(power, np.finfo(float).tiny)
    return float(np.quantile(correlation, BEST_TENTH)) < CORRELATED


@dataclass(frozen=True, eq=False)
class Body:
    """Tracks taken for one rigid body.

    Args:
        left: (M,S,3) what its motion does not explain, in a unit of a power of two; nan where not seen.
        share: of the motion that it explains. size: rms of what it explains, in units of the extent.
    """

    left: Float[np.ndarray, "M S 3"]
    share: float
    size: float


def as_one_body(x: Float[np.ndarray, "M S 3"]) -> Body | None:
    """The rigid motion that all tracks share, moment by moment; None where too few are seen."""
    seen = np.isfinite(x[..., 0])
    use = seen & (seen.sum(0) >= ENOUGH)
    there = use.any(1)
    if there.sum() < ENOUGH:
        return None
    filled = np.where(use[..., None], x, 0.0)
    filled = filled / binary_scale(filled)  # squares of lengths overflow in some units
    rest = filled.sum(1) / np.maximum(use.sum(1), 1)[:, None]
    extent = float(np.sqrt(((rest[there] - rest[there].mean(0)) ** 2).sum(1).mean()))
    if not extent > 0:
        return None
    weight = use.T[..., None] / np.maximum(use.sum(0), 1)[:, None, None]  # (S,M,1)
    p, q = np.broadcast_to(rest, (x.shape[1], *rest.shape)), filled.transpose(1, 0, 2)
    p, q = p - (weight * p).sum(1, keepdims=True), q - (weight * q).sum(1, keepdims=True)
    U, _, Vt = np.linalg.svd((weight * p).transpose(0, 2, 1) @ q)
    Vt[:, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    left = np.where(use.T[..., None], q - p @ U @ Vt, 0.0)
    moved = np.where(use.T[..., None], filled.transpose(1, 0, 2) - rest, 0.0)
    power, rest_of_it = float((moved**2).sum()), float((left**2).sum())
    common = max(power - rest_of_it, 0.0)
    told = np.where(use[..., None], left.transpose(1, 0, 2), np.nan)
    return Body(told, common / power if power > 0 else 0.0, float(np.sqrt(common / use.sum())) / extent)
