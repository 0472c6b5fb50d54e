"""Accuracy of matching against time: every matcher at every size that it can take, with POT's own solver beside it.

Each cell runs in a process of its own, warmed up on a small world, so that its peak memory is that of the cell.
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..costs.linear import Cosine, total_cost
from ..match import MATCHERS as OFFERED
from ..match.anchored import AnchoredFGW
from ..match.dense import EntropicFGW, FusedGromovWasserstein, NearestNeighbor, OptimalTransport, PartialFGW
from ..match.problem import from_plan, normalised_structure, uniform
from ..match.slot import MatcherLike
from ..metrics import match_quality
from ..plugins import ENVIRONMENT, available, loaded_files
from ..progress import counted, say
from ..simulate import matching_world
from ..types import Matches, TrackSet
from . import match_limits, record
from .record import table, write_rows

SIZES = (200, 500, 1000, 2000, 5000, 20_000, 50_000)
REFERENCE = "POT fused_gromov_wasserstein"
FIGURES = ("precision", "recall", "flips", "p50")


@dataclass(frozen=True)
class PotDefaults:
    """POT called directly, with its own defaults, on prepared matrices; the time is that of this call alone."""

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        import ot

        M, (Ca, Cb) = total_cost((Cosine(),), a, b), normalised_structure(a, b)
        p, q = uniform(len(a)), uniform(len(b))
        wall, cpu = time.perf_counter(), time.process_time()
        plan, log = ot.gromov.fused_gromov_wasserstein(M, Ca, Cb, p, q, log=True)
        stats = {"solver_seconds": time.perf_counter() - wall, "solver_cpu": time.process_time() - cpu}
        linear = (Ca**2 @ p)[:, None] + (Cb**2 @ q)[None] - 2 * Ca @ plan @ Cb + 0.5 * M
        return from_plan(plan, linear, p, q, 1.0, stats | {"objective": float(log["fgw_dist"])}, False)


#: rows of the table: name -> matcher, and the largest size at which it is tried
MATCHERS: dict[str, tuple[MatcherLike, int]] = {
    REFERENCE: (PotDefaults(), 5000),
    "NearestNeighbor": (NearestNeighbor(), 5000),
    "OptimalTransport": (OptimalTransport(), 5000),
    "FusedGromovWasserstein": (FusedGromovWasserstein(), 5000),
    "EntropicFGW": (EntropicFGW(), 2000),
    "PartialFGW": (PartialFGW(), 2000),
    "AnchoredFGW, small": (AnchoredFGW(anchors=100, cells=500, restarts=1), 50_000),
    "AnchoredFGW": (AnchoredFGW(), 50_000),
}


LIMIT = 60.0
"""CPU seconds that a matcher may take for a world."""

OTHERS_LARGEST = 2000
"""Largest size at which a matcher without a row of its own is tried: a dense one takes a minute there."""


def rivals() -> dict[str, tuple[MatcherLike, int]]:
    """Other packages' FGW, where they are installed."""
    from . import rivals

    return rivals.installed()


def others() -> dict[str, tuple[MatcherLike, int]]:
    """Matchers of the slot that have no row above, at their defaults: ours and plugins'. No gate watches them."""
    listed = {type(matcher) for matcher, _ in MATCHERS.values()}
    found = {name: thing for name, thing in available("matchers", OFFERED).items() if thing not in listed}
    return {name: (thing() if isinstance(thing, type) else thing, OTHERS_LARGEST) for name, thing in found.items()}


def contenders() -> dict[str, tuple[MatcherLike, int]]:
    """Every row of the table: name -> matcher, and the largest size at which it is tried."""
    return MATCHERS | rivals() | others()


def run(
    out: Path,
    *,
    sizes: tuple[int, ...] = SIZES,
    seeds: int | None = None,
    first_seed: int | None = None,
    limit: float = LIMIT,
    only: tuple[str, ...] = (),
    promises: bool = False,
    gate: bool = False,
    rebase: bool = False,
) -> int:
    """Measure every matcher at every size; print the table, write CSV, JSON and the plot.

    Args:
        seeds: worlds per cell, from ``first_seed`` on; nothing is tuned on them. Default: 2 from 9000; the promises'
            own.
        promises: measure the limits of matching (:mod:`otsync.bench.match_limits`) instead.
        limit: CPU seconds per world; a matcher is not tried at sizes where it is expected to take longer.
        only: names of matchers; default: all of :func:`contenders`.
        gate: compare with the committed baseline, 1 when something got worse. rebase: make this run the baseline.
            Neither looks at matchers without a row in :data:`MATCHERS`, or at other packages' without one there.
    """
    if promises:
        for name, given in (("only", only), ("sizes", sizes != SIZES), ("limit", limit != LIMIT)):
            if given:
                raise ValueError(
                    f"{name}, promises: expected one of them; found both. The promises are of AnchoredFGW at sizes of "
                    "their own."
                )
        chosen = {"seeds": seeds, "first_seed": first_seed}
        return match_limits.run(out, **{name: value for name, value in chosen.items() if value is not None})
    seeds, first_seed = 2 if seeds is None else seeds, 9000 if first_seed is None else first_seed
    every, rows = contenders(), []  # type: dict[str, tuple[MatcherLike, int]], list[dict[str, Any]]
    if not set(only) <= set(every):
        raise ValueError(f"only: expected some of {', '.join(every)}; found {', '.join(set(only) - set(every))}.")
    watched = MATCHERS | rivals()
    chosen_names = only or (watched if gate or rebase else every)  # a gate needs no others
    for name, (_, largest) in every.items():
        if name not in chosen_names:
            continue
        for n in counted([s for s in sizes if s <= largest], name, "size"):
            last = rows[-1] if rows and rows[-1]["matcher"] == name else None
            if last and last.get("cpu_seconds", limit) * (n / last["n"]) ** growth(name) > limit:
                break
            row = cell(name, n, range(first_seed, first_seed + seeds), limit)
            rows.append(row)
            say(table([row], COLUMNS).splitlines()[-1])
            if row["status"] != "ok":
                break
    for row in rows:
        base = next((r for r in rows if (r["matcher"], r["n"]) == (REFERENCE, row["n"]) and r["status"] == "ok"), None)
        row["speedup"] = base["cpu_seconds"] / row["cpu_seconds"] if base and row["status"] == "ok" else None
    mark_front(rows)
    print("\n" + table(rows, COLUMNS))
    write_rows(out, "match", rows, {"seeds": seeds, "first_seed": first_seed, "limit": limit})
    from .match_plot import plot

    plot(rows, out / "match_frontier.svg")
    figures = figures_of([row for row in rows if row["matcher"] in watched])
    if rebase:
        record.save_baseline("match", figures)
    return record.gate("match", figures, worse) if gate else 0


def growth(name: str) -> float:
    """The power of the number of tracks with which seconds are expected to grow: dense matchers fill a matrix."""
    return 1.0 if name.startswith("Anchored") or name in rivals() else 2.0


COLUMNS = ("matcher", "n", "status", *FIGURES, "objective", "seconds", "cpu_seconds", "speedup", "peak_gb", "front")


def figures_of(rows: list[dict[str, Any]]) -> dict[str, float]:
    """The figures that the gate compares: accuracy, and times as ratios to those of the yardstick beside them.

    Ratios of sizes below 1000 are left out: times of milliseconds vary too much.
    """
    done = [r for r in rows if r["status"] == "ok"]
    figures = {f"{r['matcher']} {r['n']} p50": r["p50"] for r in done}
    large = (r for r in done if r["n"] >= 1000 and r["matcher"] != REFERENCE)
    return figures | {f"{r['matcher']} {r['n']}: speed": r["yardstick"] / r["cpu_seconds"] for r in large}


YARD = 2000
"""Tracks that the yardstick fills a matrix for, at most."""


def yardstick(a: TrackSet, b: TrackSet) -> float:
    """CPU seconds of plain solvers on work like a matcher's, taken in the same minute and process.

    Nearest neighbours of the features in numpy, which wait for memory, and POT's FGW of 200 tracks, which waits for
    the processor. A ratio to one of them alone tells a machine's memory from its processor: POT's FGW of 2000 tracks,
    against which this gate once compared, moved by a factor of two from one machine to the next, by old code and new.
    """
    assert a.features is not None and b.features is not None
    x, y = a.features[:YARD], b.features[:YARD]
    small = matching_world(200, seed=1)
    M, (Ca, Cb) = total_cost((Cosine(),), *small[:2]), normalised_structure(*small[:2])
    p, q = uniform(len(M)), uniform(M.shape[1])
    import ot

    started = time.process_time()
    (1 - (x / np.linalg.norm(x, axis=1)[:, None]) @ (y / np.linalg.norm(y, axis=1)[:, None]).T).argmin(1)
    ot.gromov.fused_gromov_wasserstein(M, Ca, Cb, p, q)
    return time.process_time() - started


def worse(key: str, measured: float, baseline: float) -> bool:
    """Accuracy may vary by .04 with the rounding of platforms, the ratio of times in the same run by two fifths."""
    return measured < baseline - 0.04 if key.endswith("p50") else measured < 0.6 * baseline


def cell(name: str, n: int, seeds: range, limit: float) -> dict[str, Any]:
    """One matcher at one size, in a process of its own: mean accuracy, median times, peak memory."""
    code = f"from otsync.bench.match import measure; measure({name!r}, {n}, {list(seeds)})"
    row: dict[str, Any] = {"matcher": name, "n": n}
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            timeout=60 + 4 * limit * len(seeds),
            env=os.environ | {ENVIRONMENT: os.pathsep.join(map(str, loaded_files()))},
        )
    except subprocess.TimeoutExpired:
        return row | {"status": "over the time limit"}
    if done.returncode:
        return row | {"status": done.stderr.strip().splitlines()[-1][:100] if done.stderr else "killed"}
    row |= json.loads(done.stdout.splitlines()[-1])
    return row | {"status": "ok" if row["cpu_seconds"] <= limit else "over the time limit"}


SETTLED = 0.5
"""Seconds before the clock starts: threads of BLAS that made the world spin on for a while, and would count."""


def measure(name: str, n: int, seeds: list[int]) -> None:
    """The work of :func:`cell`, in its process; prints one line of JSON."""
    matcher = contenders()[name][0]
    matcher(*matching_world(60, seed=1)[:2])
    if isinstance(matcher, AnchoredFGW):
        matcher(*matching_world(3 * matcher.cells // 2 + 300, seed=1, frames=20)[:2])
    runs = []
    for seed in seeds:
        a, b, truth = matching_world(n, seed=seed)
        time.sleep(SETTLED)
        wall, cpu = time.perf_counter(), time.process_time()
        matches = matcher(a, b)
        spent = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
        if "solver_cpu" in matches.stats:
            spent = {"seconds": matches.stats["solver_seconds"], "cpu_seconds": matches.stats["solver_cpu"]}
        objective = matches.stats.get("objective", float("nan"))
        spent["yardstick"] = min(yardstick(a, b) for _ in range(5))  # what else ran only adds
        runs.append(match_quality(matches, truth) | spent | {"objective": objective})
    row = {key: float(np.mean([r[key] for r in runs])) for key in (*FIGURES, "objective")}
    row |= {key: float(np.median([r[key] for r in runs])) for key in ("seconds", "cpu_seconds", "yardstick")}
    row["peak_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    # not every matcher tells its objective, and files hold no NaN
    print(json.dumps({key: value if math.isfinite(value) else None for key, value in row.items()}))


def mark_front(rows: list[dict[str, Any]]) -> None:
    """``front``: no matcher at the same size is both faster and at least as accurate."""
    for row in rows:
        same = [r for r in rows if r["n"] == row["n"] and r["status"] == "ok" and r is not row]
        beaten = (
            any(r["cpu_seconds"] <= row["cpu_seconds"] and r["p50"] >= row["p50"] for r in same)
            if row["status"] == "ok"
            else True
        )
        row["front"] = "" if beaten else "*"
