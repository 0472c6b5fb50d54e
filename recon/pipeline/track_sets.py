"""Track sets and the videos of a fit: which belong to which, and in what order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from otsync.io import Scene
from otsync.types import TrackSet


def tracks_of(
    scene: Scene, tracks: Sequence[TrackSet], held_out: Sequence[str], note: Callable[[str], None]
) -> tuple[TrackSet, ...]:
    """Those of the given track sets that are of the scene's videos; the others are noted.

    ValueError for several of one video, for those of another world frame, and when none remain.
    """
    twice = sorted({t.name for t in tracks if sum(t.name == other.name for other in tracks) > 1})
    if twice:
        raise ValueError(f"tracks: expected one set a video; found several of {', '.join(map(repr, twice))}. Give one.")
    kept = []
    for one in tracks:
        if one.name in scene.names:
            kept.append(one)
        else:
            why = "is held out" if one.name in held_out else "is not among those to fit"
            note(f"tracks of {one.name!r} are left out: the video {why}")
    if not kept:
        raise ValueError(
            f"tracks: expected sets named like videos to fit ({', '.join(scene.names)}); found "
            f"{', '.join(repr(t.name) for t in tracks) or 'none'}. Name them so, or let them be made by giving none."
        )
    for one in kept:
        if one.frame is not None and one.frame != scene.frame:
            raise ValueError(
                f"tracks of {one.name!r}: expected positions in the recording's world frame {scene.frame!r}; found "
                f"{one.frame!r}. Bring them into that frame."
            )
        if len(one):
            one.check(f"tracks of {one.name!r}")
    return tuple(kept)


def of_every_video(tracks: Sequence[TrackSet], names: Sequence[str]) -> list[TrackSet]:
    """A track set of each of the videos ``names``, in their order: an empty one for a video that has none.

    A scaffold per video numbers its clocks by the sets it is built from, a fit by its videos: the two must agree.
    """
    sets, nothing = {t.name: t for t in tracks}, tracks[0].take(slice(0))
    return [sets.get(n, replace(nothing, name=n, camera=None)) for n in names]
