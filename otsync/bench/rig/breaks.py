"""``otsync bench breaks SCENE``: a truly synchronised rig of which one camera loses frames, or stands still.

Each draw takes a few cameras and begins each at another frame. One of them loses ten pictures, or shows one of them for
fifteen frames more: and goes on late, or with what comes then. The pictures themselves are left out and repeated, and
tracked as of a recording that came so; the draw without either stands beside. No depth is used.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from ...compute.threads import MapLike, pool_of
from ...files.cache import Cache
from ...io.frames import FrameRange
from ...io.scene import Scene, open_scene
from ...progress import counted
from ...recordings.routes import synchronize_scene
from ...types import Break, Offsets, Status
from ..record import table, write_rows

CAMERAS = 4
"""Of each draw; fewer where the rig has fewer."""

LONG, LATEST = 120, 28
"""Frames of each video, and the latest at which one begins; in shorter recordings the videos are shorter."""

SHORTEST = 90
"""Frames that are left of each video, at least."""

LOST, STILL = 10, 15
"""Frames that are lost, and that one picture is shown for besides its own."""

WRONG = 1.0
"""Frames of error from which on an answer that is trusted is wrong."""

WHOLE = "whole"
KINDS = (WHOLE, f"{LOST} frames lost", f"still for {STILL}, goes on late", f"still for {STILL}, catches up")


def run(
    out: Path, *, scene: str | os.PathLike[str], first_seed: int = 9700, seeds: int = 6, cache: Path | None = None
) -> int:
    """Write a row a draw and a table a kind. Exit code 1 where an answer is trusted and wrong."""
    opened = open_scene(scene)
    length = min(min(len(v.frames) for v in opened.videos) - LATEST + 1, LONG)
    if length < SHORTEST or len(opened.videos) < 2:
        raise ValueError(
            f"{scene}: expected two videos and more of {SHORTEST + LATEST - 1} frames and more; found "
            f"{len(opened.videos)}, the shortest of {length + LATEST - 1}. Film longer, or with more cameras."
        )
    kept = Cache(cache or out / "stages")
    jobs = [(seed, kind) for seed in range(first_seed, first_seed + seeds) for kind in KINDS]
    with pool_of(os.cpu_count() or 1) as pool:
        rows = [_measured(opened, length, *job, kept, pool.map) for job in counted(jobs, "breaks", "draw", len(jobs))]
    summary = [_summary(kind, [row for row in rows if row["kind"] == kind]) for kind in KINDS]
    print(table(summary))
    about = {"scene": opened.root.name, "cameras": min(CAMERAS, len(opened.videos)), "frames": length}
    write_rows(out, "breaks", summary, about)
    write_rows(out, "breaks_draws", rows)
    return 1 if any(s["trusted, wrong"] for s in summary) else 0


def shown(kind: str, start: int, length: int, at: int) -> Int[np.ndarray, " T"]:
    """The frames of the recording that a video shows whose own frame ``at`` is the first behind the break."""
    even = np.arange(start, start + length)
    if kind == KINDS[1]:
        return np.delete(even, np.arange(at, at + LOST))
    if kind == KINDS[2]:
        return np.concatenate([even[:at], np.full(STILL, even[at - 1]), even[at : length - STILL]])
    if kind == KINDS[3]:
        return np.concatenate([even[:at], np.full(STILL, even[at - 1]), even[at + STILL :]])
    return even


def _measured(scene: Scene, length: int, seed: int, kind: str, cache: Cache, map: MapLike) -> dict[str, Any]:
    """A draw: errors of all cameras but the first, and what is said of the one whose clock breaks."""
    rng = np.random.default_rng(seed)
    cameras = rng.permutation(len(scene.videos))[:CAMERAS]
    starts = rng.integers(0, LATEST + 1, len(cameras))
    who, at = int(rng.integers(1, len(cameras))), int(rng.integers(length // 3, 3 * length // 5))
    picks = [shown(kind if k == who else WHOLE, int(s), length, at) for k, s in enumerate(starts)]
    videos = [
        replace(v, frames=FrameRange(v.frames, chosen.tolist()), timestamps=None, depth=None)
        for v, chosen in zip((scene.videos[c] for c in cameras), picks, strict=True)
    ]
    whole = Scene(tuple(videos), (None,) * len(videos), frame=scene.frame, root=scene.root)
    offsets = synchronize_scene(whole, route="epipolar", cache=cache, map=map).offsets
    error = np.abs(offsets.frames - (starts - starts[0]))[1:]
    trusted = np.array([status.ok for status in offsets.status])[1:]
    named = [(v, b) for v, breaks in enumerate(offsets.breaks) for b in breaks]
    own = [b for v, b in named if v == who]
    return {
        "kind": kind,
        "draw": seed,
        "cameras": " ".join(whole.names),
        "breaks": whole.names[who] if kind != WHOLE else "",
        "at": at,
        "named": len(own),
        "named of others": len(named) - len(own),
        "flagged": Status.BROKEN_CLOCK in offsets.flags[who],
        "flagged of others": sum(Status.BROKEN_CLOCK in f for k, f in enumerate(offsets.flags) if k != who),
        "error": _mean(error[trusted]),
        "largest": float(error[trusted].max()) if trusted.any() else None,
        "trusted": int(trusted.sum()),
        "of": len(trusted),
        "trusted, wrong": int((error[trusted] > WRONG).sum()) + _lacks(offsets, kind, who),
        "jump off": _jump_off(own, kind, float(offsets.fps[who])),
    }


def _lacks(offsets: Offsets, kind: str, who: int) -> int:
    """1 where the camera that breaks is trusted, and right up to the break alone: what it lost is not said."""
    return int(kind in (KINDS[1], KINDS[2]) and not offsets.breaks[who] and offsets.status[who].ok)


def _jump_off(own: list[Break], kind: str, fps: float) -> float | None:
    """Frames by which the jump of the one break that was named is wrong; None where there is not one."""
    true = {KINDS[1]: LOST, KINDS[2]: -STILL}.get(kind)
    return round(abs(own[0].jump * fps - true), 3) if true is not None and len(own) == 1 else None


def _mean(values: np.ndarray) -> float | None:
    return round(float(values.mean()), 3) if len(values) else None


def _summary(kind: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of all draws of a kind; errors in frames, of what is trusted."""
    off = np.array([row["jump off"] for row in rows if row["jump off"] is not None])
    largest = [row["largest"] for row in rows if row["largest"] is not None]
    return {
        "kind": kind,
        "draws": len(rows),
        "named": sum(row["named"] > 0 for row in rows),
        "named or flagged": sum(row["named"] > 0 or row["flagged"] for row in rows),
        "jump off, mean": _mean(off),
        "others named": sum(row["named of others"] for row in rows),
        "others flagged": sum(row["flagged of others"] for row in rows),
        "trusted": sum(row["trusted"] for row in rows),
        "of": sum(row["of"] for row in rows),
        "error, mean": _mean(np.array([row["error"] for row in rows if row["error"] is not None])),
        "largest": round(max(largest), 3) if largest else None,
        "trusted, wrong": sum(row["trusted, wrong"] for row in rows),
    }
