"""Where a track jumps: a thing that wraps round, a tracker that takes up another point.

A jump lies somewhere between two frames and nobody knows where. A curve drawn through it rings at both ends, in both
videos alike only where their frames coincide, so that it would lock an offset to whole frames.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ..compute.indices import blocks

AROUND = 3
"""Steps on either side that a step is compared with."""

UNLIKE = 8.0
"""A step jumps that differs from the mean of those around it so many times more than any of them does: a limb that
sets out, a ball that is hit keep their new speed, and noise of the tracker has that of its neighbours."""

LEAST = 8.0
"""And so many times more than steps of the whole video usually differ, for tracks at exact rest."""

ENOUGH = 3
"""Steps around one that tell what is usual there; with fewer, a jump is :data:`LEAST` times as far."""

FARTHER = 4
"""Over a gap a thing may go farther, in proportion to its frames, but no more than so many times."""

ROUNDING = 1e-6
"""Of the largest coordinate: steps that differ by less do not differ."""

ENOUGH_STEPS = 2**20
"""Of all tracks together: how many the usual difference of steps is taken from."""

AT_ONCE = 2**18
"""Samples that are looked at together."""


@dataclass(frozen=True, eq=False)
class Jumps:
    """E jumps of tracks, in order of tracks and time.

    Args:
        track: of each jump. before, after: the frames between which it lies, both seen, none between them.
        by: how far it went, beyond the motion around it.
    """

    track: Int[np.ndarray, " E"]
    before: Int[np.ndarray, " E"]
    after: Int[np.ndarray, " E"]
    by: Float[np.ndarray, "E 3"]

    def __len__(self) -> int:
        return len(self.track)

    def take(self, index: Int[np.ndarray, " M"]) -> Jumps:
        """Those of the tracks at ``index`` (repeats allowed), under their new numbers."""
        new = [np.flatnonzero(index == track) for track in self.track]
        each = np.repeat(np.arange(len(self)), [len(n) for n in new])
        track = np.concatenate([self.track[:0], *new])
        order = np.lexsort((self.before[each], track))
        each = each[order]
        return Jumps(track[order], self.before[each], self.after[each], self.by[each])

    def each_track(self) -> Iterator[tuple[int, slice]]:
        """Every track that jumps, and where its jumps are, in order of time."""
        if not len(self):
            return
        edges = np.flatnonzero(np.diff(self.track, prepend=-1, append=np.iinfo(self.track.dtype).max))
        for first, end in itertools.pairwise(edges):
            yield int(self.track[first]), slice(first, end)


def find_jumps(x: Float[np.ndarray, "M T 3"]) -> Jumps:
    """The jumps of tracks, nan where unseen.

    A step between two samples jumps where it differs from the mean of those around it far more than any of them
    does. Two jumps that near to each other are none: a sample far off, which robust fits leave out, or things that
    move by jerks (copied frames, whole pixels), whose motion the jerks are.
    """
    usual, found = _usual(x), [Jumps(*(np.zeros(0, np.int64),) * 3, np.zeros((0, 3)))]
    if x.shape[1] > 1:
        found += [_jumps(x[some], some.start, usual) for some in blocks(x.shape[0], x.shape[1], AT_ONCE)]
    parts = zip(*((j.track, j.before, j.after, j.by) for j in found), strict=True)
    return Jumps(*(np.concatenate(part) for part in parts))


def _jumps(x: Float[np.ndarray, "M T 3"], first: int, usual: float) -> Jumps:
    """Those of some tracks, the first of which has the number ``first``."""
    step = np.diff(x, axis=1)
    track, before, after = _candidates(np.isfinite(x[..., 0]), step, usual)
    at = np.concatenate([before[:, None] + np.arange(-AROUND, 0), after[:, None] + np.arange(AROUND)], 1)
    around = step[track[:, None], np.clip(at, 0, step.shape[1] - 1)]
    around[(at < 0) | (at >= step.shape[1])] = np.nan
    known = np.isfinite(around[..., 0])
    around[~known.any(1)] = 0.0  # nothing is known there: a step is compared with rest
    middle = np.nanmean(around, axis=1)  # a median would depend on the axes
    spread = np.nanmax(np.linalg.norm(around - middle[:, None], axis=2), axis=1)
    spread = np.maximum(spread, np.where(known.sum(1) < ENOUGH, LEAST * usual, 0.0))
    frames = after - before
    by = x[track, after] - x[track, before] - frames[:, None] * middle
    limit = np.minimum(frames, FARTHER) * np.maximum(UNLIKE * spread, LEAST * usual)
    jumps = np.flatnonzero(np.linalg.norm(by, axis=1) > limit)
    jumps = jumps[np.lexsort((before[jumps], track[jumps]))]
    return Jumps(first + track[jumps], before[jumps], after[jumps], by[jumps])


def _candidates(
    seen: Bool[np.ndarray, "M T"], step: Float[np.ndarray, "M T-1 3"], usual: float
) -> tuple[Int[np.ndarray, " C"], Int[np.ndarray, " C"], Int[np.ndarray, " C"]]:
    """(track, before, after) of the steps that differ much from both neighbours, and of all gaps."""
    change = np.linalg.norm(np.diff(step, axis=1), axis=2)
    none = np.full((len(step), 1), np.nan)
    # a jump changes the step before and the step after it
    least = np.fmin(np.concatenate([none, change], 1), np.concatenate([change, none], 1))
    track, before = np.nonzero(least > LEAST * usual)
    frames = np.arange(seen.shape[1])
    following = np.minimum.accumulate(np.where(seen, frames, len(frames))[:, ::-1], axis=1)[:, ::-1]
    lost, last = np.nonzero(seen[:, :-1] & ~seen[:, 1:] & (following[:, 1:] < len(frames)))
    return (
        np.concatenate([track, lost]),
        np.concatenate([before, last]),
        np.concatenate([before + 1, following[lost, np.minimum(last + 1, len(frames) - 1)]]),
    )


def _usual(x: Float[np.ndarray, "M T 3"]) -> float:
    """Median difference of consecutive steps; infinite where none is known."""
    at = np.arange(1, x.shape[1] - 1, max(1, x.shape[0] * x.shape[1] // ENOUGH_STEPS))
    known = [np.zeros(0)]
    for some in blocks(x.shape[0], x.shape[1], AT_ONCE):
        one = x[some]
        change = np.linalg.norm((one[:, at + 1] - one[:, at]) - (one[:, at] - one[:, at - 1]), axis=2)
        known.append(change[np.isfinite(change)])
    change = np.concatenate(known)
    if not len(change):
        return np.inf
    return max(float(np.median(change)), ROUNDING * max(float(np.nanmax(x)), -float(np.nanmin(x))))
