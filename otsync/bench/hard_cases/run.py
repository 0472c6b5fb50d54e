"""``otsync bench hard-cases``: every solver through the catalogue, or the named ones."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...progress import counted
from ..record import table, write_rows
from . import adversaries, aligning, epipolar, graphs, matching, own_frames, rematching
from .case import Case
from .solvers import (
    SPECIAL,
    Solver,
    accepted,
    aligners,
    aligning_solver,
    flattening_solver,
    graph_solver,
    matchers,
    matching_solver,
    outcome,
    own_frames_solver,
    refiners,
    refining_solver,
    rematchers,
    rematching_solver,
    scanning_solver,
    watchdog,
)
from .solvers import graphs as combinations

LONGEST = 600
"""Seconds that a solver may take on a row: more is a hang, even on a slow and busy machine (usual: below one)."""


@dataclass(frozen=True)
class Section:
    """The rows of one slot and who runs them."""

    title: str
    cases: tuple[Case, ...]
    solvers: dict[str, Solver]

    def rows(self) -> Iterator[tuple[Case, str, Solver]]:
        """Every row with every solver that it is for."""
        for case in self.cases:
            for name in case.solvers or [n for n in self.solvers if n not in SPECIAL]:
                yield case, name, self.solvers[name]


def sections() -> tuple[Section, ...]:
    """The catalogue: every slot, its rows, and every algorithm that goes in it."""
    to_match = {name: matching_solver(m) for name, m in (matchers() | SPECIAL).items()}
    to_align = {name: aligning_solver(a) for name, a in aligners().items()}
    to_align |= {name: refining_solver(r) for name, r in refiners().items()}
    return (
        Section("Matching", matching.CASES, to_match),
        Section(
            "Matching once more at known times",
            rematching.CASES,
            {name: rematching_solver(at) for name, at in rematchers().items()},
        ),
        Section("Aligning and refining", aligning.CASES, to_align),
        Section("Confident and wrong: the classes of the issue Trust", adversaries.CASES, to_align),
        Section(
            "Aligning and refining without depth",
            epipolar.CASES,
            {"EpipolarScan": scanning_solver, "EpipolarRefine": flattening_solver},
        ),
        Section(
            "Many videos: the graph of pairs",
            graphs.CASES,
            {name: graph_solver(graph) for name, graph in combinations().items()},
        ),
        Section("Without a common frame", own_frames.CASES, {"OwnFrames": own_frames_solver}),
    )


def rows() -> Iterator[tuple[Case, str, Solver]]:
    """(case, name of the solver, solver) for every row of the catalogue and every solver that it is for."""
    for section in sections():
        yield from section.rows()


def run(out: Path, *, only: Sequence[str] = ()) -> int:
    """Run the catalogue, print what each solver made of it, write CSV and JSON; 1 when an answer is not accepted.

    Args:
        only: names of solvers; default: all.
    """
    chosen = [row for row in rows() if not only or row[1] in only]
    unknown = sorted(set(only) - {name for _, name, _ in rows()})
    if unknown:
        names = dict.fromkeys(name for _, name, _ in rows())
        raise ValueError(f"--only: expected some of {'; '.join(names)}. Found {'; '.join(unknown)}.")
    lines: list[dict[str, Any]] = []
    for case, name, solver in counted(chosen, "hard cases", "row", len(chosen)):
        started = time.perf_counter()
        try:
            with watchdog(LONGEST):
                kind, detail = outcome(case, solver)
            fine = accepted(case, name, kind, detail)
        except Exception as error:  # a solver of somebody else's may raise anything
            kind, fine = f"{type(error).__name__}: {error}", False
        seconds = time.perf_counter() - started
        lines.append(
            {
                "solver": name,
                "case": case.name,
                "outcome": kind,
                "expected": " or ".join(case.expect),
                "accepted": fine,
                "seconds": seconds,
            }
        )
    write_rows(out, "hard_cases", lines)
    summary = []
    for name in dict.fromkeys(line["solver"] for line in lines):
        own = [line for line in lines if line["solver"] == name]
        kinds = {
            kind: sum(line["outcome"] == kind for line in own) for kind in ("right", "flagged", "refused", "WRONG")
        }
        summary.append({"solver": name, "rows": len(own), **kinds, "not accepted": sum(not x["accepted"] for x in own)})
    print(table(summary))
    for line in lines:
        if not line["accepted"]:
            print(f"{line['solver']}: {line['case']}: {line['outcome']}; accepted: {line['expected']}")
    return 0 if all(line["accepted"] for line in lines) else 1
