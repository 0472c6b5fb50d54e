"""``otsync bench thresholds``: where the limits behind the flags come from, on the seeds that they are tuned on.

One limit at a time is set to other values, everything else stays as it is, and the classes of
:mod:`otsync.bench.trust.worlds` are synchronised anew. The table says how many answers each value trusts, how many of
those are wrong, and which value trusts the most right ones while no more than one in 500 is wrong.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ...align.likelihood import READS as SCANNED
from ...align.likelihood import LikelihoodScan
from ...refine.slot import JUDGED_BY
from ...refine.splines import READS as FITTED
from ...refine.splines import SplineRefine
from ...sync.method import Method
from ...types.trust import Trust
from ..record import Row, table, write_rows
from .diagram import in_sigmas
from .kept import Kept
from .run import FIRST_SEED, interval, measured, one, written, wrong
from .worlds import CLASSES, WITHOUT_DEPTH

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
    now = {name: value_of(name) for name in dict.fromkeys(only or LIMITS)}
    tried = {name: values(value) for name, value in now.items()}
    others = [(name, value) for name, each in tried.items() for value in each if value != now[name]]
    worlds = [(world, first_seed + k) for world in CLASSES for k in range(seeds)]
    # the limits as they are answer once, for all
    jobs = [(*limit, *world) for limit in [(None, 0.0), *others] for world in worlds if reads(limit[0], world[0])]
    about = {"seeds": seeds, "first_seed": first_seed}
    answers = list(measured(jobs, answered, "thresholds", Kept(out / "thresholds_answers.jsonl")))
    of: dict[tuple[str | None, float], list[Row]] = {}
    for row in answers:
        of.setdefault((row["limit"], row["value"]), []).append(row)
    rows = [
        summary(
            name,
            value,
            now[name],
            [r for r in of[(None, 0.0) if value == now[name] else (name, value)] if reads(name, r["class"])],
        )
        for name, each in tried.items()
        for value in each
    ]
    write_rows(out, "thresholds_answers", [written(r) for r in answers], about)
    write_rows(out, "thresholds", rows, about)
    told = [chosen([r for r in rows if r["limit"] == name]) for name in now]
    write_rows(out, "thresholds_chosen", told, about)
    print(table(rows), flush=True)
    print(f"\nchosen on seeds {first_seed} to {first_seed + seeds - 1}:\n\n{table(told)}", flush=True)
    return 0


def reads(name: str | None, world: str) -> bool:
    """Whether a limit can change the answers to a class: those of Trust are changed for tracks with depth alone."""
    return name not in LIMITS or world not in WITHOUT_DEPTH


def values(now: float) -> list[float]:
    """The values that are tried of a limit; of a whole number whole ones."""
    return list(dict.fromkeys(type(now)(round(now * f)) if isinstance(now, int) else now * f for f in FACTORS))


def value_of(name: str) -> float:
    """What a limit is now. ValueError where there is none of that name."""
    if name in LIMITS:
        return getattr(Trust(), name)
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
    return value


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
    owner = importlib.import_module(f"otsync.{place}")
    now = getattr(owner, constant)
    ours = [module for name, module in list(sys.modules.items()) if name.startswith("otsync.")]
    holders = [m for m in ours if vars(m).get(constant) is now and (m is owner or not defines(m, constant))]
    try:
        for module in holders:
            setattr(module, constant, value)
        yield None
    finally:
        for module in holders:
            setattr(module, constant, now)


def defines(module: ModuleType, constant: str) -> bool:
    """Whether a module gives the name a value of its own, which may be the same number by chance."""
    assigned = rf"^(\w+, )*{re.escape(constant)}\b[^=\n]*= "
    return re.search(assigned, inspect.getsource(module), re.MULTILINE) is not None


def answered(job: tuple[str | None, float, str, int]) -> list[dict[str, Any]]:
    """Answers to one world at one value of a limit, a row a video; None: all limits as they are."""
    name, value, world, seed = job
    with limit_set(name, value) if name else contextlib.nullcontext() as method:
        return [{"limit": name, "value": value, **row} for row in one((world, "default", seed), method)]


def summary(name: str, value: float, now: float, answers: Sequence[Row]) -> Row:
    """What a value does: answers that it trusts, those of them that are wrong, and how well sigma covers the others."""
    ok = [r for r in answers if r["trusted"]]
    bad = sum(wrong(r) for r in ok)
    units = in_sigmas([r for r in ok if not wrong(r)])
    return {
        "limit": name,
        "value": value,
        "now": now,
        "answers": len(answers),
        "right": len(ok) - bad,
        "wrong": bad,
        "wrong at most": interval(bad, len(ok))[1],
        "wrong classes": ", ".join(dict.fromkeys(r["class"] for r in ok if wrong(r))),
        "1 sigma": float((units <= 1).mean()) if len(units) else None,
        "2 sigma": float((units <= 2).mean()) if len(units) else None,
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
