"""Hard cases of aligners and refiners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...types import Matches, TrackSet
from .case import FLAGGED, REFUSED, RIGHT, SOUND, Case, cloud, near

N = 30
ALL = Matches(np.stack([np.arange(N)] * 2, 1))


def videos(frames: int = 120, late: int = 10, of=lambda x: x) -> tuple[TrackSet, TrackSet, Matches]:
    """b is a, ``late`` frames later: offset late / 30 s."""
    xyz = of(cloud(N, frames + late, 4))
    rng = np.random.default_rng(8)
    a, b = (TrackSet(x + 1e-3 * rng.normal(size=x.shape), fps=30) for x in (xyz[:, :frames], xyz[:, late:]))
    return a, b, ALL


def edited(**fields):
    def make() -> tuple[TrackSet, TrackSet, Matches]:
        a, b, m = videos()
        return a, replace(b, **{k: f(b) for k, f in fields.items()}), m

    return make


def matched(m: Matches):
    return lambda: (*videos()[:2], m)


def alternating() -> tuple[TrackSet, TrackSet, Matches]:
    a, b, m = videos()
    odd = np.zeros(a.seen.shape, bool)
    odd[: N // 2] = True
    return replace(a, visible=odd), replace(b, visible=~odd), m


def gaps(share: float):
    def make() -> tuple[TrackSet, TrackSet, Matches]:
        rng = np.random.default_rng(13)
        a, b, m = videos()
        return (
            replace(a, visible=rng.random(a.seen.shape) > share),
            replace(b, visible=rng.random(b.seen.shape) > share),
            m,
        )

    return make


def strangers() -> tuple[TrackSet, TrackSet, Matches]:
    """Two scenes, matched by number."""
    return videos()[0], TrackSet(cloud(N, 120, 31), fps=30), ALL


def wrong(share: float, n: int = 100):
    """``share`` of the matches join strangers."""

    def make() -> tuple[TrackSet, TrackSet, Matches]:
        rng = np.random.default_rng(14)
        xyz = cloud(n, 130, 4)
        a, b = (TrackSet(x + 1e-3 * rng.normal(size=x.shape), fps=30) for x in (xyz[:, :120], xyz[:, 10:]))
        j, bad = np.arange(n), rng.permutation(n)[: round(share * n)]
        j[bad] = np.roll(bad, 1)
        return a, b, Matches(np.stack([np.arange(n), j], 1))

    return make


def rated(rate: float, frames: int = 120, late: float = 10.0):
    """b's clock runs by ``rate`` while it says 30 frames a second."""

    def make() -> tuple[TrackSet, TrackSet, Matches]:
        from scipy.interpolate import CubicSpline

        xyz = cloud(N, 2 * frames + 60, 4)
        rng = np.random.default_rng(15)
        moved = CubicSpline(np.arange(xyz.shape[1]), xyz, axis=1)
        b = moved(late + rate * np.arange(frames))
        a, b = (x + 1e-3 * rng.normal(size=x.shape) for x in (xyz[:, :frames], b))
        return TrackSet(a, fps=30), TrackSet(b, fps=30), ALL

    return make


CASES: tuple[Case, ...] = (
    Case(
        "flat costs",
        "nothing moves: every shift is as good",
        "flagged: static",
        lambda: videos(of=lambda x: x[:, :1].repeat(130, 1)),
        (FLAGGED,),
    ),
    Case(
        "constant tracks, exactly",
        "variances are zero",
        "flagged",
        lambda: (*(TrackSet(np.ones((N, 100, 3)), fps=30) for _ in range(2)), ALL),
        (FLAGGED,),
    ),
    Case(
        "one match",
        "errors up to 42 frames",
        "flagged: few matches",
        matched(Matches(np.array([[3, 3]]))),
        (FLAGGED, RIGHT),
        check=near(1 / 3),
    ),
    Case(
        "no match at all",
        "empty means",
        "flagged, nan offset",
        matched(Matches(np.zeros((0, 2), int))),
        (FLAGGED,),
    ),
    Case(
        "matches never seen together",
        "every cell of the cost is empty",
        "flagged, nan offset",
        alternating,
        (FLAGGED,),
    ),
    Case(
        "nothing seen in b",
        "no sample",
        "flagged, nan offset",
        edited(visible=lambda b: np.zeros_like(b.seen)),
        (FLAGGED,),
    ),
    Case(
        "huge offset, no overlap",
        "there is no right answer",
        "flagged",
        lambda: (videos()[0], TrackSet(cloud(N, 120, 99), fps=30), ALL),
        (FLAGGED,),
    ),
    Case(
        "ten frames in common",
        "a short overlap fits anything",
        "right, or flagged",
        lambda: videos(120, 110),
        (FLAGGED, RIGHT),
        check=near(110 / 30),
    ),
    Case(
        "clips of two frames",
        "no velocity, no window",
        "flagged or refused",
        lambda: videos(2, 0),
        SOUND,
        check=near(0.0, 0.1),
    ),
    Case(
        "a clip of one frame",
        "no rate, no motion",
        "flagged or refused",
        lambda: videos(1, 0),
        SOUND,
        check=near(0.0, 0.1),
    ),
    Case(
        "duplicated timestamps",
        "time does not advance",
        "ValueError that names both frames",
        lambda: (videos()[0], TrackSet(videos()[1].xyz, timestamps=np.r_[0, 0, np.arange(1, 119)] / 30), ALL),
        (REFUSED,),
        "strictly increasing",
    ),
    Case(
        "timestamps that go back",
        "sorted by decoding order",
        "ValueError that names both frames",
        lambda: (videos()[0], TrackSet(videos()[1].xyz, timestamps=np.r_[1, 0, np.arange(2, 120)] / 30), ALL),
        (REFUSED,),
        "strictly increasing",
    ),
    Case(
        "matches beyond the tracks",
        "a and b swapped",
        "ValueError that asks whether a and b are swapped",
        matched(Matches(np.array([[0, N]]))),
        (REFUSED,),
        "expected indices of b below",
    ),
    Case(
        "nan in a visible sample, aligning",
        "it spreads over the cost",
        "ValueError with track and frame",
        edited(xyz=lambda b: np.where(np.arange(120)[None, :, None] == 5, np.nan, b.xyz)),
        (REFUSED,),
        "finite values in visible",
    ),
    Case(
        "25 against 30 frames a second",
        "frame i is not frame i",
        "common clock first",
        lambda: (videos()[0], TrackSet(videos(144)[1].xyz[:, ::6].repeat(1, 1), fps=5), ALL),
        SOUND,
        check=near(1 / 3, 0.1),
    ),
    Case(
        "unit of length x 1e6",
        "absolute thresholds",
        "no unit enters",
        lambda: tuple(replace(x, xyz=x.xyz * 1e6) if isinstance(x, TrackSet) else x for x in videos()),
        (RIGHT,),
        check=near(1 / 3, 0.1),
    ),
    Case(
        "unit of length x 1e-6",
        "absolute thresholds",
        "no unit enters",
        lambda: tuple(replace(x, xyz=x.xyz * 1e-6) if isinstance(x, TrackSet) else x for x in videos()),
        (RIGHT,),
        check=near(1 / 3, 0.1),
    ),
    Case(
        "one track a thousand scenes away",
        "it outweighs all others",
        "logarithms and weights bound it",
        edited(
            xyz=lambda b: b.xyz + 1e3 * (np.arange(N) == 0)[:, None, None] * np.sin(np.arange(120.0))[None, :, None]
        ),
        (RIGHT, FLAGGED),
        check=near(1 / 3, 0.1),
    ),
    Case(
        "half of the matches wrong",
        "they vote for other offsets",
        "wrong matches cannot veto",
        matched(Matches(np.stack([np.arange(N), np.r_[np.arange(N // 2), np.roll(np.arange(N // 2, N), 3)]], 1))),
        (RIGHT, FLAGGED),
        check=near(1 / 3, 0.05),
    ),
    Case(
        "strictly periodic motion",
        "every period is as good",
        "flagged: ambiguous, or right",
        lambda: videos(
            120, 10, lambda x: x[:, :1] + np.sin(2 * np.pi * np.arange(130) / 20)[None, :, None] * x[:, 1:2]
        ),
        (FLAGGED, RIGHT),
        check=near(1 / 3, 0.05),
    ),
    Case(
        "b ten frames later",
        "nothing: the usual case",
        "the right shift",
        videos,
        (RIGHT,),
        check=near(1 / 3),
        clean=True,
    ),
    Case(
        "b thirty frames later",
        "corner to corner a path pays for every frame that is in one video only",
        "the right shift, or flagged",
        lambda: videos(120, 30),
        (RIGHT, FLAGGED),
        check=near(1.0),
        clean=True,
    ),
    Case(
        "two matches",
        "errors up to 42 frames",
        "right, or flagged",
        matched(Matches(np.array([[3, 3], [5, 5]]))),
        SOUND,
        check=near(1 / 3),
    ),
    Case(
        "three matches, one wrong",
        "little to vote by",
        "right, or flagged",
        matched(Matches(np.array([[3, 3], [5, 5], [7, 9]]))),
        SOUND,
        check=near(1 / 3),
    ),
    Case(
        "all matches are one pair",
        "a vote counted thirty times",
        "right, or flagged",
        matched(Matches(np.array([[3, 3]] * N))),
        SOUND,
        check=near(1 / 3),
    ),
    Case("unrelated videos, aligning", "some shift is always the best", "flagged", strangers, (FLAGGED,)),
    Case(
        "80 % of the matches wrong",
        "four of five vote for other offsets",
        "wrong matches cannot veto",
        wrong(0.8),
        SOUND,
        check=near(1 / 3),
    ),
    Case("all matches wrong", "nothing votes for the right offset", "flagged", wrong(1.0), (FLAGGED,)),
    Case(
        "half of the samples missing, aligning",
        "other tracks in every frame",
        "common samples only",
        gaps(0.5),
        SOUND,
        check=near(1 / 3),
    ),
    Case(
        "90 % of the samples missing, aligning",
        "hardly a window without a gap",
        "right, or flagged",
        gaps(0.9),
        SOUND,
        check=near(1 / 3),
    ),
    Case(
        "clips of 40 frames",
        "a short overlap fits anything",
        "right, or flagged",
        lambda: videos(40, 6),
        SOUND,
        check=near(0.2),
    ),
    Case(
        "periodic motion, short overlap",
        "a period later fits the rest of the clip",
        "right, or flagged",
        lambda: videos(
            90, 50, lambda x: x[:, :1] + np.sin(2 * np.pi * np.arange(x.shape[1]) / 24)[None, :, None] * x[:, 1:2]
        ),
        SOUND,
        check=near(50 / 30),
    ),
    Case(
        "planar motion, aligning",
        "one coordinate says nothing",
        "two are enough",
        lambda: videos(of=lambda x: x * [1, 1, 0]),
        (RIGHT, FLAGGED),
        check=near(1 / 3),
    ),
    Case(
        "motion along a line",
        "two coordinates say nothing",
        "right, or flagged",
        lambda: videos(of=lambda x: x * [1, 0, 0]),
        SOUND,
        check=near(1 / 3),
    ),
    Case(
        "one thing moves, 29 rest",
        "most matches say nothing",
        "right, or flagged",
        lambda: videos(of=lambda x: np.where(np.arange(len(x))[:, None, None] == 0, x, x[:, :1])),
        SOUND,
        check=near(1 / 3),
    ),
    Case(
        "all move as one",
        "thirty matches tell what one tells",
        "right, or flagged",
        lambda: videos(of=lambda x: x[:, :1] + (x[:1] - x[:1, :1])),
        SOUND,
        check=near(1 / 3),
    ),
    Case(
        "a mirrored scene, aligning",
        "a reader with the wrong handedness: one coordinate moves the other way",
        "right by the others, or flagged",
        edited(xyz=lambda b: b.xyz * [1, 1, -1]),
        SOUND,
        check=near(1 / 3),
    ),
    Case(
        "24 declared as 30 frames a second",
        "no one offset suits the whole clip",
        "flagged",
        rated(30 / 24),
        SOUND,
        check=near(1 / 3, 0.1),
    ),
    Case(
        "one frame of a hundred and fifty dropped in b",
        "everything behind it is a frame early",
        "within a frame, or flagged",
        edited(xyz=lambda b: np.concatenate([b.xyz[:, :60], b.xyz[:, 61:], b.xyz[:, -1:]], 1)),
        SOUND,
        check=near(1 / 3),
    ),
    *(
        Case(
            f"unit of length x {u:g}",
            "squares leave the range of floats",
            "no unit enters",
            lambda u=u: tuple(replace(x, xyz=x.xyz * u) if isinstance(x, TrackSet) else x for x in videos()),
            (RIGHT, FLAGGED),
            check=near(1 / 3),
        )
        for u in (1e-160, 1e160)
    ),
    Case(
        "single precision, far origin",
        "differences of large numbers",
        "right, or flagged",
        lambda: tuple(
            replace(x, xyz=(x.xyz + 1e3).astype(np.float32)) if isinstance(x, TrackSet) else x for x in videos()
        ),
        SOUND,
        check=near(1 / 3),
    ),
    Case(
        "uneven timestamps",
        "a variable frame rate",
        "splines on an even clock",
        lambda: (
            videos()[0],
            TrackSet(videos()[1].xyz, timestamps=np.arange(120) / 30 + np.r_[0, np.full(119, 1 / 90)]),
            ALL,
        ),
        SOUND,
        check=near(1 / 3),
    ),
)
