"""Hard cases of matching once more at known times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...types import Clock, TrackSet
from .case import FLAGGED, REFUSED, RIGHT, SOUND, Case, cloud, few_right, mostly_identity

LATE = 20
"""Frames that b starts later than a."""

Pair = tuple[TrackSet, TrackSet, Clock]
identity = mostly_identity()


def pair(n: int = 80, frames: int = 90, seed: int = 0, noise: float = 0.3, late: int = LATE) -> Pair:
    """Two videos in one declared world frame; track k of a is track k of b, seen ``late`` frames later."""
    rng = np.random.default_rng(seed + 2000)
    xyz, features = cloud(n, frames + late, seed + 40), rng.normal(size=(n, 24))

    def seen(x: np.ndarray) -> TrackSet:
        wobble = noise * rng.normal(size=features.shape)
        moved = x + 0.01 * rng.normal(size=x.shape)
        return TrackSet(moved, features=features + wobble, fps=30, frame="world")

    return seen(xyz[:, :frames]), seen(xyz[:, late:]), Clock(late / 30)


def changed(**fields: Callable) -> Callable[[], Pair]:
    """The pair with fields of b passed through functions."""

    def made() -> Pair:
        a, b, clock = pair()
        return a, replace(b, **{k: f(getattr(b, k)) for k, f in fields.items()}), clock

    return made


def both(**fields: Callable) -> Callable[[], Pair]:
    """The pair with fields of both sets passed through functions."""

    def made() -> Pair:
        a, b, clock = pair()
        a, b = (replace(x, **{k: f(getattr(x, k)) for k, f in fields.items()}) for x in (a, b))
        return a, b, clock

    return made


def like_objects(frame: str | None) -> Callable[[], Pair]:
    """An object and its copy, turned by half a turn about the middle: features and structure cannot tell them apart."""

    def made() -> Pair:
        rng = np.random.default_rng(6)
        half = 0.3 * cloud(50, 90 + LATE, 6) + [1.0, 0, 0]
        xyz, features = np.concatenate([half, half * [-1, -1, 1]]), np.tile(rng.normal(size=(50, 16)), (2, 1))

        def video(x: np.ndarray) -> TrackSet:
            looks = features + 0.1 * rng.normal(size=features.shape)
            return TrackSet(x + 0.005 * rng.normal(size=x.shape), features=looks, fps=30, frame=frame)

        return video(xyz[:, :90]), video(xyz[:, LATE:]), Clock(LATE / 30)

    return made


def gaps(share: float) -> Callable[[], Pair]:
    def made() -> Pair:
        rng = np.random.default_rng(12)
        a, b, clock = pair()
        a, b = (replace(x, visible=rng.random(x.seen.shape) > share) for x in (a, b))
        return a, b, clock

    return made


def sized(n_a: int, n_b: int) -> Callable[[], Pair]:
    def made() -> Pair:
        a, b, clock = pair(max(n_a, n_b))
        return a.take(slice(0, n_a)), b.take(slice(0, n_b)), clock

    return made


def unrelated() -> Pair:
    return pair(seed=1)[0], pair(seed=2)[1], Clock(LATE / 30)


def few_in_common() -> Pair:
    """A tenth of the tracks are in both videos."""
    a, b, clock = pair(200)
    other = pair(200, seed=9)[1]
    own = np.arange(200) < 20
    return (
        a,
        replace(
            b,
            xyz=np.where(own[:, None, None], b.xyz, other.xyz),
            features=np.where(own[:, None], b.features, other.features),
        ),
        clock,
    )


CASES: tuple[Case, ...] = (
    Case(
        "one frame, synchronised",
        "nothing: the usual case",
        "places, motion and features agree",
        pair,
        (RIGHT,),
        check=identity,
        clean=True,
    ),
    Case(
        "two like objects exchanged, one world frame",
        "features cannot tell the copies apart",
        "places at equal times can",
        like_objects("world"),
        (RIGHT,),
        check=identity,
    ),
    Case(
        "two like objects exchanged, no frame declared",
        "places do not count",
        "motion tells the copies apart, or flagged",
        like_objects(None),
        SOUND,
        check=identity,
    ),
    Case(
        "mirrored scene, one world frame",
        "a reader with the wrong handedness",
        "nothing is at the same place at the same time: flagged",
        changed(xyz=lambda x: x * [1, 1, -1]),
        (FLAGGED,),
    ),
    Case(
        "mirrored scene, no frame declared",
        "features agree, places do not count",
        "chirality: flagged",
        lambda: tuple(
            replace(x, xyz=x.xyz * [1, 1, s], frame=None) if isinstance(x, TrackSet) else x
            for x, s in zip(pair(), (1, -1, 1), strict=True)
        ),
        (FLAGGED, REFUSED),
    ),
    Case(
        "mirrored scene, features equal",
        "only motion is left, and it is mirrored",
        "flagged",
        lambda: tuple(
            replace(x, xyz=x.xyz * [1, 1, s], features=np.ones((80, 2))) if isinstance(x, TrackSet) else x
            for x, s in zip(pair(), (1, -1, 1), strict=True)
        ),
        (FLAGGED,),
    ),
    Case(
        "unrelated videos, at a clock",
        "there is always a nearest neighbour",
        "features of the better half hardly beat chance: flagged",
        unrelated,
        (FLAGGED,),
    ),
    Case(
        "a clock that is a second wrong",
        "everything is compared with what was there a second ago",
        "features decide, or flagged",
        lambda: (*pair()[:2], Clock(LATE / 30 + 1)),
        SOUND,
        check=identity,
    ),
    Case(
        "a clock without common frames",
        "no moment is in both",
        "flagged",
        lambda: (*pair()[:2], Clock(60.0)),
        SOUND,
        check=identity,
    ),
    Case(
        "a clock with 4 frames in common",
        "fewer moments than a distance needs",
        "features decide, or flagged",
        lambda: pair(late=86),
        SOUND,
        check=identity,
    ),
    Case(
        "half of the samples missing, at equal times",
        "other frames are missing in either video",
        "moments that both see",
        gaps(0.5),
        (RIGHT, FLAGGED),
        check=identity,
    ),
    Case(
        "90 % of the samples missing, at equal times",
        "a moment in a hundred is in both",
        "features decide, or flagged",
        gaps(0.9),
        SOUND,
        check=identity,
    ),
    Case(
        "static scene, at equal times",
        "no motion to compare",
        "places are enough",
        both(xyz=lambda x: x[:, :1].repeat(90, 1)),
        SOUND,
        check=identity,
    ),
    Case(
        "all features equal, one world frame",
        "only places and motion tell",
        "they are enough",
        both(features=lambda f: np.ones_like(f)),
        (RIGHT, FLAGGED),
        check=identity,
    ),
    Case(
        "every track twice, at equal times",
        "equal rows",
        "twins may be exchanged",
        lambda: tuple(x.take(np.repeat(np.arange(50), 2)) if isinstance(x, TrackSet) else x for x in pair(50)),
        (RIGHT,),
        check=mostly_identity(of=lambda k: k // 2),
    ),
    Case("one track each, at equal times", "no evidence", "flagged", sized(1, 1), SOUND, check=few_right(1)),
    Case("three tracks each, at equal times", "little evidence", "right, or flagged", sized(3, 3), check=few_right(3)),
    Case(
        "300 against 15, at equal times",
        "most of a is in nothing of b",
        "what is near at equal times",
        sized(300, 15),
        SOUND,
        check=mostly_identity(0.9, 8),
    ),
    Case(
        "a tenth of the tracks in common",
        "nine of ten nearest neighbours are wrong",
        "the best matches are right, or flagged",
        few_in_common,
        SOUND,
        check=mostly_identity(0.9, 15),
    ),
    *(
        Case(
            f"unit of length x {u:g}, at equal times",
            "distances at equal times have a unit",
            "the scene's own size is the unit",
            both(xyz=lambda x, u=u: x * u),
            (RIGHT,),
            check=identity,
        )
        for u in (1e-30, 1e-6, 1e6, 1e30)
    ),
    Case(
        "single precision, far origin, at equal times",
        "differences of large numbers",
        "double precision before differences",
        both(xyz=lambda x: (x + 1e3).astype(np.float32)),
        (RIGHT,),
        check=identity,
    ),
    Case(
        "nan in a visible sample, at equal times",
        "nan spreads over the splines",
        "ValueError with track and frame",
        lambda: (
            pair()[0],
            replace(pair()[1], xyz=np.where(np.arange(90)[None, :, None] == 7, np.nan, pair()[1].xyz)),
            pair()[2],
        ),
        (REFUSED,),
        "finite values in visible",
    ),
)
