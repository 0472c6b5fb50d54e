"""Whether the frames of a video agree on one offset.

A fit gives each video one offset. A clock that breaks (a frozen or lost stretch, a cut, a pause) has two, and the fit
finds one between them, surely: the scene follows the other videos, so the frames before the break all vote one way
(:mod:`recon.fit.uncertainty`), and those behind it the other. Pictures tell this where tracks do not, and they tell it
of the answer itself. Of a rate that is wrong the votes are a ramp instead.

Of a time that is off by a frame and more a vote tells less than that: images are not linear so far, and the scene gives
way a little. So a gap says that a clock breaks, and not by how much.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from recon.fit.uncertainty import Votes, by_misfit, sandwich

LEAST = 4
"""Votes of a part, and of the rest."""

GAP = 0.15
"""Frames between the offsets of two parts, from which on a clock breaks. Worlds of ``recon.simulate.capture`` of which
one video lost a frame in the middle have .4 there, and .1 in the others, which it pulls along; of which none did, .03
(seeds 501 to 505, 600 steps)."""

SURE = 4.0
"""Sigmas of a gap, from which on it counts, since the break is sought where the gap is widest. Of a part of few votes
more are asked, as many as Student's distribution has for the same doubt."""

OTHERS = 3.0
"""Times the usual gap of the other videos: what a scene shows badly in all of them is no clock's."""

SHOWN = 12.0
"""Times the error that a scene may make of a clock by showing its frames badly
(:func:`recon.fit.uncertainty.by_misfit`): of the video that is shown best, where the other videos' gaps are a guard as
well; of two and three by the median. Films of ``recon simulate`` (30 frames a second) have gaps of up to ten times the
median after 300 steps, without a break (.1 to .7 frame; seeds 80160 to 80168), most worlds that lost frames 15 to 95
times. A break spoils what is shown, too: after a short fit a long one of two or three videos may be missed, and so are
most where frames are far apart, since the error is of seconds."""


class Parting(NamedTuple):
    """A part of a video whose votes differ most from those of the rest.

    gap: seconds by which its offset is larger. sigma: of the gap. first, last: the frames that voted at its ends.
    votes: of the part or of the rest, whichever has fewer; of a slope, as many as would tell as much if all told alike.
    """

    gap: float
    sigma: float
    first: int
    last: int
    votes: int


def parting(votes: Votes) -> Parting | None:
    """The part of a video that, with an offset of its own, explains its votes best; None where too few show motion.

    It ends the video where the clock breaks once, and lies within where it breaks and is right again (frames that were
    lost, and later as many that stand still).
    """
    n, g, h = len(votes.g), votes.g, votes.h
    G, H = (np.concatenate([[0.0], np.cumsum(x)]) for x in (g, h))
    first, end = np.triu_indices(n + 1, LEAST)
    kept = (first > 0) & (end - first <= n - LEAST)  # a first part is the rest of the other one
    first, end = first[kept], end[kept]
    inside, outside = H[end] - H[first], H[-1] - (H[end] - H[first])
    moves = (inside > 0) & (outside > 0)
    if not moves.any():
        return None
    first, end, inside, outside = first[moves], end[moves], inside[moves], outside[moves]
    step = -(G[end] - G[first]) / inside
    gap = step + (G[-1] - (G[end] - G[first])) / outside
    best = int(np.argmax(gap**2 * inside * outside / (inside + outside)))
    part = slice(int(first[best]), int(end[best]))
    variance = _variance(g[part], h[part]) + _variance(np.delete(g, part), np.delete(h, part))
    return Parting(
        float(gap[best]),
        float(np.sqrt(variance)),
        int(votes.frames[part.start]),
        int(votes.frames[part.stop - 1]),
        min(part.stop - part.start, n - (part.stop - part.start)),
    )


def tilt(votes: Votes) -> Parting | None:
    """The two halves of a video whose votes lie along a line, as those of a rate that is wrong do; None where too few
    show motion.

    Of such votes two parts with an offset each scatter by themselves, so that their gap looks unsure.
    """
    n, g, h = len(votes.g), votes.g, votes.h
    if n < 2 * LEAST or not h.sum() > 0:
        return None
    at = votes.frames - (h @ votes.frames) / h.sum()
    weight, half = h * at**2, (votes.frames[-1] - votes.frames[0]) / 2
    if not weight.sum() > 1e-9 * h.sum() * half**2:  # one frame alone moves
        return None
    slope = -(g @ at) / weight.sum()
    # about the line: what is left of a slope of 0 is noise alone
    variance = sandwich(at * (g - h * (g.sum() / h.sum()) + h * slope * at), weight)
    middle = n // 2
    return Parting(
        float(slope * half),
        float(np.sqrt(variance) * half),
        int(votes.frames[middle]),
        int(votes.frames[-1]),
        max(2, int(weight.sum() ** 2 / np.square(weight).sum())),  # a slope hangs on those that are far out
    )


def broken(votes: Sequence[Votes], frame_step: float) -> list[int]:
    """Videos whose clocks break, or run at another rate than they say.

    Args:
        frame_step: seconds of a frame.
    """
    found = {v: told for v, one in enumerate(votes) if (told := _partings(one))}
    if not found:
        return []
    gaps = {v: max(abs(part.gap) for part in told) / frame_step for v, told in found.items()}
    misfits = [by_misfit(votes[v].residual, votes[v].rate) / frame_step for v in found]
    few = len(found) <= 3  # of these each gives way to a break of another one nearly as much as that does
    shown = SHOWN * float(np.median(misfits) if few else np.min(misfits))
    out = []
    for v, told in found.items():
        usual = 0.0 if few else float(np.median([gap for u, gap in gaps.items() if u != v]))
        least = max(GAP, OTHERS * usual, shown) * frame_step
        if any(abs(part.gap) > max(least, sure(part.votes) * part.sigma) for part in told):
            out.append(v)
    return out


def _partings(votes: Votes) -> list[Parting]:
    """The part that has an offset of its own, and the halves that a rate parts."""
    return [part for of in (parting, tilt) if (part := of(votes)) is not None]


def sure(votes: int) -> float:
    """Sigmas from which on a gap counts, of a part of so many votes."""
    return float(stats.t.isf(stats.norm.sf(SURE), votes - 1))


def _variance(g: np.ndarray, h: np.ndarray) -> float:
    """Of the offset of a part, about itself."""
    return sandwich(g - h * (g.sum() / h.sum()), h)
