"""Hard cases without a common frame: every video lives in a rotation, translation and scale of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from ...simulate import simulate
from ...types import Offsets, Similarity, TrackSet
from .case import FLAGGED, RIGHT, SOUND, Case

LATE = (0.0, 0.4, -0.3)
"""Seconds that the videos start later than the first."""

FRAME, TURN, SCALE = 1 / 30, 6.0, 0.09
"""Seconds, degrees and share of the scale (or four sigmas, where more) beyond which a trusted answer is wrong."""

LARGER = 1000.0
"""How many times as large as in metres a video in millimetres is."""

Given = tuple[list[TrackSet], None]


@cache
def world(motion: str = "softball", preset: str = "clean", videos: int = 2, seed: int = 21) -> tuple[Any, Any]:
    """(track sets, truth) of one simulated scene."""
    late = LATE[:videos]
    return simulate(motion, preset=preset, videos=videos, offsets=late, own_frames=True, seed=seed)


def seen(*, of: Callable[[TrackSet], TrackSet] = lambda t: t, both: bool = False, **how: Any) -> Callable[[], Given]:
    """The world with the last video, or with every video, passed through a function."""

    def made() -> Given:
        tracks = list(world(**how)[0])
        return [of(t) if both or t is tracks[-1] else t for t in tracks], None

    return made


def right(larger: float = 1.0, **how: Any) -> Callable[[Offsets], np.ndarray]:
    """Which videos have their offset, their rotation and their scale; the last video is so many times as large."""

    def check(found: Offsets) -> np.ndarray:
        truth = world(**how)[1]
        ok = []
        size = np.r_[np.ones(len(found) - 1), larger]
        for v, S in enumerate(found.transforms):
            true: Similarity = truth.transform(found.reference, v)
            late = LATE[v] - LATE[found.reference]
            ok.append(
                S is not None
                and abs(found.seconds[v] - late) <= FRAME
                and S.degrees_from(true) <= max(TURN, 4 * S.rotation_sigma)
                and abs(np.log(S.scale * size[v] / size[found.reference] / true.scale)) <= max(SCALE, 4 * S.scale_sigma)
            )
        return np.array(ok)

    return check


def noisy_features(t: TrackSet) -> TrackSet:
    assert t.features is not None
    return replace(t, features=np.random.default_rng(len(t)).normal(size=t.features.shape))


def enlarged(t: TrackSet) -> TrackSet:
    return replace(t, xyz=LARGER * t.positions())


def mirrored(t: TrackSet) -> TrackSet:
    return replace(t, xyz=t.positions() * [1, 1, -1])


def flat(t: TrackSet) -> TrackSet:
    """Without what stands out of the plane that fits best: the other side looks the same."""
    x = t.positions()
    points = x[np.isfinite(x).all(-1)]
    middle = points.mean(0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    return replace(t, xyz=x - ((x - middle) @ normal)[..., None] * normal)


def holes(t: TrackSet) -> TrackSet:
    """Half of the samples are not seen."""
    hidden = np.random.default_rng(len(t)).random(t.seen.shape) < 0.5
    return replace(t, visible=t.seen & ~hidden)


def some(n: int) -> Callable[[TrackSet], TrackSet]:
    return lambda t: t.take(np.sort(np.random.default_rng(1).permutation(len(t))[:n]))


def outliers(t: TrackSet) -> TrackSet:
    """A third of the tracks go where tracks of a second scene go, and look like those."""
    other = world(motion="boxes")[0][1]
    n = len(t) // 2
    x, y = t.positions(), other.positions()[:n]
    frames = min(x.shape[1], y.shape[1])
    assert t.features is not None and other.features is not None
    return TrackSet(
        np.concatenate([x[:, :frames], y[:, :frames]]),
        features=np.concatenate([t.features, other.features[:n]]),
        fps=t.fps,
        frame=t.frame,
        name=t.name,
    )


def part(t: TrackSet, first: int, last: int) -> TrackSet:
    """Frames first..last alone."""
    assert t.uv is not None
    return replace(t, xyz=t.positions()[:, first:last], uv=t.uv[:, first:last], visible=t.seen[:, first:last])


CASES: tuple[Case, ...] = (
    Case(
        "two videos, frames of their own",
        "no position can be compared",
        "clock and pose from motion and structure",
        seen(),
        (RIGHT,),
        check=right(),
        clean=True,
    ),
    Case(
        "three videos, frames of their own",
        "no position can be compared",
        "averaged over the cycle",
        seen(videos=3),
        (RIGHT,),
        check=right(videos=3),
    ),
    Case(
        "one video in millimetres",
        "a thousand times as large",
        "scale is found, not assumed",
        seen(of=enlarged),
        (RIGHT,),
        check=right(larger=LARGER),
    ),
    Case(
        "noisy tracks of one preset harder",
        "noise, outliers, other points of the surface",
        "right, or flagged",
        seen(preset="hard"),
        SOUND,
        check=right(preset="hard"),
    ),
    Case(
        "noise for features, own frames",
        "only structure and motion can tell",
        "right, or flagged",
        seen(of=noisy_features, both=True),
        SOUND,
        check=right(),
    ),
    Case(
        "no features, own frames",
        "only structure and motion can tell",
        "right, flagged or refused",
        seen(of=lambda t: replace(t, features=None), both=True),
        SOUND,
        check=right(),
    ),
    Case(
        "half of the samples missing, own frames",
        "distances within a video are of few common frames",
        "right, or flagged",
        seen(of=holes, both=True),
        SOUND,
        check=right(),
    ),
    Case(
        "a second scene in one video, own frames",
        "a third of the tracks belong to nothing in the other video",
        "right, or flagged",
        seen(of=outliers),
        SOUND,
        check=right(),
    ),
    Case(
        "twelve tracks, own frames",
        "few of them are the same in both videos",
        "right, or flagged",
        seen(of=some(12), both=True),
        SOUND,
        check=right(),
    ),
    Case(
        "a mirrored video, own frames",
        "its reader has the wrong handedness: no rotation fits",
        "flagged",
        seen(of=mirrored),
        (FLAGGED,),
    ),
    Case(
        "a flat scene, own frames",
        "the plane turned over fits as well",
        "right, or flagged",
        seen(of=flat, both=True),
        SOUND,
        check=right(),
    ),
    Case(
        "nothing moves, own frames",
        "structure fits at every time",
        "flagged",
        seen(motion="static"),
        (FLAGGED,),
    ),
    Case(
        "two scenes, own frames",
        "some pose and some time fit best",
        "flagged",
        lambda: ([world()[0][0], world(motion="football")[0][1]], None),
        (FLAGGED,),
    ),
    Case(
        "no frame in common, own frames",
        "the second clip begins after the first one ends",
        "flagged",
        lambda: ([part(world()[0][0], 0, 70), part(world()[0][1], 90, 150)], None),
        (FLAGGED,),
    ),
    Case(
        "periodic motion, own frames",
        "every period fits",
        "right, or flagged",
        seen(motion="juggle"),
        SOUND,
        check=right(motion="juggle"),
    ),
    Case(
        "like people, own frames",
        "each fits each, turned and later",
        "right, or flagged",
        seen(motion="unison"),
        SOUND,
        check=right(motion="unison"),
    ),
)
