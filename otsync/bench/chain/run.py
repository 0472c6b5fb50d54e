"""``otsync bench chain``: what a matcher is worth at the end of the chain, in frames of the offset.

Every matcher x every way from matches to an offset x matched again or not, each through :func:`otsync.synchronize` as
a user would call it, in situations that matchers differ in: the simulator's presets, few tracks, tracks of strangers,
a wide baseline, people who look alike, no depth; and, with a recording, pairs of its cameras. The row "paper" is
:data:`otsync.sync.method.PAPER`. Matched again means: by the matcher itself where it can be (cheapest partners,
unbalanced OT), else by mutual nearest neighbours at equal times, by the matcher's own costs. A missing answer counts as
the largest error that there can be.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...align.likelihood import LikelihoodScan
from ...align.warping import DTW
from ...compute.processes import process_pool
from ...costs.epipolar import EpipolarDistance
from ...costs.linear import Cosine, Cost
from ...costs.positions import CurveDistance
from ...epipolar import EpipolarRefine, EpipolarScan
from ...files.arrays import read_json
from ...match import (
    AnchoredFGW,
    Candidates,
    FusedGromovWasserstein,
    GromovWasserstein,
    NearestNeighbor,
    OptimalTransport,
    PartialFGW,
    SemirelaxedFGW,
    UnbalancedFGW,
    UnbalancedOT,
)
from ...match.slot import Matcher
from ...progress import counted, say
from ...recordings.stages import COLOUR
from ...refine.splines import SplineRefine
from ...refine.unrefined import Unrefined
from ...sync.method import PAPER, Method
from ...sync.verb import synchronize
from ...types import Clock
from ..record import table, write_rows
from .gate import judged
from .plot import plot
from .worlds import SITUATIONS, WRONG, Case, real_cases

FRESH, SEEDS = 9400, 10
"""First seed, and how many: nothing was tuned on seeds from here on."""

FEATURES: tuple[Cost, ...] = (Cosine(),)
PLACES: tuple[Cost, ...] = (Cosine(weight=COLOUR, center=False), CurveDistance())
"""Features and curves in one world frame: the costs of the default on recordings."""

IN_SPACE = {
    "nearest neighbour": NearestNeighbor(FEATURES),
    "EMD": OptimalTransport(costs=FEATURES),
    "GW": GromovWasserstein(),
    "FGW": FusedGromovWasserstein(costs=FEATURES),
    "partial FGW": PartialFGW(costs=FEATURES),
    "unbalanced FGW": UnbalancedFGW(costs=FEATURES),
    "semi-relaxed FGW": SemirelaxedFGW(costs=FEATURES),
    "anchored FGW": AnchoredFGW(costs=FEATURES),
    "EMD + curve": OptimalTransport(costs=PLACES),
    "cheapest partners + curve": Candidates(2, 200, PLACES),
    "unbalanced OT + curve": UnbalancedOT(costs=PLACES),
}
"""Matchers of tracks in space: on features (and structure), then with places in the common frame."""

PIXELS: tuple[Cost, ...] = (Cosine(center=False), EpipolarDistance())

IN_PIXELS = {
    "nearest neighbour": NearestNeighbor(PIXELS),
    "EMD": OptimalTransport(costs=PIXELS),
    "cheapest partners": Candidates(20, None, PIXELS),
    "unbalanced OT": UnbalancedOT(partners=20, top=None, costs=PIXELS),
}
"""Matchers of tracks in pixels."""

WAYS = {
    "DTW": (DTW(), Unrefined()),
    "scan": (LikelihoodScan(), Unrefined()),
    "scan + spline": (LikelihoodScan(), SplineRefine()),
}
PIXEL_WAYS = {"scan": (EpipolarScan(), Unrefined()), "scan + fit": (EpipolarScan(), EpipolarRefine())}
"""From matches to an offset: the paper's, and ours."""


def contenders(flat: bool, only: Sequence[str] = ()) -> dict[tuple[str, str, int], Method]:
    """Methods by (matcher, way, rematch). ValueError names a matcher that there is not."""
    matchers, ways = (IN_PIXELS, PIXEL_WAYS) if flat else (IN_SPACE, WAYS)
    rows = {
        (name, way, rematch): Method(matcher=matcher, aligner=aligner, refiner=refiner, rematch=rematch)
        for name, matcher in matchers.items()
        for way, (aligner, refiner) in ways.items()
        for rematch in (0, 1)
        # on pixels what cannot match again by itself would become another matcher
        if (not only or name in only) and not (flat and rematch and Matcher.of(matcher).at(Clock()) is None)
    }
    return rows if flat else rows | {("paper", "DTW", 0): PAPER}


def run(
    out: Path,
    *,
    scene: str | os.PathLike[str] | None = None,
    cache: Path | None = None,
    seeds: int = SEEDS,
    first_seed: int = FRESH,
    only: tuple[str, ...] = (),
    gate: bool = False,
    rebase: bool = False,
) -> int:
    """Measure, print a table for each situation, write CSV, JSON and the plot.

    Args:
        scene: a truly synchronised recording, whose pairs are measured too. cache: of its tracks and depth.
        seeds: worlds of each situation; half as many pairs of cameras of the recording, each with an offset in three
            bands.
        only: names of the matchers; default: all.
        gate: measure the default chain alone, on worlds of its own, and compare it with the committed baseline; exit
            code 1 where something got worse. rebase: make this run the baseline.
    """
    if gate or rebase:
        given: dict[str, Any] = {"scene": scene, "cache": cache, "only": only or None}
        given |= {"seeds": seeds if seeds != SEEDS else None, "first_seed": first_seed if first_seed != FRESH else None}
        if extra := [name for name, value in given.items() if value is not None]:
            raise ValueError(
                f"{', '.join(extra)}: expected none with --gate or --rebase, which measure worlds of their own. Leave "
                "it out."
            )
        return judged(out, gate=gate, rebase=rebase)
    known = {*IN_SPACE, *IN_PIXELS}
    if strange := [name for name in only if name not in known]:
        raise ValueError(f"--only: expected some of {', '.join(sorted(known))}; found {', '.join(strange)}.")
    if cache is not None and scene is None:
        raise ValueError(f"--cache: expected with a recording, whose tracks and depth it keeps; found {cache} alone.")
    chosen = range(first_seed, first_seed + seeds)
    cases: list[tuple[str, Callable[[], Case]]] = [
        (name, partial(make, seed)) for name, make in SITUATIONS.items() for seed in chosen
    ]
    if scene is not None:
        cases += real_cases(scene, cache or out / "stages", (seeds + 1) // 2, first_seed)
    about = {
        "seeds": seeds,
        "first_seed": first_seed,
        "scene": None if scene is None else Path(scene).resolve().name,
        "only": list(only),
    }
    rows = continued(out, about)
    done = {r["n"] for r in rows}
    left = [n for n in range(len(cases)) if n not in done]
    if done:
        say(f"{len(done)} cases are kept from an earlier run; {len(left)} are to be measured")
    if left:
        with process_pool(len(os.sched_getaffinity(0)), begin, (cases, only)) as pool:
            for found in counted(pool.map(partial(measure, only=only), left), "chains", "case", len(left)):
                rows += found
                write_rows(out, "chain_answers", rows, about)  # a run that is stopped continues here
    summary = summarise(rows)
    write_rows(out, "chain", summary, about)
    for situation in dict.fromkeys(r["situation"] for r in summary):
        own = [{k: v for k, v in r.items() if k != "situation"} for r in summary if r["situation"] == situation]
        say(f"{situation}: errors in frames\n{table(own)}\n")
    plot(summary, out / "chain.svg")
    return 0


def continued(out: Path, about: dict[str, Any]) -> list[dict[str, Any]]:
    """The answers of an earlier run into ``out`` with the same arguments; none when there was none."""
    path = out / "chain_answers.json"
    document = read_json(path) if path.exists() else {}
    alike = isinstance(document, dict) and all(document.get(k) == v for k, v in about.items())
    return list(document["rows"]) if alike and isinstance(document.get("rows"), list) else []


_cases: list[tuple[str, Callable[[], Case]]] = []
"""What a worker chooses from: sent to it once, since a recording's tracks are too large to send for every pair."""


def begin(cases: list[tuple[str, Callable[[], Case]]], only: tuple[str, ...]) -> None:
    """A worker takes the cases. Imports and compiled loops are no method's time."""
    _cases[:] = cases
    for case in (SITUATIONS["mid"](0), SITUATIONS["no depth"](0)):
        for method in contenders(case.a.xyz is None, only).values():
            synchronize([case.a, case.b], method=method)


def measure(index: int, only: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """Every contender on one case, a line for every video; CPU-seconds of one thread a pair.

    Of many videos at once the last way alone, and the paper's: the graph of pairs comes after either.
    """
    situation, make = _cases[index]
    case = make()
    rows = []
    for (matcher, way, rematch), method in contenders(case.a.xyz is None, only).items():
        if case.more and not (way == "scan + spline" or matcher == "paper"):
            continue
        started = time.process_time()
        offsets = synchronize(case.tracks, method=method)
        seconds = time.process_time() - started
        for v, error in enumerate(case.errors(offsets.seconds), 1):
            rows.append(
                {
                    "n": index,
                    "situation": situation,
                    "case": case.name,
                    "video": offsets.names[v],
                    "matcher": matcher,
                    "way": way,
                    "rematch": rematch,
                    "error": float(error),
                    "missing": not np.isfinite(offsets.seconds[v]),
                    "trusted": bool(offsets.status[v].ok),
                    "cpu_s": seconds / len(offsets.alignments),
                }
            )
    return rows


def summarise(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """By situation and chain: figures of |error|, share trusted, trusted answers that are wrong, the Pareto front."""
    groups: dict[tuple[str, str, str, int], list[dict[str, Any]]] = {}
    for r in rows:
        groups.setdefault((r["situation"], r["matcher"], r["way"], r["rematch"]), []).append(r)
    out: list[dict[str, Any]] = []
    for (situation, matcher, way, rematch), own in groups.items():
        e = np.array([r["error"] for r in own])
        trusted = np.array([r["trusted"] for r in own])
        out.append(
            {
                "situation": situation,
                "matcher": matcher,
                "way": way,
                "rematch": rematch,
                "median": round(float(np.median(e)), 4),
                "mean": round(float(e.mean()), 4),
                "p90": round(float(np.quantile(e, 0.9)), 4),
                "within_1": round(float((e <= WRONG).mean()), 3),
                "trusted": round(float(trusted.mean()), 3),
                "trusted_wrong": int((trusted & (e > WRONG)).sum()),
                "missing": int(sum(r["missing"] for r in own)),
                "cpu_s": round(float(np.mean([r["cpu_s"] for r in own])), 4),
            }
        )
    for r in out:
        rivals = [o for o in out if o["situation"] == r["situation"] and o is not r]
        r["front"] = not any(
            o["cpu_s"] <= r["cpu_s"] and o["mean"] <= r["mean"] and (o["cpu_s"], o["mean"]) != (r["cpu_s"], r["mean"])
            for o in rivals
        )
    return out
