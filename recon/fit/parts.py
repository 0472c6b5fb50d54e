"""Whether the frames of a video agree on one offset.

A fit gives each video one offset. A clock that breaks (a frozen or lost stretch, a cut, a pause) has two, and the fit
finds one between them, surely: the scene follows the other videos, so the frames before the break all vote one way
(:mod:`recon.fit.uncertainty`), and those behind it the other. Pictures tell this where tracks do not, and they tell it
of the answer itself.

Of a time that is off by a frame and more a vote tells less than that: images are not linear so far, and the scene gives
way a little. So a gap says that a clock breaks, and not by how much.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from recon.fit.uncertainty import Votes, sandwich

LEAST = 4
"""Votes on either side of a break."""

GAP = 0.15
"""Frames between the offsets of two parts, from which on a clock breaks. Worlds of ``recon.simulate.capture`` of which
one video lost a frame in the middle have .4 there, and .1 in the others, which it pulls along; of which none did, .03
(seeds 501 to 505, 600 steps)."""

SURE = 4.0
"""Sigmas of a gap, from which on it counts: the break is sought where the gap is widest."""

OTHERS = 3.0
"""Times the usual gap of the other videos: what a scene shows badly in all of them is no clock's."""


class Parting(NamedTuple):
    """Two parts of a video whose votes differ most.

    gap: seconds by which the offset of the second is larger. sigma: of the gap. frame: the second's first that voted.
    """

    gap: float
    sigma: float
    frame: int


def parting(votes: Votes) -> Parting | None:
    """The two parts of a video that explain its votes best; None where too few of its frames show motion."""
    g, h = votes.g, votes.h
    found: tuple[float, Parting] | None = None
    for k in range(LEAST, len(g) - LEAST + 1):
        sides = [_offset(g[part], h[part]) for part in (slice(None, k), slice(k, None))]
        (first, var_first, told_first), (second, var_second, told_second) = sides
        if not (told_first > 0 and told_second > 0):
            continue
        gain = (second - first) ** 2 * told_first * told_second / (told_first + told_second)
        if found is None or gain > found[0]:
            sigma = float(np.sqrt(var_first + var_second))
            found = gain, Parting(second - first, sigma, int(votes.frames[k]))
    return None if found is None else found[1]


def broken(votes: Sequence[Votes], frame_step: float) -> list[int]:
    """Videos whose clocks break.

    Args:
        frame_step: seconds of a frame.
    """
    found = [parting(one) for one in votes]
    gaps = np.array([np.nan if one is None else abs(one.gap) / frame_step for one in found])
    out = []
    for v, one in enumerate(found):
        if one is None:
            continue
        others = np.delete(gaps, v)
        others = others[np.isfinite(others)]
        # of two or three videos each gives way to a break of another one nearly as much as that does
        usual = float(np.median(others)) if len(others) > 2 else 0.0
        if gaps[v] > max(GAP, OTHERS * usual) and abs(one.gap) > SURE * one.sigma:
            out.append(v)
    return out


def _offset(g: np.ndarray, h: np.ndarray) -> tuple[float, float, float]:
    """The step of a part in seconds, its variance, and its information; 0 of the last where nothing moves."""
    told = float(h.sum())
    if not told > 0:
        return 0.0, 0.0, 0.0
    step = -float(g.sum()) / told
    return step, sandwich(g + h * step, h), told
