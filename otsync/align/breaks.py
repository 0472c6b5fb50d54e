"""Where a clock breaks: parts of the overlap with offsets of their own, after a freeze, lost frames or a cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import CommonClock
from .peaks import likely, vertex
from .returns import beside_returns, like_itself, return_is_liked
from .windows import LEAST_WINDOW, STEP, agreement, explained, local_curves, seen_share

PRICE, SHARE = 7.0, 0.08
"""Nats a match, and share of the whole evidence, that a jump must gain to be told. Clean pairs (mid to brutal) gain up
to 7, freezes of 15 frames and ten lost frames 10 to 25."""

LOW_PRICE, LOW_SHARE = 3.5, 0.05
"""The same where part of the overlap is not explained by the best offset."""

UNEXPLAINED = 0.5
"""Share of its motion that a window of 20 frames must have in common at the best offset, for the best quarter of the
matches. The least window of clean pairs has .73 and more (mid), .49 (hard, like people .67); of freezes and a missing
second .43 and less; of ten lost frames .06 to .9."""

PREFERS, OF_USUAL, SEEN = 0.6, 0.22, 0.5
"""Nats a match, and share of what two windows in a row usually have, by which any other offset may suit two of them
better than the best offset does, where at least a share of the usual samples is seen: noise leaves much of the motion
unexplained at every offset, a break does so at one alone. In units of this limit clean pairs (270, seeds 600-699: mid
to brutal, few tracks, like people) have .91 at most but for one of 1.25; trusted answers that were wrong at one end
(frames lost, frozen pictures under hard and brutal noise, two takes) .5 to 1.8, five of seven more than 1."""

ODD, UNUSUAL = 3.0, 4.5
"""How many times more than usual may be missing in two windows in a row: clean pairs 1.5 (mid), 4.3 (hard), 4.2
(brutal) at most, of ten lost frames half have 4.6 to 7."""

AGREES = 0.5
"""Share of its motion that the median match must have in common over a part, at the part's own offset."""

BEYOND = 0.5
"""Share of a usual window's evidence that windows must have which lie beyond the overlap at the best offset: some
offset suits them by chance. Clean pairs have up to .4 there, parts that are real .5 and more."""

AS_A_RATE = 2.0
"""Nats a match that parts must add beyond what an even change of the offset adds."""

SLOPES = 0.05
"""Largest relative difference of rates that is weighed against jumps."""

LEAST_JUMP = 3 / 30
"""Seconds; smaller steps are a rate, or noise."""

SHORT = 1.0
"""Seconds at either end of the clip in which some offset may suit by chance."""

LEAST_PART = 20 / 30
"""Seconds of the shortest part that counts."""

MOST_CELLS = 2_000_000
"""Windows times lags that are looked at; of longer clips only the lags within :data:`REACH` of the answer."""

REACH = 5.0

NONE = np.zeros((0, 2))


@dataclass(frozen=True, eq=False)
class Breaks:
    """What a pair tells of breaks.

    Args:
        parts: rows (seconds of a's clock from which on, offset in seconds); none where one offset suits the whole.
        gain: evidence that the parts add, nats a match.
        doubtful: there may be parts that the evidence is too weak to tell.
        returns: motion comes back, and some stretch suits another return as well.
    """

    parts: Float[np.ndarray, "P 2"] = field(default_factory=lambda: NONE)
    gain: float = 0.0
    doubtful: bool = False
    returns: bool = False


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
    *,
    ambiguous: bool = False,
) -> Breaks:
    """The parts of the overlap that have offsets of their own.

    Args:
        ambiguous: another offset is known to suit the whole as well: that it suits a part is no doubt more.
    """
    step = max(1, round(STEP * pair.fps))
    windows = -(-pair.a.shape[1] // step) + 1
    if windows * len(lags) > MOST_CELLS:
        near = np.abs(lags - lags[int(np.argmax(score))]) <= REACH * pair.fps
        lags = lags[near]
    if windows < 4 or not len(lags):
        return Breaks()
    curves = local_curves(pair, lags, floor, weight)
    found = _told(pair, lags, curves, curves, floor, step)
    best = int(np.argmax(curves.sum(0)))
    if found.doubtful or len(found.parts):
        own = beside_returns(curves, like_itself(pair, lags, best, floor, weight), best)
        found = _told(pair, lags, curves, own, floor, step)
    if found.doubtful or len(found.parts):
        return found
    returns = return_is_liked(pair, lags, curves, best, step, round(LEAST_JUMP * pair.fps))
    return replace(found, doubtful=returns and not ambiguous, returns=returns)


def _told(
    pair: CommonClock,
    lags: Int[np.ndarray, " K"],
    curves: Float[np.ndarray, "W K"],
    own: Float[np.ndarray, "W K"],
    floor: float,
    step: int,
) -> Breaks:
    """What :func:`find_breaks` returns. The one offset is that of ``curves``; others are sought in ``own``."""
    windows = len(curves)
    best = int(np.argmax(curves.sum(0)))
    straight = float(curves[:, best].sum())
    rate_gain, even = _as_a_rate(curves, straight)
    line = even if rate_gain > AS_A_RATE else np.full(windows, best)
    doubtful = prefers_another(curves, own, line, seen_share(pair, int(lags[best]), step))
    curves = without_chance(own, best, pair, int(lags[best]), step)
    least, ratio = explained(pair, int(lags[best]), floor, step)
    doubtful |= ratio > UNUSUAL
    prices = [max(PRICE, SHARE * straight)]
    if least < UNEXPLAINED or ratio > ODD:
        prices.append(max(LOW_PRICE, LOW_SHARE * straight))
    for price in prices:
        path, gain = _parts(curves, straight, price, pair.fps)
        edges = np.flatnonzero(np.diff(path)) + 1
        if len(edges) and gain >= price * len(edges):
            break
    else:
        return Breaks(gain=max(gain, 0.0), doubtful=doubtful)
    if gain <= _as_a_rate(curves, straight)[0] + AS_A_RATE:
        return Breaks(gain=gain, doubtful=doubtful)  # a rate explains it as well, with one number
    look = Look(pair, lags, curves, best, floor, step)
    spans = np.split(np.arange(windows), edges)
    tops = [int(np.argmax(curves[p].sum(0))) for p in spans]
    kept = by_chance(spans, look.at(tops), look.agree(spans, tops), int(lags[best]), pair, step)
    if len(kept) < len(spans):
        gain -= sum(float(curves[spans[k], path[spans[k]]].sum()) for k in range(len(spans)) if k not in kept)
        # the windows of what is left out belong to nothing; the next part begins where it did
        spans, tops = [spans[k] for k in kept], [tops[k] for k in kept]
        if len(kept) < 2 or gain < price * (len(kept) - 1):
            return Breaks(gain=max(gain, 0.0), doubtful=True)
    tops, change, sound = look.settled(spans, tops)
    gain += change
    if not sound or (change and gain < price * (len(tops) - 1)):
        return Breaks(gain=max(gain, 0.0), doubtful=doubtful)
    offsets = [float(pair.seconds(vertex(lags, curves[p].sum(0), top))) for p, top in zip(spans, tops, strict=True)]
    begin = pair.start + (np.array([p[0] for p in spans]) - 0.5) * step / pair.fps
    begin[0] = pair.start
    return Breaks(np.stack([begin, offsets], 1), gain)


@dataclass(frozen=True, eq=False)
class Look:
    """A pair, the evidence of its windows at all lags, and which of these (its index) suits the whole best."""

    pair: CommonClock
    lags: Int[np.ndarray, " K"]
    curves: Float[np.ndarray, "W K"]
    best: int
    floor: float
    step: int

    def at(self, tops: Sequence[int]) -> list[int]:
        """The lags of these indices."""
        return [int(self.lags[top]) for top in tops]

    def agree(self, spans: Sequence[np.ndarray], tops: Sequence[int]) -> list[float]:
        """Of every part, the share of its motion that its median match has in common."""
        return [self.agrees(spans, tops, k) for k in range(len(tops))]

    def agrees(self, spans: Sequence[np.ndarray], tops: Sequence[int], k: int) -> float:
        found = self.at(tops)
        # halves that were exchanged lost nothing: all of them counts, too
        asked = {partners(spans, found, k, self.step), frames(spans[k], self.step)}
        return max(agreement(self.pair, begin, end, found[k], self.floor) for begin, end in asked)

    def settled(self, spans: Sequence[np.ndarray], tops: list[int]) -> tuple[list[int], float, bool]:
        """The index of every part's lag, once most of its matches agree at it; the evidence that this adds; whether
        they do.

        Some offset suits a few of the matches by chance. Of motion that comes again, another one may suit most.
        """
        least = round(LEAST_JUMP * self.pair.fps)
        agree, change = self.agree(spans, tops), 0.0
        for k, top in enumerate(tops):
            if top == self.best or agree[k] >= AGREES:
                continue
            evidence, told = self.curves[spans[k]].sum(0), {}
            for other in likely(evidence, least):
                found = [*tops[:k], other, *tops[k + 1 :]]
                if np.abs(np.diff(self.at(found))).min() >= least:
                    told[other] = self.agrees(spans, found, k)
            other = max(told, key=lambda o: told[o], default=top)
            if told.get(other, 0.0) < AGREES:
                return tops, change, False
            change += float(evidence[other] - evidence[top])
            tops = [*tops[:k], other, *tops[k + 1 :]]
        return tops, change, True


def frames(span: Int[np.ndarray, " P"], step: int) -> tuple[int, int]:
    """a's frames of some windows in a row, from the first one's middle to the last one's."""
    return int(span[0]) * step - step // 2, int(span[-1]) * step + step // 2


def partners(spans: Sequence[np.ndarray], lags: Sequence[int], k: int, step: int) -> tuple[int, int]:
    """a's frames of part k that have partners in b, whichever end of a gap the windows put its edge at.

    Where the lag grows from one part to the next, b lost that many frames, or a repeats them: there a's have no
    partner. At least half of the part counts.
    """
    begin, end = frames(spans[k], step)
    half = (end - begin) // 2
    before = max(0, lags[k] - lags[k - 1]) if k else 0
    behind = max(0, lags[k + 1] - lags[k]) if k + 1 < len(lags) else 0
    trim = max(0, min(before, half)), max(0, min(behind, half))
    if sum(trim) > half:
        trim = (half // 2, half // 2)
    return begin + trim[0], end - trim[1]


def by_chance(
    spans: Sequence[np.ndarray],
    lags: Sequence[int],
    agree: Sequence[float],
    best: int,
    pair: CommonClock,
    step: int,
) -> list[int]:
    """The parts that are left without those in which some offset suits by chance: short ones, not at the ``best`` lag
    of all, that agree less than the parts beside them, and whose frames of a have no partner if these are right: b lost
    them, or begins later, or ends earlier.
    """
    kept = list(range(len(spans)))
    for k in range(len(spans)):
        left = [j for j in kept if j < k][-1:]
        right = [k + 1] if k + 1 < len(spans) else []
        if lags[k] == best or not (left or right) or agree[k] >= min(agree[j] for j in (*left, *right)):
            continue
        begin, end = frames(spans[k], step)
        weak = end - begin <= SHORT * pair.fps or agree[k] < AGREES
        if left and right:
            alone = end - begin <= lags[right[0]] - lags[left[0]] + 2 * step
        elif right:
            alone = weak and end <= lags[right[0]] + step
        else:
            alone = weak and begin >= pair.b.shape[1] + lags[left[0]] - step
        if alone:
            kept.remove(k)
    return kept


def prefers_another(
    curves: Float[np.ndarray, "W K"],
    own: Float[np.ndarray, "W K"],
    line: Int[np.ndarray, " W"],
    seen: Float[np.ndarray, " W"],
) -> bool:
    """Whether two windows in a row, in which enough is seen, clearly suit an offset of their ``own`` better than
    ``line``, the index of that of each in ``curves``.
    """
    usual = float(np.median(seen[seen > 0])) if (seen > 0).any() else 0.0
    told = np.flatnonzero(np.minimum(seen[:-1], seen[1:]) >= SEEN * usual)
    if usual == 0 or not len(told):
        return False
    here = curves[told, line[told]] + curves[told + 1, line[told + 1]]
    gain = float(((own[told] + own[told + 1]).max(1) - here).max())
    return gain > PREFERS + OF_USUAL * max(float(np.median(here)), 0.0)


def without_chance(
    curves: Float[np.ndarray, "W K"], best: int, pair: CommonClock, lag: int, step: int
) -> Float[np.ndarray, "W K"]:
    """The curves of windows beyond the overlap at the best lag, less what some offset has by chance."""
    W = len(curves)
    low, high = (np.arange(W) - 1) * step, (np.arange(W) + 1) * step
    begin, end = max(0, lag), min(pair.a.shape[1], pair.b.shape[1] + lag)
    common = np.minimum(high, end) - np.maximum(low, begin)
    beyond = common < LEAST_WINDOW * pair.fps
    if beyond.all() or not beyond.any():
        return curves
    usual = BEYOND * float(curves[~beyond, best].mean())
    curves = curves.copy()
    others = np.arange(curves.shape[1]) != best
    curves[np.ix_(beyond, others)] -= usual
    return curves


def _parts(
    curves: Float[np.ndarray, "W K"], straight: float, price: float, fps: float
) -> tuple[Int[np.ndarray, " W"], float]:
    """The path at a price, without what is too short or too small to be a part, and what it gains."""
    path = without_steps(curves, path_of(curves, price), round(LEAST_JUMP * fps), round(LEAST_PART / STEP))
    return path, float(curves[np.arange(len(path)), path].sum() - straight)


def _as_a_rate(curves: Float[np.ndarray, "W K"], straight: float) -> tuple[float, Int[np.ndarray, " W"]]:
    """Evidence that a lag which changes evenly adds to the best constant one, and that lag's index in every window.

    Changes of at least a frame are tried; where none can be, nothing is added, and the index is 0.
    """
    W, K = curves.shape
    position = np.arange(W) - (W - 1) / 2
    most = min(K // 2, int(np.ceil(SLOPES * W * 10)))
    summed = np.concatenate([np.zeros((1, K)), np.cumsum(curves, 0)])
    gain, line = 0.0, np.zeros(W, np.int64)
    for ends in range(-most, most + 1):
        shift = np.rint(ends * position / max(W - 1, 1)).astype(np.int64)
        reach = int(np.abs(shift).max(initial=0))
        if 2 * reach >= K:
            continue
        middle = np.arange(reach, K - reach)
        edges = np.flatnonzero(np.diff(shift, prepend=shift[0] - 1, append=shift[-1] + 1))
        by_shift = summed[edges[1:]] - summed[edges[:-1]]  # windows of one shift follow each other
        total = by_shift[np.arange(len(by_shift))[:, None], middle + shift[edges[:-1], None]].sum(0)
        top = int(np.argmax(total))
        if total[top] - straight > gain:
            gain, line = float(total[top] - straight), middle[top] + shift
    return gain, line


def without_steps(
    curves: Float[np.ndarray, "W K"], path: Int[np.ndarray, " W"], least: int, shortest: int
) -> Int[np.ndarray, " W"]:
    """The path without parts of fewer than ``shortest`` windows, or whose lag is within ``least`` of the next one's."""
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
