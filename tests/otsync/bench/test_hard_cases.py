"""Every solver runs the whole catalogue: it answers rightly, flags or refuses; never a confident wrong answer, nan or
a hang.
"""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync import Alignment, Matches, Status, TrackSet
from otsync.bench.hard_cases import plain
from otsync.bench.hard_cases.case import FLAGGED, REFUSED, RIGHT, Case, near
from otsync.bench.hard_cases.clean import draws
from otsync.bench.hard_cases.page import PLAIN, told_by_hand
from otsync.bench.hard_cases.run import LONGEST, rows, run, sections
from otsync.bench.hard_cases.solvers import (
    SPECIAL,
    WRONG,
    accepted,
    check_sane,
    judged,
    matchers,
    matching_solver,
    outcome,
    watchdog,
)

PAGE = Path(__file__).parents[3] / "docs" / "stability.md"

FAST = (
    "NearestNeighbor",
    "OptimalTransport",
    "FusedGromovWasserstein",
    "UnbalancedOT",
    "SynchronousMatching",
    "UnbalancedOT, at equal times",
    "LikelihoodScan",
    "SplineRefine",
    "EpipolarScan",
)
"""Run every time, one or two of every slot; the graph by the rows below, all others in the slow tests."""

FAST_GRAPHS = (
    "one video unrelated",
    "one video without a frame in common",
    "two scenes, two videos of each",
    "the reference unrelated",
)


def is_slow(case: Case, name: str) -> bool:
    return name not in FAST and not (name == "Graph" and case.name in FAST_GRAPHS)


ROWS = [
    pytest.param(case, name, solver, id=f"{case.name}-{name}", marks=[pytest.mark.slow] if is_slow(case, name) else [])
    for case, name, solver in rows()
]


@pytest.mark.parametrize("case, name, solver", ROWS)
def test_answers_rightly_or_refuses(case, name, solver):
    with watchdog(LONGEST), warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        kind, detail = outcome(case, solver)
    if case.open and kind == WRONG:
        pytest.xfail(f"open: issue {case.open}")
    assert accepted(case, name, kind, detail), f"{kind}: {detail}"


@given(
    st.integers(0, 10**9),
    st.sampled_from(
        ["NearestNeighbor", "OptimalTransport", "FusedGromovWasserstein", "PartialFGW", "AnchoredFGW", "UnbalancedOT"]
    ),
)
@settings(max_examples=60, deadline=None)
def test_whatever_comes_the_answer_is_sane(seed, name):
    """Beyond the catalogue: random sizes, magnitudes, gaps, repetitions, degenerate dimensions."""
    rng = np.random.default_rng(seed)

    def video() -> TrackSet:
        n, frames = int(rng.integers(1, 30)), int(rng.integers(1, 8))
        xyz = rng.normal(size=(n, frames, 3)) * 10.0 ** rng.integers(-40, 40) * rng.integers(0, 2, 3)
        features = rng.normal(size=(n, 5)).round(int(rng.integers(0, 3))) + 1e-3 * rng.integers(0, 2)
        features[~features.any(1)] = 1
        repeat = rng.integers(0, n, n) if rng.random() < 0.3 else np.arange(n)
        return TrackSet(xyz[repeat], rng.random((n, frames)) < rng.choice([0.1, 0.6, 1.0]), features[repeat], fps=30)

    with watchdog(LONGEST), warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        check_sane(matching_solver(matchers()[name])(video(), video()))


def test_the_catalogue_is_large_and_its_names_are_unique():
    names = [case.name for section in sections() for case in section.cases]
    assert len(names) >= 110
    assert not [name for name, n in Counter(names).items() if n > 1]


def test_every_slot_has_rows_and_every_row_a_solver():
    told = sections()
    assert len(told) == len(PLAIN)
    for section in told:
        assert len(section.cases) >= 9, section.title
        for case in section.cases:
            assert case.check is not None or RIGHT not in case.expect, f"{case.name}: right by what?"
            assert set(case.solvers) <= set(section.solvers) and set(case.limits) <= set(section.solvers)
    everyone = {name for _, name, _ in rows()}
    assert everyone >= {"UnbalancedOT", "UnbalancedFGW", "SemirelaxedFGW", "Candidates", "Unrefined", "EpipolarRefine"}
    assert everyone >= set(SPECIAL) | {"Graph", "Graph, star"}


def test_no_limit_excuses_a_wrong_answer():
    case = Case("x", "", "", lambda: (), (RIGHT,), check=near(1.0), limits={"Lame": "it may"})
    wrong, right = Alignment(2.0), Alignment(1.0)
    assert judged(case, wrong) == WRONG and judged(case, right) == RIGHT
    assert judged(case, replace(wrong, flags=(Status.WEAK,))) == FLAGGED
    assert accepted(case, "Lame", FLAGGED, None) and accepted(case, "Lame", REFUSED, "why")
    assert not accepted(case, "Lame", WRONG, None) and not accepted(case, "Other", FLAGGED, None)
    # where only a flag is right, no answer without one is, whatever it says
    assert judged(replace(case, expect=(FLAGGED,)), right) == WRONG
    repeated = Matches(np.array([[0, 0], [0, 0]]))
    with pytest.raises(AssertionError):
        check_sane(repeated)


def test_the_page_tells_every_row():
    """`make stability` runs and writes it; the columns that are not run are compared here."""
    lines = set()
    for line in PAGE.read_text().splitlines():
        cells = [c.strip() for c in line.split("|")[1:-1]]
        if len(cells) == 7:
            lines.add((cells[0], cells[1], cells[3], cells[5], cells[6]))
    missing = {told_by_hand(case) for section in sections() for case in section.cases} - lines
    assert not missing, f"run `make stability`; it does not tell {sorted(missing)[:3]}"


def test_plain_solvers_are_run():
    """POT on an easy row and on nan features; the star where nothing has an offset."""
    by_name = {case.name: (case, solver) for s, solver in zip(sections(), PLAIN, strict=True) for case in s.cases}
    assert plain.outcome(*by_name["read-only arrays"]).startswith("right")
    assert plain.outcome(*by_name["nan features"]).startswith(("nan", "the product plan", "an answer", "ValueError"))
    assert plain.outcome(*by_name["300,000 tracks"]) == "not run: 671 GiB a matrix"


def test_the_shell_runs_one_solver_through_it(tmp_path, capsys):
    assert run(tmp_path, only=["NearestNeighbor"]) == 0
    assert "NearestNeighbor" in capsys.readouterr().out and (tmp_path / "hard_cases.csv").is_file()
    with pytest.raises(ValueError, match=r"--only: expected some of .*AnchoredFGW.*Found nobody"):
        run(tmp_path, only=["nobody"])


@pytest.mark.slow
def test_easy_rows_are_hardly_ever_flagged():
    told = list(draws())
    assert len(told) >= 200
    assert np.mean([flagged for _, _, flagged in told]) <= 0.05
    by_solver = Counter(name for _, name, flagged in told if flagged)
    assert not by_solver or max(by_solver.values()) <= 1, by_solver
