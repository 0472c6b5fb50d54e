"""Worlds to be trusted or not: classes by name, each ``seed -> World``, with the error of any answer to them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ...recordings.stages import PIXELS
from ...simulate import PRESETS, Truth, simulate
from ...simulate.effects import (
    ClockDrift,
    ClockRamp,
    ClockSway,
    Cut,
    Drop,
    Effect,
    Freeze,
    Gaps,
    In,
    Lag,
    LatePoses,
    LimbDrift,
    Loop,
    PartLate,
    Repeats,
    Replay,
    Reverse,
    SharedDrift,
    SlowMotion,
    Transient,
)
from ...simulate.phones import Hand
from ...types import Offsets, TrackSet
from ..sync_worlds import FPS, MOVING

BESIDE = 8 / 30
"""Seconds beside a break in which frames are not asked for: nobody can tell which of them is which."""

LEVEL = 15
"""Frames over which the error of a clock is averaged: a whole number of turns of what repeats every third or fifth."""

PIXEL_NOISE = 0.5
"""Pixels, of tracks without depth: what flow leaves on a textured thing."""

POSE_NOISE = 0.005, 0.05
"""Metres and degrees, one sigma an axis, of the poses of cameras that were found frame by frame."""


@dataclass(frozen=True, eq=False)
class World:
    """Videos, and what their frames show.

    Args:
        tracks: of every video. shown: per video (T,) seconds of the world; None where there is no true answer, so that
            every answer that is trusted is wrong.
        options: of :func:`otsync.synchronize`, beside its defaults; a ``method`` of its own is the only one that
            reads its tracks.
    """

    tracks: tuple[TrackSet, ...]
    shown: tuple[np.ndarray, ...] | None
    options: Mapping[str, Any] = field(default_factory=dict)

    def errors(self, offsets: Offsets) -> tuple[np.ndarray, np.ndarray]:
        """Per video but the first: error in frames at the beginning and the end of what it shares with the first, the
        larger one; and the largest anywhere. Infinite where there is no true answer, nan without an answer.
        """
        worst = [np.abs(self._late(offsets, v)[0]).max() for v in range(1, len(self.tracks))]
        return self.at_ends(offsets).max(1), np.array(worst)

    def at_ends(self, offsets: Offsets) -> np.ndarray:
        """(V-1, 2) the errors of :meth:`errors` at the beginning and at the end, each for itself."""
        late = [self._late(offsets, v)[0] for v in range(1, len(self.tracks))]
        return np.array([[abs(x[0]), abs(x[-1])] for x in late]).reshape(-1, 2)

    def where_heard(self, offsets: Offsets) -> np.ndarray:
        """Per video but the first: the largest error in frames where a step of its clock would be heard
        (:attr:`Offsets.steps_heard`); or the median error, if that is larger: an answer holds for most frames, or not.
        """
        worst = []
        for v in range(1, len(self.tracks)):
            late, found = self._late(offsets, v)
            begin, end = offsets.steps_heard[v]
            inside = np.abs(late[(found >= begin) & (found <= end)])
            worst.append(max(float(np.median(np.abs(late))), inside.max(initial=0.0)))
        return np.array(worst)

    def _late(self, offsets: Offsets, v: int) -> tuple[np.ndarray, np.ndarray]:
        """(S,) frames by which the clock that was found for video v is off, at every frame that is asked, in order; and
        (S,) when on the clock of the first that is, s.
        """
        if not np.isfinite(offsets.seconds[v]) or offsets.component[v] != offsets.component[0]:
            return np.array([np.nan]), np.array([np.nan])
        if self.shown is None:
            return np.array([np.inf]), np.array([np.nan])
        first, own = self.shown[0], self.shown[v]
        found = offsets.times(v, self.tracks[v].times)
        # what the reference showed when its clock, breaks undone, said so
        clock = offsets.times(0, self.tracks[0].times)
        known = np.isfinite(clock)
        order = np.argsort(clock[known], kind="stable")
        true = np.interp(found, clock[known][order], first[known][order], left=np.nan, right=np.nan)
        common = np.isfinite(found) & np.isfinite(true)
        if not common.any():
            return np.array([np.inf]), np.array([np.nan])  # nothing that is claimed to be common is
        asked = common & steady(own, self.tracks[v].times)
        asked &= ~near(found, clock, ~steady(first, self.tracks[0].times))
        if asked.sum() < LEVEL:  # a steep staircase all along (few frames at an end seem even): its middle, everywhere
            asked = common
        return levelled((true - own)[asked], self.tracks[v].times[asked]) * FPS, found[asked]


def steady(shown: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(T,) frames around which a video's time runs on: what it shows beside what its clock says hardly changes."""
    late = shown - times
    low, high = np.searchsorted(times, times - BESIDE), np.searchsorted(times, times + BESIDE, side="right")
    return np.array([np.ptp(late[i:j]) < 1.5 / FPS for i, j in zip(low, high, strict=True)])


def levelled(late: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Means over :data:`LEVEL` frames in a row around each, of those without a gap between them.

    A file that repeats frames is a staircase, and a clock that runs through its middle is right. So as many frames are
    taken at the ends as elsewhere: of 24 pictures a second in 30 every fifth is repeated, and the mean over eight
    frames is up to .09 of a frame off the middle, of fifteen nothing.
    """
    out = np.empty(len(late))
    for run in np.split(np.arange(len(late)), np.flatnonzero(np.diff(times) > BESIDE) + 1):
        width = min(LEVEL, len(run))
        total = np.concatenate([[0.0], np.cumsum(late[run])])
        begin = np.clip(np.arange(len(run)) - width // 2, 0, len(run) - width)
        out[run] = (total[begin + width] - total[begin]) / width
    return out


def near(found: np.ndarray, clock: np.ndarray, doubtful: np.ndarray) -> np.ndarray:
    """Which of the moments ``found`` lie where the reference's frames are doubtful."""
    if not doubtful.any():
        return np.zeros(len(found), bool)
    index = np.clip(np.searchsorted(clock, found), 0, len(clock) - 1)
    return doubtful[index]


def drawn(
    seed: int,
    *,
    motion: str | None = None,
    classes: Sequence[str] = MOVING,
    preset: str = "mid",
    videos: int = 2,
    frames: Any = 150,
    first: tuple[Effect, ...] = (),
    last: tuple[Effect, ...] = (),
    rates: Sequence[float] | None = None,
    within: float = 40.0,
    alike: bool = False,
    tracks: int | None = None,
) -> tuple[tuple[TrackSet, ...], Truth]:
    """A world of a class drawn from the seed; effects ``first`` go before the preset's, ``last`` behind them."""
    rng = np.random.default_rng([seed, 901])
    level = PRESETS[preset]
    if alike and level.features is not None:
        level = replace(level, features=replace(level.features, person=0.0))
    late = [0.0, *(rng.uniform(-within, within, videos - 1) / FPS)]
    sets, truth = simulate(
        classes[int(rng.integers(len(classes)))] if motion is None else motion,
        preset=level,
        videos=videos,
        frames=frames,
        offsets=late,
        tracks=tracks,
        rates=rates,
        effects=(*first, *level.effects, *last),
        seed=int(rng.integers(2**31)),
    )
    return tuple(sets), truth


def plain(seed: int, **options: Any) -> World:
    tracks, truth = drawn(seed, **options)
    return World(tracks, truth.shown)


def in_hands(seed: int, *, rate: float = 1.0, off: bool = False, **options: Any) -> World:
    """Four phones in hands that film three seconds, and no depth: tracks in pixels, the poses of every frame known.

    Args:
        rate: that the second one's clock runs by, though nobody says so. off: whether each frame's pose is off by
            :data:`POSE_NOISE`. options: of :func:`drawn`.
    """
    known: dict[str, Any] = {"preset": "clean", "videos": 4, "frames": 90, "within": 20, "last": (Gaps(0.2),)}
    tracks, truth = drawn(seed, rates=[1.0, rate, 1.0, 1.0], **known | options)
    rng, held = np.random.default_rng([seed, 905]), []
    for t, shown in zip(tracks, truth.shown, strict=True):
        assert t.camera is not None
        camera = replace(t.camera, w2c=Hand().shaken(t.camera.w2c, shown, rng))
        told = replace(camera, w2c=_pushed(rng, t.n_frames) @ camera.w2c) if off else camera
        uv = camera.project(t.positions()) + rng.normal(0, PIXEL_NOISE, (len(t), t.n_frames, 2))
        # a picture that stands still is the same, noise and all
        _, first, same = np.unique(shown, return_index=True, return_inverse=True)
        held.append(replace(t, xyz=None, uv=uv[:, first[same]], visible=t.seen[:, first[same]], camera=told))
    return World(tuple(held), truth.shown, {"method": PIXELS})


def _pushed(rng: np.random.Generator, count: int) -> np.ndarray:
    """(T,4,4) small motions of a camera, each by itself."""
    from scipy.spatial.transform import Rotation

    out = np.repeat(np.eye(4)[None], count, 0)
    out[:, :3, :3] = Rotation.from_rotvec(np.radians(POSE_NOISE[1]) * rng.normal(size=(count, 3))).as_matrix()
    out[:, :3, 3] = POSE_NOISE[0] * rng.normal(size=(count, 3))
    return out


def untrue(seed: int, **options: Any) -> World:
    """A world whose videos share no time."""
    tracks, _ = drawn(seed, **options)
    return World(tracks, None)


def rated(seed: int, *, rate: float, frames: int, preset: str = "mid") -> World:
    """One video's clock runs by ``rate``, up or down, and nobody says so."""
    up = np.random.default_rng([seed, 902]).choice([1 + rate, 1 / (1 + rate)])
    return plain(seed, rates=[1.0, float(up)], frames=frames, preset=preset)


def bending(seed: int) -> World:
    """The rate of one video's clock changes by 1 to 4 % within its 5 s."""
    rng = np.random.default_rng([seed, 904])
    change = float(rng.choice([-1, 1]) * rng.uniform(0.01, 0.04))
    return plain(seed, first=(In(1, ClockRamp(change)),))


def times_given(seed: int, *, off: float = 0.0, made: Callable[..., World] = plain, **options: Any) -> World:
    """A second is missing from the second video, or as much as ``options`` say, and its file says so by its times.

    Args:
        off: s by which they say too much. made: what makes the world, with ``options``.
    """
    world = made(seed, **{"first": (In(1, Drop(1.0)),)} | options)
    assert world.shown is not None
    times = world.shown[1] - world.shown[1][0]
    behind = int(np.argmax(np.diff(times))) + 1
    told = replace(world.tracks[1], timestamps=times + off * (np.arange(len(times)) >= behind))
    return World((world.tracks[0], told, *world.tracks[2:]), world.shown, world.options)


def paused(seed: int) -> World:
    """A recorder that was paused for .25 to .5 s, and goes on between two frames of before."""
    return plain(seed, first=(In(1, Drop(float(np.random.default_rng([seed, 903]).uniform(0.25, 0.5)))),))


def beside_an_end(seed: int, preset: str = "mid") -> World:
    """Three to five frames are lost .5 to .8 s from an end of one video."""
    rng = np.random.default_rng([seed, 906])
    away = float(rng.uniform(0.5, 0.8)) * FPS / 150
    lost = In(1, Drop(int(rng.integers(3, 6)) / FPS, at=float(rng.choice([away, 1 - away]))))
    return plain(seed, preset=preset, frames=150, first=(lost,), within=10)


def at_an_end(seed: int, preset: str) -> World:
    """Two to six frames are lost .2 to .9 s from an end of a video: hardly enough is left to tell by."""
    rng = np.random.default_rng([seed, 907])
    away = float(rng.uniform(0.2, 0.9)) * FPS / 150
    lost = In(int(rng.integers(0, 2)), Drop(int(rng.integers(2, 7)) / FPS, at=float(rng.choice([away, 1 - away]))))
    return plain(seed, preset=preset, frames=150, first=(lost,), within=10)


def performers(seed: int, *, motion: str, sees: Sequence[Sequence[int]]) -> World:
    """Like performers: video v sees those of ``sees[v]`` alone."""
    tracks, truth = drawn(seed, motion=motion, videos=len(sees), alike=True, within=15)
    each = (max(int(s.object.max()) for s in truth.surfaces) + 1) // 2
    chosen = []
    for t, surface, who in zip(tracks, truth.surfaces, sees, strict=True):
        mine = np.isin(surface.object // each, who) & (surface.object >= 0)
        chosen.append(t.take(np.flatnonzero(mine)))
    return World(tuple(chosen), truth.shown)


def takes(seed: int, freedom: float = 0.03) -> World:
    """Two takes of one choreography at one place: nobody moves twice alike to better than a tenth of a second."""
    return untrue(seed, first=(In(1, ClockDrift(0.1, correlation=1.0)), In(1, LimbDrift(freedom, correlation=0.8))))


def strangers(seed: int, **options: Any) -> World:
    """Two scenes that have nothing in common."""
    (a, _), _ = drawn(seed, **options)
    (_, b), _ = drawn(seed + 100_003, **options)
    return World((a, b), None)


CLASSES: dict[str, Callable[[int], World]] = {
    "mid": partial(plain, preset="mid"),
    "hard": partial(plain, preset="hard"),
    "brutal": partial(plain, preset="brutal"),
    "mid, four videos": partial(plain, preset="mid", videos=4),
    "hard, four videos": partial(plain, preset="hard", videos=4),
    "few tracks": partial(plain, preset="hard", tracks=24),
    "like people": partial(plain, preset="hard", classes=("basketball", "football")),
    "short clips": partial(plain, preset="mid", frames=75, within=20),
    "canon, one each": partial(performers, motion="canon", sees=((0,), (1,))),
    "canon, one sees both": partial(performers, motion="canon", sees=((0,), (0, 1))),
    "canon, two and two": partial(performers, motion="canon", sees=((0,), (0,), (1,), (1,))),
    "unison, one each": partial(performers, motion="unison", sees=((0,), (1,))),
    "two takes": takes,
    "two scenes": strangers,
    "two scenes, hard": partial(strangers, preset="hard"),
    "static": partial(untrue, motion="static"),
    "static, trackers settle": partial(untrue, motion="static", last=(Transient(0.2),)),
    "static, one drift for all": partial(untrue, motion="static", last=(SharedDrift(0.2, seed=5),)),
    "one drift for all": partial(plain, preset="mid", last=(SharedDrift(0.05, seed=5),)),
    "freeze of 15": partial(plain, first=(In(1, Freeze(15)),)),
    "freeze of 30": partial(plain, first=(In(1, Freeze(30)),)),
    "freeze of 30, four videos": partial(plain, videos=4, first=(In(2, Freeze(30)),)),
    "freeze that catches up": partial(plain, first=(In(1, Freeze(30, catches_up=True)),)),
    "freeze of the first": partial(plain, first=(In(0, Freeze(20)),)),
    "ten frames dropped": partial(plain, first=(In(1, Drop(10 / 30)),)),
    "ten frames dropped, hard": partial(plain, preset="hard", first=(In(1, Drop(10 / 30)),)),
    "few frames lost near an end": beside_an_end,
    "few frames lost near an end, hard": partial(beside_an_end, preset="hard"),
    "frames lost at an end": partial(at_an_end, preset="mid"),
    "frames lost at an end, hard": partial(at_an_end, preset="hard"),
    "frames lost at an end, brutal": partial(at_an_end, preset="brutal"),
    "freeze of 15, hard": partial(plain, preset="hard", first=(In(1, Freeze(15)),)),
    "freeze of 15, brutal": partial(plain, preset="brutal", first=(In(1, Freeze(15)),)),
    "a second missing": partial(plain, first=(In(1, Drop(1.0)),), within=15),
    "a second missing, times given": partial(times_given, within=15),
    "a second missing, times given, hard": partial(times_given, preset="hard", within=15),
    "a second missing, times off": partial(times_given, off=-0.3, within=15),
    "recorder paused": paused,
    "halves exchanged": partial(plain, first=(In(1, Cut()),), within=15),
    "a replay": partial(plain, first=(In(1, Replay(1.0)),), within=15),
    "a replay, hard": partial(plain, preset="hard", first=(In(1, Replay(1.0)),), within=15),
    "a replay in the first": partial(plain, first=(In(0, Replay(1.5)),), within=15),
    "24 as 30": partial(plain, first=(In(1, Repeats(24.0)),)),
    "24 as 30, frozen": partial(plain, first=(In(1, Repeats(24.0)), In(1, Freeze(15)))),
    "looped file": partial(untrue, first=(In(1, Loop()),)),
    "played backwards": partial(untrue, first=(In(1, Reverse()),)),
    "slow motion": partial(plain, first=(In(1, SlowMotion(2.0)),)),
    "rate 1 %, 10 s": partial(rated, rate=0.01, frames=300),
    "rate 1 %, 20 s": partial(rated, rate=0.01, frames=600),
    "rate .1 %, 20 s": partial(rated, rate=0.001, frames=600),
    "rate .1 %, 30 s": partial(rated, rate=0.001, frames=900),
    "rate 1 %, 5 s": partial(rated, rate=0.01, frames=150),
    "clock bends": bending,
    "clock sways": partial(plain, first=(In(1, ClockSway()),)),
    "tracks that lag": partial(plain, first=(In(1, Lag(3 / 30)),)),
    "tracks that lag, hard": partial(plain, preset="hard", first=(In(1, Lag(3 / 30)),)),
    "camera follows, poses late": partial(plain, last=(In(1, LatePoses(3 / 30)),)),
    "one of two late": partial(plain, classes=("basketball", "football"), first=(In(1, PartLate()),)),
    "one of two late, hard": partial(
        plain, preset="hard", classes=("basketball", "football"), first=(In(1, PartLate()),)
    ),
    "one of two late, frames lost": partial(
        plain, classes=("basketball", "football"), first=(In(1, PartLate()), In(1, Drop(8 / 30)))
    ),
    "phones in hands": in_hands,
    "phones in hands, four lost": partial(in_hands, first=(In(1, Drop(4 / 30)),)),
    "phones in hands, ten lost": partial(in_hands, first=(In(1, Drop(10 / 30)),)),
    "phones in hands, times given": partial(times_given, made=in_hands, first=(In(1, Drop(10 / 30)),)),
    "phones in hands, times off": partial(times_given, made=in_hands, first=(In(1, Drop(10 / 30)),), off=-0.2),
    "phones in hands, poses off, ten lost": partial(in_hands, off=True, first=(In(1, Drop(10 / 30)),)),
    "phones in hands, one frozen": partial(in_hands, first=(In(1, Freeze(8)),)),
    "phones in hands, rate 4 %": partial(in_hands, rate=1.04),
    "short overlap": partial(plain, preset="hard", frames=56, within=5),
    "short overlap, one frozen": partial(plain, preset="hard", frames=56, within=5, first=(In(1, Freeze(8)),)),
    "short overlap, ten lost": partial(plain, preset="hard", frames=56, within=5, first=(In(1, Drop(10 / 30)),)),
    "exact loop": partial(plain, motion="loop"),
    "strides": partial(plain, motion="strides"),
    "strides, hard": partial(plain, motion="strides", preset="hard"),
    "strides, one frozen": partial(plain, motion="strides", first=(In(1, Freeze(30)),)),
    "strides, one missing": partial(plain, motion="strides", first=(In(1, Drop(1.0)),), within=15),
    "strides, one missing late": partial(plain, motion="strides", first=(In(1, Drop(1.0, at=0.75)),), within=15),
    "strides, one missing, four videos": partial(
        plain, motion="strides", videos=4, first=(In(1, Drop(1.0)),), within=15
    ),
    "carousel": partial(plain, motion="carousel", alike=True),
    "belt": partial(plain, motion="belt", alike=True),
    "flock": partial(plain, motion="flock", alike=True),
    "rain": partial(plain, motion="rain"),
    "things that jump": partial(plain, motion="portals"),
    "things that jump, hard": partial(plain, motion="portals", preset="hard"),
}
"""Classes by name: those of the benchmark first, then those that mislead."""

WITHOUT_DEPTH = frozenset(name for name in CLASSES if name.startswith("phones in hands"))
"""Classes of tracks in pixels, which no other method reads than their own."""

AT_THE_END = frozenset(name for name in CLASSES if name.startswith("frames lost at an end"))
"""Classes whose clocks step where too little is left to tell: an answer holds where a step would be heard."""
