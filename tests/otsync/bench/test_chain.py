"""The benchmark of chains: every row is what its name says, missing answers count, the front is a front."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from otsync import PAPER, synchronize
from otsync.bench import own_frames
from otsync.bench.chain import gate
from otsync.bench.chain import run as chain
from otsync.bench.chain.worlds import SITUATIONS, world
from otsync.recordings.stages import Stages


@pytest.mark.slow
def test_rows_on_two_situations(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(chain, "SITUATIONS", {name: SITUATIONS[name] for name in ("mid", "no depth")})
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0})  # every worker compiles tslearn's loops anew
    assert chain.run(tmp_path, seeds=1, first_seed=31, only=("EMD",)) == 0
    answers = json.loads((tmp_path / "chain_answers.json").read_text())["rows"]
    assert {(r["situation"], r["matcher"]) for r in answers} == {("mid", "EMD"), ("mid", "paper"), ("no depth", "EMD")}
    assert len(answers) == 3 * 2 + 1 + 2
    monkeypatch.setattr(chain, "measure", None)  # everything is there: nothing is measured again
    assert chain.run(tmp_path, seeds=1, first_seed=31, only=("EMD",)) == 0
    case = world(31, preset="mid")
    paper = next(r for r in answers if r["matcher"] == "paper")
    offsets = synchronize([case.a, case.b], method=PAPER)
    assert paper["error"] == abs(offsets.seconds[1] - case.offset) * case.fps
    three = replace(case, more=((case.b, case.offset + 1.0),))
    assert len(three.tracks) == 3 and three.largest == 150
    found = np.array([0.0, case.offset + 0.1, np.nan])
    np.testing.assert_allclose(three.errors(found), [0.1 * case.fps, 150])
    assert (tmp_path / "chain.svg").read_text().startswith("<?xml") and "mid: errors" in capsys.readouterr().out


def test_missing_answers_count_as_the_largest_error_and_the_front_is_a_front():
    def row(matcher: str, error: float, seconds: float, missing: bool = False) -> dict:
        return {
            "situation": "s",
            "matcher": matcher,
            "way": "scan",
            "rematch": 0,
            "error": error,
            "missing": missing,
            "trusted": not missing,
            "cpu_s": seconds,
        }

    rows = [row("good", 0.1, 1.0), row("good", 150.0, 1.0, True), row("fast", 80.0, 0.1), row("worse", 90.0, 2.0)]
    summary = {r["matcher"]: r for r in chain.summarise(rows)}
    assert summary["good"]["mean"] == pytest.approx(75.05) and summary["good"]["missing"] == 1
    assert summary["good"]["trusted_wrong"] == 0 and summary["worse"]["trusted_wrong"] == 1
    assert [m for m, r in summary.items() if r["front"]] == ["good", "fast"]


def test_situations_are_what_they_say():
    few, far = SITUATIONS["few tracks"](3), SITUATIONS["wide baseline"](3)
    assert len(few.a) == 24 < len(far.a)
    centres = [np.linalg.inv(t.camera.w2c)[:2, 3] for t in (far.a, far.b)]
    cosine = centres[0] @ centres[1] / np.prod(np.linalg.norm(centres, axis=1))
    assert np.degrees(np.arccos(cosine)) > 100
    mixed, plain = SITUATIONS["strangers"](3), world(3, preset="mid")
    same = sum(any(np.array_equal(x, y, equal_nan=True) for y in plain.a.xyz) for x in mixed.a.xyz)
    assert same == len(plain.a) - round(0.6 * len(plain.a))
    assert SITUATIONS["no depth"](3).a.xyz is None


def test_an_unknown_matcher_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"--only: expected some of .*EMD.*; found nobody"):
        chain.run(tmp_path, only=("nobody",))
    for suite in (chain, own_frames):
        with pytest.raises(ValueError, match="--cache: expected with a recording"):
            suite.run(tmp_path, cache=tmp_path)


def test_the_gate_tells_what_got_worse(tmp_path, monkeypatch, capsys):
    answers = [{"error": e, "trusted": 1.0, "cpu_s": 2.0, "yardstick": 0.02} for e in (0.1, 0.2, 0.3, 0.1, 0.2, 0.3)]
    rows = [{"situation": "mid", **gate.summary(answers)}]
    assert rows[0] | {"mean": 0.2, "trusted": 1.0, "trusted_wrong": 0, "cpu_s": 2.0, "speed": 0.01} == rows[0]
    monkeypatch.setattr(gate, "measured", lambda seeds: rows)
    monkeypatch.setattr("otsync.bench.record.baseline_path", lambda name: tmp_path / f"{name}.json")
    assert chain.run(tmp_path, rebase=True) == 0 == chain.run(tmp_path, gate=True)
    assert (tmp_path / "chain_gate.csv").exists() and "no worse" in capsys.readouterr().out
    for key, allowed, too_much in (
        ("mean", 0.25, 0.27),
        ("trusted", 5 / 6, 4 / 6),
        ("trusted_wrong", 0, 1),
        ("speed", 0.007, 0.005),
    ):
        kept = rows[0][key]
        rows[0][key] = allowed
        assert chain.run(tmp_path, gate=True) == 0
        rows[0][key] = too_much
        assert chain.run(tmp_path, gate=True) == 1 and f"mid: {key}" in capsys.readouterr().err
        rows[0][key] = kept


@pytest.mark.parametrize("option", [{"scene": "here"}, {"cache": "here"}, {"only": ("EMD",)}, {"seeds": 3}])
def test_a_gate_takes_nothing_else(option, tmp_path):
    with pytest.raises(ValueError, match=f"{next(iter(option))}: expected none with --gate"):
        chain.run(tmp_path, gate=True, **option)


def test_an_answer_of_the_gate_is_the_default_chains():
    case = SITUATIONS["mid"](12_400)
    found = gate.answer(case)
    offsets = synchronize(case.tracks, method=Stages().space)
    assert found["error"] == case.errors(offsets.seconds)[0] < 0.1 and found["trusted"] == 1.0
    assert 0 < found["yardstick"] < found["cpu_s"]
