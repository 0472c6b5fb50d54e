"""Which cameras are to be trusted: enough matches, two mappers that agree, a lens that is known; else what to film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..geometry import fundamental, sampson, undistort
from ..types import Camera
from .clips import Lens
from .found import WALK, FoundCamera
from .mapping import Model, lenses_found
from .world import centres, degrees, laid_over

FEW_INLIERS = 50
"""Verified matches with the nearest picture: of pairs with 30 to 50 half are right, of those with 50 to 80 92 %."""

MAPPERS_TURN, MAPPERS_MOVE = 2.0, 0.05
"""How far two mappers may disagree: degrees, and shares of the distance to the middle of the cameras."""

COUNTING, OBEYS = 30, 4.0
"""Matches of a pair from which on it is heard about a model, and pixels within which they obey it."""

HEALTHY = 0.5
"""Share of a camera's matches with other videos that must obey the model: of a wrong model the right pairs break it."""

BRIDGED = 0.1
"""Share of a moving camera's frames that may lie between their neighbours."""

MOVING_PICTURES = 12
"""Registered key frames of moving cameras from which on they determine focal lengths."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """How two models of the same pictures differ, when the one is laid over the other.

    Args:
        turn, move: (V,) degrees, and shares of the distance to the middle of the cameras: the median over each video's
            pictures; nan for a video that either model lacks.
        whole: whether most pictures agree. If not, no camera is confirmed: two worlds can always be laid over each
            other so that some few do.
    """

    turn: Float[np.ndarray, " V"]
    move: Float[np.ndarray, " V"]
    whole: bool


def agreement(one: Model, other: Model | None, of: np.ndarray, videos: int) -> Agreement:
    """How the second model differs from the first."""
    turn, move = np.full(videos, np.nan), np.full(videos, np.nan)
    both = [] if other is None else sorted(set(one.pictures.tolist()) & set(other.pictures.tolist()))
    if other is None or len(both) < 3:
        return Agreement(turn, move, False)
    a = np.stack([other.w2c[int(np.flatnonzero(other.pictures == p)[0])] for p in both])
    b = np.stack([one.w2c[int(np.flatnonzero(one.pictures == p)[0])] for p in both])
    moved = laid_over(a, b).camera(a)
    turns = degrees(moved[:, :3, :3] @ np.swapaxes(b[:, :3, :3], 1, 2))
    places = centres(b)
    size = max(float(np.median(np.linalg.norm(places - np.median(places, 0), axis=1))), 1e-300)
    shifts = np.linalg.norm(centres(moved) - places, axis=1) / size
    video = of[np.array(both)]
    for v in set(video.tolist()):
        turn[v], move[v] = np.median(turns[video == v]), np.median(shifts[video == v])
    agree = int(((turns < MAPPERS_TURN) & (shifts < MAPPERS_MOVE)).sum())
    return Agreement(turn, move, agree >= 3 and 2 * agree > max(len(one.pictures), len(other.pictures)))


def spread(model: Model, of: np.ndarray, videos: int) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """Standard deviations of every video's pose: degrees, and units of the model; nan where they are not known.

    Poses from either half of the points differ by twice the standard deviation of those from all of them. Each video's
    is the root of the mean square over its pictures, and no less than a third of that over all: two halves of one
    picture may agree by chance.
    """
    turn, move = np.full(videos, np.nan), np.full(videos, np.nan)
    if len(model.halves) != 2 or len(model.pictures) < 3:
        return turn, move
    a, b = model.halves
    over = laid_over(a, b)
    moved = over.camera(a)
    scale = laid_over(b, model.w2c).scale
    turns = degrees(moved[:, :3, :3] @ np.swapaxes(b[:, :3, :3], 1, 2)) / 2
    moves = scale * np.linalg.norm(centres(moved) - centres(b), axis=1) / 2
    video = of[model.pictures]
    for values, out in ((turns, turn), (moves, move)):
        least = float(np.sqrt(np.mean(values**2))) / 3
        for v in set(video.tolist()):
            out[v] = max(float(np.sqrt(np.mean(values[video == v] ** 2))), least)
    return turn, move


@dataclass(frozen=True, eq=False)
class Support:
    """What the verified matches between videos say of a model.

    Args:
        kept, broken: (V,) matches of each video with others that obey, or break, the geometry of the model.
        nearest: (V,) the most matches that a picture has with one of another video.
    """

    kept: Int[np.ndarray, " V"]
    broken: Int[np.ndarray, " V"]
    nearest: Int[np.ndarray, " V"]

    @property
    def worth(self) -> int:
        """Of two models the one with more matches that obey it, and fewer that break it, is the better one."""
        return int(self.kept.sum()) - int(self.broken.sum())

    @property
    def health(self) -> Float[np.ndarray, " V"]:
        """Share of each video's matches that obey the model; nan where there are none."""
        total = self.kept + self.broken
        return np.where(total > 0, self.kept / np.maximum(total, 1), np.nan)


def support(
    model: Model | None,
    matches: Mapping[tuple[int, int], Float[np.ndarray, "N 4"]],
    of: np.ndarray,
    lenses: Sequence[Lens],
) -> Support:
    """Hold a model against all verified matches between videos, those that its mapper left out too."""
    kept, broken, most = (np.zeros(len(lenses), int) for _ in range(3))
    at = {} if model is None else {int(p): n for n, p in enumerate(model.pictures)}
    found = lenses if model is None else lenses_found(model, lenses)
    for (a, b), uv in matches.items():
        va, vb = int(of[a]), int(of[b])
        if va == vb:
            continue
        most[va], most[vb] = max(most[va], len(uv)), max(most[vb], len(uv))
        if model is None or a not in at or b not in at or len(uv) < COUNTING:
            continue
        one, two = (Camera(found[v].K, model.w2c[at[p]], 1, 1, found[v].distortion) for v, p in ((va, a), (vb, b)))
        off = np.abs(sampson(fundamental(one, two), undistort(one, uv[:, :2]), undistort(two, uv[:, 2:])))
        good = int((off < OBEYS).sum())
        for v in (va, vb):
            kept[v] += good
            broken[v] += len(uv) - good
    return Support(kept, broken, most)


def judged(
    camera: FoundCamera,
    *,
    turn: float = np.nan,
    move: float = np.nan,
    whole: bool = False,
    checked: bool = False,
    health: float = np.nan,
    helped: bool = False,
) -> FoundCamera:
    """A camera with the reason to doubt it, where there is one.

    Args:
        turn, move, whole: how far the mappers differ (see :class:`Agreement`).
        checked: whether the other mapper made a model at all.
        health: share of its matches that obey the model. helped: whether a walk clip is there.
    """
    name, more = camera.name, "Film a longer and slower walk past all cameras." if helped else WALK
    if camera.w2c is None:
        return camera.doubted(f"{name} sees no background in common with the others, or too little of it.", more)
    if camera.inliers < FEW_INLIERS:
        camera = camera.doubted(f"{name} shares {camera.inliers} matches with its nearest picture, which is few.", more)
    if not np.isfinite(turn):
        why = "leaves it out" if checked else "makes no model"
        camera = camera.doubted(f"the second mapper {why}, so nothing confirms where {name} stands.", more)
    elif not whole:
        camera = camera.doubted("two mappers make different models of the whole, so neither is confirmed.", more)
    elif turn > MAPPERS_TURN or move > MAPPERS_MOVE:
        camera = camera.doubted(
            f"two mappers disagree on {name}: by {turn:.1f} degrees and {100 * move:.0f} % of its distance.", more
        )
    if health < HEALTHY:
        camera = camera.doubted(
            f"{100 * (1 - health):.0f} % of the matches of {name} contradict where it stands.", more
        )
    if camera.lens == "guessed":
        camera = camera.doubted(
            f"the focal length of {name} is a guess.",
            "Give it by --intrinsics, film a board (board.mp4, --board), or: " + WALK[0].lower() + WALK[1:],
        )
    if camera.bridged > BRIDGED:
        camera = camera.doubted(
            f"{100 * camera.bridged:.0f} % of the frames of {name} have no pose of their own.",
            "Move it more slowly, keep the scene's background in view, or give more key frames (--key-frames).",
        )
    return camera
