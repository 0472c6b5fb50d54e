"""Videos in which nothing can be followed: they are left without a clock, and the others get theirs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from ..progress import Tell
from ..types import Offsets, Status, TrackSet, Video

if TYPE_CHECKING:
    from ..io.scene import Scene
    from .synchronized import Synchronized

T = TypeVar("T")


class NothingToFollow(ValueError):
    """Videos have no track that could tell the time. ``why``: by name, what was looked for and what to do."""

    def __init__(self, why: Mapping[str, str]):
        self.why = dict(why)
        super().__init__(" ".join(self.why.values()))


def tried(make: Callable[..., T], *args: Any) -> T | NothingToFollow:
    """What ``make(*args)`` returns, or its complaint: the other videos are asked, too, before anybody decides."""
    try:
        return make(*args)
    except NothingToFollow as error:
        return error


def followed(made: Sequence[T | NothingToFollow]) -> list[T]:
    """What was made of all videos; NothingToFollow names all of which nothing was made."""
    why = {k: v for one in made if isinstance(one, NothingToFollow) for k, v in one.why.items()}
    if why:
        raise NothingToFollow(why)
    return [one for one in made if not isinstance(one, NothingToFollow)]


def of_those_that_move(
    scene: Scene,
    reference: int | Literal["auto"],
    synchronized: Callable[..., Synchronized],
    tell: Tell,
) -> Synchronized:
    """What ``synchronized(scene, reference=...)`` says of the videos in which something can be followed.

    The others have a row each that says so. NothingToFollow where the reference is among them, or all but one.
    """
    try:
        return synchronized(scene, reference=reference)
    except NothingToFollow as error:
        rest = [name for name in scene.names if name not in error.why]
        centre = None if reference == "auto" else scene.names[reference]
        if centre in error.why and len(rest) > 1:
            other = f"It is the reference: name another one (--reference {rest[0]})."
            raise NothingToFollow(error.why | {centre: f"{error.why[centre]} {other}"}) from None
        if len(rest) < 2:
            raise
        for line in error.why.values():
            tell(f"note: {line}")
        tell(f"going on with {', '.join(rest)}")
        answer = synchronized(scene.take(rest), reference="auto" if centre is None else rest.index(centre))
        return with_silent(answer, scene.videos, error.why, scene.frame)


def with_silent(answer: Synchronized, videos: Sequence[Video], why: Mapping[str, str], frame: str) -> Synchronized:
    """The answer for all ``videos``: those of ``why`` have no tracks, and a clock of their own, which is ``static``."""
    place = [n for n, v in enumerate(videos) if v.name not in why]
    tracks = [_nothing(v, frame) for v in videos]
    for n, kept in zip(place, answer.tracks, strict=True):
        tracks[n] = kept
    return replace(
        answer,
        offsets=_with_rows(answer.offsets, videos, place),
        first=None if answer.first is None else _with_rows(answer.first, videos, place),
        tracks=tuple(tracks),
        why=(*answer.why, *(f"{name} has no clock: nothing in it can be followed" for name in why)),
    )


def _nothing(video: Video, frame: str) -> TrackSet:
    frames = len(video.frames)
    return TrackSet(
        None,
        np.zeros((0, frames), bool),
        fps=video.fps,
        timestamps=video.timestamps,
        name=video.name,
        uv=np.zeros((0, frames, 2)),
        camera=video.camera,
        frame=frame,
    )


def _with_rows(offsets: Offsets, videos: Sequence[Video], place: Sequence[int]) -> Offsets:
    """Args: place: index among ``videos`` of each video that ``offsets`` has."""
    n, at = len(videos), np.array(place)
    silent = np.setdiff1d(np.arange(n), at)

    def grown(values: np.ndarray, other: np.ndarray | float) -> np.ndarray:
        out = np.empty(n, np.asarray(values).dtype)
        out[at], out[silent] = values, other
        return out

    flags: list[tuple[Status, ...]] = [(Status.DISCONNECTED, Status.STATIC)] * n
    breaks: list = [()] * n
    transforms: list = [None] * n
    for k, v in enumerate(place):
        flags[v], breaks[v] = offsets.flags[k], offsets.breaks[k]
        transforms[v] = offsets.transforms[k] if offsets.transforms else None
    return replace(
        offsets,
        names=tuple(v.name for v in videos),
        fps=grown(offsets.fps, np.array([_nothing(videos[v], "").fps for v in silent], float)),
        seconds=grown(offsets.seconds, 0.0),
        rates=grown(offsets.rates, 1.0),
        sigma=grown(offsets.sigma, 0.0),
        reference=int(at[offsets.reference]),
        component=grown(at[offsets.component], silent),
        flags=tuple(flags),
        alignments={(place[a], place[b]): answer for (a, b), answer in offsets.alignments.items()},
        matches={(place[a], place[b]): found for (a, b), found in offsets.matches.items()},
        transforms=tuple(transforms) if offsets.transforms else (),
        breaks=tuple(breaks),
    )
