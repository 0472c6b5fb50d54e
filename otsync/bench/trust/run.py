"""``otsync bench trust``: whether an answer that says "ok" is right, within the sigma that it says.

Every class of :mod:`otsync.bench.trust.worlds` is synchronised by the defaults. An answer is wrong where it is off by
more than a frame at either end of what two videos share; where there is no true answer, every trusted one is wrong.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...align.warping import DTW
from ...compute.processes import process_pool
from ...progress import counted, tell
from ...sync.method import PAPER, Method
from ...sync.verb import synchronize
from ..record import Row, table, write_rows
from ..sync_acceptance import WRONG, Check, at_least, at_most
from ..sync_worlds import FPS
from .diagram import draw, in_sigmas, reliability
from .kept import Kept
from .worlds import AT_THE_END, CLASSES

FIRST_SEED = 20_000
"""Thresholds were chosen on seeds below 10,000 (see :mod:`otsync.types.trust`)."""

METHODS: dict[str, Method | None] = {"default": None, "paper": PAPER, "DTW": Method("DTW", aligner=DTW())}

MENDED = (
    "freeze of 15",
    "freeze of 30",
    "ten frames dropped",
    "a second missing",
    "rate 1 %, 10 s",
    "rate 1 %, 20 s",
    "rate .1 %, 20 s",
    "rate .1 %, 30 s",
)
"""Classes whose clocks are to be found out, named and mended, to within :data:`AT_ENDS` frames at both ends."""

AT_ENDS = 0.15

SHORT = ("mid", "hard")
"""Classes that other methods than the default are asked, too."""


def run(
    out: Path,
    *,
    seeds: int = 20,
    first_seed: int = FIRST_SEED,
    only: tuple[str, ...] = (),
    promises: bool = False,
) -> int:
    """Measure, print tables, write CSV, JSON and the diagram; with ``promises`` 1 when one is not kept.

    Args:
        seeds: worlds a class. first_seed: where they begin. only: names of classes.
    """
    unknown = set(only) - set(CLASSES)
    if unknown:
        raise ValueError(f"--only: expected classes among {', '.join(CLASSES)}; found {', '.join(sorted(unknown))}.")
    chosen = tuple(only) or tuple(CLASSES)
    asked = [(name, "default") for name in chosen]
    if not only:
        asked += [(n, m) for n in SHORT for m in METHODS if m != "default"]
    # seed by seed: a draw that is stopped has answers of every class
    jobs = [(name, method, first_seed + k) for k in range(seeds) for name, method in asked]
    about = {"seeds": seeds, "first_seed": first_seed}
    rows = list(measured(jobs, one, "trust", Kept(out / "trust_answers.jsonl")))
    write_rows(out, "trust", [written(r) for r in rows], about)
    summary = summarise(rows)
    write_rows(out, "trust_classes", [written(r) for r in summary], about)
    print(table(summary), flush=True)
    told = reliability([r for r in rows if r["method"] == "default"])
    print("\n" + table(told), flush=True)
    write_rows(out, "trust_reliability", told, about)
    draw(rows, out / "trust.png")
    checks = list(acceptance(rows))
    print("\n" + table([c.row() for c in checks]), flush=True)
    write_rows(out, "trust_acceptance", [c.row() for c in checks], about)
    return 0 if all(c.met for c in checks) or not promises else 1


def measured(
    jobs: Sequence[Any], answer: Callable[[Any], list[dict[str, Any]]], what: str, kept: Kept | None = None
) -> Iterator[dict[str, Any]]:
    """A row a video; the jobs are done by a process a core.

    Args:
        what: is counted, in the progress bar. kept: what was measured before, and is not measured again.
    """
    todo = [job for job in jobs if kept is None or kept.rows(job) is None]
    if kept is not None and len(todo) < len(jobs):
        tell(f"{what}: {len(jobs) - len(todo)} of {len(jobs)} worlds were answered before: {kept.path}")
    with process_pool(len(os.sched_getaffinity(0))) as pool:
        fresh = iter(counted(pool.map(answer, todo, chunksize=2), what, "world", total=len(todo)))
        for job in jobs:
            rows = None if kept is None else kept.rows(job)
            if rows is None:
                rows = next(fresh)
                if kept is not None:
                    kept.keep(job, rows)
            yield from rows


def one(job: tuple[str, str, int], changed: Method | None = None) -> list[dict[str, Any]]:
    """Answers and errors of one world, a row a video.

    Args:
        job: class, name of the method, and seed. changed: stands in for the named method.
    """
    name, method, seed = job
    world = CLASSES[name](seed)
    if "method" in world.options and (changed is not None or method != "default"):
        raise ValueError(f"{name}: expected no other method, for these tracks have no depth; found {method!r}.")
    offsets = synchronize(list(world.tracks), **{"method": changed or METHODS[method], **world.options})
    ends, worst = world.errors(offsets)
    both, sigmas, heard = world.at_ends(offsets), offsets.sigma_ends * FPS, world.where_heard(offsets)
    rows = []
    for v in range(1, len(world.tracks)):
        sigma = float(offsets.sigma[v]) * FPS
        rows.append(
            {
                "class": name,
                "method": method,
                "seed": seed,
                "video": v,
                "error": float(ends[v - 1]),
                "anywhere": float(worst[v - 1]),
                "heard": float(heard[v - 1]),
                "sigma": sigma,
                "begin": float(both[v - 1, 0]),
                "end": float(both[v - 1, 1]),
                "sigma_begin": float(sigmas[v, 0]),
                "sigma_end": float(sigmas[v, 1]),
                "trusted": bool(offsets.status[v].ok and np.isfinite(offsets.seconds[v])),
                "rate": float(offsets.rates[v]),
                "breaks": "; ".join(f"video {u}: {b}" for u, bs in enumerate(offsets.breaks) for b in bs),
                "flags": " ".join(f.code for f in offsets.flags[v]),
            }
        )
    return rows


def written(row: Row) -> Row:
    """The row for a file: JSON knows neither nan (null) nor infinity ("inf")."""

    def plain(x: Any) -> Any:
        if isinstance(x, float) and not np.isfinite(x):
            return None if np.isnan(x) else "inf"
        return x

    return {k: plain(v) for k, v in row.items()}


def wrong(row: Row) -> bool:
    """Trusted, and off by more than a frame; no answer is nan, and never wrong."""
    return bool(row["trusted"] and not row["error"] <= WRONG)


def wrong_where_heard(row: Row) -> bool:
    """Trusted, and off by more than a frame where a step of the clock would be heard, or in most frames."""
    return bool(row["trusted"] and not row["heard"] <= WRONG)


def summarise(rows: Sequence[Row]) -> list[Row]:
    """By class and method."""
    summary: list[Row] = []
    for key in dict.fromkeys((r["class"], r["method"]) for r in rows):
        own = [r for r in rows if (r["class"], r["method"]) == key]
        ok = [r for r in own if r["trusted"]]
        e = np.array([r["error"] for r in ok])
        units = in_sigmas(ok)
        refused = np.array([r["error"] for r in own if not r["trusted"]])
        refused = refused[np.isfinite(refused)]
        summary.append(
            {
                "class": key[0],
                "method": key[1],
                "answers": len(own),
                "trusted": len(ok) / len(own),
                "wrong": sum(wrong(r) for r in own),
                "where heard": sum(wrong_where_heard(r) for r in own),
                "median": float(np.median(e)) if len(e) else None,
                "p90": float(np.quantile(e, 0.9)) if len(e) else None,
                "worst": float(e.max()) if len(e) else None,
                "1 sigma": float((units <= 1).mean()) if len(e) else None,
                "2 sigma": float((units <= 2).mean()) if len(e) else None,
                "median refused": float(np.median(refused)) if len(refused) else None,
            }
        )
    return summary


def acceptance(rows: Sequence[Row]) -> Iterator[Check]:
    """What is promised of trusted answers by the default method."""
    ours = [r for r in rows if r["method"] == "default"]
    ok = [r for r in ours if r["trusted"]]
    heard = [r["class"] for r in ok if wrong_where_heard(r)]
    yield at_most("confident and wrong where a step would be heard, in 500", 500 * len(heard) / max(len(ok), 1), 1)
    yield at_most("  most in one class", max(map(heard.count, heard), default=0), 1)
    ok = [r for r in ok if r["class"] not in AT_THE_END]
    bad = [r for r in ok if wrong(r)]
    yield at_most("confident and wrong, in 500 trusted", 500 * len(bad) / max(len(ok), 1), 1)
    low, high = interval(len(bad), len(ok))
    yield Check("  95 % interval of that share", high, f"{low:.2%} - {high:.2%} of {len(ok)}", True)
    by_class = [sum(r["class"] == c for r in bad) for c in dict.fromkeys(r["class"] for r in rows)]
    yield at_most("most in one class", max(by_class, default=0), 1)
    for preset, share in (("mid", 0.97), ("hard", 0.8), ("brutal", 0.4)):
        own = [r for r in ours if r["class"] == preset]
        if own:
            yield at_least(f"{preset}: share trusted", float(np.mean([r["trusted"] for r in own])), share)
    for preset in ("mid", "hard"):
        own = [r for r in ok if r["class"].startswith(preset)]
        if own:
            units = in_sigmas(own)
            one_sigma = float((units <= 1).mean())
            yield Check(f"{preset}: within one sigma", one_sigma, "0.63 - 0.75", 0.63 <= one_sigma <= 0.75)
            yield at_least(f"{preset}: within two sigmas", float((units <= 2).mean()), 0.93)
    for name in MENDED:
        own = [r for r in ours if r["class"] == name]
        if own:
            found = [r for r in own if (r["breaks"] or r["rate"] != 1.0) and r["error"] <= WRONG]
            yield at_least(f"{name}: found and named", len(found) / len(own), 0.9)
            yield at_most(
                f"{name}: largest error of trusted, frames",
                max((r["error"] for r in own if r["trusted"]), default=0.0),
                AT_ENDS,
            )


def interval(bad: int, of: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper and Pearson 1934)."""
    from scipy.stats import beta

    if of == 0:
        return 0.0, 1.0
    low = float(beta.ppf(0.025, bad, of - bad + 1)) if bad else 0.0
    return low, float(beta.ppf(0.975, bad + 1, of - bad)) if bad < of else 1.0
