"""Which cameras are to be trusted: enough matches, two mappers that agree, a lens that is known; else what to film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from .found import WALK, FoundCamera
from .mapping import Model
from .world import centres, degrees, laid_over

FEW_INLIERS = 50
"""Verified matches with the nearest picture: of pairs with 30 to 50 half are right, of those with 50 to 80 92 % (dome)."""

MAPPERS_TURN, MAPPERS_MOVE = 2.0, 0.05
"""How far two mappers may disagree: degrees, and shares of the distance to the middle of the cameras."""

BRIDGED = 0.1
"""Share of a moving camera's frames that may lie between their neighbours."""

MOVING_PICTURES = 12
"""Registered key frames of moving cameras from which on they determine focal lengths."""


def disagreement(
    one: Model, other: Model | None, of: np.ndarray, videos: int
) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """Degrees, and shares of the distance to the cameras' middle, by which two models differ on every video's pictures.

    The median over the video's pictures; nan for a video that either lacks.
    """
    turn, move = np.full(videos, np.nan), np.full(videos, np.nan)
    if other is None:
        return turn, move
    both = sorted(set(one.pictures.tolist()) & set(other.pictures.tolist()))
    if len(both) < 2:
        return turn, move
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
    return turn, move


def nearest(inliers: Mapping[tuple[int, int], int], of: np.ndarray, videos: int) -> list[int]:
    """Of every video: the most verified matches that a picture of it has with one of another video."""
    best = [0] * videos
    for (a, b), count in inliers.items():
        if of[a] != of[b]:
            for v in (int(of[a]), int(of[b])):
                best[v] = max(best[v], count)
    return best


def judged(
    camera: FoundCamera,
    *,
    turn: float,
    move: float,
    checked: bool,
    helped: bool,
) -> FoundCamera:
    """A camera with the reason to doubt it, where there is one.

    Args:
        turn, move: how far the mappers disagree (see :func:`disagreement`); nan: the other one lacks it.
        checked: whether the other mapper made a model at all. helped: whether a walk clip is there.
    """
    name, more = camera.name, "Film a longer and slower walk past all cameras." if helped else WALK
    if camera.w2c is None:
        return camera.doubted(f"{name} sees too little background that another camera sees.", more)
    if camera.inliers < FEW_INLIERS:
        camera = camera.doubted(f"{name} shares {camera.inliers} matches with its nearest picture, which is few.", more)
    if not np.isfinite(turn):
        why = "leaves it out" if checked else "makes no model"
        camera = camera.doubted(f"the second mapper {why}, so nothing confirms where {name} stands.", more)
    elif turn > MAPPERS_TURN or move > MAPPERS_MOVE:
        camera = camera.doubted(
            f"two mappers disagree on {name}: by {turn:.1f} degrees and {100 * move:.0f} % of its distance.", more
        )
    if camera.lens == "guessed":
        camera = camera.doubted(
            f"the focal length of {name} is a guess.",
            "Give it by --intrinsics, film a board as board.mp4, or: " + WALK[0].lower() + WALK[1:],
        )
    if camera.bridged > BRIDGED:
        camera = camera.doubted(
            f"{100 * camera.bridged:.0f} % of the frames of {name} have no pose of their own.",
            "Move it more slowly, keep the scene's background in view, or give more key frames (--key-frames).",
        )
    return camera


def lost_together(lost: Sequence[str]) -> str:
    """The message about cameras without a pose."""
    names = " and ".join([", ".join(lost[:-1]), lost[-1]] if len(lost) > 1 else lost)
    return f"{names} {'see' if len(lost) > 1 else 'sees'} no background in common with the others."
