"""The limits of matching: no left/right cue, wide baselines, unrelated videos, units; and the speed of D_track."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..costs.linear import track_distance
from ..match.anchored import AnchoredFGW
from ..match.verb import match
from ..metrics import match_quality
from ..progress import counted
from ..simulate import matching_world
from ..types import TrackSet
from .record import table, write_rows
from .sync_acceptance import Check, at_least

SCENES: dict[str, dict[str, float]] = {
    "no left/right cue": {"left_right": 0.0},
    "cameras 90 degrees apart": {"angle": 90.0},
    "cameras 90 degrees apart, no cue": {"angle": 90.0, "left_right": 0.0},
    "cameras 150 degrees apart": {"angle": 150.0},
}


def run(out: Path, *, n: int = 4000, seeds: int = 6, pairs: int = 20, first_seed: int = 9500) -> int:
    """Measure everything, print the tables, write CSV and JSON; nothing is tuned on these seeds.

    0, or 1 when one of :func:`promises` is missed.
    """
    seeds_used = range(first_seed, first_seed + seeds)
    hard = [scene(name, n, seeds_used, options) for name, options in SCENES.items()]
    print(f"AnchoredFGW, N = {n}, {seeds} fresh seeds:\n{table(hard)}\n")
    write_rows(out, "match_limits", hard, {"n": n, "first_seed": first_seed})
    trust = [related(pairs, first_seed), unrelated(pairs, first_seed), units(seeds, first_seed)]
    print(f"{table(trust)}\n")
    speed = track_distance_speed()
    print(table(speed))
    write_rows(out, "match_trust", trust)
    write_rows(out, "track_distance", speed)
    checks = promises(hard, trust, speed)
    print(f"\n{table([c.row() for c in checks])}")
    write_rows(out, "match_promises", [c.row() for c in checks], {"n": n, "first_seed": first_seed})
    return 0 if all(c.met for c in checks) else 1


def promises(hard: list[dict[str, Any]], trust: list[dict[str, Any]], speed: list[dict[str, Any]]) -> tuple[Check, ...]:
    """What matching promises. Speed is a ratio within one run."""
    worst = {row["scene"]: row["worst_p50"] for row in hard}
    share = {row["what"]: row["count"] / row["of"] for row in trust}
    ours, numpys = (row["cpu_seconds"] for row in speed)
    return (
        at_least("no left/right cue: worst P50", worst["no left/right cue"], 0.85),
        *(
            at_least(f"{what}: share", value, 0.95 if what == "related scenes matched" else 1.0)
            for what, value in share.items()
        ),
        at_least("D_track: times as fast as numpy's Gram", numpys / ours, 10.0),
    )


def scene(name: str, n: int, seeds: range, options: dict[str, Any]) -> dict[str, Any]:
    """Mean quality, worst P50, and how many answers were flagged."""
    qualities, flagged = [], 0
    for seed in counted(seeds, name, "world"):
        a, b, truth = matching_world(n, seed=seed, **options)
        matches = match(a, b, AnchoredFGW(), throw=False)
        qualities.append(match_quality(matches, truth))
        flagged += not matches.status.ok
    means = {key: float(np.mean([q[key] for q in qualities])) for key in qualities[0]}
    return {"scene": name, **means, "worst_p50": float(min(q["p50"] for q in qualities)), "flagged": flagged}


def related(pairs: int, seed: int, n: int = 1000) -> dict[str, Any]:
    """How many pairs of views of one scene are matched without a flag."""
    worlds = counted(range(seed, seed + pairs), "related scenes", "pair")
    ok = sum(match(*matching_world(n, seed=s)[:2], throw=False).status.ok for s in worlds)
    return {"what": "related scenes matched", "of": pairs, "count": ok}


def unrelated(pairs: int, seed: int, n: int = 1000) -> dict[str, Any]:
    """How many pairs of views of different scenes are told apart."""
    told = 0
    for k in counted(range(pairs), "unrelated scenes", "pair"):
        a, b = matching_world(n, seed=seed + k)[0], matching_world(n, seed=seed + 1000 + k)[1]
        told += match(a, b, throw=False).status.code == "no_match"
    return {"what": "unrelated scenes: no match", "of": pairs, "count": told}


def scaled(tracks: TrackSet, unit: float) -> TrackSet:
    """The same tracks in another unit of length."""
    assert tracks.xyz is not None
    return replace(tracks, xyz=tracks.xyz * np.float32(unit))


def units(seeds: int, seed: int, n: int = 2000) -> dict[str, Any]:
    """How many worlds give identical matches when lengths are multiplied by 1e-6 and by 1e6."""
    same = 0
    for k in counted(range(seeds), "units", "world"):
        a, b, _ = matching_world(n, seed=seed + k)
        first, *others = (
            {tuple(pair) for pair in match(scaled(a, unit), scaled(b, unit), throw=False).pairs.tolist()}
            for unit in (1.0, 1e-6, 1e6)
        )
        same += all(pairs == first for pairs in others)
    return {"what": "identical matches with units x 1e-6 and x 1e6", "of": seeds, "count": same}


def track_distance_speed(n: int = 5000, frames: int = 150) -> list[dict[str, Any]]:
    """D_track against numpy's Gram matrices, frame by frame; error relative to a float64 sample."""
    rng = np.random.default_rng(0)
    x = (rng.normal(size=(n, 1, 3)) + 0.2 * rng.normal(size=(n, frames, 3)) + 3).astype(np.float32)
    seen = np.ones(x.shape[:2], bool)
    track_distance(x[:200], seen[:200])
    rows, some = [], rng.integers(0, n, (2, 4000))
    exact = np.linalg.norm(x[some[0]].astype(float) - x[some[1]].astype(float), axis=2).max(1)
    for name, solver in (("D_track in blocks", lambda: track_distance(x, seen)), ("numpy Gram", lambda: gram(x))):
        wall, cpu = time.perf_counter(), time.process_time()
        distances = solver()
        spent = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
        error = np.abs(distances[some[0], some[1]] - exact)[exact > 0] / exact[exact > 0]
        rows.append({"what": name, "n": n, "frames": frames, **spent, "relative_error": float(error.max())})
    return rows


def gram(x: np.ndarray) -> np.ndarray:
    """max_t of ‖x_i‖² + ‖x_j‖² - 2 x_i·x_j: the textbook formula, whose terms cancel."""
    best = np.zeros((len(x), len(x)), x.dtype)
    for t in range(x.shape[1]):
        p = x[:, t]
        square = (p * p).sum(1)
        np.maximum(best, square[:, None] + square[None] - 2 * p @ p.T, out=best)
    return np.sqrt(np.maximum(best, 0))
