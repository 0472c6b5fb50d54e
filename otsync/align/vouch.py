"""Whether an alignment deserves trust: a second opinion for aligners without flags, and places in one world frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..costs.places import apart
from ..types import Alignment, Matches, Status, TrackSet, in_order
from .likelihood import LikelihoodScan
from .slot import Aligner

AGREES = 3 / 30
"""Seconds within which an aligner without flags and the likelihood scan are of one opinion (the scan's own limit for
the disagreement of its parts)."""

APART = 1.2
"""Median distance of matched tracks at the answer, in units of the median distance between the tracks of one video,
above which two videos of one world frame do not show the same points. Measured at true offsets: real cameras .09 to
.40, presets mid .36, hard .71, brutal 1.01 at most (36 pairs each); somebody else, later: 2.2 to 2.5."""


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
    if a.frame is not None and a.frame == b.frame:
        distance = apart(a, b, matches, alignment.offset)
        if distance > APART:
            flags.append(Status.AMBIGUOUS)
        alignment = replace(alignment, stats=alignment.stats | {"apart": distance})
    return replace(alignment, flags=in_order(flags))
