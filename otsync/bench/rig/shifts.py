"""``otsync bench shifts SCENE``: a truly synchronised rig whose videos begin at other frames, all of them.

Each seed draws how many frames every video loses at its start: 0 to 30. Frames are left out of the tracks, which every
video seeds in frames of its own, so that a draw costs its pairs alone. The truth is exact up to the rig's own
synchronisation and calibration, for which the draw ``as filmed`` stands: no frame is left out there.

In a project of Pose2Sim that has keypoints (``pose/NAME_json/*.json``) two more ways are measured on the same draws:
otsync on these keypoints in place of its own tracks, and Pose2Sim's own synchronisation (:mod:`.their_sync`).
"""

from __future__ import annotations

import os
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...compute.threads import MapLike, pool_of
from ...files.cache import Cache
from ...io.scene import Scene, read_document, scene_from_document
from ...priors.points import ChainedFlow
from ...progress import counted
from ...recordings.routes import pairs_in_pixels, select, synchronize_scene
from ...recordings.stages import Stages
from ...types import Offsets
from ..record import table, write_rows
from . import their_sync

MOST = 30
"""Frames that a video loses at most."""

WRONG = 1.0
"""Frames of error from which on an answer that is trusted is wrong."""

AS_FILMED = "as filmed"


def run(
    out: Path, *, scene: str | os.PathLike[str], first_seed: int = 5200, seeds: int = 10, cache: Path | None = None
) -> int:
    """Write a row a camera and a table a way. Exit code 1 where an answer of otsync is trusted and wrong."""
    document, root = read_document(scene)
    opened = scene_from_document(document, root)
    frames = min(len(v.frames) for v in opened.videos)
    if frames < 3 * MOST:
        raise ValueError(f"{root}: expected {3 * MOST} frames and more of every video; found {frames}. Film longer.")
    draws: dict[int | str, np.ndarray] = {AS_FILMED: np.zeros(len(opened.videos), int)}
    for seed in range(first_seed, first_seed + seeds):
        draws[seed] = np.random.default_rng(seed).integers(0, MOST + 1, len(opened.videos))
    with pool_of(os.cpu_count() or 1) as pool:
        rows = _own_tracks(opened, draws, Cache(cache or out / "stages"), pool.map)
        files = their_sync.keypoint_files(root, opened.names)
        if files:
            rows += _keypoints(document, root, files, draws, pool.map)
            rows += _theirs(opened, files, draws, out)
    summary = [_summary(way, rows) for way in dict.fromkeys(row["way"] for row in rows)]
    print(table([row for row in rows if row["draw"] == AS_FILMED]))
    print(table(summary))
    write_rows(out, "shifts", summary, {"largest shift, frames": MOST, "scene": root.name})
    write_rows(out, "shifts_draws", rows)
    return 1 if any(s["trusted, wrong"] for s in summary if s["way"].startswith("otsync")) else 0


def _own_tracks(scene: Scene, draws: dict[int | str, np.ndarray], cache: Cache, map: MapLike) -> list[dict[str, Any]]:
    """otsync as it is on tracks of its own, without depth."""
    stages = Stages()

    def track(v: int) -> dict[str, np.ndarray]:
        # every video seeds its grids in frames of its own, or the seeds' rhythm would tell the truth
        phase = zlib.crc32(scene.names[v].encode()) % ChainedFlow.every
        tracking = replace(stages.tracking, points=ChainedFlow(phase=phase))
        return tracking(scene.videos[v], scene.masks[v], cache)

    raw = list(map(track, range(len(scene.videos))))

    def solve(starts: np.ndarray) -> Offsets:
        tracks = []
        for video, tracked, start in zip(scene.videos, raw, starts, strict=True):
            uv = tracked["uv"][:, start:]
            lived = np.isfinite(uv[..., 0]).any(1)
            short = replace(video, frames=range(uv.shape[1]), depth=None, fps=_fps(scene), timestamps=None)
            cut = {"uv": uv[lived], "features": tracked["features"][lived]}
            tracks.append(select(short, cut, stages, scene.frame))
        return pairs_in_pixels(tracks, 0, stages, cache, map)

    return _measured("otsync", scene.names, draws, solve)


def _keypoints(
    document: dict[str, Any],
    root: Path,
    files: Sequence[Sequence[Path]],
    draws: dict[int | str, np.ndarray],
    map: MapLike,
) -> list[dict[str, Any]]:
    """otsync on points that another program found."""
    listed = [[path.relative_to(root).as_posix() for path in own] for own in files]
    whole = scene_from_document(document, root)

    def solve(starts: np.ndarray) -> Offsets:
        videos = [
            {**entry, "points": {"files": own}, "fps": _fps(whole), "range": [int(start), len(video.frames)]}
            for entry, own, start, video in zip(document["videos"], listed, starts, whole.videos, strict=True)
        ]
        cut = scene_from_document({**document, "videos": videos}, root)
        return synchronize_scene(cut, route="epipolar", map=map).offsets

    return _measured("otsync, their keypoints", whole.names, draws, solve)


def _theirs(
    scene: Scene, files: Sequence[Sequence[Path]], draws: dict[int | str, np.ndarray], out: Path
) -> list[dict[str, Any]]:
    """Pose2Sim's own; nothing where it is not installed."""
    reason = their_sync.lacking()
    if reason:
        print(reason)
        return []
    started = time.perf_counter()
    whole = [[int(s) for s in starts] for starts in draws.values()]
    answers = their_sync.their_frames(files, scene.names, _fps(scene), whole, out / "pose2sim")
    seconds = (time.perf_counter() - started) / len(draws)
    return [
        {"way": "Pose2Sim", "draw": draw, "camera": name, "shift": int(starts[v] - starts[0])}
        | {"error": float(found[v] - (starts[v] - starts[0])), "sigma": None, "flags": "", "seconds": round(seconds, 2)}
        for (draw, starts), found in zip(draws.items(), answers, strict=True)
        for v, name in enumerate(scene.names)
        if v
    ]


def _measured(
    way: str, names: Sequence[str], draws: dict[int | str, np.ndarray], solve: Callable[[np.ndarray], Offsets]
) -> list[dict[str, Any]]:
    """A line for every draw and every video but the first."""
    rows = []
    for draw, starts in counted(draws.items(), way, "draw", len(draws)):
        started = time.perf_counter()
        try:
            offsets: Offsets | None = solve(starts)
        except ValueError as refused:  # too few tracks in what is left
            offsets, why = None, str(refused).partition(":")[0]
        seconds = round(time.perf_counter() - started, 2)
        for v in range(1, len(names)):
            row: dict[str, Any] = {"way": way, "draw": draw, "camera": names[v], "shift": int(starts[v] - starts[0])}
            if offsets is None:
                row |= {"error": None, "sigma": None, "flags": f"refused: {why}"}
            else:
                error, sigma = offsets.frames[v] - row["shift"], offsets.sigma[v] * offsets.fps[v]
                row |= {"error": _number(error), "sigma": _number(sigma)}
                row |= {"flags": " ".join(f.code for f in offsets.flags[v])}
            rows.append(row | {"seconds": seconds})
    return rows


def _summary(way: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures of |error|, frames, over all draws but the one without shifts.

    ``from as filmed``: how far answers lie from the one without shifts, where the rig's own error is in both.
    """
    own = [row for row in rows if row["way"] == way and row["draw"] != AS_FILMED]
    error = np.array([np.nan if row["error"] is None else abs(row["error"]) for row in own])
    known = error[np.isfinite(error)]
    trusted = np.array([not row["flags"] for row in own], bool)
    if way == "Pose2Sim":
        trusted[:] = True  # it says nothing else
    filmed = {r["camera"]: r["error"] for r in rows if r["way"] == way and r["draw"] == AS_FILMED}
    moved = [abs(r["error"] - filmed[r["camera"]]) for r in own if None not in (r["error"], filmed[r["camera"]])]
    held = [abs(r["error"]) <= 2 * r["sigma"] for r in own if r["sigma"] and r["error"] is not None]
    return {
        "way": way,
        "answers": len(own),
        "none": int(np.isnan(error).sum()),
        "mean": round(float(known.mean()), 3) if known.size else None,
        "median": round(float(np.median(known)), 3) if known.size else None,
        "90 %": round(float(np.quantile(known, 0.9)), 3) if known.size else None,
        "largest": round(float(known.max()), 3) if known.size else None,
        "from as filmed": round(float(np.mean(moved)), 3) if moved else None,
        "within 1": round(float((known <= WRONG).sum() / len(own)), 3),
        "trusted": int(trusted.sum()),
        "trusted, wrong": int((trusted & (error > WRONG)).sum()),
        "in 2 sigma": round(float(np.mean(held)), 3) if held else None,
        "seconds": round(float(np.mean([row["seconds"] for row in own])), 2),
    }


def _fps(scene: Scene) -> float:
    """Frames per second of the rig. ValueError where its videos differ: shifts are whole frames."""
    rates = [v.fps or 1 / float(np.median(np.diff(v.times))) for v in scene.videos]
    if max(rates) > 1.001 * min(rates):
        raise ValueError(f"scene: expected one frame rate; found {min(rates):g} to {max(rates):g}. Choose cameras.")
    return float(rates[0])


def _number(x: float) -> float | None:
    """For files: None where there is no answer."""
    return float(x) if np.isfinite(x) else None
