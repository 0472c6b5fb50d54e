"""What a row of the catalogue is, and what counts as an acceptable outcome."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...types import Alignment, Matches, TrackSet

RIGHT, FLAGGED, REFUSED = "right", "flagged", "refused"
SOUND = (RIGHT, FLAGGED, REFUSED)

TRUST = "Trust"
"""The open issue about scenes that answer confidently and wrongly."""


@dataclass(frozen=True)
class Case:
    """One row.

    Args:
        name, why: what it is, and why it is hard.
        handled: what otsync does.
        make: the input: ``(a, b)`` for matchers, ``(a, b, clock)`` for matchers at known times, ``(a, b, matches)`` for
            aligners and refiners, with pixels or without; ``(tracks, matches or None)`` for the graph of pairs.
        expect: acceptable outcomes. ``right``: unflagged, and ``check`` (where given) holds; ``flagged``; ``refused``:
            a ValueError.
        message: that the refusal must contain.
        check: whether an unflagged answer is right; of :class:`otsync.Offsets`, which videos are, (V,).
        solvers: names of the solvers that run it; empty: all of the slot.
        limits: solvers that may flag or refuse where others answer, and why. No limit excuses a wrong answer without a
            flag.
        open: the issue that is to mend the wrong answers of this row, which the page lists and counts until then.
        clean: an easy row: it counts needless flags.
    """

    name: str
    why: str
    handled: str
    make: Callable[[], tuple[Any, ...]]
    expect: tuple[str, ...] = SOUND
    message: str = ""
    check: Callable[[Any], Any] | None = None
    solvers: tuple[str, ...] = ()
    limits: dict[str, str] = field(default_factory=dict)
    open: str = ""
    clean: bool = False


def cloud(n: int, frames: int, seed: int = 0, scale: float = 1.0) -> np.ndarray:
    """(n, frames, 3) smooth tracks of a loosely rigid cloud: no two alike."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / 30
    spot = rng.normal(size=(n, 1, 3))
    waves = sum(
        rng.normal(size=(n, 1, 3)) * np.sin(2 * np.pi * f * t[None, :, None] + rng.uniform(0, 6.3, (n, 1, 3)))
        for f in (0.3, 0.7, 1.3)
    )
    return scale * (spot + 0.15 * waves)


def pair(n: int = 80, frames: int = 40, seed: int = 0, noise: float = 0.3, dims: int = 24) -> tuple[TrackSet, TrackSet]:
    """Two videos of one cloud in different rigid frames; track k of a is track k of b."""
    rng = np.random.default_rng(seed + 1000)
    xyz, features = cloud(n, frames, seed), rng.normal(size=(n, dims))
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1.0]])

    def seen(x: np.ndarray) -> TrackSet:
        wobble = noise * rng.normal(size=features.shape)
        return TrackSet(x + 0.002 * rng.normal(size=x.shape), features=features + wobble, fps=30)

    return seen(xyz), seen(xyz @ turn.T + [2.0, -1, 0.5])


def changed(make: Callable[[], tuple[TrackSet, TrackSet]], **fields: Callable[[Any], Any]) -> Callable[[], tuple]:
    """The pair with each named field of both sets passed through a function."""

    def made() -> tuple[TrackSet, TrackSet]:
        return tuple(replace(x, **{k: f(getattr(x, k)) for k, f in fields.items()}) for x in make())

    return made


def mostly_identity(
    share: float = 0.9, n: int | None = None, of: Callable[[np.ndarray], np.ndarray] = lambda k: k
) -> Callable[[Matches], bool]:
    """At least ``share`` of the best matches join track k to track k, and there are some.

    The best matches: ``n`` of them, by default half as many as can be one to one, so that matchers with several
    partners a track are asked no more than the others. ``of``: what a track is an image of.
    """

    def check(m: Matches) -> bool:
        best = m.best((min(len(np.unique(column)) for column in m.pairs.T) + 1) // 2 if n is None else n)
        i, j = best.pairs.T
        return len(i) >= 5 and float((of(i) == of(j)).mean()) >= share

    return check


def few_right(n: int) -> Callable[[Matches], bool]:
    """The best ``n`` matches, all that there can be, join track k to track k."""
    return lambda m: len(m) >= n and all(i == j for i, j in m.best(n).pairs)


def near(seconds: float, tolerance: float = 0.05) -> Callable[[Alignment], bool]:
    return lambda found: abs(found.offset - seconds) <= tolerance
