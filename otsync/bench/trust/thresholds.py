"""``otsync bench thresholds``: where the limits behind the flags come from, on the seeds that they are tuned on.

One limit at a time is set to other values, everything else stays as it is, and the classes of
:mod:`otsync.bench.trust.worlds` are synchronised anew. The table says how many answers each value trusts, how many of
those are wrong, and which value trusts the most right ones while no more than one in 500 is wrong.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from ...align.likelihood import READS as SCANNED
from ...align.likelihood import LikelihoodScan
from ...progress import counted
from ...refine.slot import JUDGED_BY
from ...refine.splines import READS as FITTED
from ...refine.splines import SplineRefine
from ...sync.method import Method
from ...types.trust import Trust
from ..record import Row, table, write_rows
from .run import FIRST_SEED, interval, one, written, wrong
from .worlds import CLASSES

FACTORS = (0.5, 0.7, 0.85, 1.0, 1.2, 1.4, 2.0)
"""A limit is tried at its own value times these."""

LIMITS = tuple(field.name for field in fields(Trust))

TUNED_ON = 500
"""Where the seeds begin that limits are chosen on: those from :data:`FIRST_SEED` on only measure."""

APART = True
"""Takes hours, and is for those who change a limit: no part of ``otsync bench all``."""

ALLOWED = 1 / 500
"""Share of trusted answers that may be wrong."""


def run(out: Path, *, seeds: int = 3, first_seed: int = TUNED_ON, only: tuple[str, ...] = ()) -> int:
    """Sweep limits; print and write a row a value and the value that each would be given.

    Args:
        seeds: worlds a class and a value. first_seed: where they begin.
        only: limits; default: all of :class:`otsync.Trust`. A field of it (``blur``) or a number that stands in a
            module (``sync.parts.SUITS_BETTER``).

    Raises:
        ValueError: for a limit that there is not, or seeds that limits are not chosen on.
    """
    if first_seed + seeds > FIRST_SEED:
        raise ValueError(
            f"--first-seed: expected seeds below {FIRST_SEED}; found {first_seed} to {first_seed + seeds - 1}. What is "
            "measured from there on must be new to every limit."
        )
    now = {name: value_of(name) for name in only or LIMITS}
    tried = [(name, factor * value) for name, value in now.items() for factor in FACTORS]
    jobs = [(name, value, world, first_seed + k) for name, value in tried for world in CLASSES for k in range(seeds)]
    answers = list(measured(jobs))
    rows = [summary(name, value, now[name], [r for r in answers if (r["limit"], r["value"]) == (name, value)])
            for name, value in tried]  # fmt: skip
    about = {"seeds": seeds, "first_seed": first_seed}
    write_rows(out, "thresholds_answers", [written(r) for r in answers], about)
    write_rows(out, "thresholds", rows, about)
    told = [chosen([r for r in rows if r["limit"] == name]) for name in now]
    write_rows(out, "thresholds_chosen", told, about)
    print(table(rows), flush=True)
    print(f"\nchosen on seeds {first_seed} to {first_seed + seeds - 1}:\n\n{table(told)}", flush=True)
    return 0


def value_of(name: str) -> float:
    """What a limit is now. ValueError where there is none of that name."""
    if name in LIMITS:
        return float(getattr(Trust(), name))
    place, _, constant = name.rpartition(".")
    try:
        value = getattr(importlib.import_module(f"otsync.{place}"), constant)
    except (ImportError, AttributeError):
        value = None
    if not isinstance(value, (int, float)) or isinstance(value, bool) or value == 0:
        raise ValueError(
            f"--only: expected a limit among {', '.join(LIMITS)}, or a number other than 0 in a module of otsync such "
            f"as sync.parts.SUITS_BETTER; found {name}."
        )
    return float(value)


@contextlib.contextmanager
def limit_set(name: str, value: float) -> Iterator[Method | None]:
    """The method with a field of Trust changed; or a module's number changed, wherever it was imported."""
    if name in LIMITS:
        trust = replace(Trust(), **{name: value})
        yield Method(
            name,
            aligner=LikelihoodScan(trust=trust) if name in SCANNED else None,
            refiner=SplineRefine(trust=trust) if name in (*FITTED, *JUDGED_BY) else None,
        )
        return
    place, _, constant = name.rpartition(".")
    now = getattr(importlib.import_module(f"otsync.{place}"), constant)
    holders = [m for key, m in list(sys.modules.items()) if key.startswith("otsync") and vars(m).get(constant) is now]
    try:
        for module in holders:
            setattr(module, constant, value)
        yield None
    finally:
        for module in holders:
            setattr(module, constant, now)


def answered(job: tuple[str, float, str, int]) -> list[Row]:
    """Answers to one world at one value of a limit, a row a video."""
    name, value, world, seed = job
    with limit_set(name, value) as method:
        return [{"limit": name, "value": value, **row} for row in one((world, name, seed), method)]


def measured(jobs: Sequence[tuple[str, float, str, int]]) -> Iterator[Row]:
    """A row a video; the jobs are done by a process a core."""
    import multiprocessing

    workers = len(os.sched_getaffinity(0))
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        for rows in counted(pool.map(answered, jobs, chunksize=2), "thresholds", "world", total=len(jobs)):
            yield from rows


def summary(name: str, value: float, now: float, answers: Sequence[Row]) -> Row:
    """What a value does: answers that it trusts, those of them that are wrong, and how well sigma covers the others."""
    ok = [r for r in answers if r["trusted"]]
    bad = sum(wrong(r) for r in ok)
    error, sigma = (np.array([r[k] for r in ok if not wrong(r)]) for k in ("error", "sigma"))
    return {
        "limit": name,
        "value": value,
        "now": now,
        "answers": len(answers),
        "right": len(ok) - bad,
        "wrong": bad,
        "wrong at most": interval(bad, len(ok))[1],
        "wrong classes": ", ".join(dict.fromkeys(r["class"] for r in ok if wrong(r))),
        "1 sigma": float((error <= sigma).mean()) if len(error) else None,
        "2 sigma": float((error <= 2 * sigma).mean()) if len(error) else None,
    }


def chosen(rows: Sequence[Row]) -> Row:
    """The value that trusts the most right answers with at most :data:`ALLOWED` wrong; the nearest to the present one
    of several. Where none is that good, the one with the smallest share of wrong ones.
    """

    def share(row: Row) -> float:
        return row["wrong"] / max(row["right"] + row["wrong"], 1)

    def apart(row: Row) -> float:
        return abs(float(np.log(row["value"] / row["now"])))

    good = [r for r in rows if share(r) <= ALLOWED]
    best = min(good, key=lambda r: (-r["right"], apart(r))) if good else min(rows, key=lambda r: (share(r), apart(r)))
    present = min(rows, key=apart)
    return {
        "limit": best["limit"],
        "now": best["now"],
        "right now": present["right"],
        "wrong now": present["wrong"],
        "chosen": best["value"],
        "right": best["right"],
        "wrong": best["wrong"],
    }
