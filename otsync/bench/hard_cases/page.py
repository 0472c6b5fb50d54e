"""Writes docs/stability.md from the catalogue: ``python -m otsync.bench.hard_cases.page``."""

from __future__ import annotations

from pathlib import Path

from . import aligning, matching
from .case import Case

HEAD = """# Hard cases

What a plain solver (POT called directly, or the paper's method) does, and what otsync does instead. Generated from the
table in `otsync/bench/hard_cases` by `make stability`; the tests run every row on every solver of its slot: it answers
rightly, flags its answer, or refuses the input with a ValueError, and never hangs. `otsync bench hard-cases` runs the
table from the shell, plugins included.
"""


def page() -> str:
    return "\n".join([HEAD, section("Matching", matching.CASES), section("Aligning and refining", aligning.CASES)])


def section(title: str, cases: tuple[Case, ...]) -> str:
    lines = [
        f"## {title}",
        "",
        "| case | why it is hard | plain solver | otsync | accepted | known limits |",
        "|-|-|-|-|-|-|",
    ]
    for c in cases:
        limits = "; ".join(f"{', '.join(n)}: {why}" for why, n in grouped(c.limits).items()) or "–"
        lines.append(f"| {c.name} | {c.why} | {c.plain} | {c.handled} | {', '.join(c.expect)} | {limits} |")
    return "\n".join(lines) + "\n"


def grouped(limits: dict[str, str]) -> dict[str, list[str]]:
    """Reason -> solvers."""
    out: dict[str, list[str]] = {}
    for name, why in limits.items():
        out.setdefault(why, []).append(name)
    return out


if __name__ == "__main__":
    Path("docs").mkdir(exist_ok=True)
    Path("docs/stability.md").write_text(page())
