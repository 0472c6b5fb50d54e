"""The benchmarks find what others add, and their gates judge only what stands in a baseline."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from otsync import bench, plugins
from otsync.align import ALIGNERS
from otsync.bench import match, panoptic, record, sync
from otsync.bench.sync_worlds import FPS, pair_case
from otsync.match import MATCHERS
from otsync.refine import REFINERS
from otsync.types import Alignment, Matches

PLUGIN = """
import numpy as np
from otsync import Matches
from otsync.plugins import register

@register("matchers")
class InOrder:
    def __call__(self, a, b):
        n = min(len(a), len(b))
        return Matches(np.stack([np.arange(n), np.arange(n)], 1))
"""


@pytest.fixture
def add():
    """Register things for one test."""
    added = []

    def register(group, thing, name=None):
        added.append(thing)
        return plugins.register(group, name)(thing)

    yield register
    plugins.forget(*added)


@dataclass(frozen=True)
class Constant:
    """An aligner that always gives one answer."""

    offset: float = 0.25

    def __call__(self, a, b, matches):
        return Alignment(self.offset, 1.0, 0.01)


def unchanged(a, b, matches, alignment):
    """A refiner that does nothing."""
    return alignment


# ---- suites


def test_every_suite_loads_and_runs():
    suites = bench.suites()
    assert list(suites)[:3] == ["core", "match", "sync"] and "raster" in suites
    for load in suites.values():
        assert callable(load().run)


def test_suites_of_others_stand_beside_ours(add, monkeypatch):
    mine = add("benchmarks", SimpleNamespace(run=lambda out, **options: 0, name="mine"), "mine")
    assert bench.suites()["mine"]() is mine
    add("benchmarks", SimpleNamespace(run=None), "core")
    with pytest.raises(ValueError, match="two named 'core'"):
        bench.suites()


def test_a_suite_that_does_not_import_is_named_when_it_is_asked_for(monkeypatch):
    broken = EntryPoint("far", "otsync.there_is_none", "otsync.benchmarks")
    monkeypatch.setattr(bench, "entries", lambda group: {"far": broken})
    suites = bench.suites()
    assert isinstance(suites["core"](), ModuleType)
    with pytest.raises(ValueError, match=r"benchmark far: expected otsync\.there_is_none to import"):
        suites["far"]()


# ---- matchers


def test_every_matcher_of_the_slot_has_a_row(add):
    add("matchers", Constant, "mine")
    rows = match.contenders()
    assert {type(matcher) for matcher, _ in rows.values()} >= {*MATCHERS, Constant}
    assert rows["mine"] == (Constant(), match.OTHERS_LARGEST)
    assert list(rows)[: len(match.MATCHERS)] == list(match.MATCHERS)
    with pytest.raises(ValueError, match=r"only: expected some of .*mine.*; found nobody"):
        match.run(None, only=("nobody",))


@pytest.mark.slow
def test_a_matcher_from_a_file_is_measured_and_not_judged(tmp_path, monkeypatch):
    """Its process learns of the file too. A baseline neither gets nor misses it."""
    (tmp_path / "in_order.py").write_text(PLUGIN)
    plugins.load_files([tmp_path / "in_order.py"])
    name, (matcher, _) = next((n, row) for n, row in match.contenders().items() if n == "in-order")
    try:
        saved = []
        monkeypatch.setattr(record, "save_baseline", lambda suite, figures: saved.append(figures))
        monkeypatch.setattr(record, "baseline_path", lambda suite: tmp_path / "baseline.json")
        (tmp_path / "baseline.json").write_text(json.dumps({"figures": {}}))
        options = {"sizes": (60,), "seeds": 1, "only": (name, "NearestNeighbor"), "gate": True, "rebase": True}
        assert match.run(tmp_path / "out", **options) == 0
    finally:
        plugins.forget(type(matcher))
        plugins._files.clear()
    rows = json.loads((tmp_path / "out" / "match.json").read_text())["rows"]
    assert {row["matcher"]: row["status"] for row in rows} == {"NearestNeighbor": "ok", name: "ok"}
    assert [list(figures) for figures in saved] == [["NearestNeighbor 60 p50"]]


# ---- aligners and refiners


def test_every_aligner_and_refiner_of_the_slots_has_a_row(add):
    before = dict(sync.methods())
    assert before == sync.METHODS
    assert {type(part) for row in before.values() for part in row} == {*ALIGNERS, *REFINERS}
    add("aligners", Constant, "mine")
    add("refiners", unchanged)
    added = {name: row for name, row in sync.methods().items() if name not in before}
    assert list(added) == ["mine", "mine + splines", "likelihood scan + unchanged"]
    assert added["mine"][0] == Constant() and added["likelihood scan + unchanged"][1] is unchanged


@pytest.mark.slow
def test_methods_of_others_are_measured_and_not_judged(add, monkeypatch):
    add("aligners", Constant, "mine")
    case = replace(pair_case("boxes", "clean", 0, 5000), offset=0.0)
    some = np.arange(12)  # what is measured does not matter here
    case = replace(
        case,
        a=case.a.take(case.matches.pairs[some, 0]),
        b=case.b.take(case.matches.pairs[some, 1]),
        matches=Matches(np.stack([some, some], 1), case.matches.score[some]),
    )
    cases = [replace(case, preset=preset, band=band) for preset in sync.PRESETS for band in range(3)]
    monkeypatch.setattr(sync, "pair_cases", lambda presets, seeds: iter(cases))
    fast = {name: sync.METHODS["DTW + splines" if "splines" in name else "open-end DTW"] for name in sync.METHODS}
    monkeypatch.setattr(sync, "METHODS", fast)
    rows = sync.method_rows((5000,))
    errors = [row["error"] for row in rows if row["method"] == "mine"]
    np.testing.assert_allclose(errors, [0.25 * FPS] * len(cases))
    summary = sync.summarise(rows)
    assert next(row["mean"] for row in summary if row["method"] == "mine") == pytest.approx(0.25 * FPS)
    shutters = [{"videos": 2, "shutter": "rolling, declared", "preset": p, "mean": 0.1} for p in ("mid", "hard")]
    watched = sync.figures_of(summary, [], shutters)
    ours = [row for row in summary if row["method"] in sync.METHODS]
    assert watched == sync.figures_of(ours, [], shutters) and not any("mine" in key for key in watched)


# ---- the gate


def test_the_gate_compares_figures_of_the_baseline_alone(tmp_path, monkeypatch, capsys):
    def worse(key, measured, baseline):
        return measured > baseline

    monkeypatch.setattr(record, "baseline_path", lambda suite: tmp_path / f"{suite}.json")
    record.save_baseline("toy", {"error": 1.0})
    assert record.gate("toy", {"error": 1.0, "of a plugin": 9.0}, worse) == 0
    assert "1 figure no worse" in capsys.readouterr().out
    assert record.gate("toy", {"error": 1.1}, worse) == 1
    assert record.gate("toy", {"error": float("nan")}, worse) == 1
    assert record.gate("toy", {"of a plugin": 9.0}, worse) == 1
    assert "error is in the baseline and was not measured" in capsys.readouterr().err


def test_a_missed_promise_of_matching_is_told():
    from otsync.bench.match_limits import promises

    def made(worst: float, told: int, ours: float) -> list[bool]:
        hard = [{"scene": "no left/right cue", "worst_p50": worst}]
        trust = [
            {"what": "related scenes matched", "of": 20, "count": 19},
            {"what": "unrelated scenes: no match", "of": 20, "count": told},
        ]
        return [c.met for c in promises(hard, trust, [{"cpu_seconds": ours}, {"cpu_seconds": 5.0}])]

    assert all(made(0.9, 20, 0.2))
    assert made(0.8, 19, 1.0) == [False, True, False, False]


@pytest.mark.parametrize("option", [{"only": ("AnchoredFGW",)}, {"sizes": (200,)}, {"limit": 9.0}])
def test_promises_of_matching_take_no_options_of_the_table(option, tmp_path):
    from otsync.bench.match import run

    with pytest.raises(ValueError, match=f"{next(iter(option))}, promises"):
        run(tmp_path, promises=True, **option)


def test_the_reference_s_own_error_does_not_count_as_often_as_there_are_others():
    lines = [{"kind": "all 0", "error": e} for e in (0.1, 0.12, 0.08)] + [{"kind": "all 1", "error": e} for e in (0, 1)]
    np.testing.assert_allclose(panoptic.apart(lines), [0.09, 0.01, 0.03, 0.01, 0, 0, 1], atol=1e-12)
    missing = panoptic.apart([{"kind": "all 0", "error": e} for e in (None, 0.0, 0.0)])
    assert missing.max() == panoptic.LARGEST and panoptic.apart([]).size == 0
