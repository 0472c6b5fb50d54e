"""``otsync bench chain --gate``: the chain that recordings are solved with, its errors and its time, on worlds.

Worlds and answers are decided by seeds: on one kind of machine errors are the same each time. Times are ratios to plain
solvers that run beside them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...compute.threads import FEW, blas_for
from ...progress import counted
from ...recordings.stages import Stages
from ...sync.verb import synchronize
from .. import record
from ..match import yardstick
from .worlds import SITUATIONS, WRONG, Case

SEEDS = range(12_400, 12_406)
"""Nothing was tuned on these."""

SHARE, FRAME = 0.2, 0.02
"""By which an error may grow: a share of the baseline's, and frames."""

TRUSTED, SLOWER = 0.17, 0.4
"""By how much less of a situation may be trusted: one answer of six, not two; and the share by which the speed may
fall."""


def judged(out: Path, *, gate: bool, rebase: bool) -> int:
    """Measure, write ``chain_gate.csv`` and ``.json``; 1 where the gate finds something worse, else 0.

    gate: compare with the baseline. rebase: make this run the baseline.
    """
    rows = measured(SEEDS)
    record.write_rows(out, "chain_gate", rows, {"first_seed": SEEDS[0], "seeds": len(SEEDS), "unit": "frames"})
    print(record.table(rows))
    figures = figures_of(rows)
    if rebase:
        record.save_baseline("chain", figures)
    return record.gate("chain", figures, worse) if gate else 0


def measured(seeds: Sequence[int]) -> list[dict[str, Any]]:
    """A row for every situation."""
    cases = [(name, make, seed) for name, make in SITUATIONS.items() for seed in seeds]
    found: dict[str, list[dict[str, float]]] = {}
    with blas_for(FEW):  # its threads spin for longer than they compute, and would be the yardstick
        for name in ("mid", "no depth"):  # imports and compiled loops are nobody's time
            answer(SITUATIONS[name](0))
        for name, make, seed in counted(cases, "the default chain", "case", len(cases)):
            found.setdefault(name, []).append(answer(make(seed)))
    return [{"situation": name, **summary(answers)} for name, answers in found.items()]


def answer(case: Case) -> dict[str, float]:
    """One case by the default chain: error, whether it is trusted, CPU seconds, and those of the yardstick."""
    stages = Stages()
    flat = case.a.xyz is None
    started = time.process_time()
    offsets = synchronize(case.tracks, method=stages.pixels if flat else stages.space)
    seconds = time.process_time() - started
    return {
        "error": float(case.errors(offsets.seconds)[0]),
        "trusted": float(offsets.status[1].ok),
        "cpu_s": seconds,
        "yardstick": min(yardstick(case.a, case.b) for _ in range(3)),  # what else ran only adds
    }


def summary(answers: Sequence[dict[str, float]]) -> dict[str, Any]:
    error, trusted, seconds, yard = (
        np.array([a[key] for a in answers]) for key in ("error", "trusted", "cpu_s", "yardstick")
    )
    return {
        "mean": round(float(error.mean()), 4),
        "trusted": round(float(trusted.mean()), 3),
        "trusted_wrong": int(((trusted > 0) & (error > WRONG)).sum()),
        "cpu_s": round(float(np.median(seconds)), 3),
        "speed": round(float(np.median(yard / seconds)), 5),
    }


def figures_of(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """The figures that the gate watches."""
    watched = ("mean", "trusted", "trusted_wrong", "speed")
    return {f"{row['situation']}: {key}": float(row[key]) for row in rows for key in watched}


def worse(key: str, found: float, baseline: float) -> bool:
    """Whether a figure of :func:`figures_of` is worse than the baseline's by more than the tolerance."""
    kind = key.rpartition(": ")[2]
    if kind == "trusted":
        return found < baseline - TRUSTED
    if kind == "trusted_wrong":
        return found > baseline
    if kind == "speed":
        return found < (1 - SLOWER) * baseline
    return found > (1 + SHARE) * baseline + FRAME
