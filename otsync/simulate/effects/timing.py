"""Effects of what a file does to time and does not say: freezes, lost frames, cuts, loops, slow motion.

Each changes which moment of the world a frame shows and leaves the video's declared clock alone. They belong before the
errors of cameras and trackers in the tuple, since those happen in the video's own time. ``Truth.shown`` tells what
every frame shows.
"""

from __future__ import annotations

import numbers
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ...types.checks import check_number, check_whole
from ..observation import Observation

if TYPE_CHECKING:
    from . import Effect

MIDDLE = (0.35, 0.65)
"""Shares of the clip between which an event happens whose place is not given."""


@dataclass(frozen=True)
class In:
    """An effect in one video only."""

    video: int
    effect: Effect

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        return self.effect(obs, rng) if obs.video == self.video else obs


def showing(obs: Observation, own: Float[np.ndarray, " T"]) -> Observation:
    """The observation whose k-th frame shows what this one shows ``own[k]`` s after its first frame.

    So effects of one video add up in their order: each is done to the file that the one before has made. Beyond the
    clip the file goes on as it ends.
    """
    earlier = 0.0 if obs.late is None else _late_at(obs.late, obs.times - obs.times[0], own)
    shown = obs.rate * (obs.times[0] + own) + obs.offset + earlier
    step = shown - obs.world_times
    late = step if obs.late is None else obs.late + step
    return replace(obs, xyz=obs.xyz + obs.moved(step), late=late)


def _late_at(
    late: Float[np.ndarray, " T"], times: Float[np.ndarray, " T"], t: Float[np.ndarray, " S"]
) -> Float[np.ndarray, " S"]:
    """``late`` at the moments ``t``: on a line between two frames; where the file jumps, that of the nearest frame."""
    if len(times) < 2:
        return np.full(len(t), late[0])
    right = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
    low, high = late[right - 1], late[right]
    step = times[right] - times[right - 1]
    share = np.clip((t - times[right - 1]) / step, 0.0, 1.0)
    jumps = np.abs(high - low) > 1.5 * step
    return np.asarray(low + np.where(jumps, np.round(share), share) * (high - low))


def check_moment(name: str, at: Any) -> None:
    """Refuse what is no share of a clip, from 0 to 1, nor None."""
    real = isinstance(at, numbers.Real) and not isinstance(at, bool)
    if not (at is None or (real and 0 <= at <= 1)):
        raise ValueError(f"{name}: expected a share of the clip, from 0 to 1; found {at!r}.")


def moment(at: float | None, clock: np.ndarray, rng: np.random.Generator) -> int:
    """The frame at the share ``at`` of the clip; None: any in the middle of it."""
    share = rng.uniform(*MIDDLE) if at is None else at
    return int(np.clip(round(share * len(clock)), 1, len(clock) - 1))


@dataclass(frozen=True)
class Freeze:
    """The picture stands still for ``frames`` frames.

    Args:
        frames: that repeat the one before them.
        at: share of the clip; None: drawn.
        catches_up: whether the video then goes on where the world is (an encoder that choked), instead of where it
            stopped (a buffer that was played out late).
    """

    frames: int = 15
    at: float | None = None
    catches_up: bool = False

    def __post_init__(self) -> None:
        check_whole("Freeze.frames", self.frames, 1)
        check_moment("Freeze.at", self.at)

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        own = obs.times - obs.times[0]
        k = moment(self.at, own, rng)
        end = min(k + self.frames, len(own))
        shown = own.copy()
        shown[k:end] = own[k - 1]
        if not self.catches_up:
            shown[end:] -= own[end - 1] - own[k - 1]
        return showing(obs, shown)


@dataclass(frozen=True)
class Drop:
    """``seconds`` of the recording are missing, and the frames behind them keep the declared rate: frames that were
    dropped, or a recorder that was paused.

    Args:
        seconds: missing. at: share of the clip; None: drawn.
    """

    seconds: float = 10 / 30
    at: float | None = None

    def __post_init__(self) -> None:
        check_number("Drop.seconds", self.seconds)
        check_moment("Drop.at", self.at)

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        own = obs.times - obs.times[0]
        k = moment(self.at, own, rng)
        return showing(obs, own + self.seconds * (np.arange(len(own)) >= k))


@dataclass(frozen=True)
class Cut:
    """An editor exchanged the two parts of the video before and behind ``at``, a share of the clip; None: drawn."""

    at: float | None = None

    def __post_init__(self) -> None:
        check_moment("Cut.at", self.at)

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        own = obs.times - obs.times[0]
        return showing(obs, np.roll(own, moment(self.at, own, rng)))


@dataclass(frozen=True)
class Replay:
    """From ``at`` on, a share of the clip, the video shows again what it has shown in the last ``seconds``, and goes on
    from there; ``at`` None: drawn. What a broadcast replays, or a buffer that is played out twice.
    """

    seconds: float = 1.0
    at: float | None = None

    def __post_init__(self) -> None:
        check_number("Replay.seconds", self.seconds)
        check_moment("Replay.at", self.at)

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        own = obs.times - obs.times[0]
        k = moment(self.at, own, rng)
        back = min(self.seconds, float(own[k]))  # not to before the file begins
        return showing(obs, own - back * (np.arange(len(own)) >= k))


@dataclass(frozen=True)
class Repeats:
    """Footage of ``fps`` frames a second within a file of more: frames repeat until the next one is due."""

    fps: float = 24.0

    def __post_init__(self) -> None:
        check_number("Repeats.fps", self.fps)

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        own = obs.times - obs.times[0]
        return showing(obs, np.floor(own * self.fps + 1e-9) / self.fps)


@dataclass(frozen=True)
class Loop:
    """The first ``seconds`` over and over again."""

    seconds: float = 40 / 30

    def __post_init__(self) -> None:
        check_number("Loop.seconds", self.seconds)

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        return showing(obs, np.mod(obs.times - obs.times[0], self.seconds))


@dataclass(frozen=True)
class Reverse:
    """Played backwards."""

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        return showing(obs, (obs.times - obs.times[0])[::-1].copy())


@dataclass(frozen=True)
class SlowMotion:
    """A part of the video is played ``factor`` times slower; what follows comes later.

    Args:
        factor: more than 1 is slower. begin, end: shares of the clip.
    """

    factor: float = 2.0
    begin: float = 0.3
    end: float = 0.6

    def __post_init__(self) -> None:
        check_number("SlowMotion.factor", self.factor)
        check_moment("SlowMotion.begin", self.begin)
        check_moment("SlowMotion.end", self.end)

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        own = obs.times - obs.times[0]
        slow = (own >= self.begin * own[-1]) & (own < self.end * own[-1])
        pace = np.where(slow, 1 / self.factor, 1.0)
        return showing(obs, np.concatenate([[0.0], np.cumsum(np.diff(own) * pace[:-1])]))
