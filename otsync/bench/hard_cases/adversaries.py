"""Scenes that answer confidently and wrongly: the classes of the issue Trust, as rows of aligners and refiners."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from ...types import Matches, TrackSet
from .case import FLAGGED, RIGHT, Case, cloud, near

N, FRAMES = 40, 150
ALL = Matches(np.stack([np.arange(N)] * 2, 1))
Given = tuple[TrackSet, TrackSet, Matches]


def filmed(xyz: np.ndarray, seed: int, noise: float = 0.005) -> TrackSet:
    moved = xyz + noise * np.random.default_rng(seed).normal(size=xyz.shape)
    return TrackSet(moved, fps=30, frame="world")


def canon(later: int = 20) -> Given:
    """Two dancers do the same, the second ``later`` frames afterwards, two metres away; each video sees one of them.

    The videos started together: the true offset is 0.
    """
    dance = cloud(N, FRAMES + later, 21, 0.4)
    first, second = dance[:, later:], dance[:, :FRAMES] + [2.0, 0, 0]
    return filmed(first, 1), filmed(second, 2), ALL


def takes(hurry: float = 0.1) -> Given:
    """Two takes of one choreography at one place: nobody moves twice alike, nor keeps time better than ``hurry`` s
    (rms; now early, now late, in turns of four seconds).

    A second take with the very timing of the first, and only freedom in space, has no row: its arrays are those of one
    take whose trackers drift, which has a true offset. No method on tracks can answer the one and flag the other.
    """
    dance, freedom = cloud(N, FRAMES + 30, 22, 0.5), cloud(N, FRAMES, 23, 0.03)
    frame = np.arange(FRAMES)
    pace = 30 * hurry * np.sqrt(2) * np.sin(2 * np.pi * 0.25 * frame / 30 + 0.7)
    again = CubicSpline(np.arange(FRAMES + 30), dance, axis=1)(15 + frame + pace)
    return filmed(dance[:, 15 : 15 + FRAMES], 1), filmed(again + freedom - freedom[:, :1], 2), ALL


def drift(seed: int, size: float) -> np.ndarray:
    """(1, FRAMES, 3): one smooth motion that all tracks of a video share."""
    motion = cloud(1, FRAMES, seed)
    return size * (motion - motion[:, :1])


def transient() -> Given:
    """A static scene whose trackers settle in the same way during the first half second of each video."""
    still = cloud(N, 1, 24).repeat(FRAMES, 1)
    settle = 0.2 * np.exp(-np.arange(FRAMES) / 8.0)[None, :, None] * np.array([1.0, 0.3, 0.2])
    return filmed(still + settle, 1), filmed(still + settle, 2), ALL


def common_drift() -> Given:
    """A static scene; both calibrations drift in the same way in each video's own clock."""
    still = cloud(N, 1, 25).repeat(FRAMES, 1)
    return filmed(still + drift(26, 0.5), 1), filmed(still + drift(26, 0.5), 2), ALL


def frozen(frames: int) -> Given:
    """b repeats a frame for a while and goes on where the scene is by then: its clock jumps."""
    xyz = cloud(N, FRAMES + 40, 27)
    late = 10
    b = np.concatenate([xyz[:, late : late + 75], xyz[:, late + 75 - frames : late + FRAMES - frames]], 1)
    return filmed(xyz[:, :FRAMES], 1), filmed(b, 2), ALL


def dropped(frames: int) -> Given:
    """b lost ``frames`` frames in the middle and does not say so."""
    xyz = cloud(N, FRAMES + 60, 28)
    late = 10
    b = np.concatenate([xyz[:, late : late + 75], xyz[:, late + 75 + frames : late + FRAMES + frames]], 1)
    return filmed(xyz[:, :FRAMES], 1), filmed(b, 2), ALL


def rated(rate: float, frames: int) -> Given:
    xyz = cloud(N, round(frames * rate) + 60, 29)
    b = CubicSpline(np.arange(xyz.shape[1]), xyz, axis=1)(10 + rate * np.arange(frames))
    return filmed(xyz[:, :frames], 1), filmed(b, 2), ALL


def like_in_two_places() -> Given:
    """Two like performers in unison, two metres apart; each video sees the other one."""
    dance = cloud(N, FRAMES + 10, 33, 0.4)
    return filmed(dance[:, :FRAMES], 1), filmed(dance[:, 10:] + [2.0, 0, 0], 2), ALL


def half_canon(later: int = 20) -> Given:
    """As :func:`canon`, but half of the matches join the same dancer: those tell the truth."""
    dance = cloud(N // 2, FRAMES + later, 34, 0.4)
    first, second = dance[:, later:], dance[:, :FRAMES] + [2.0, 0, 0]
    beside = first + np.array([0.05, 0, 0])
    both = np.concatenate([first, beside]), np.concatenate([first, second])
    return filmed(both[0], 1), filmed(both[1], 2), ALL


def rain(late: float) -> Given:
    """Things that fall, each at its own speed, sway, and come again on top; b began ``late`` s later."""
    rng = np.random.default_rng(35)
    place, speed = rng.uniform(-1, 1, (N, 1, 3)), rng.uniform(0.6, 1.8, (N, 1))
    phase, rate = rng.uniform(0, 6.28, (N, 1, 2)), rng.uniform(0.2, 0.9, (N, 1, 2))

    def at(t: np.ndarray) -> np.ndarray:
        sway = place[..., :2] + 0.15 * np.sin(2 * np.pi * rate * t[:, None] + phase)
        return np.concatenate([sway, ((place[..., 2] - speed * t) % 2.4)[..., None]], 2)

    t = np.arange(FRAMES) / 30
    return filmed(at(t), 1), filmed(at(t + late), 2), ALL


def other_points(share: float = 0.5) -> Given:
    """Half of b's tracks take up another point of the scene somewhere in the middle."""
    rng = np.random.default_rng(36)
    xyz = cloud(N, FRAMES + 10, 37)
    b = xyz[:, 10:].copy()
    for k in np.flatnonzero(rng.random(N) < share):
        when = int(rng.integers(30, FRAMES - 30))
        b[k, when:] = xyz[int(rng.integers(N)), 10 + when :]
    return filmed(xyz[:, :FRAMES], 1), filmed(b, 2), ALL


wrong_anywhere = near(1e9)

CASES: tuple[Case, ...] = (
    Case(
        "canon: somebody else, later",
        "the second dancer does the same twenty frames later; each video sees one of them",
        "one declared world frame: what is matched must be at one place at the answer",
        canon,
        (FLAGGED, RIGHT),
        check=near(0.0),
    ),
    Case(
        "somebody else in unison, declared frame",
        "motions agree, places never do",
        "flagged, or right",
        like_in_two_places,
        (FLAGGED, RIGHT),
        check=near(1 / 3),
    ),
    Case(
        "canon, half of the matches right",
        "two offsets, each with half of the votes",
        "flagged, or right",
        half_canon,
        (FLAGGED, RIGHT),
        check=near(0.0),
    ),
    Case(
        "two takes of one choreography",
        "motions and places agree, up to a tenth of a second",
        "flagged: there is no true offset",
        takes,
        (FLAGGED,),
        check=wrong_anywhere,
    ),
    Case(
        "trackers that settle",
        "a static scene; all tracks of a video move alike at its beginning",
        "flagged",
        transient,
        (FLAGGED,),
        check=wrong_anywhere,
    ),
    Case(
        "a drift of both calibrations",
        "a static scene; all tracks of a video move alike",
        "flagged",
        common_drift,
        (FLAGGED,),
        check=wrong_anywhere,
    ),
    *(
        Case(
            f"a freeze of {k} frames",
            "one offset before it, another behind it",
            "flagged",
            lambda k=k: frozen(k),
            (FLAGGED,),
            check=wrong_anywhere,
        )
        for k in (15, 30)
    ),
    Case(
        "ten frames dropped",
        "one offset before them, another behind them",
        "flagged",
        lambda: dropped(10),
        (FLAGGED,),
        check=wrong_anywhere,
    ),
    Case(
        "things that come again on top",
        "every track jumps, between two frames, nobody knows when: a curve through a jump rings",
        "jumps are taken out of the curves",
        lambda: rain(0.35),
        (FLAGGED, RIGHT),
        check=near(0.35),
    ),
    Case(
        "half of the tracks take up another point",
        "each of them is right up to its jump alone",
        "jumps are taken out of the curves; what moves otherwise behind them loses weight",
        other_points,
        (FLAGGED, RIGHT),
        check=near(1 / 3),
    ),
    Case(
        "frame rate wrong by 1 %, 12 s",
        "wrong by frames at both ends",
        "flagged",
        lambda: rated(1.01, 360),
        (FLAGGED,),
        check=wrong_anywhere,
    ),
)
