"""Hard cases of the graph of pairs: several videos at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from ...types import Matches, Offsets, TrackSet
from .case import FLAGGED, REFUSED, RIGHT, SOUND, Case, cloud

N, FRAMES = 40, 130
LATE = (0, 12, 25, -9)
"""Frames that the videos start later than the first."""

NONE = 10**6
"""A start that no answer is near: of a video that has no true offset."""

Given = tuple[list[TrackSet], dict[tuple[int, int], Matches] | None]


def video(late: int, seed: int = 0, n: int = N, frames: int = FRAMES, noise: float = 0.01, of=lambda x: x) -> TrackSet:
    """A clip of scene ``seed`` from its frame ``60 + late`` on; features tell the tracks apart."""
    rng = np.random.default_rng([seed, late + 1000, 3])
    xyz = of(cloud(n, 60 + 160 + FRAMES, seed + 80))[:, 60 + late : 60 + late + frames]
    features = np.random.default_rng(seed + 5).normal(size=(n, 24))
    looks = features + 0.3 * rng.normal(size=features.shape)
    return TrackSet(xyz + noise * rng.normal(size=xyz.shape), features=looks, fps=30, frame="world", name=f"{late}")


def videos(late: Sequence[int] = LATE, **how) -> list[TrackSet]:
    return [video(k, **how) for k in late]


def given(tracks: list[TrackSet]) -> Given:
    """With the right matches of every pair: track k is track k."""
    same = Matches(np.stack([np.arange(N)] * 2, 1))
    return tracks, {pair: same for pair in combinations(range(len(tracks)), 2)}


def placed(late: Sequence[int], frames: float = 0.5) -> Callable[[Offsets], np.ndarray]:
    """Which videos are within ``frames`` of their place on the reference's clock."""
    truth = np.asarray(late, float) / 30

    def check(found: Offsets) -> np.ndarray:
        return np.abs(found.seconds - (truth - truth[found.reference])) <= frames / 30

    return check


def stranger(where: int) -> Callable[[], Given]:
    """One video shows another scene; matches are those of tracks by number, which mean nothing there."""

    def made() -> Given:
        tracks = videos()
        tracks[where] = video(0, seed=7)
        return given(tracks)

    return made


def lying_pair(lie: int = 20) -> Given:
    """The pair (1, 2) is matched to what a clip shifted by ``lie`` frames shows: it is wrong and sure of it.

    Each video also follows N tracks of a second object, which video 2 shows ``lie`` frames late.
    """
    tracks, matches = given(videos())
    extra = [video(k, seed=11) for k in (LATE[0], LATE[1], LATE[2] + lie, LATE[3])]
    tracks = [
        replace(t, xyz=np.concatenate([t.xyz, x.xyz]), features=np.concatenate([t.features, x.features]), visible=None)
        for t, x in zip(tracks, extra, strict=True)
    ]
    k = np.arange(N, 2 * N)
    return tracks, matches | {(1, 2): Matches(np.stack([k, k], 1))}


def swapped_sign(x: np.ndarray) -> np.ndarray:
    return x * [1, 1, -1]


CASES: tuple[Case, ...] = (
    Case(
        "four videos of one scene",
        "nothing: the usual case",
        "all within half a frame",
        lambda: given(videos()),
        (RIGHT,),
        check=placed(LATE),
        clean=True,
    ),
    Case(
        "four videos, matched here",
        "the default matcher and a second matching at known times",
        "all within half a frame",
        lambda: (videos(), None),
        (RIGHT,),
        check=placed(LATE),
        clean=True,
    ),
    Case(
        "two videos",
        "no third says whether the pair is right",
        "the pair vouches for itself",
        lambda: given(videos(LATE[:2])),
        (RIGHT,),
        check=placed(LATE[:2]),
    ),
    Case(
        "one video unrelated",
        "it has no place, but a best one with every other",
        "it is flagged, the others are not moved by it",
        stranger(2),
        (FLAGGED,),
        check=placed((0, 12, NONE, -9)),
    ),
    Case(
        "one video unrelated, matched here",
        "its matches are the cheapest ones",
        "it is flagged, the others are not moved by it",
        lambda: ([*videos(LATE[:3]), video(0, seed=7)], None),
        (FLAGGED,),
        check=placed((0, 12, 25, NONE)),
    ),
    Case(
        "the reference unrelated",
        "nothing is on its clock",
        "all are flagged",
        stranger(0),
        (FLAGGED,),
        check=placed((NONE, 12, 25, -9)),
    ),
    Case(
        "two scenes, two videos of each",
        "two components",
        "the second is flagged and has a clock of its own",
        lambda: given([video(0), video(12), video(0, seed=7), video(12, seed=7)]),
        (FLAGGED,),
        check=placed((0, 12, NONE, NONE)),
    ),
    Case(
        "one pair wrong and sure of it",
        "it contradicts the cycles",
        "the others outvote it",
        lying_pair,
        (RIGHT, FLAGGED),
        check=placed(LATE),
    ),
    Case(
        "the star's own pair wrong and sure of it",
        "the reference's pair lies; other ways tell the truth",
        "the graph outvotes it; a star cannot know",
        lambda: (
            lying_pair()[0],
            {((0, 1) if p == (1, 2) else (1, 2) if p == (0, 1) else p): m for p, m in lying_pair()[1].items()},
        ),
        SOUND,
        check=placed(LATE),
    ),
    Case(
        "a video twice",
        "two equal videos vote as two",
        "all within half a frame",
        lambda: given([*videos(), replace(video(LATE[1]), name="again")]),
        (RIGHT,),
        check=placed((*LATE, LATE[1])),
    ),
    Case(
        "the same video four times",
        "every offset is 0 exactly",
        "0",
        lambda: given([replace(video(0), name=str(k)) for k in range(4)]),
        (RIGHT,),
        check=placed((0, 0, 0, 0)),
    ),
    Case(
        "nothing moves in any video",
        "no pair can tell the time",
        "all flagged",
        lambda: given(videos(of=lambda x: x[:, :1].repeat(x.shape[1], 1))),
        (FLAGGED,),
        check=placed((0, NONE, NONE, NONE)),
    ),
    Case(
        "one video without motion seen",
        "its tracks are lost",
        "flagged, the others stand",
        lambda: given([*videos(LATE[:3]), replace(video(LATE[3]), visible=np.zeros((N, FRAMES), bool))]),
        (FLAGGED,),
        check=placed((*LATE[:3], NONE)),
    ),
    Case(
        "one video without a frame in common",
        "it began when the others had ended",
        "flagged, the others stand",
        lambda: given([*videos(LATE[:3]), video(160)]),
        (FLAGGED, RIGHT),
        check=placed((*LATE[:3], 160)),
    ),
    Case(
        "periodic motion in all videos",
        "every period is as good in every pair",
        "right or flagged",
        lambda: given(
            videos(of=lambda x: x[:, :1] + np.sin(2 * np.pi * np.arange(x.shape[1]) / 20)[None, :, None] * x[:, 1:2])
        ),
        SOUND,
        check=placed(LATE),
    ),
    Case(
        "one video mirrored",
        "its reader has the wrong handedness",
        "flagged, or right all the same: two of three axes tell the time",
        lambda: ([*videos(LATE[:3]), video(LATE[3], of=swapped_sign)], None),
        SOUND,
        check=placed(LATE),
    ),
    Case(
        "one video at 29 instead of 30 frames a second",
        "no one offset suits its whole length",
        "flagged",
        lambda: given([*videos(LATE[:3]), replace(video(LATE[3]), fps=29.0)]),
        SOUND,
        check=placed(LATE, 1.0),
    ),
    Case(
        "80 % of the matches wrong in every pair",
        "wrong matches add up",
        "right or flagged",
        lambda: (
            videos(),
            {
                p: Matches(np.stack([np.arange(N), np.r_[np.arange(8), 8 + (np.arange(32) + 5) % 32]], 1))
                for p in combinations(range(4), 2)
            },
        ),
        SOUND,
        check=placed(LATE),
    ),
    Case(
        "one video alone",
        "there is no pair",
        "ValueError",
        lambda: ([video(0)], None),
        (REFUSED,),
        "at least two track sets",
    ),
    Case(
        "videos in two world frames",
        "positions cannot be compared",
        "ValueError that names the frames",
        lambda: given([*videos(LATE[:3]), replace(video(LATE[3]), frame="other")]),
        (REFUSED,),
        "expected one world frame",
    ),
)
