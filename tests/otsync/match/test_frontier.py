"""Budgets, defaults by size, refusals before memory is taken, vouching, and the benchmark of matching."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from otsync import AnchoredFGW, FusedGromovWasserstein, GromovWasserstein, PartialFGW, Status, match, matcher_for
from otsync.bench import match as bench
from otsync.bench.match_plot import plot
from otsync.bench.record import baseline_path
from otsync.match.frontier import ANCHORED_FROM, FRONTIER, accuracy, fitting, predicted
from otsync.match.problem import check_memory
from otsync.match.vouch import geometry, poses, relative_cost, vouch
from otsync.simulate import matching_world


def test_predictions_go_through_the_measured_points_and_grow():
    for name, points in FRONTIER.items():
        for n, (seconds, p50) in points.items():
            assert predicted(name, n) == pytest.approx(seconds) and accuracy(name, n) == p50
        assert predicted(name, 4 * max(points)) >= 4 * points[max(points)][0] * 0.99


def test_the_table_is_the_committed_baseline():
    figures = json.loads(baseline_path("match").read_text())["figures"]
    for name, points in FRONTIER.items():
        for n, (_, p50) in points.items():
            assert figures[f"{name} {n} p50"] == pytest.approx(p50, abs=0.0011)


@pytest.mark.parametrize("n", [200, 1000, 2000, 20_000, 50_000])
def test_more_budget_is_never_less_accurate(n):
    best = 0.0
    for budget in (0.01, 0.05, 0.2, 1.0, 5.0, 30.0):
        try:
            name = fitting(n, budget)
        except ValueError:
            continue
        assert predicted(name, n) <= budget and accuracy(name, n) >= best
        best = accuracy(name, n)
    assert best > 0.8


def test_the_default_changes_where_the_frontier_says():
    assert accuracy("AnchoredFGW", ANCHORED_FROM) > max(
        accuracy(name, ANCHORED_FROM) for name in FRONTIER if not name.startswith("Anchored")
    )
    assert isinstance(matcher_for(ANCHORED_FROM - 1, 500), FusedGromovWasserstein)
    assert isinstance(matcher_for(ANCHORED_FROM, 500), AnchoredFGW)


def test_a_budget_chooses_and_says_which(caplog):
    a, b, _ = matching_world(300, seed=1, frames=40)
    with caplog.at_level(logging.INFO, logger="otsync"):
        match(a, b, budget=5.0, throw=False)
    assert "AnchoredFGW" in caplog.text and "fits 5 s" in caplog.text
    with pytest.raises(ValueError, match=r"budget: expected at least .* AnchoredFGW.* at 50000 tracks; found 0.01"):
        matcher_for(50_000, 50_000, 0.01)
    with pytest.raises(ValueError, match="expected one of them; found both"):
        match(a, b, PartialFGW(), budget=1.0)
    with pytest.raises(ValueError, match="budget: expected a number > 0"):
        matcher_for(100, 100, -1.0)


def test_too_large_problems_are_refused_with_their_size():
    with pytest.raises(ValueError, match=r"needs about \d+ GiB for 100000 x 100000 tracks.*Use AnchoredFGW"):
        check_memory(100_000, 100_000)
    check_memory(2000, 2000)


@pytest.mark.parametrize("matcher", [FusedGromovWasserstein, GromovWasserstein])
def test_torch_gives_the_same_plan_as_numpy(matcher):
    pytest.importorskip("torch")
    a, b, _ = matching_world(120, seed=2, frames=30)
    plain, torch = matcher()(a, b), matcher(device="cpu")(a, b)
    np.testing.assert_allclose(torch.plan, plain.plan, atol=1e-9)
    np.testing.assert_array_equal(torch.pairs, plain.pairs)


def test_vouching_measures_what_it_says():
    a, b, truth = matching_world(300, seed=4, angle=0.0, outliers=0.0, noise=0.0)
    i, j = truth.matches(0, 1, wrong=0.0, n=200).pairs.T
    shuffled = np.random.default_rng(0).permutation(j)
    assert geometry(a, b, i, j) < 0.5 < geometry(a, b, i, shuffled)
    assert geometry(a, a, i, i) == 0
    costs = FusedGromovWasserstein().costs
    assert relative_cost(costs, a, b, i, j) < 0.7 and relative_cost(costs, a, b, i, shuffled) > 0.8
    assert vouch(truth.matches(0, 1, wrong=0.0, n=200), a, b, costs).status.ok
    wrong = replace(truth.matches(0, 1, wrong=0.0, n=200), pairs=np.stack([i, shuffled], 1))
    assert vouch(wrong, a, b, costs).status is Status.NO_MATCH


def test_poses_take_the_nearest_frame_that_is_seen():
    xyz = np.arange(5.0)[None, :, None].repeat(3, 2)
    seen = np.array([[False, True, False, False, True]])
    assert poses(xyz, seen, 5)[0, :, 0].tolist() == [1, 1, 1, 4, 4]


def test_the_front_and_the_gate():
    def row(name, n, p50, cpu, status="ok"):
        spent = {"cpu_seconds": cpu, "seconds": cpu, "yardstick": 0.5}
        return {"matcher": name, "n": n, "p50": p50, "status": status} | spent

    rows = [
        row("x", 2000, 0.9, 1.0),
        row("y", 2000, 0.8, 2.0),
        row("z", 2000, 0.95, 3.0),
        row(bench.REFERENCE, 2000, 0.5, 9.0),
    ]
    bench.mark_front(rows)
    assert [r["front"] for r in rows] == ["*", "", "*", ""]
    assert bench.figures_of(rows)["y 2000: speed"] == 0.25
    assert bench.worse("x 200 p50", 0.8, 0.9) and not bench.worse("x 200 p50", 0.88, 0.9)
    assert bench.worse("x: speed", 5.0, 9.0) and not bench.worse("x: speed", 7.0, 9.0)


def test_the_plot_is_written(tmp_path):
    rows = [
        {"matcher": "x", "n": n, "p50": 0.5, "cpu_seconds": n / 1e3, "status": "ok", "front": "*"} for n in (200, 5000)
    ]
    plot(rows, tmp_path / "p.svg")
    text = (tmp_path / "p.svg").read_text()
    assert "5k" in text and "200" in text


@pytest.mark.slow
def test_a_small_benchmark_runs_from_end_to_end(tmp_path):
    assert bench.run(tmp_path, sizes=(200,), seeds=1, only=("AnchoredFGW", bench.REFERENCE)) == 0
    assert {p.name for p in tmp_path.iterdir()} == {"match.csv", "match.json", "match_frontier.svg"}


@pytest.mark.slow
def test_peak_memory_of_twenty_thousand_tracks():
    code = (
        "import resource; from otsync import AnchoredFGW; from otsync.simulate import matching_world;"
        "AnchoredFGW()(*matching_world(20000, 1)[:2]); print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / "
        "2**20)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 2
