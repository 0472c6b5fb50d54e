"""The part of a recording that is fitted: frames that can be read, videos that have a clock; the rest is named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from otsync.clocks.shutter import check_within_a_frame
from otsync.compute.threads import MapLike
from otsync.io import Scene
from otsync.io.mend import keep_frames, unreadable
from otsync.progress import Progress
from otsync.types import Clock, Offsets, Video


def readable(scene: Scene, cache: Any, map: MapLike, progress: Progress) -> Scene:
    """The scene without frames that cannot be read, each of which is noted. ValueError when one video has none left."""

    for video in scene.videos:
        check_within_a_frame(video.camera.readout, video.times, f"camera.readout of {video.name!r}")

    def look(item: tuple[Video, Any]) -> dict[str, np.ndarray]:
        video, masks = item
        parts = [getattr(x, "digest", None) for x in (video.frames, masks, video.depth) if x is not None]

        def compute() -> dict[str, np.ndarray]:
            bad = {f"{k:08d}": np.array(why) for k, why in unreadable(video, masks).items()}
            return {**bad, "looked": np.array(1)}

        if not all(parts):  # frames that are in memory have no digest, and are quickly looked at
            return compute()
        try:
            key = (*[digest() for digest in parts], video.camera.width, video.camera.height)  # type: ignore[misc]
        except OSError:
            return compute()
        return cache.arrays("readable", key, compute)

    index = []
    answers = map(look, list(zip(scene.videos, scene.masks, strict=True)))
    for video, answer in zip(scene.videos, answers, strict=True):
        bad = {int(k): str(why) for k, why in answer.items() if k != "looked"}
        for k, why in sorted(bad.items())[:3]:
            progress.note(f"video {video.name}, frame {k} is left out: {why}")
        if len(bad) > 3:
            progress.note(f"video {video.name}: {len(bad) - 3} further frames are left out")
        if len(bad) == len(video.frames):
            raise ValueError(f"video {video.name}: expected frames that can be read; found none. {bad[0]}")
        index.append([k for k in range(len(video.frames)) if k not in bad])
    return keep_frames(scene, index)


def split(
    scene: Scene, offsets: Offsets, held_out: Sequence[str], progress: Progress
) -> tuple[Scene, Scene | None, Offsets, dict[str, Clock]]:
    """Training videos, held-out ones, the offsets of the former alone, and the clocks of the latter that are known.

    Videos without an offset on the reference's clock are left out, with a note.
    """
    train, known = trained(scene, offsets, held_out), given_clocks(offsets)
    for name in scene.names:
        if name not in train and name not in held_out:
            why = "has no offset on the common clock" if name in offsets.names else "is not in the offsets"
            progress.note(f"video {name} is left out: it {why}")
    clocks = {n: clock for n, clock in known.items() if n in held_out}
    return scene.take(train), scene.take(held_out) if held_out else None, only(offsets, train), clocks


def trained(scene: Scene, offsets: Offsets, held_out: Sequence[str]) -> list[str]:
    """The names of the videos to fit. ValueError for held-out ones that there are not, or a reference among them."""
    missing = [n for n in held_out if n not in scene.names]
    if missing:
        raise ValueError(f"held_out: expected some of {', '.join(scene.names)}; found {', '.join(missing)}.")
    reference, known = offsets.names[offsets.reference], given_clocks(offsets)
    train = [n for n in scene.names if n in known and n not in held_out]
    if reference not in train:
        raise ValueError(
            f"offsets: expected the reference ({reference}) among the videos to fit; found "
            f"{', '.join(train) or 'none'}. "
            "Hold out another video, or synchronise with another reference."
        )
    return train


def given_clocks(offsets: Offsets) -> dict[str, Clock]:
    """The clocks of the videos that have an offset on the reference's."""
    return {
        name: Clock(float(offsets.seconds[v]), float(offsets.rates[v]))
        for v, name in enumerate(offsets.names)
        if np.isfinite(offsets.seconds[v]) and offsets.component[v] == offsets.reference
    }


def only(offsets: Offsets, names: Sequence[str]) -> Offsets:
    """The offsets of some videos on the reference's clock, in that order.

    Where the reference is none of them, the first is named in its place; seconds stay those of world time.
    """
    at = [offsets.names.index(n) for n in names]
    new = {v: i for i, v in enumerate(at)}
    reference = new.get(offsets.reference, 0)
    pairs = {k: v for k, v in offsets.alignments.items() if k[0] in new and k[1] in new}
    return replace(
        offsets,
        names=tuple(names),
        fps=offsets.fps[at],
        seconds=offsets.seconds[at],
        rates=offsets.rates[at],
        sigma=offsets.sigma[at],
        reference=reference,
        component=np.full(len(at), reference),
        flags=tuple(offsets.flags[v] for v in at),
        breaks=tuple(offsets.breaks[v] for v in at),
        alignments={(new[i], new[j]): a for (i, j), a in pairs.items()},
        matches={},
    )
