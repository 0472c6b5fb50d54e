"""Situations for :mod:`otsync.bench.chain.run`: pairs of videos with a known offset."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...compute.threads import pool_of
from ...files.cache import Cache
from ...geometry import common_target, view_angle
from ...io import open_scene
from ...progress import say
from ...recordings.stages import Stages
from ...simulate import Rig, simulate
from ...types import TrackSet
from ..panoptic import BANDS, Material
from ..sync_worlds import FPS, MOVING

FARTHEST = 50.0
"""Frames of offset, at most."""

WRONG = 1.0
"""Frames of error from which a trusted answer counts as wrong."""

TOGETHER, GRAPH = 6, "recording, 6 cameras"

STRANGERS = 0.6
"""Share of tracks that belong to another scene."""


@dataclass(frozen=True, eq=False)
class Case:
    """A pair of videos and the true offset of b, in seconds of a; with ``more``, several videos and their offsets.

    ``largest``: frames, what a missing answer counts as: the clip's length, the largest error that there can be.
    """

    name: str
    a: TrackSet
    b: TrackSet
    offset: float
    fps: float = FPS
    more: tuple[tuple[TrackSet, float], ...] = ()

    @property
    def tracks(self) -> list[TrackSet]:
        """Of all videos."""
        return [self.a, self.b, *(tracks for tracks, _ in self.more)]

    def errors(self, seconds: np.ndarray) -> np.ndarray:
        """|error| of every video but the first, in frames; a missing answer counts as :attr:`largest`."""
        true = np.array([self.offset, *(offset for _, offset in self.more)])
        error = np.abs(seconds[1:] - true) * self.fps
        return np.where(np.isfinite(error), error, self.largest)

    @property
    def largest(self) -> float:
        return float(max(self.a.n_frames, self.b.n_frames))


def world(
    seed: int,
    *,
    preset: str = "hard",
    classes: tuple[str, ...] = MOVING,
    tracks: int | None = None,
    angle: float | None = None,
) -> Case:
    """A simulated pair; motion class and offset are drawn from the seed."""
    rng = np.random.default_rng([seed, 77])
    offset = float(rng.uniform(-FARTHEST, FARTHEST)) / FPS
    motion = classes[seed % len(classes)]
    rig = None if angle is None else Rig(angle=angle)
    (a, b), _ = simulate(
        motion, preset=preset, offsets=[0.0, offset], tracks=tracks, rig=rig, seed=int(rng.integers(2**31))
    )
    return Case(f"{motion} {seed}", a, b, offset)


def strangers(seed: int) -> Case:
    """Most tracks of either video belong to a scene of its own, with features from the same model."""
    case = world(seed, preset="mid")
    rng = np.random.default_rng([seed, 78])

    def mixed(tracks: TrackSet) -> TrackSet:
        other = world(int(rng.integers(2**20)), preset="mid").a
        n = round(STRANGERS * len(tracks))
        index = rng.permutation(len(tracks))
        own, foreign = tracks.take(index[n:]), other.take(rng.choice(len(other), min(n, len(other)), replace=False))
        fields = ("xyz", "visible", "features", "uv")
        joined: dict[str, Any] = {f: np.concatenate([getattr(own, f), getattr(foreign, f)]) for f in fields}
        return replace(own, sigma=None, labels=None, **joined)

    return replace(case, a=mixed(case.a), b=mixed(case.b))


def flat(seed: int) -> Case:
    """Pixels and calibration alone."""
    case = world(seed, preset="mid")
    return replace(case, a=replace(case.a, xyz=None, sigma=None), b=replace(case.b, xyz=None, sigma=None))


SITUATIONS: dict[str, Callable[[int], Case]] = {
    "mid": partial(world, preset="mid"),
    "hard": partial(world, preset="hard"),
    "brutal": partial(world, preset="brutal"),
    "few tracks": partial(world, preset="hard", tracks=24),
    "strangers": strangers,
    "wide baseline": partial(world, preset="hard", angle=130.0),
    "like people": partial(world, preset="hard", classes=("basketball", "football")),
    "no depth": flat,
}


def real_cases(
    scene: str | os.PathLike[str], cache: Path, pairs: int, seed: int
) -> list[tuple[str, Callable[[], Case]]]:
    """Pairs of cameras of a truly synchronised recording, cut so that they begin 1-50 frames apart, in three bands.

    And for every second pair :data:`TOGETHER` cameras at once, which begin up to 30 frames apart.
    """
    opened = open_scene(scene)
    with pool_of(len(os.sched_getaffinity(0))) as pool:
        material = Material.of(opened, Stages(), Cache(cache), pool.map, say)
    rng = np.random.default_rng(seed)
    every = list(itertools.combinations(range(len(opened.videos)), 2))
    rng.shuffle(every)
    target = common_target([v.camera for v in opened.videos])
    cases: list[tuple[str, Callable[[], Case]]] = []
    for a, b in every[:pairs]:
        angle = view_angle(opened.videos[a].camera, opened.videos[b].camera, target)
        for low, high in BANDS:
            shift, later = int(rng.integers(low, high + 1)), bool(rng.integers(2))
            name = "recording, below 95 degrees" if angle < 95 else "recording, beyond"
            starts = (0, shift) if later else (shift, 0)
            cases.append((name, partial(_clipped, material, int(a), int(b), starts, True)))
            cases.append(("recording, no depth", partial(_clipped, material, int(a), int(b), starts, False)))
    for _ in range((pairs + 1) // 2):
        chosen = rng.permutation(len(opened.videos))[:TOGETHER]
        begin = rng.integers(0, 31, len(chosen))
        cases.append((GRAPH, partial(_together, material, chosen.tolist(), begin.tolist())))
    return cases


def _clipped(material: Material, a: int, b: int, starts: tuple[int, int], lifted: bool) -> Case:
    first, second = (material.clip(v, s, material.frames, 1, lifted) for v, s in zip((a, b), starts, strict=True))
    fps = float(first.fps or FPS)
    names = material.scene.names
    return Case(f"{names[a]} {names[b]} {starts}", first, second, (starts[1] - starts[0]) / fps, fps)


def _together(material: Material, cameras: list[int], starts: list[int]) -> Case:
    length = material.frames - 30
    clips = [material.clip(v, s, s + length, 1, True) for v, s in zip(cameras, starts, strict=True)]
    fps = float(clips[0].fps or FPS)
    late = [(s - starts[0]) / fps for s in starts]
    more = tuple(zip(clips[2:], late[2:], strict=True))
    return Case(f"{[material.scene.names[v] for v in cameras]} {starts}", clips[0], clips[1], late[1], fps, more)
