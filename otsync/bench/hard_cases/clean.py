"""Needless flags: every solver on easy rows with fresh seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ...types import Matches, Offsets, TrackSet
from . import case, epipolar, graphs, own_frames, rematching
from .case import cloud
from .run import sections
from .solvers import SPECIAL

SEEDS = range(7200, 7208)
"""Nothing was tuned on them."""


def shifted(seed: int) -> tuple[TrackSet, TrackSet, Matches]:
    """b is a, 10 to 30 frames later, with a little noise."""
    rng = np.random.default_rng(seed)
    late = int(rng.integers(10, 31))
    xyz = cloud(30, 150 + late, seed)
    a, b = (TrackSet(x + 2e-3 * rng.normal(size=x.shape), fps=30) for x in (xyz[:, :150], xyz[:, late:]))
    return a, b, Matches(np.stack([np.arange(30)] * 2, 1))


DRAWS: tuple[Callable[[int], tuple[Any, ...]], ...] = (
    lambda seed: case.pair(seed=seed),
    lambda seed: rematching.pair(seed=seed),
    shifted,
    shifted,
    lambda seed: epipolar.videos(seed=seed),
    lambda seed: graphs.given(graphs.videos(seed=seed)),
    lambda seed: own_frames.seen(seed=seed)(),
)
"""An easy input of every section's slot."""


def draws() -> Iterator[tuple[str, str, bool]]:
    """(section, solver, whether it flags) for every slot, solver and seed; 56 inputs."""
    for section, draw in zip(sections(), DRAWS, strict=True):
        for seed in SEEDS:
            given = draw(seed)
            for name, solver in section.solvers.items():
                if name not in SPECIAL:
                    answer = solver(*given)
                    flagged = any(answer.flags) if isinstance(answer, Offsets) else not answer.status.ok
                    yield section.title, name, flagged


def needless() -> tuple[int, int]:
    """Flagged answers, and all."""
    told = [flagged for _, _, flagged in draws()]
    return sum(told), len(told)
