"""Hard cases of the depth-free scan and its refinement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...types import Alignment, Camera, Matches, TrackSet
from .case import FLAGGED, REFUSED, RIGHT, SOUND, Case, near

N, FRAMES, LATE = 40, 150, 15
K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
Given = tuple[TrackSet, TrackSet, Matches]


def camera(azimuth: float, distance: float = 6.0, height: float = -1.0) -> Camera:
    """Looks at the middle of the scene from a circle, y down; degrees."""
    angle = np.radians(azimuth)
    centre = np.array([distance * np.sin(angle), height, -distance * np.cos(angle)])
    forward = -centre / np.linalg.norm(centre)
    right = np.cross([0, 1.0, 0], forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = R, -R @ centre
    return Camera(K, w2c, 640, 480)


def shifted(x: float, y: float = 0.0, z: float = -6.0) -> Camera:
    """Looks along z from (x, y, z): cameras of a stereo rig."""
    w2c = np.eye(4)
    w2c[:3, 3] = -np.array([x, y, z])
    return Camera(K, w2c, 640, 480)


def wander(n: int, frames: int, seed: int) -> np.ndarray:
    """(n, frames, 3) smooth paths through the middle of the scene; no two share a frequency, so none comes back."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / 30
    out = 0.6 * rng.normal(size=(n, 1, 3))
    for _ in range(3):
        turn = 2 * np.pi * rng.uniform(0.2, 1.4, (n, 1, 3)) * t[None, :, None] + rng.uniform(0, 6.3, (n, 1, 3))
        out = out + 0.1 * rng.normal(size=(n, 1, 3)) * np.sin(turn)
    return out


def filmed(eye: Camera, xyz: np.ndarray, rng: np.random.Generator, jitter: float = 0.3, **more) -> TrackSet:
    """Pixels with ``jitter`` pixels of noise."""
    uv = eye.project(xyz)
    return TrackSet(None, uv=uv + jitter * rng.normal(size=uv.shape), camera=eye, fps=30, frame="world", **more)


def videos(
    of: Callable[[np.ndarray], np.ndarray] = lambda x: x,
    a: Camera | None = None,
    b: Camera | None = None,
    *,
    frames: int = FRAMES,
    late: int = LATE,
    n: int = N,
    seed: int = 0,
    jitter: float = 0.3,
) -> Given:
    """Two views of ``of`` a moving cloud; b starts ``late`` frames later; every track has its own and a wrong partner.

    The scan takes candidates: a track's own partner and another one.
    """
    rng = np.random.default_rng(seed + 50)
    xyz = of(wander(n, frames + late, seed + 60))
    n = len(xyz)
    left = filmed(camera(0) if a is None else a, xyz[:, :frames], rng, jitter)
    right = filmed(camera(50) if b is None else b, xyz[:, late:], rng, jitter)
    k = np.arange(n)
    pairs = np.concatenate([np.stack([k, k], 1), np.stack([k, (k + 7) % n], 1)]) if n > 7 else np.stack([k, k], 1)
    return left, right, Matches(pairs)


def with_matches(pairs: np.ndarray) -> Callable[[], Given]:
    return lambda: (*videos()[:2], Matches(pairs))


def wrong(share: float) -> Given:
    """``share`` of the matched pairs join strangers, and nothing else is offered."""
    rng = np.random.default_rng(4)
    a, b, _ = videos(n=80)
    k = np.arange(80)
    bad = rng.permutation(80)[: round(share * 80)]
    j = k.copy()
    j[bad] = np.roll(bad, 1)
    return a, b, Matches(np.stack([k, j], 1))


def comes_back(hurry: float = 0.1) -> Given:
    """All moves come back after seven seconds, up to ``hurry`` s early or late (rms); the clips, of five seconds each,
    begin seven seconds apart.

    Moves that come back in the very frame have no row: the clips are those of two cameras that filmed at once.
    """
    rng = np.random.default_rng(6)
    t = np.arange(FRAMES) / 30
    pace = hurry * np.sqrt(2) * np.sin(2 * np.pi * 0.25 * t + 0.7)
    place = 0.6 * rng.normal(size=(N, 1, 3))
    moves = [(turns, rng.uniform(0, 6.3, (N, 1, 3)), rng.normal(size=(N, 1, 3))) for turns in (3, 5, 9)]

    def at(t: np.ndarray) -> np.ndarray:
        turn = 2 * np.pi * t[None, :, None] / 7
        return place + sum(0.1 * size * np.sin(turns * turn + phase) for turns, phase, size in moves)

    a, b = filmed(camera(0), at(t), rng), filmed(camera(50), at(t + 7 + pace), rng)
    return a, b, videos()[2]


def apart() -> Given:
    """Two clips without a frame in common."""
    rng = np.random.default_rng(5)
    xyz = wander(N, 2 * FRAMES + 60, 60)
    a, b = filmed(camera(0), xyz[:, :FRAMES], rng), filmed(camera(50), xyz[:, FRAMES + 60 :], rng)
    return a, b, videos()[2]


def strangers() -> Given:
    return videos(seed=1)[0], videos(seed=2)[1], videos()[2]


def along_lines(x: np.ndarray) -> np.ndarray:
    """Every track only moves along the baseline of a stereo rig: along its epipolar line in both images."""
    return np.concatenate([x[..., :1], np.broadcast_to(x[:, :1, 1:], (*x.shape[:2], 2))], 2)


def in_depth(x: np.ndarray) -> np.ndarray:
    """Every track only moves towards the camera and back."""
    return np.concatenate([np.broadcast_to(x[:, :1, :2], (*x.shape[:2], 2)), x[..., 2:]], 2)


def still(x: np.ndarray) -> np.ndarray:
    return x[:, :1].repeat(x.shape[1], 1)


def periodic(x: np.ndarray) -> np.ndarray:
    turn = 2 * np.pi * np.arange(x.shape[1]) / 24
    return x[:, :1] + np.sin(turn)[None, :, None] * 0.3 * x[:, 1:2]


def seen_share(share: float) -> Callable[[], Given]:
    def made() -> Given:
        rng = np.random.default_rng(8)
        a, b, m = videos()
        return *(replace(x, visible=rng.random(x.seen.shape) > share) for x in (a, b)), m

    return made


FRAME = 1 / 30
"""Seconds beyond which an answer without a flag is wrong: the scan answers in whole frames."""


def right(found: Alignment) -> bool:
    """Within half a frame; or within a frame where the answer's own three sigmas say so."""
    return abs(found.offset - LATE / 30) <= min(max(0.5 / 30, 3 * found.sigma), 1 / 30)


CASES: tuple[Case, ...] = (
    Case(
        "two views 50° apart",
        "nothing: the usual case",
        "the right lag stands out",
        videos,
        (RIGHT,),
        check=right,
        clean=True,
    ),
    Case(
        "one camera twice",
        "without a baseline the epipolar geometry is what rounding makes of it",
        "right, since any such geometry holds between equal images; or flagged",
        lambda: videos(b=camera(0)),
        SOUND,
        check=right,
    ),
    Case(
        "two cameras a millimetre apart",
        "the epipolar geometry hangs on the last digits",
        "right, or flagged",
        lambda: videos(a=shifted(0.0), b=shifted(0.001)),
        SOUND,
        check=right,
    ),
    Case(
        "parallel cameras",
        "the epipoles lie at infinity",
        "right",
        lambda: videos(a=shifted(-0.5), b=shifted(0.5)),
        SOUND,
        check=right,
    ),
    Case(
        "motion along the epipolar lines",
        "any shift keeps every point on its line",
        "flagged",
        lambda: videos(along_lines, shifted(-0.5), shifted(0.5)),
        (FLAGGED,),
    ),
    Case(
        "motion towards the camera",
        "it hardly shows in one view, and runs along the lines in the other",
        "right, or flagged",
        lambda: videos(in_depth, shifted(-0.5), shifted(0.5)),
        SOUND,
        check=right,
    ),
    Case(
        "pure forward motion of the camera",
        "the epipole lies within the image",
        "right, or flagged",
        lambda: videos(a=shifted(0, 0, -6), b=shifted(0, 0, -5)),
        SOUND,
        check=right,
    ),
    Case(
        "opposite cameras",
        "each stands in the middle of the other's image",
        "right, or flagged",
        lambda: videos(b=camera(180)),
        SOUND,
        check=right,
    ),
    Case("nothing moves, pixels", "every lag is as good", "flagged", lambda: videos(still), (FLAGGED,)),
    Case(
        "strictly periodic motion, pixels",
        "every period is as good",
        "right, or flagged",
        lambda: videos(periodic),
        SOUND,
        check=right,
    ),
    Case("unrelated videos, pixels", "some lag is always the best", "flagged", strangers, (FLAGGED,)),
    Case("no overlap, pixels", "there is no right answer", "flagged", apart, (FLAGGED,)),
    Case(
        "no overlap, and all motion comes back, pixels",
        "the second clip shows what the first one shows, up to a tenth of a second",
        "flagged",
        comes_back,
        (FLAGGED,),
    ),
    Case(
        "ten frames in common, pixels",
        "fewer than the least overlap",
        "flagged",
        lambda: videos(late=140),
        SOUND,
        check=near(140 / 30, FRAME),
    ),
    Case(
        "clips of 40 frames, pixels",
        "little time for motion to differ",
        "right, or flagged",
        lambda: videos(frames=40, late=6),
        SOUND,
        check=near(6 / 30, FRAME),
    ),
    Case(
        "clips of two frames, pixels",
        "no lag has enough frames",
        "flagged or refused",
        lambda: videos(frames=2, late=0),
        (FLAGGED, REFUSED),
    ),
    Case(
        "one match, pixels",
        "one curve in two views",
        "right, or flagged",
        with_matches(np.array([[3, 3]])),
        SOUND,
        check=right,
    ),
    Case(
        "two matches, pixels",
        "two curves in two views",
        "right, or flagged",
        with_matches(np.array([[3, 3], [5, 5]])),
        SOUND,
        check=right,
    ),
    Case(
        "three matches, one wrong, pixels",
        "little to vote by",
        "right, or flagged",
        with_matches(np.array([[3, 3], [5, 5], [7, 9]])),
        SOUND,
        check=right,
    ),
    Case(
        "no match at all, pixels",
        "nothing to compare",
        "flagged",
        with_matches(np.zeros((0, 2), int)),
        (FLAGGED,),
    ),
    Case(
        "80 % of the matches wrong, pixels",
        "strangers meet each other's lines now and then",
        "the outlier of every mixture keeps them from voting",
        lambda: wrong(0.8),
        SOUND,
        check=right,
    ),
    Case(
        "all matches wrong, pixels",
        "nothing votes for the right lag",
        "flagged",
        lambda: wrong(1.0),
        (FLAGGED,),
    ),
    Case(
        "planar motion, pixels",
        "a plane's points are related by a homography at every lag",
        "right, or flagged",
        lambda: videos(lambda x: x * [1, 0, 1]),
        SOUND,
        check=right,
    ),
    Case(
        "half of the samples missing, pixels",
        "frames in common are a quarter",
        "right, or flagged",
        seen_share(0.5),
        SOUND,
        check=right,
    ),
    Case(
        "nothing is seen, pixels",
        "no sample",
        "flagged",
        lambda: tuple(replace(x, visible=np.zeros_like(x.seen)) if isinstance(x, TrackSet) else x for x in videos()),
        (FLAGGED,),
    ),
    Case(
        "all tracks at one place, pixels",
        "all candidates are the same curve",
        "right, or flagged",
        lambda: videos(lambda x: np.repeat(x[:1], len(x), 0)),
        SOUND,
        check=right,
    ),
    Case(
        "a jitter of 20 pixels",
        "noise of the size of the motion",
        "right, or flagged",
        lambda: videos(jitter=20.0),
        SOUND,
        check=right,
    ),
    Case(
        "calibration off by 3°",
        "epipolar lines miss by dozens of pixels",
        "motion counts more than place: right, or flagged",
        lambda: (videos()[0], replace(videos()[1], camera=camera(53)), videos()[2]),
        SOUND,
        check=right,
    ),
    Case(
        "no camera",
        "there is no epipolar geometry",
        "ValueError with the remedy",
        lambda: (videos()[0], replace(videos()[1], camera=None), videos()[2]),
        (REFUSED,),
        "expected pixels (uv) and a camera",
    ),
    Case(
        "nan in a visible pixel",
        "nan spreads",
        "ValueError with track and frame",
        lambda: (
            videos()[0],
            replace(videos()[1], uv=np.where(np.arange(FRAMES)[None, :, None] == 9, np.nan, videos()[1].uv)),
            videos()[2],
        ),
        (REFUSED,),
        "finite values in visible",
    ),
)
