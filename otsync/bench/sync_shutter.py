"""Synchronisation with rolling shutters: with the readout declared and undeclared, beside global shutters."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..align.verb import align
from ..progress import counted
from ..refine.verb import refine
from ..simulate import PRESETS, Rig, Truth, simulate
from ..simulate.effects import Effect, RollingShutter
from ..sync.graph import Graph
from ..sync.verb import synchronize
from ..types import TrackSet
from .record import Row
from .sync_worlds import FPS, label, motions

READOUT = (0.005, 0.03)
"""Bounds in seconds; every video draws its own."""

RIG = Rig(tilt=12.0)
"""Hand-held: the scene lies in the upper part of one image and in the lower part of another."""

SHUTTERS = ("global", "rolling, declared", "rolling, not declared")


def undeclared(tracks: TrackSet) -> TrackSet:
    """The same tracks from a camera that does not tell its readout."""
    assert tracks.camera is not None
    return replace(tracks, camera=replace(tracks.camera, readout=None))


def worlds(motion: str, preset: str, videos: int, seed: int) -> Iterator[tuple[str, list[TrackSet], Truth]]:
    """One world filmed in three ways, offsets within 30 frames; everything random is alike except the shutters."""
    drawn = int(np.random.default_rng([seed, videos, zlib.crc32(label(motion).encode())]).integers(2**31))
    effects = PRESETS[preset].effects

    def filmed(*more: Effect) -> tuple[list[TrackSet], Truth]:
        return simulate(motion, preset=preset, videos=videos, rig=RIG, seed=drawn, effects=(*more, *effects))

    yield SHUTTERS[0], *filmed()
    rolled, truth = filmed(RollingShutter(READOUT))
    yield SHUTTERS[1], rolled, truth
    yield SHUTTERS[2], [undeclared(t) for t in rolled], truth


def measured(tracks: Sequence[TrackSet], truth: Truth) -> Iterator[tuple[float, bool]]:
    """(frames off, trusted) of every video but the reference; two videos are a pair alone."""
    if len(tracks) == 2:
        a, b = tracks
        alignment = align(a, b, truth.matches(0, 1), throw=False)
        if np.isfinite(alignment.offset):
            alignment = refine(a, b, truth.matches(0, 1), alignment, throw=False)
        yield abs(alignment.offset - truth.offset(0, 1)) * FPS, alignment.status.ok
        return
    many = synchronize(tracks, matches={pair: truth.matches(*pair) for pair in Graph().pairs(len(tracks), 0)})
    for v in range(1, len(tracks)):
        yield abs(float(many.seconds[v] - truth.offsets[v])) * FPS, many.status[v].ok


def shutter_rows(
    seeds: Sequence[int],
    presets: Sequence[str] = ("clean", "mid", "hard"),
    videos: Sequence[int] = (2, 8),
    classes: Sequence[str] | None = None,
) -> list[Row]:
    """Errors in frames by number of videos, preset and shutter.

    Args:
        seeds: for every class; with more than two videos the first one alone, as in the tables of graphs: they take
            long.
    """
    rows: list[Row] = []
    for count, preset in itertools.product(videos, presets):
        answers: dict[str, list[tuple[float, bool]]] = {name: [] for name in SHUTTERS}
        drawn = list(itertools.product(classes or motions(), list(seeds)[: None if count == 2 else 1]))
        for motion, seed in counted(drawn, f"shutters, {preset}, {count} videos", "world"):
            for name, tracks, truth in worlds(motion, preset, count, seed):
                answers[name] += measured(tracks, truth)
        for name, pairs in answers.items():
            e, trusted = np.array([x for x, _ in pairs]), np.array([ok for _, ok in pairs])
            rows.append(
                {
                    "videos": count,
                    "preset": preset,
                    "shutter": name,
                    "mean": float(np.nanmean(e)),
                    "median": float(np.nanmedian(e)),
                    "p90": float(np.nanquantile(e, 0.9)),
                    "trusted": float(trusted.mean()),
                    "worst trusted": float(e[trusted].max(initial=0)),
                    "missing": float(np.isnan(e).mean()),
                }
            )
    return rows
