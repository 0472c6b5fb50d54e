"""Worlds for benchmarks of synchronisation: moving classes, three bands of offsets, the presets' own matches."""

from __future__ import annotations

import itertools
import os
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..progress import counted
from ..simulate import Truth, simulate
from ..sync.graph import Graph, Pair
from ..types import Matches, TrackSet

FPS = 30.0
MOVING = ("boxes", "juggle", "softball", "tennis", "basketball", "football")
BANDS = ((0, 10), (10, 30), (30, 50))
"""|offset| in frames."""

CALIBRATION, FRESH = 1000, 5000
"""First seeds: thresholds were chosen on 1000-1999, figures are measured from 5000 on."""


@dataclass(frozen=True)
class Case:
    """One pair to synchronise: its world, its matches and its true offset in frames."""

    motion: str
    preset: str
    band: int
    seed: int
    a: TrackSet
    b: TrackSet
    matches: Matches
    truth: Truth
    offset: float


def motions() -> tuple[str, ...]:
    """The moving classes, and motion capture where the data folder is there (OTSYNC_DATA, or ../shared/data)."""
    roots = (os.environ.get("OTSYNC_DATA"), Path(__file__).parents[3] / "shared" / "data")
    for root in roots:
        files = sorted(Path(root).glob("motion/*.bvh")) if root else []
        if files:
            return (*MOVING, f"mocap:{files[0]}")
    return MOVING


def label(motion: str) -> str:
    return motion.split(":")[0]


def pair_case(
    motion: str, preset: str, band: int, seed: int, *, n: int | None = None, wrong: float | None = None
) -> Case:
    """A pair whose offset lies in ``band``, on either side; drawn from class, band and seed only."""
    rng = np.random.default_rng([seed, band, zlib.crc32(label(motion).encode())])
    offset = float(rng.uniform(*BANDS[band]) * rng.choice([-1, 1]))
    world = int(rng.integers(2**31))
    (a, b), truth = simulate(motion, preset=preset, offsets=[0.0, offset / FPS], seed=world)
    return Case(label(motion), preset, band, seed, a, b, truth.matches(0, 1, n=n, wrong=wrong), truth, offset)


def pair_cases(presets: Sequence[str], seeds: Sequence[int], classes: Sequence[str] | None = None) -> Iterator[Case]:
    """Pairs of every preset, class, band and seed."""
    cells = list(itertools.product(presets, classes or motions(), range(len(BANDS)), seeds))
    for preset, motion, band, seed in counted(cells, "pairs", "pair"):
        yield pair_case(motion, preset, band, seed)


def many(
    motion: str, preset: str, videos: int, seed: int, *, n: int | None = None, graph: Graph | None = None
) -> tuple[list[TrackSet], Truth, dict[Pair, Matches]]:
    """A world of many videos, offsets within 30 frames, and the matches of the pairs that ``graph`` compares."""
    world = int(np.random.default_rng([seed, videos, zlib.crc32(label(motion).encode())]).integers(2**31))
    tracks, truth = simulate(motion, preset=preset, videos=videos, seed=world)
    return tracks, truth, {pair: truth.matches(*pair, n=n) for pair in (graph or Graph()).pairs(videos, 0)}
