"""Every solver runs the whole catalogue: it answers rightly or refuses; never a confident wrong answer, nan or a
hang.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync import TrackSet
from otsync.bench.hard_cases import aligning, matching
from otsync.bench.hard_cases.page import page
from otsync.bench.hard_cases.run import LONGEST, rows, run
from otsync.bench.hard_cases.solvers import accepted, check_sane, matchers, matching_solver, outcome, watchdog

SLOW = ("EntropicFGW",)
ROWS = [
    pytest.param(case, name, solver, id=f"{case.name}-{name}", marks=[pytest.mark.slow] if name in SLOW else [])
    for case, name, solver in rows()
]


@pytest.mark.parametrize("case, name, solver", ROWS)
def test_answers_rightly_or_refuses(case, name, solver):
    with watchdog(LONGEST), warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        kind, detail = outcome(case, solver)
    assert accepted(case, name, kind, detail), f"{kind}: {detail}"


@given(
    st.integers(0, 10**9),
    st.sampled_from(["NearestNeighbor", "OptimalTransport", "FusedGromovWasserstein", "PartialFGW", "AnchoredFGW"]),
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
    names = [case.name for case in matching.CASES + aligning.CASES]
    assert len(names) >= 60 and len(set(c.name for c in matching.CASES)) == len(matching.CASES)


def test_the_page_is_up_to_date():
    """`make stability` writes it."""
    assert (Path(__file__).parents[3] / "docs" / "stability.md").read_text() == page()


def test_the_shell_runs_one_solver_through_it(tmp_path, capsys):
    assert run(tmp_path, only=["NearestNeighbor"]) == 0
    assert "NearestNeighbor" in capsys.readouterr().out and (tmp_path / "hard_cases.csv").is_file()
    with pytest.raises(ValueError, match=r"--only: expected some of .*AnchoredFGW.*Found nobody"):
        run(tmp_path, only=["nobody"])
