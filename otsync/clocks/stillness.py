"""Whether a video stood still, and for how many frames: what shows no motion where the other videos move.

A pair measures by how much a clock jumps to some tenths of a frame. A video that froze tells itself: what it shows in
each frame of the pause is one moment, so that steps from frame to frame are noise alone, and can be counted.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
from jaxtyping import Float, Int

STILL = 0.35
"""A video stands still where its tracks wander less than by this share of how far they do beside it."""

FASTEST = 0.75
"""Quantile of these distances from which on tracks are asked."""

FEWEST = 4
"""Frames of a pause, at least."""

MOVING = 0.1
"""Share of the furthest that they wander near the pause, from which on they move."""

AROUND = 20 / 30
"""Seconds within which a pause may begin elsewhere than where the pair has it."""

OFF = 6
"""Frames by which a pause may begin and end elsewhere than where the pair has it."""

BESIDE = 3
"""Steps on either side of a pause that tell whether things move there."""

RHYTHM = 30
"""Frames on either side of all these in which a single still step says that the file repeats frames: 24 pictures a
second in a file of 30 repeat every fifth, 29 one a second. One of them beside a pause cannot be told from it (75016 of
"24 as 30, frozen" was trusted, a frame off behind it)."""

CORE = 4
"""Fewest steps of a pause that tell how large steps are that show nothing but noise."""

OUTLYING = 0.98
"""Quantile of squared steps beyond which one counts for no more: a tracker that loses its point jumps."""

ROUNDED = 1e-9
"""Of the largest mean square: less is nothing."""

ALIKE, DEVIATIONS = 0.25, 5.0
"""A step is of the pause where its mean square is larger than theirs by this share, or by so many of the deviations
among them."""

MOVES, EDGE, CLEAR, SHARP = 1.8, 2.0, 7.0, 0.7
"""Beside a pause that is counted the mean square of three steps is this many times as large, and by so many (CLEAR)
deviations. The first one is larger by this many times what a step of the pause may be (EDGE), and has this share of
what the second one has more. What turns next to the pause grows with the square of time: its first steps are hidden,
and the next cannot be both so large and so alike. (Of swings under noise 62 of 3458 counts were up to nine frames too
long while the first step had to be 1.5 times the usual mean square alone; now none of 3359 is.)"""


def stood_still(
    times: Float[np.ndarray, " T"], x: Float[np.ndarray, "M T 3"], start: float, length: float
) -> float | None:
    """When a pause of ``length`` s began, near ``start``; None where tracks did not rest, or not move on both sides.

    How far a track wanders within a span is its mean square distance from its mean there, less half the mean square of
    its steps: of noise about one place both are the same (von Neumann 1941), so noise adds nothing to it. The tracks
    that wander furthest around are asked, since what rests anyway tells nothing.

    Args:
        times: (T,) s. x: (M,T,3) where its tracks are seen, as they are; nan where not seen.
    """
    frame = float(np.median(np.diff(times)))
    frames = round(length / frame) + 1  # all that show the moment at which it began
    near, lead = int(np.searchsorted(times, start - frame / 2)), round(AROUND / frame)
    begins = np.arange(near - lead - frames, near + lead + frames + 1)
    if frames < FEWEST:
        return None
    wander = _wander(x, begins, frames)
    moves = np.isfinite(wander).any(1)
    if not moves.any():
        return None
    most = np.nanmax(wander[moves], 1)
    wander = wander[moves][most >= np.quantile(most, FASTEST)]
    told = np.full(len(begins), np.nan)
    enough = np.isfinite(wander).sum(0) >= len(wander) / 2
    told[enough] = np.nanmedian(wander[:, enough], 0)
    if not enough.any():
        return None
    before, inside, behind = told[: -2 * frames], told[frames:-frames], told[2 * frames :]
    beside = np.fmin(before, behind)
    # beside a pause things move; within its neighbour, or where all rest, noise alone decides
    asked = np.isfinite(inside) & (beside > MOVING * float(np.nanmax(told)))
    share = np.divide(inside, beside, out=np.full(len(inside), np.inf), where=asked)
    best = int(np.argmin(share))
    return float(times[begins[frames + best]]) if share[best] < STILL**2 else None


def _wander(x: Float[np.ndarray, "M T 3"], begins: Int[np.ndarray, " B"], frames: int) -> Float[np.ndarray, "M B"]:
    """See :func:`stood_still`, of every track in the ``frames`` from each begin on; nan where it is seen in few."""
    out = np.full((len(x), len(begins)), np.nan)
    for k, begin in enumerate(begins):
        if begin < 0 or begin + frames > x.shape[1]:
            continue
        part = x[:, begin : begin + frames]
        seen = np.isfinite(part[..., 0])
        pairs = seen[:, 1:] & seen[:, :-1]
        use = (seen.sum(1) >= max(FEWEST, frames / 2)) & pairs.any(1)
        part = np.where(seen[..., None], part, 0.0)
        count = np.maximum(seen.sum(1), 2)
        mean = part.sum(1) / count[:, None]
        apart = np.where(seen, np.square(part - mean[:, None]).sum(2), 0.0).sum(1) / (count - 1)
        steps = np.where(pairs, np.square(np.diff(part, axis=1)).sum(2), 0.0).sum(1) / np.maximum(pairs.sum(1), 1)
        out[use, k] = (apart - 0.5 * steps)[use]
    return out


def pause(
    times: Float[np.ndarray, " T"], x: Float[np.ndarray, "M T 3"], start: float, length: float
) -> tuple[float, float] | None:
    """The seconds between which a video shows one moment, near ``start`` and ``length`` s; None where noise hides it.

    Args:
        times: (T,) s. x: (M,T,3) where its tracks are seen, as they are; nan where not seen.
    """
    # only what is asked about: of an hour all steps would take gigabytes
    low, high = (int(k) for k in np.searchsorted(times, [start, start + length]))
    wide = OFF + BESIDE + RHYTHM
    begin, end = max(0, low - wide), min(len(times), high + wide + 1)
    times, steps, low, high = times[begin:end], mean_steps(x[:, begin:end]), low - begin, high - begin
    core = max(CORE, (high - low) // 2)
    begins = range(max(0, low - OFF), min(len(steps) - core, high + OFF - core) + 1)
    if not len(begins) or not np.isfinite(steps).any():
        return None
    first = min(begins, key=lambda k: float(steps[k : k + core].mean()))
    inside = steps[first : first + core]
    usual = max(float(np.median(inside)), ROUNDED * float(np.nanmax(steps)))
    if not usual >= 0:
        return None
    spread = 1.4826 * float(np.median(np.abs(inside - usual)))
    margin = max(ALIKE * usual, DEVIATIONS * spread)
    still = steps <= usual + margin
    if not still[first : first + core].all():
        return None
    i, j = first, first + core
    while i > 0 and still[i - 1]:
        i -= 1
    while j < len(steps) and still[j]:
        j += 1
    if i < BESIDE or j + BESIDE > len(steps) or max(abs(i - low), abs(j - high)) > OFF:
        return None
    beside = min(float(steps[i - BESIDE : i].mean()), float(steps[j : j + BESIDE].mean()))
    clear = (
        beside >= max(MOVES * usual, usual + CLEAR * spread) and min(steps[i - 1], steps[j]) >= usual + EDGE * margin
    )

    def sharp(one: int, two: int) -> bool:
        """Whether motion is there at once: what turns begins slowly."""
        return bool(steps[one] - usual >= SHARP * (steps[two] - usual))

    # what turns right there may have begun before
    clear &= sharp(i - 1, i - 2) and sharp(j, j + 1)
    alone = [k for k in np.flatnonzero(still).tolist() if 2 <= k < i - 2 or j + 2 <= k < len(steps) - 2]
    rhythm = any(
        sharp(k - 1, k - 2) and sharp(k + 1, k + 2) and min(steps[k - 1], steps[k + 1]) >= usual + EDGE * margin
        for k in alone
    )
    return (float(times[i]), float(times[j])) if clear and not rhythm and beside > 0 else None


PICTURES, ENOUGH_BESIDE, APART = 60, 5, 3.0
"""Frames on either side of a pause whose pictures are counted, the fewest pictures on one side, and the factor by which
mean square steps to a new picture are larger than all others."""

PERIODS = sorted({Fraction(a, b) for b in range(1, 7) for a in range(b + 1, 3 * b + 1)})
"""Frames for which a picture may last, in the mean: 24, 25, 20, 15, 12 and 10 a second in a file of 30, 50 or 60."""

AT_REST = 0.01
"""A picture that stands still is at rest where its mean square steps are less than this share of the median."""


LONGEST, ENOUGH_PICTURES = 4, 8
"""Frames for which a picture may last in a file that repeats some, and pictures that tell it."""

UNMOVED, FAST = 0.01, 0.9
"""A picture is the last one again where its mean square step is less than this share of a fast one, this quantile."""


def pauses(x: Float[np.ndarray, "M T D"]) -> list[tuple[int, int]]:
    """The first and the last frame of each time that all tracks are at rest, though they mostly are not; nobody guesses
    when that is.

    Args:
        x: coordinates of the tracks, nan where not seen.
    """
    steps = mean_steps(x)
    known = steps[np.isfinite(steps)]
    if not len(known):
        return []
    rest = np.concatenate([[False], steps < AT_REST * float(np.median(known)), [False]])
    turns = np.flatnonzero(rest[1:] != rest[:-1])
    return [(int(i), int(j)) for i, j in turns.reshape(-1, 2) if j - i >= FEWEST]


def picture_frames(x: Float[np.ndarray, "M T D"]) -> float:
    """Frames for which a video shows a picture, in the mean: 1 where each is new, 2 where every one is shown twice.

    Where it rests for longer than :data:`LONGEST` frames is left out.
    """
    steps = mean_steps(x)
    steps = steps[np.isfinite(steps)]
    if not len(steps):
        return 1.0
    moves = np.flatnonzero(steps > UNMOVED * np.quantile(steps, FAST))
    lasts = np.diff(moves)
    lasts = lasts[lasts <= LONGEST]
    return float(lasts.mean()) if len(lasts) >= ENOUGH_PICTURES else 1.0


def pause_of_pictures(
    times: Float[np.ndarray, " T"], x: Float[np.ndarray, "M T 3"], start: float, length: float
) -> tuple[float, int] | None:
    """A pause in a file that repeats pictures: when it ends, s, and for how many frames it lasts; None where its
    pictures do not tell that.

    A file of more frames than pictures shows a new one whenever it is due, so that picture m begins at the frame
    floor(m p + q): a digital straight line. A pause that was made in the file moves all that follow by as many frames
    as it lasts, and one number alone makes a line of both sides again. One that was in the footage before leaves the
    line as it is, and then the file does not tell it to a frame.

    Args:
        times: (T,) s. x: (M,T,3) where its tracks are seen, as they are; nan where not seen. start, length: as a pair
            has measured them, s.
    """
    low, high = (int(k) for k in np.searchsorted(times, [start, start + length]))
    begin, end = max(0, low - OFF - PICTURES), min(len(times), high + OFF + PICTURES + 1)
    times, low, high = times[begin:end], low - begin, high - begin
    new = _new_pictures(mean_steps(x[:, begin:end]))
    if len(new) < 2 * ENOUGH_BESIDE:
        return None
    first = int(np.argmax(np.diff(new)))  # of the pause, which is the longest that a picture lasts
    before, behind = new[: first + 1], new[first + 1 :]
    still = int(behind[0] - before[-1])
    if min(len(before), len(behind)) < ENOUGH_BESIDE or still <= LONGEST:
        return None
    if not 1 < max(np.diff(before).max(), np.diff(behind).max()) <= LONGEST:
        return None  # each picture is new, or something rests there, too
    if max(abs(before[-1] - low), abs(behind[0] - 1 - high)) > OFF + LONGEST:
        return None
    k, later = np.arange(len(new)), np.arange(len(new)) > first
    lasts = set()
    for period in PERIODS:
        if any(_in_step(k + n * later, new, period) for n in range(still)):
            return None
        lasts |= {n for n in range(max(1, still - LONGEST), still) if _in_step(k, new - n * later, period)}
    return (float(times[behind[0]]), lasts.pop()) if len(lasts) == 1 else None


def _new_pictures(steps: Float[np.ndarray, " S"]) -> Int[np.ndarray, " N"]:
    """The frames that show another picture than the one before; none where no gap sets moving steps apart from still
    ones.
    """
    if len(steps) < 2 or not np.isfinite(steps).all():
        return np.zeros(0, int)
    size = np.log(np.maximum(steps, ROUNDED * max(float(steps.max()), 1e-300)))
    order = np.sort(size)
    gaps = np.diff(order)
    widest = int(np.argmax(gaps))
    if gaps[widest] < math.log(APART):
        return np.zeros(0, int)
    return 1 + np.flatnonzero(size > order[widest] + gaps[widest] / 2)


def _in_step(k: Int[np.ndarray, " N"], frames: Int[np.ndarray, " N"], period: Fraction) -> bool:
    """Whether the pictures ``k`` begin at floor(k period + q), of any q."""
    late = frames * period.denominator - k * period.numerator
    return int(late.max() - late.min()) < period.denominator


def mean_steps(x: Float[np.ndarray, "M T D"]) -> Float[np.ndarray, " T-1"]:
    """Mean square of how far tracks go from frame to frame; nan where none is seen in both."""
    square = ((x[:, 1:] - x[:, :-1]) ** 2).sum(2)
    seen = np.isfinite(square)
    if not seen.any():
        return np.full(square.shape[1], np.nan)
    most = np.quantile(square[seen], OUTLYING)
    total = np.where(seen, np.minimum(square, most), 0.0).sum(0)
    return np.where(seen.any(0), total / np.maximum(seen.sum(0), 1), np.nan)
