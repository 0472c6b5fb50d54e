"""Whether one offset holds for the whole of every video where pairs have no depth: windows of the overlap, one by one.

A window of one pair says little. A video whose clock breaks is off against all others in the same windows and by the
same time, so the evidence of its pairs is added.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import nominal_fps, on_clock, strongest
from ..geometry import seen_pixels
from ..types import Matches, TrackSet
from .poses import Views
from .scan import EpipolarScan, unit_of

STEP = 20 / 30
"""Half the length, s, of the windows, and how far they are apart."""

REACH = 30 / 30
"""Seconds by which a window's own offset may differ from the answer."""

NEAR = 2.5 / 30
"""Seconds within which it is the answer."""

LEAST_SEEN, LEAST_PAIRS = 12 / 30, 3
"""Seconds within a window that a match must be seen in a, and how many such matches tell anything."""

LEAST_GAIN, LEAST_SHARE = 50.0, 0.25
"""Nats, and share of the rise over the typical offset, by which another offset must suit two windows in a row better.
Whole clips of basketball: sound cameras have less in 65 of 70 pairs and in 16 of 16 sets of four, those with ten frames
dropped or fifteen frozen more in 51 of 60 and 15 of 16 (seeds 21900-21969, 23900-23915)."""

SAME = 3 / 30
"""Seconds within which all windows up to an end have the same offset."""

AGREED = 0.9
"""Root sums of squares of its pairs' gains that their sum must reach; that of one pair alone is 1. Matches of a few
wrong things say much for some offset in some pairs, and as much against it in others. Basketball, sets of six: with ten
frames dropped or fifteen frozen 1.5 and more in 16 of 16, of sound cameras .7 at most (seeds 5300-5329, 5600-5611)."""

MATCHES = 1500
"""Matches of a pair that are read, the best ones."""


def local_evidence(
    scan: EpipolarScan,
    a: TrackSet,
    b: TrackSet,
    matches: Matches,
    offset: float,
    start: float,
    count: int,
    fps: float,
) -> Float[np.ndarray, "W D"]:
    """Evidence (nats) of windows of a's time for offsets that differ by -REACH ... REACH from ``offset``, a column a
    frame; 0 where too little is common.

    Args:
        start: of the first window on a's clock, s. count: of windows, :data:`STEP` apart. fps: of the clock that both
            videos are brought on, so that curves of several pairs can be added.
    """
    xa, xb = (on_clock(tracks, seen_pixels(tracks), fps) for tracks in (a, b))
    views, unit = Views.of(a, b, fps), unit_of(a, b)
    middle = round((offset - float(a.times[0] - b.times[0])) * fps)
    reach, length = round(REACH * fps), round(2 * STEP * fps)
    lags = middle + np.arange(-reach, reach + 1)
    out = np.zeros((count, len(lags)))
    for w in range(count):
        first = round((start + w * STEP - float(a.times[0])) * fps)
        inside = slice(max(first, 0), max(first + length, 0))
        part = xa[:, inside]
        seen = np.isfinite(part[matches.pairs[:, 0], :, 0]).sum(1) >= LEAST_SEEN * fps
        if seen.sum() < LEAST_PAIRS:
            continue
        few = None if matches.weight is None else matches.weight[seen]
        out[w] = scan.evidence(part, xb, views.within(inside), matches.pairs[seen], lags - inside.start, fps, unit, few)
    return out


def unsteady(
    scan: EpipolarScan,
    tracks: Sequence[TrackSet],
    matches: Mapping[tuple[int, int], Matches],
    seconds: Float[np.ndarray, " V"],
) -> list[int]:
    """Videos that in some windows are off against the others, by one and the same time: their clocks break.

    Args:
        matches: of the pairs that count. seconds: (V,) the offsets that are asked about; nan where there is none.
    """
    fps = min(nominal_fps(t) for t in tracks)
    known = [v for v in range(len(tracks)) if np.isfinite(seconds[v])]
    if not known:
        return []
    start = min(float(tracks[v].times[0] + seconds[v]) for v in known)
    stop = max(float(tracks[v].times[-1] + seconds[v]) for v in known)
    count = int((stop - start) / STEP)
    told = {
        (i, j): local_evidence(
            scan, tracks[i], tracks[j], _some(m), float(seconds[j] - seconds[i]), start - float(seconds[i]), count, fps
        )
        for (i, j), m in matches.items()
        if len(m) and np.isfinite(seconds[[i, j]]).all()
    }
    found: list[int] = []
    while told and count > 1:
        gains = [_gain([c if v == j else c[:, ::-1] for (i, j), c in told.items() if v in (i, j)], fps) for v in known]
        # of two videos, which are off against each other alike, the later one
        worst = len(known) - 1 - int(np.argmax(gains[::-1]))
        if not gains[worst] > 0:
            break
        found.append(known[worst])
        told = {pair: c for pair, c in told.items() if known[worst] not in pair}
    return sorted(found)


def _some(matches: Matches) -> Matches:
    return strongest(matches, MATCHES) if matches.score is not None else matches


def _gain(curves: Sequence[Float[np.ndarray, "W D"]], fps: float) -> float:
    """Nats that other offsets have beyond the answer, summed over every two windows in a row where that is more than
    chance has, and where it goes on to an end of what was filmed: a rhythm suits some windows by chance, but a clock
    that broke is off from there on, or was up to there.
    """
    if not curves:
        return 0.0
    single = np.stack(curves)
    pairs = single[:, :-1] + single[:, 1:]
    total = pairs.sum(0)
    middle = total.shape[1] // 2
    near = np.flatnonzero(np.abs(np.arange(total.shape[1]) - middle) <= NEAR * fps)
    best, answer = total.argmax(1), near[total[:, near].argmax(1)]
    window = np.arange(len(total))
    each = pairs[:, window, best] - pairs[:, window, answer]
    gain, rise = each.sum(0), total.max(1) - np.median(total, 1)
    # a curve that still rises at its end tells of no offset
    inside = np.abs(best - middle) < middle - 1
    agreed = gain >= AGREED * np.sqrt((each**2).sum(0))
    told = inside & agreed & (gain > LEAST_GAIN) & (gain > LEAST_SHARE * rise)
    summed, same = single.sum(0), round(SAME * fps)
    lasting = [told[k] and _lasts(summed, int(k), int(best[k]), near, same) for k in window]
    return float(gain[lasting].sum())


def _lasts(total: Float[np.ndarray, "W D"], first: int, best: int, answer: Int[np.ndarray, " A"], same: int) -> bool:
    """Whether no window of the two from ``first`` on speaks for the answer, and the sum of all up to them, or of all
    from them on, for the same other offset.

    Args:
        best: of these two, a column; ``same`` columns on either side are the same offset. answer: the answer's columns.
    """
    there = slice(max(best - same, 0), best + same + 1)
    each = total[first : first + 2]
    ends = np.stack([total[: first + 2].sum(0), total[first:].sum(0)])

    def gained(windows: Float[np.ndarray, "K D"]) -> Float[np.ndarray, " K"]:
        return windows[:, there].max(1) - windows[:, answer].max(1)

    enough = np.maximum(LEAST_GAIN, LEAST_SHARE * (ends.max(1) - np.median(ends, 1)))
    return bool((gained(each) >= 0).all() and (gained(ends) > enough).any())
