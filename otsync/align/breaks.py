"""Where a clock breaks: parts of the overlap with offsets of their own, after a freeze, lost frames or a cut."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import CommonClock
from .peaks import vertex

STEP = 10 / 30
"""Half the length, s, of the windows that are compared, and how far they are apart."""

LEAST_WINDOW = 8 / 30
"""Seconds that a match must be seen in both videos within a window."""

PRICE, SHARE = 7.0, 0.08
"""Nats a match, and share of the whole evidence, that a jump must gain to be told. Clean pairs (mid to brutal) gain up to
7, freezes of 15 frames and ten lost frames 10 to 25."""

DOUBT, DOUBT_SHARE = 3.5, 0.12
"""The same for a jump that only makes the answer doubtful."""

SLOPES = 0.05
"""Largest relative difference of rates that is weighed against jumps."""

LEAST_JUMP = 3 / 30
"""Seconds; smaller steps are a rate, or noise."""

LEAST_PART = 20 / 30
"""Seconds of the shortest part that counts."""

MOST_CELLS = 2_000_000
"""Windows times lags that are looked at; of longer clips only the lags within :data:`REACH` of the answer."""

REACH = 5.0

NONE = np.zeros((0, 2))


def local_curves(
    pair: CommonClock, lags: Int[np.ndarray, " K"], floor: float, weight: Float[np.ndarray, " M"]
) -> Float[np.ndarray, "W K"]:
    """Evidence of every window of a's frames (two steps long) at every lag, nats a match."""
    from . import kernels
    from .likelihood import Signal

    def frames(seconds: float) -> int:
        return max(1, round(seconds * pair.fps))

    a, b = Signal.of(pair.a), Signal.of(pair.b)
    step = frames(STEP)
    count = -(-pair.a.shape[1] // step) + 1
    out = np.zeros((count, len(lags)))
    begin = np.zeros(len(lags), np.int64)
    kernels.windowed_evidence(*a.arrays, *b.arrays, lags, begin, step, frames(LEAST_WINDOW), floor, weight, out)
    return out / max(len(pair.a), 1)


def path_of(curves: Float[np.ndarray, "W K"], price: float) -> Int[np.ndarray, " W"]:
    """The lag of every window that gathers most evidence, where every change costs ``price`` (Viterbi)."""
    W, K = curves.shape
    total = curves[0].copy()
    came = np.zeros((W, K), np.int64)
    stay = np.arange(K)
    for w in range(1, W):
        best = int(np.argmax(total))
        jump = total[best] - price
        moved = jump > total
        came[w] = np.where(moved, best, stay)
        total = np.where(moved, jump, total) + curves[w]
    path = np.empty(W, np.int64)
    path[-1] = int(np.argmax(total))
    for w in range(W - 1, 0, -1):
        path[w - 1] = came[w, path[w]]
    return path


def find_breaks(
    pair: CommonClock,
    lags: Int[np.ndarray, " K"],
    score: Float[np.ndarray, " K"],
    floor: float,
    weight: Float[np.ndarray, " M"],
) -> tuple[Float[np.ndarray, "P 2"], float, bool]:
    """The parts of the overlap that have offsets of their own.

    Returns rows (seconds of a's clock from which on, offset in seconds), none where one offset suits the whole; how much
    evidence the parts add, nats a match; and whether there may be parts that the evidence is too weak to tell.
    """
    step = max(1, round(STEP * pair.fps))
    windows = -(-pair.a.shape[1] // step) + 1
    if windows * len(lags) > MOST_CELLS:
        near = np.abs(lags - lags[int(np.argmax(score))]) <= REACH * pair.fps
        lags = lags[near]
    if windows < 4 or not len(lags):
        return NONE, 0.0, False
    curves = local_curves(pair, lags, floor, weight)
    straight = float(curves.sum(0).max())
    price = max(PRICE, SHARE * straight)
    path, gain = _parts(curves, straight, price, pair.fps)
    edges = np.flatnonzero(np.diff(path)) + 1
    if not len(edges) or gain < price * len(edges):
        low = max(DOUBT, DOUBT_SHARE * straight)
        path, less = _parts(curves, straight, low, pair.fps)
        jumps = int((np.diff(path) != 0).sum())
        doubtful = jumps > 0 and less >= low * jumps and less > _rate_gain(curves, straight) + low
        return NONE, max(gain, less, 0.0), doubtful
    if gain <= _rate_gain(curves, straight) + price:
        return NONE, gain, False  # a rate explains it as well, with one number
    spans = np.split(np.arange(windows), edges)
    offsets = [float(pair.seconds(vertex(lags, c := curves[p].sum(0), int(np.argmax(c))))) for p in spans]
    begin = pair.start + (np.concatenate([[0], edges]) - 0.5) * step / pair.fps
    begin[0] = pair.start
    return np.stack([begin, offsets], 1), gain, False


def _parts(
    curves: Float[np.ndarray, "W K"], straight: float, price: float, fps: float
) -> tuple[Int[np.ndarray, " W"], float]:
    """The path at a price, without what is too short or too small to be a part, and what it gains."""
    path = without_steps(curves, path_of(curves, price), round(LEAST_JUMP * fps), round(LEAST_PART / STEP))
    return path, float(curves[np.arange(len(path)), path].sum() - straight)


def _rate_gain(curves: Float[np.ndarray, "W K"], straight: float) -> float:
    """Evidence that a lag which changes evenly adds to the best constant one; changes of at least a frame are tried."""
    W, K = curves.shape
    position = np.arange(W) - (W - 1) / 2
    most = min(K // 2, int(np.ceil(SLOPES * W * 10)))
    best = 0.0
    for ends in range(-most, most + 1):
        shift = np.rint(ends * position / max(W - 1, 1)).astype(np.int64)
        reach = int(np.abs(shift).max(initial=0))
        if K <= 2 * reach:
            continue
        middle = np.arange(reach, K - reach)
        total = sum(curves[w, middle + shift[w]] for w in range(W))
        best = max(best, float(np.max(total)) - straight)
    return best


def without_steps(
    curves: Float[np.ndarray, "W K"], path: Int[np.ndarray, " W"], least: int, shortest: int
) -> Int[np.ndarray, " W"]:
    """The path without parts that are shorter than ``shortest`` windows or whose lag is within ``least`` of the next."""
    while True:
        edges = np.flatnonzero(np.diff(path)) + 1
        if not len(edges):
            return path
        parts = np.split(np.arange(len(path)), edges)
        size = [len(p) for p in parts]
        near = [abs(int(path[parts[k + 1][0]] - path[parts[k][0]])) < least for k in range(len(edges))]
        if min(size) < shortest:
            k = int(np.argmin(size))
        elif any(near):
            k = near.index(True)
        else:
            return path
        # the part goes to its better neighbour
        sides = [j for j in (k - 1, k + 1) if 0 <= j < len(parts)]
        if min(size) >= shortest:
            joined = np.concatenate([parts[k], parts[k + 1]])
            path = path.copy()
            path[joined] = int(np.argmax(curves[joined].sum(0)))
            continue
        best = max(sides, key=lambda j: curves[parts[k], path[parts[j][0]]].sum())
        path = path.copy()
        path[parts[k]] = path[parts[best][0]]
