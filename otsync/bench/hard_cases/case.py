"""What a row of the catalogue is, and what counts as an acceptable outcome."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...types import Alignment, Matches, TrackSet

RIGHT, FLAGGED, REFUSED = "right", "flagged", "refused"
SOUND = (RIGHT, FLAGGED, REFUSED)


@dataclass(frozen=True)
class Case:
    """One row.

    Args:
        name, why: what it is, and why it is hard.
        plain: what the plain solver (POT, or the paper's method) does.
        handled: what otsync does.
        make: the input: ``(a, b)`` for matchers, ``(a, b, matches)`` for aligners and refiners.
        expect: acceptable outcomes. ``right``: unflagged, and ``check`` (where given) holds; ``flagged``; ``refused``:
            a ValueError.
        message: that the refusal must contain.
        check: whether an unflagged answer is right.
        solvers: names of the solvers that run it; empty: all of the slot.
        limits: solvers of which only a sane answer (finite, in time) is asked, and why.
    """

    name: str
    why: str
    plain: str
    handled: str
    make: Callable[[], tuple[Any, ...]]
    expect: tuple[str, ...] = SOUND
    message: str = ""
    check: Callable[[Any], bool] | None = None
    solvers: tuple[str, ...] = ()
    limits: dict[str, str] = field(default_factory=dict)


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


def mostly_identity(share: float = 0.9) -> Callable[[Matches], bool]:
    """At least ``share`` of the better half of the matches join track k to track k, and there are some."""

    def check(m: Matches) -> bool:
        i, j = m.best((len(m) + 1) // 2).pairs.T
        return len(i) >= 5 and float((i == j).mean()) >= share

    return check


def near(seconds: float, tolerance: float = 0.05) -> Callable[[Alignment], bool]:
    return lambda found: abs(found.offset - seconds) <= tolerance
