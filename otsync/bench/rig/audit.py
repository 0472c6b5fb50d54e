"""``otsync bench audit SCENE``: a truly synchronised rig with one camera moved by known frames, and with none.

Each seed draws cameras, a clip, the camera that is moved and the direction; a trial leaves out whole frames of that
camera's tracks, so the truth is exact up to the rig's own synchronisation. Tracks are kept, so that a trial costs its
pairs alone.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from ...compute.threads import pool_of
from ...files.cache import Cache
from ...io import open_scene
from ...progress import counted
from ...recordings.audit import audit_offsets
from ...recordings.routes import pairs_in_pixels, select, track_all
from ...recordings.stages import Stages
from ..record import table, write_rows

MOVES = (0, 1, 2, 5)
"""Frames that one camera is moved by; 0: none is."""

CAMERAS, FRAMES = 6, 120


def run(
    out: Path,
    *,
    scene: str | os.PathLike[str],
    first_seed: int = 4100,
    seeds: int = 20,
    cache: Path | None = None,
) -> int:
    """Write a row a trial and a table a move. Exit code 1 where a moved camera was missed or a false alarm raised."""
    opened = open_scene(scene)
    kept, stages = Cache(cache or out / "stages"), Stages()
    started = time.process_time()
    with pool_of(os.cpu_count() or 1) as pool:
        raw = track_all(opened, stages, kept, pool.map)
        rows: list[dict[str, Any]] = []
        trials = [(move, first_seed + n) for n in range(seeds) for move in MOVES]
        for move, seed in counted(trials, "audit", "trial", len(trials)):
            # the same draw for every move: pairs of cameras that stay are computed once
            rng = np.random.default_rng(seed)
            V = len(opened.videos)
            chosen = rng.permutation(V)[: min(CAMERAS, V)]
            length = min(FRAMES, min(len(v.frames) for v in opened.videos) - 2 * max(MOVES))
            spare = min(len(v.frames) for v in opened.videos) - length
            start = int(rng.integers(max(MOVES), spare - max(MOVES) + 1))
            moved, way = int(rng.integers(len(chosen))), int(rng.choice([-1, 1]))
            tracks = []
            for n, v in enumerate(chosen):
                first = start + (move * way if n == moved else 0)
                video = opened.videos[v]
                cut = {**raw[v], "uv": raw[v]["uv"][:, first : first + length]}
                lived = np.isfinite(cut["uv"][..., 0]).any(1)
                cut = {k: x[lived] if k in ("uv", "features", "labels") else x for k, x in cut.items()}
                tracks.append(_clip(video, cut, stages, opened.frame))
            offsets = pairs_in_pixels(tracks, "auto", stages, kept, pool.map)
            told = audit_offsets(offsets)
            at = told.cameras[moved]
            others = [c for n, c in enumerate(told.cameras) if n != moved or not move]
            truth = [move * way if n == moved else 0 for n in range(len(chosen))]
            far = [abs(c.frames - true) / c.sigma for c, true in zip(told.cameras, truth, strict=True)]
            rows.append(
                {
                    "move": move * way,
                    "seed": seed,
                    "camera": at.name,
                    "found": bool(at.finding == "off" and abs(at.frames - move * way) < 0.5) if move else None,
                    "frames": round(at.frames, 3),
                    "sigma": round(at.sigma, 3),
                    "false_alarms": sum(c.finding == "off" for c in others),
                    "unsure": sum(c.finding == "unsure" for c in others),
                    "largest_other": round(max(abs(c.frames) for c in others), 3),
                    "cameras": len(far),
                    "within_sigma": sum(x <= 1 for x in far),
                    "within_two": sum(x <= 2 for x in far),
                }
            )
    summary = []
    for move in MOVES:
        own = [r for r in rows if abs(r["move"]) == move]
        errors = [abs(r["frames"] - r["move"]) for r in own]
        summary.append(
            {
                "moved by": move,
                "trials": len(own),
                "found": sum(bool(r["found"]) for r in own) if move else None,
                "trials with a false alarm": sum(r["false_alarms"] > 0 for r in own),
                "unsure cameras": sum(r["unsure"] for r in own),
                "mean error": round(float(np.mean(errors)), 3) if move else None,
                "largest of the others": max(r["largest_other"] for r in own),
                "within one sigma": round(sum(r["within_sigma"] for r in own) / sum(r["cameras"] for r in own), 3),
                "within two": round(sum(r["within_two"] for r in own) / sum(r["cameras"] for r in own), 3),
            }
        )
    print(table(summary))
    print(f"CPU {time.process_time() - started:.0f} s")
    write_rows(out, "audit", summary, {"cameras": CAMERAS, "frames": FRAMES})
    write_rows(out, "audit_trials", rows)
    missed = any(s["found"] != s["trials"] for s in summary if s["moved by"])
    return 1 if missed or any(s["trials with a false alarm"] for s in summary) else 0


def _clip(video: Any, cut: dict[str, np.ndarray], stages: Stages, frame: str) -> Any:
    """The tracks of a clip; clocks begin at 0."""
    from dataclasses import replace

    camera = video.camera
    short = replace(video, frames=range(cut["uv"].shape[1]), depth=None, timestamps=None, camera=camera)
    return select(short, cut, stages, frame)
