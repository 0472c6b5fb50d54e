"""How sure a refined clock is: every frame votes, and the spread of the votes tells.

At the end of a fit each frame of a video proposes one Gauss-Newton step of that video's offset,

    g_k = sum_pixels r dI/dt,   h_k = sum_pixels (dI/dt)^2,   step = - sum_k g_k / sum_k h_k

with the residuals r of its pixels. Pixels of one frame err together (a wrong shape, a highlight), and frames while what
they show moves one way; those further apart much less: so stretches of frames, not pixels, are taken as independent (a
sandwich estimate, White 1980). What the frames agree on beyond the answer is a bias that the fit did not follow, and is
added. Where videos are few, the motion itself could take up much of a clock's error. All this is a lower bound, and
another one stands beside it: a scene that shows its frames badly may do so by its clocks (:func:`by_misfit`). What a
short fit has not settled yet is added (:func:`unsettled`), and what it could not have reached (:func:`unreached`). What
the fit and the clocks that it began with say together is told in :mod:`recon.fit.witnesses`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from otsync.compute.threads import MapLike

Look = Callable[[int, int, float], Tensor]
Target = Callable[[int, int], Tensor]

FRAMES = 48
STEP = 0.1  # frames between the instants of the central difference, half
GOLDEN = (5**0.5 - 1) / 2
MISFIT = 0.08  # s; of filmed rigs and rooms whose fits were short or poor: docs/trust.md
STRETCHES = 4  # of a clip that a variance is taken from, at least
AVERAGED = 0.8  # share of the steps from which on clocks are averaged: Adam's last steps still shake each of them
BEFORE = 0.6  # and from which on those are that they are held against
LEFT = 1.5  # of the last move that is still to go: .6 / (1 - .6)


class Votes(NamedTuple):
    """What frames of one video say of its clock, in their order; see the head of this file.

    frames: which. g, h: of each; -sum(g)/sum(h) is their step in seconds. residual, rate: the sums of
    :func:`by_misfit`.
    """

    frames: np.ndarray
    g: np.ndarray
    h: np.ndarray
    residual: np.ndarray
    rate: np.ndarray


def cast(
    look: Look,
    target: Target,
    keys: np.ndarray,
    n_videos: int,
    frame_step: float,
    frames: int = FRAMES,
    map: MapLike = map,
) -> list[Votes]:
    """The votes of each video; of less than two frames none are asked.

    Args:
        look: (video, frame, seconds) -> the image [h,w,3] that the scene gives, that much later than the frame.
        target: (video, frame) -> the frame's own pixels [h,w,3].
        keys: (K,2) the (video, frame) that took part in the fit. frames: of a video that vote, at most. map: calls
            the votes.
    """
    votes = []
    for v in range(n_videos):
        own = np.sort(keys[keys[:, 0] == v, 1])
        chosen = own[scattered(len(own), frames)] if len(own) > 1 else own[:0]
        found = list(map(partial(_vote, look, target, STEP * frame_step, v), chosen.tolist()))
        votes.append(Votes(chosen, *np.array(found).reshape(-1, 4).T))
    return votes


def newton_sigma(votes: Sequence[Votes]) -> np.ndarray:
    """[V] standard deviations in seconds of each video's clock; nan where nothing moves."""
    variance = np.full(len(votes), np.nan)
    for v, one in enumerate(votes):
        if len(one.frames):
            variance[v] = max(sandwich(one.g, one.h), by_misfit(one.residual, one.rate) ** 2)
    shown = int(np.isfinite(variance).sum())
    if shown > 1:  # V videos have 2 V numbers of a point, three of which tell where it is, and none of time
        variance *= 2 * shown / (2 * shown - 3)
    return np.sqrt(variance)


def scattered(count: int, most: int) -> np.ndarray:
    """Indices of at most ``most`` of ``count`` frames, about one in each of as many stretches, at uneven distances.

    Knots of a motion stand at even distances, and what errs between two of them errs alike between the next two: frames
    at even distances would all err alike, or none of them would.
    """
    if count <= most:
        return np.arange(count)
    stretch = np.arange(most)
    return np.unique(((stretch + stretch * GOLDEN % 1.0) * count / most).astype(int))


def averaged(history: np.ndarray) -> np.ndarray:
    """[V] clocks of the last steps' mean (Polyak and Juditsky 1992), seconds; what all share is that of the last step.

    The steps shake each clock by about its rate; their mean is nearer to where they shake about. What all clocks share
    moves with the scene, which is that of the last step.

    Args:
        history: (R,1+V) rows of (step, offsets in seconds) in order, the first one at the start, the last at the end.
    """
    return _mean_of(history, AVERAGED, 1.0) + history[-1, 1:].mean()


def unsettled(history: np.ndarray, reference: int) -> np.ndarray:
    """[V] seconds that each offset, relative to the reference's, had left to go, by how far it last went.

    That is from the mean of one fifth of a fit's steps to the mean of the last fifth; moves are taken to become three
    fifths of themselves from one to the next.

    Args:
        history: as of :func:`averaged`.
    """
    went = _mean_of(history, AVERAGED, 1.0) - _mean_of(history, BEFORE, AVERAGED)
    return LEFT * np.abs(went - went[reference])


def _mean_of(history: np.ndarray, begin: float, end: float) -> np.ndarray:
    """[V] mean offsets, without what all share, of a share of the steps; of the last row before it, where it has none.

    The last row is part of the last share alone.
    """
    steps, offsets = history[:, 0] / max(history[-1, 0], 1e-9), history[:, 1:]
    own = offsets - offsets.mean(1, keepdims=True)
    inside = (steps >= begin) & ((steps < end) | (end >= 1.0))
    if not inside.any():
        before = np.flatnonzero(steps < end)
        inside[before[-1] if len(before) else 0] = True
    return own[inside].mean(0)


def unreached(start_sigma: np.ndarray, reach: float) -> np.ndarray:
    """[V] seconds by which each start may be off and that a fit had no steps to go: what it says is not heeded there.

    An optimiser moves an offset by its rate a step at most. A fit of a few steps stays where it began, whatever the
    pictures say, so its frames agree on the start and nothing seems unsettled.

    Args:
        start_sigma: one standard deviation of the clocks that it began with, seconds; nan or 0: no witness.
        reach: seconds that all steps together can move an offset.
    """
    return np.where(np.isfinite(start_sigma), np.fmax(start_sigma - reach, 0.0), 0.0)


def sandwich(g: np.ndarray, h: np.ndarray) -> float:
    """Variance of -sum(g)/sum(h) about zero, with stretches of the terms taken as independent; nan when h vanishes.

    The stretches are as long as makes the variance largest: where a shape is wrong, frames err together for as long as
    it moves one way. One of them has a single term at the least, and there are :data:`STRETCHES` at the least.
    """
    total = h.sum()
    if not total > 0 or len(g) < 2:
        return float("nan")
    step = -g.sum() / total
    left, spread = g + h * step, 0.0
    for length in range(1, max(1, len(g) // STRETCHES) + 1):
        each = np.add.reduceat(left, np.arange(0, len(g), length))
        spread = max(spread, len(each) / (len(each) - 1) * float(np.square(each).sum()))
    return spread / float(total) ** 2 + float(step) ** 2


def by_misfit(residual: np.ndarray, rate: np.ndarray) -> float:
    """One sigma in seconds, of what a scene that shows frames badly may have made of their clock.

    The residuals are as large as if time were off by tau from place to place: tau² = Σ w r² / Σ w (dI/dt)² over the
    pixels, by w = (dI/dt)², so that what stands still does not count. What of it the clock takes grows with tau itself:
    a body that is shown badly is shown so alike in many frames. So sigma is tau² / :data:`MISFIT`, as it is of tracks
    (``otsync.refine.splines.COMMON_ERRORS``).

    Args:
        residual, rate: the two sums of every frame.
    """
    return float(residual.sum() / rate.sum()) / MISFIT if rate.sum() > 0 else 0.0


def _vote(look: Look, target: Target, step: float, v: int, k: int) -> tuple[float, float, float, float]:
    """(g, h) of one frame, and its sums for :func:`by_misfit`."""
    with torch.no_grad():  # per thread
        residual = (look(v, k, 0.0) - target(v, k)).double()
        rate = (look(v, k, step) - look(v, k, -step)).double() / (2 * step)
    weight = rate.square().mean(-1, keepdim=True)
    misfit, pace = (weight * residual.square()).sum(), (weight * rate.square()).sum()
    return float((residual * rate).sum()), float(rate.square().sum()), float(misfit), float(pace)
