"""Answers that a scene with a symmetry of its own would be mistaken for: half turns of an answer about its axes.

People turned over stand where people stand. Matches by structure then agree on a similarity that is half a turn off,
and none of them proposes the right one; but half a turn back from a wrong answer the right one lies near. The shift of
a wrong answer says nothing, so every shift is looked at.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ..types import Similarity
from .agreement import overlay
from .clouds import Cloud, thinned_cloud
from .scan import MIN_OVERLAP, STRIDE

if TYPE_CHECKING:
    from .solver import Candidate

TRACKS = 100
"""Of each video, those seen longest: enough to tell which shifts deserve a fit."""

SHIFTS = 2
"""Shifts of each half turn that are weighed."""

BESIDE = 10 / 30
"""Seconds within which the fit of one shift reaches the other."""


def half_turns(a: Cloud, b: Cloud, answer: Similarity, max_lag: float | None = None) -> list[Candidate]:
    """Half turns of ``answer`` (b's units to a's) about the axes of a's scene, each at its best shifts.

    Returns (agreement, offset in seconds, similarity), best first.
    """
    a, b = thinned_cloud(a, TRACKS), thinned_cloud(b, TRACKS)
    middle, axes = principal_axes(a)
    shifts = np.array(common_shifts(a, b, max_lag))
    found: list[Candidate] = []
    for axis in axes:
        turn = 2 * np.outer(axis, axis) - np.eye(3)
        mate = Similarity(1.0, turn, middle - turn @ middle).after(answer)
        agreement = np.array([overlay(a, b, float(s), 1.0, mate).agreement() for s in shifts])
        for _ in range(SHIFTS):
            if not len(agreement) or agreement.max() <= 0:
                break
            best = int(agreement.argmax())
            found.append((float(agreement[best]), float(shifts[best]), mate))
            agreement[np.abs(shifts - shifts[best]) < BESIDE] = 0.0
    return sorted(found, key=lambda c: -c[0])


def principal_axes(cloud: Cloud) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """(the mean place, the axes of the covariance of all places as rows)."""
    x = cloud.tracks.positions().reshape(-1, 3)
    x = x[np.isfinite(x[:, 0])]
    middle = x.mean(0)
    return middle, np.linalg.eigh((x - middle).T @ (x - middle))[1].T


def common_shifts(a: Cloud, b: Cloud, max_lag: float | None) -> list[float]:
    """Offsets in seconds, every :data:`STRIDE`, that leave :data:`MIN_OVERLAP` in common."""
    ta, tb = a.curves.times, b.curves.times
    first, last = ta[0] - tb[-1] + MIN_OVERLAP, ta[-1] - tb[0] - MIN_OVERLAP
    if max_lag is not None:
        first, last = max(first, -max_lag), min(last, max_lag)
    return [STRIDE * k for k in range(int(np.ceil(first / STRIDE)), int(np.floor(last / STRIDE)) + 1)]
