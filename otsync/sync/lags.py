"""Whether the tracks of one video keep one time: what is close together moves at once, unless its tracks come late.

A tracker that filters as it goes (Kalman, One Euro, a template that follows) delivers every track late by a delay of
its own. Partners are chosen by how well they move together, so the matches of two videos hardly show it, and the fit
says that it knows the offset well; it is off by the delays that most matches have in common. Neighbours within one
video were not chosen so, and need no other video: each pair of them tells by how much one is late.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import missing
from ..clocks.splines import TrackSplines
from ..compute.indices import evenly
from ..compute.medians import known_median
from ..costs.linear import binary_scale
from ..geometry import directions
from ..refine.samples import Pieces, detrended
from ..types import Status, TrackSet
from .verdict import Answer

NEIGHBOURS = 3
"""Of every track, the nearest ones that it is compared with: of small things further ones are on another thing."""

MOST_TRACKS = 1000
"""Of more tracks, so many stand for all."""

MOMENTS = 64
"""Frames at most, evenly spread, that tell which tracks are neighbours; both must be seen at four of them."""

WINDOW = 14 / 30
"""Half window of detrending, s, as of the fit."""

LEAST_SEEN = 20 / 30
"""Seconds for which both neighbours must be seen."""

TYPICAL = 2.0
"""Pairs whose residual is beyond this many typical ones count for less: neighbours that part."""

TOGETHER = 0.31
"""Correlation of the detrended positions of neighbours, the median, from which on they move together. Forty things that
each go their own way have .30 at most, tracks that lag .76 and more (mid) and .31 (hard, 92 videos, seeds 41000-41039,
55000-55019 and 56000-56019). Tracks that do not lag, with .3 to .45, seem late by .38 frame at most (42 videos, hard,
brutal and few tracks, same seeds and 55020-55039), but for one with .31 (.69)."""

FINE, DEPENDENT = 0.3 / 30, 0.3
"""A pair that knows its delay to FINE seconds counts half as much as one that knows it exactly; and seconds within
which errors of one pair depend on each other."""

LOWER = 1.5
"""Standard errors of the spread that are taken off it: what is left is hardly noise. Of 648 videos without delays
(clean, mid and hard; 60 to 240 frames, 20 to 160 tracks; seeds 82000-82599) two have more than .3 frame left, of 230
brutal ones twelve. Of 56 whose delays are exponential with a mean of .6 frame (clean to hard) 45 have more, of 188 with
1.5 to 4.5 frames 179; all but one of the others are hard."""

USUAL = 0.4 / 30
"""Seconds that the delays of tracks without any may seem to be: sigma has only what is more. Of the same videos without
delays 3 (clean), 5 (mid) and 8 % (hard) have more, mostly those of few tracks."""


@dataclass(frozen=True)
class Lag:
    """Delays among the tracks of one video.

    Args:
        spread: mean by which one of two neighbours is late against the other, s; below 0 where noise hides it.
        error: one sigma of it.
    """

    spread: float
    error: float

    @property
    def told(self) -> float:
        """The spread, s, without what may be noise."""
        return max(0.0, self.spread - LOWER * self.error)

    @property
    def sigma(self) -> float:
        """What it may move the clock of the video by, s: the delays that most of its matches share are as large as
        those by which they differ, as far as these are not excluded.
        """
        held = max(0.0, self.spread) + self.error
        return math.sqrt(max(0.0, held**2 - USUAL**2))


def lag_of(tracks: TrackSet) -> Lag:
    """How much the tracks of a video lag behind each other; by positions where there are any, otherwise by pixels.

    Of pixels of a camera that moves its own motion is taken out.

    With x, y two neighbours, their mean velocity w, all without their means over ± :data:`WINDOW`, a second of delay
    of one makes x - y grow by w. Noise is not late: what a pair says in one second has nothing to do with what it says
    in another, while a delay is the same in all. So the square of a pair's delay is the mean, over all pairs of
    different seconds, of the product of what both say; of noise it is as often below zero as above. Its root, with its
    sign, is averaged over pairs: of squares a few long delays would be most, and hide how sure the others are.
    Nothing is told where neighbours do not move together: things that each go their own way are late against each
    other all the time.
    """
    times = tracks.times
    frame = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    here_and_there = _positions(tracks, evenly(len(times), MOMENTS))
    unit = binary_scale(here_and_there)
    i, j = _neighbours(here_and_there / unit)
    if not len(i):
        return Lag(0.0, 0.0)
    sums, moved = [], np.zeros((3, len(i)))
    shakes = tracks.xyz is None and tracks.camera is not None and tracks.camera.w2c.ndim == 3
    parts = Pieces.at(frame, len(times), WINDOW)
    index = np.arange(len(times))
    within = (index >= parts.near) & (index < len(times) - parts.near)
    # nor is a window whole in which frames are missing, for all that moves jumps there; but where hardly any other is
    # left, delays must be asked for all the same
    gaps = np.concatenate([[0], np.cumsum(missing(times))])
    first, last = np.clip(index - parts.near, 0, None), np.clip(index + parts.near, None, len(times) - 1)
    even = within & (gaps[first] == gaps[last])
    within = even if 2 * even.sum() >= within.sum() else within
    for frames, middle in parts:
        # curves of a piece alone: of an hour only a part is read
        t = times[frames]
        curves = TrackSplines(t, _positions(tracks, frames) / unit)
        x, v, seen = curves.joined(t), curves.velocity(t), curves.support(t)
        if shakes:
            # what a hand that sways does to all at once is no motion that two things have in common
            drift = np.nan_to_num(known_median(np.where(seen[..., None], v, np.nan), 0))
            x, v = x - np.cumsum(drift, 0) * frame, v - drift
        both = seen[i] & seen[j]
        p, q, w = (detrended(d, both, parts.near) for d in (x[i], x[j], (v[i] + v[j]) / 2))
        # a window that the clip cuts leaves half of a steady motion in, which things have in common by chance
        whole = both & within[frames]
        p, q, w = (np.where(whole[..., None], d, 0.0)[:, middle] for d in (p, q, w))
        r = p - q
        moved += [(p * q).sum((1, 2)), (p * p).sum((1, 2)), (q * q).sum((1, 2))]
        second = np.floor(t[middle] - t[middle][0] + 1e-9).astype(int)
        products = (r * w).sum(2), (w * w).sum(2), (r * r).sum(2), whole[:, middle].astype(float)
        sums.append(np.stack([_by(second, p) for p in products]))
    move = moved[1] * moved[2] > 0
    alike = moved[0, move] / np.sqrt(moved[1, move] * moved[2, move])
    if not len(alike) or np.median(alike) < TOGETHER:
        return Lag(0.0, 0.0)
    return _spread(np.concatenate(sums, 2), frame)


def _spread(sums: Float[np.ndarray, "4 M S"], frame: float) -> Lag:
    """Args: sums: of r·w, w·w, r·r and 1, of every pair, second by second."""
    late, moving, size, seen = sums
    count, information = seen.sum(1), moving.sum(1)
    known = count * frame >= LEAST_SEEN
    if not known.any() or not information[known].any():
        return Lag(0.0, 0.0)
    # what a delay explains is no reason to doubt a pair
    rest = np.maximum(size.sum(1) - late.sum(1) ** 2 / np.maximum(information, 1e-300), 0.0)
    rms = np.sqrt(rest / np.maximum(count, 1))
    typical = float(np.median(rms[known]))
    weight = np.where(known, 1 / (1 + (rms / max(TYPICAL * typical, 1e-300)) ** 2), 0.0)
    noise = float(weight @ rest) / float(weight @ count) / 3
    weight = weight / (information + max(noise * DEPENDENT / frame / FINE**2, 1e-300))
    square = late.sum(1) ** 2 - (late**2).sum(1)
    of = float(weight @ np.sqrt(np.maximum(information**2 - (moving**2).sum(1), 0.0)))
    if of <= 0:
        return Lag(0.0, 0.0)
    root = weight * np.sign(square) * np.sqrt(np.abs(square))
    error = math.sqrt(float(((root - root.mean()) ** 2).sum()))
    return Lag(float(root.sum()) / of, error / of)


def _positions(tracks: TrackSet, frames: slice | Int[np.ndarray, " F"]) -> Float[np.ndarray, "N F 3"]:
    """Of at most :data:`MOST_TRACKS` tracks at some frames; nan where unseen."""
    some = evenly(len(tracks), MOST_TRACKS)
    if tracks.xyz is not None:
        x = tracks.positions(some, frames)
    else:
        assert tracks.uv is not None
        seen = tracks.seen[:, frames][some, :, None]
        uv = np.where(seen, tracks.uv[:, frames][some], np.nan)
        camera = tracks.camera
        if camera is not None and camera.w2c.ndim == 3:
            x = camera.K[0, 0] * directions(replace(camera, w2c=camera.w2c[frames]), uv.astype(float))
        else:
            x = np.concatenate([uv, np.where(seen, 0.0, np.nan)], 2)
    return np.asarray(x, float)


def _neighbours(x: Float[np.ndarray, "N T 3"]) -> tuple[Int[np.ndarray, " M"], Int[np.ndarray, " M"]]:
    """Pairs of tracks that are the nearest to each other, in the mean over the moments that show both."""
    seen = np.isfinite(x).all(2)
    middle = x[seen].mean(0) if seen.any() else 0.0
    x = np.where(seen[..., None], x - middle, 0.0)
    ok = seen.astype(float)
    flat = x.reshape(len(x), -1)
    own = (x**2).sum(2) @ ok.T
    squares = own + own.T - 2 * flat @ flat.T
    count = ok @ ok.T
    apart = np.where(count >= 4, np.maximum(squares, 0) / np.maximum(count, 1), np.inf)
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, 1, kind="stable")[:, :NEIGHBOURS]
    first = np.repeat(np.arange(len(x)), near.shape[1])
    second = near.ravel()
    good = np.isfinite(apart[first, second])
    pairs = np.unique(np.sort(np.stack([first, second], 1)[good], axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _by(second: Int[np.ndarray, " T"], values: Float[np.ndarray, "M T"]) -> Float[np.ndarray, "M S"]:
    starts = np.flatnonzero(np.diff(second, prepend=-1))
    return np.add.reduceat(values, starts, axis=1)


def with_lags(answers: Sequence[Answer], lags: Sequence[Lag], limit: float) -> list[Answer] | None:
    """The answers, with those of videos doubted whose tracks lag by more than ``limit`` s; None where none do."""
    late = {v for v, lag in enumerate(lags) if lag.told > limit}
    return [lagging(a) if late & set(a.pair) else a for a in answers] if late else None


def lagging(answer: Answer) -> Answer:
    """The answer, doubted."""
    return answer.flagged(Status.LAGGING)
