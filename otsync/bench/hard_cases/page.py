"""Writes docs/stability.md by running the catalogue: ``python -m otsync.bench.hard_cases.page``, some minutes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from . import plain
from .case import FLAGGED, REFUSED, RIGHT, Case
from .clean import needless
from .run import Section, sections
from .solvers import WRONG, outcome

HEAD = """# Hard cases

What plain solvers do on hard inputs (POT and tslearn called directly, as their manuals show), and what otsync does. All
outcomes are run, by `make stability`, from the tables in `otsync/bench/hard_cases`. The tests run every row on every
solver of its slot: it answers rightly, flags its answer, or refuses the input with a ValueError, and never hangs.
*Known limits* name solvers that flag or refuse where others answer; no limit excuses a wrong answer without a flag.
Rows that are *open* have such answers today: they are counted below, and are to be mended.
`otsync bench hard-cases` runs the table from the shell, plugins included.
"""

PLAIN: tuple[Callable[..., Any], ...] = (
    plain.matching,
    plain.rematching,
    plain.aligning,
    plain.aligning,
    plain.scanning,
    plain.graph,
    plain.graph,
)
"""The plain solver of every section."""

Line = tuple[Case, str, dict[str, list[str]]]
"""A row, the plain solver's outcome, and ours: kind -> solvers."""


def page() -> str:
    """The whole page; it runs everything."""
    logging.getLogger("otsync").setLevel(logging.ERROR)  # failures of pairs are outcomes here
    told = [(s, [line(c, s, solver) for c in s.cases]) for s, solver in zip(sections(), PLAIN, strict=True)]
    return "\n".join([HEAD, summary(told), *(section(s.title, lines) for s, lines in told)])


def line(case: Case, section: Section, solver: Callable[..., Any]) -> Line:
    """A row with everything run on it."""
    kinds: dict[str, list[str]] = {RIGHT: [], FLAGGED: [], REFUSED: [], WRONG: []}
    for row, name, ours in section.rows():
        if row is case:
            kinds[outcome(row, ours)[0]].append(name)
    return case, plain.outcome(case, solver), kinds


def summary(told: list[tuple[Section, list[Line]]]) -> str:
    """Counts, and what is wrong without a flag."""
    rows = [
        "| slot | rows | combinations | right | flagged | refused | **wrong, unflagged** | plain solver right |",
        "|-|-|-|-|-|-|-|-|",
    ]
    total = [0] * 7
    wrong = []
    for s, lines in told:
        kinds = [sum(len(k[kind]) for _, _, k in lines) for kind in (RIGHT, FLAGGED, REFUSED, WRONG)]
        counts = [len(lines), sum(kinds), *kinds, sum(said.startswith("right") for _, said, _ in lines)]
        total = [x + y for x, y in zip(total, counts, strict=True)]
        rows.append(f"| {s.title} | " + " | ".join(map(str, counts)) + " |")
        wrong += [
            f"* {case.name}: {', '.join(k[WRONG])}"
            + (f" (open: issue {case.open})" if case.open else " (**not accepted**)")
            for case, _, k in lines
            if k[WRONG]
        ]
    rows.append("| all | " + " | ".join(map(str, total)) + " |")
    flagged, draws = needless()
    needed = [
        "",
        f"Needless flags on easy rows, fresh draws: {flagged} of {draws} ({100 * flagged / draws:.1f} %).",
        "",
        f"Wrong without a flag: {total[5]}.",
        "",
        *wrong,
        "",
    ]
    return "\n".join(rows + needed)


def section(title: str, lines: list[Line]) -> str:
    """The table of a slot."""
    out = [
        f"## {title}",
        "",
        "| case | why it is hard | plain solver, run | otsync | outcomes | accepted | known limits |",
        "|-|-|-|-|-|-|-|",
    ]
    for case, said, kinds in lines:
        told = ", ".join(f"{kind} {len(names)}" for kind, names in kinds.items() if names)
        name, why, handled, accepted, limits = told_by_hand(case)
        out.append(f"| {name} | {why} | {said} | {handled} | {told} | {accepted} | {limits} |")
    return "\n".join(out) + "\n"


def told_by_hand(case: Case) -> tuple[str, str, str, str, str]:
    """The columns that are not run."""
    limits = "; ".join(f"{', '.join(names)}: {why}" for why, names in grouped(case.limits).items()) or "–"
    accepted = ", ".join(case.expect) + (f" (open: issue {case.open})" if case.open else "")
    return case.name, case.why, case.handled, accepted, limits


def grouped(limits: dict[str, str]) -> dict[str, list[str]]:
    """Reason -> solvers."""
    out: dict[str, list[str]] = {}
    for name, why in limits.items():
        out.setdefault(why, []).append(name)
    return out


if __name__ == "__main__":
    Path("docs").mkdir(exist_ok=True)
    Path("docs/stability.md").write_text(page())
