"""Hard cases of aligners and refiners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...types import Matches, TrackSet
from .case import FLAGGED, REFUSED, RIGHT, SOUND, Case, cloud, near

N = 30
ALL = Matches(np.stack([np.arange(N)] * 2, 1))
SHORT = {"DTW": "the paper's method has no flags for this", "ConstantShift": "a rival without flags"}


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


CASES: tuple[Case, ...] = (
    Case(
        "flat costs",
        "nothing moves: every shift is as good",
        "offset 0, confident",
        "flagged: static",
        lambda: videos(of=lambda x: x[:, :1].repeat(130, 1)),
        (FLAGGED,),
        limits=SHORT,
    ),
    Case(
        "constant tracks, exactly",
        "variances are zero",
        "offset 0, confident",
        "flagged",
        lambda: (*(TrackSet(np.ones((N, 100, 3)), fps=30) for _ in range(2)), ALL),
        (FLAGGED,),
        limits=SHORT,
    ),
    Case(
        "one match",
        "errors up to 42 frames",
        "confident",
        "flagged: few matches",
        matched(Matches(np.array([[3, 3]]))),
        (FLAGGED, RIGHT),
        check=near(1 / 3),
    ),
    Case(
        "no match at all",
        "empty means",
        "nan or an exception",
        "flagged, nan offset",
        matched(Matches(np.zeros((0, 2), int))),
        (FLAGGED,),
    ),
    Case(
        "matches never seen together",
        "every cell of the cost is empty",
        "zeros taken for positions",
        "flagged, nan offset",
        alternating,
        (FLAGGED,),
    ),
    Case(
        "nothing seen in b",
        "no sample",
        "zeros taken for positions",
        "flagged, nan offset",
        edited(visible=lambda b: np.zeros_like(b.seen)),
        (FLAGGED,),
    ),
    Case(
        "huge offset, no overlap",
        "there is no right answer",
        "some offset, confident",
        "flagged",
        lambda: (videos()[0], TrackSet(cloud(N, 120, 99), fps=30), ALL),
        (FLAGGED,),
        limits=SHORT,
    ),
    Case(
        "ten frames in common",
        "a short overlap fits anything",
        "corner to corner: offset 0",
        "right, or flagged",
        lambda: videos(120, 110),
        (FLAGGED, RIGHT),
        check=near(110 / 30),
        limits=SHORT
        | {"LikelihoodScan": "the overlap is below its least one; quasi-periodic motion looks sure elsewhere"},
    ),
    Case(
        "clips of two frames",
        "no velocity, no window",
        "an index error",
        "flagged or refused",
        lambda: videos(2, 0),
        SOUND,
        check=near(0.0, 0.1),
        limits=SHORT,
    ),
    Case(
        "a clip of one frame",
        "no rate, no motion",
        "an index error",
        "flagged or refused",
        lambda: videos(1, 0),
        SOUND,
        check=near(0.0, 0.1),
        limits=SHORT,
    ),
    Case(
        "duplicated timestamps",
        "time does not advance",
        "division by zero",
        "ValueError that names both frames",
        lambda: (videos()[0], TrackSet(videos()[1].xyz, timestamps=np.r_[0, 0, np.arange(1, 119)] / 30), ALL),
        (REFUSED,),
        "strictly increasing",
    ),
    Case(
        "timestamps that go back",
        "sorted by decoding order",
        "a curve with a loop",
        "ValueError that names both frames",
        lambda: (videos()[0], TrackSet(videos()[1].xyz, timestamps=np.r_[1, 0, np.arange(2, 120)] / 30), ALL),
        (REFUSED,),
        "strictly increasing",
    ),
    Case(
        "matches beyond the tracks",
        "a and b swapped",
        "an index error, or negative wrap",
        "ValueError that asks whether a and b are swapped",
        matched(Matches(np.array([[0, N]]))),
        (REFUSED,),
        "expected indices of b below",
    ),
    Case(
        "nan in a visible sample",
        "it spreads over the cost",
        "nan offset",
        "ValueError with track and frame",
        edited(xyz=lambda b: np.where(np.arange(120)[None, :, None] == 5, np.nan, b.xyz)),
        (REFUSED,),
        "finite values in visible",
    ),
    Case(
        "25 against 30 frames a second",
        "frame i is not frame i",
        "a drift",
        "common clock first",
        lambda: (videos()[0], TrackSet(videos(144)[1].xyz[:, ::6].repeat(1, 1), fps=5), ALL),
        SOUND,
        check=near(1 / 3, 0.1),
        limits=SHORT,
    ),
    Case(
        "unit of length x 1e6",
        "absolute thresholds",
        "other answers",
        "no unit enters",
        lambda: tuple(replace(x, xyz=x.xyz * 1e6) if isinstance(x, TrackSet) else x for x in videos()),
        (RIGHT,),
        check=near(1 / 3, 0.1),
        limits=SHORT,
    ),
    Case(
        "unit of length x 1e-6",
        "absolute thresholds",
        "other answers",
        "no unit enters",
        lambda: tuple(replace(x, xyz=x.xyz * 1e-6) if isinstance(x, TrackSet) else x for x in videos()),
        (RIGHT,),
        check=near(1 / 3, 0.1),
        limits=SHORT,
    ),
    Case(
        "one track a thousand scenes away",
        "it outweighs all others",
        "pulled",
        "logarithms and weights bound it",
        edited(
            xyz=lambda b: b.xyz + 1e3 * (np.arange(N) == 0)[:, None, None] * np.sin(np.arange(120.0))[None, :, None]
        ),
        (RIGHT, FLAGGED),
        check=near(1 / 3, 0.1),
        limits=SHORT,
    ),
    Case(
        "half of the matches wrong",
        "they vote for other offsets",
        "pulled",
        "wrong matches cannot veto",
        matched(Matches(np.stack([np.arange(N), np.r_[np.arange(N // 2), np.roll(np.arange(N // 2, N), 3)]], 1))),
        (RIGHT, FLAGGED),
        check=near(1 / 3, 0.05),
        limits=SHORT,
    ),
    Case(
        "strictly periodic motion",
        "every period is as good",
        "the one nearest the diagonal",
        "flagged: ambiguous, or right",
        lambda: videos(
            120, 10, lambda x: x[:, :1] + np.sin(2 * np.pi * np.arange(130) / 20)[None, :, None] * x[:, 1:2]
        ),
        (FLAGGED, RIGHT),
        check=near(1 / 3, 0.05),
        limits=SHORT,
    ),
)
