"""Motion that comes back, as strides do: it is like itself a while later, and tells little of clocks then."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from ..clocks.common import CommonClock
from .peaks import likely
from .windows import LEAST_WINDOW, local_curves, variance

COMES_BACK = 0.75
"""Share of what a window has at another offset that a video must have in common with itself then, for motion that comes
back to explain it: a video is like itself, point by point, at least as much as it is like another. Where bodies swing
and walk (films, seeds 430 and 433) it is .8 to 2 in most pairs; behind a missing second (mid, seeds 41000-41005), in
motion that nearly comes back, .9 at most and .5 usually."""

NEARLY = 0.6
"""Share of the whole evidence that another offset must have to be one at which the motion comes back."""

STRETCH, VOTERS, ENOUGH = 4, 8, 0.3
"""Windows of a stretch that is looked at; how many matches must be seen there, and what share of them all."""

LIKED = 0.3
"""Share of the matches that suit a return better over a stretch, from which on one may hide a break. Looked at: strides
of which the file misses one (57000-58019, and early, late and of four videos, 59100-59111: 18 trusted and 30 frames off
at one end) .3 to .7; that miss none .05 to .2 mostly, .38 at most where 50 matches and more decide: two of nine right
answers are withheld. Of mid, hard and brutal worlds one of 60 is."""


def like_itself(
    pair: CommonClock, lags: Int[np.ndarray, " K"], best: int, floor: float, weight: Float[np.ndarray, " M"]
) -> Float[np.ndarray, "W K"]:
    """What either video has in common with itself, in place of the other: :func:`local_curves` of a with what it shows
    so much later as each lag is beside the ``best`` one, or of b, the larger.
    """
    lag = int(lags[best])
    # all that a shows: of what only the overlap shows, more would be in common at lags that reach beyond it
    a_later = local_curves(dataclasses.replace(pair, b=pair.a), lags - lag, floor, weight)
    b_later = dataclasses.replace(pair, a=_later(pair.b, -lag, pair.a.shape[1]))
    return np.maximum(a_later, local_curves(b_later, lags, floor, weight))


def beside_returns(
    curves: Float[np.ndarray, "W K"], alike: Float[np.ndarray, "W K"], best: int
) -> Float[np.ndarray, "W K"]:
    """What windows have at every offset; where that is more than at the ``best`` one of all, less what motion that
    comes back makes of it.

    People who walk do nearly the same a stride later, and of two strides either may suit a window better, by chance or
    by wrong matches. What a video has in common with itself so much later, ``alike``, tells nothing of clocks. Slow
    motion is like itself a little later, too, and hides no break: only what rises again behind the least counts.
    """
    below = np.minimum.accumulate(alike[:, best::-1], 1)[:, ::-1]
    above = np.minimum.accumulate(alike[:, best:], 1)
    returns = alike - np.concatenate([below, above[:, 1:]], 1)
    here = curves[:, [best]]
    told = (curves > here) & (alike >= COMES_BACK * curves)
    return np.where(told, np.maximum(here, curves - returns), curves)


def _later(x: Float[np.ndarray, "M T 3"], begin: int, length: int) -> Float[np.ndarray, "M L 3"]:
    """``length`` frames from ``begin`` on, nan where there are none."""
    out = np.full((len(x), length, x.shape[2]), np.nan)
    low, high = max(0, -begin), min(length, x.shape[1] - begin)
    if high > low:
        out[:, low:high] = x[:, low + begin : high + begin]
    return out


def return_is_liked(
    pair: CommonClock,
    lags: Int[np.ndarray, " K"],
    curves: Float[np.ndarray, "W K"],
    best: int,
    step: int,
    apart: int,
) -> bool:
    """Whether, over some stretch, many matches suit another offset better that suits the whole nearly as well.

    Of motion that comes back two returns differ by little, and the longer overlap may decide between them; a lost
    stride adds less than a jump must gain among hundreds of offsets. But returns are few, and while nothing is lost,
    few matches suit one better anywhere, on what b shows at both offsets: each has one vote. Behind a gap neither suits
    all of it, and about half vote for either.
    """
    total = curves.sum(0)
    for k in likely(total, apart):
        if total[k] < NEARLY * total[best]:
            break  # they come best first
        gains, seen = _votes(pair, int(lags[best]), int(lags[k]), len(curves), step)
        fewest = max(VOTERS, ENOUGH * np.count_nonzero(seen.any(1)))
        for begin in range(len(curves) - STRETCH + 1):
            stretch = slice(begin, begin + STRETCH)
            asked = seen[:, stretch].sum(1) >= STRETCH - 1
            votes = gains[asked, stretch].sum(1) > 0
            if len(votes) >= fewest and votes.mean() >= LIKED:
                return True
    return False


def _votes(
    pair: CommonClock, lag: int, other: int, windows: int, step: int
) -> tuple[Float[np.ndarray, "M W"], Bool[np.ndarray, "M W"]]:
    """How much better every match suits the ``other`` lag than ``lag`` in every window, by what b shows of it at both;
    and where it shows enough.
    """
    T, length = pair.a.shape[1], pair.b.shape[1]
    gains, told = np.zeros((len(pair.a), windows)), np.zeros((len(pair.a), windows), bool)
    for w in range(windows):
        begin = max(0, (w - 1) * step, lag, other)
        end = min(T, (w + 1) * step, length + lag, length + other)
        if end - begin < LEAST_WINDOW * pair.fps:
            continue
        a, here, there = pair.a[:, begin:end], *(pair.b[:, begin - one : end - one] for one in (lag, other))
        seen = np.isfinite(a[..., 0]) & np.isfinite(here[..., 0]) & np.isfinite(there[..., 0])
        use = seen.sum(1) >= LEAST_WINDOW * pair.fps
        a, here, there, seen = a[use], here[use], there[use], seen[use]
        gains[use, w], told[use, w] = variance(a - here, seen) - variance(a - there, seen), True
    return gains, told
