"""Long benchmarks go on where they were interrupted, and never mix the figures of two codes."""

from __future__ import annotations

import math

import pytest

from otsync.bench.trust import kept
from otsync.bench.trust.kept import Kept
from otsync.bench.trust.run import measured


def test_rows_come_back_as_they_were(tmp_path):
    path = tmp_path / "new" / "rows.jsonl"
    first = Kept(path)
    assert first.rows(("mid", 1)) is None
    rows = [{"error": math.inf, "sigma": math.nan, "trusted": True, "flags": "é"}]
    first.keep(("mid", 1), rows)
    again = Kept(path)
    found = again.rows(("mid", 1))
    assert found is not None and repr(found) == repr(rows) and len(again) == 1


def test_other_code_begins_anew(tmp_path, monkeypatch):
    path = tmp_path / "rows.jsonl"
    Kept(path).keep("a", [{"x": 1}])
    assert len(Kept(path)) == 1
    monkeypatch.setattr(kept, "code_digest", lambda: "another")
    assert len(Kept(path)) == 0


@pytest.mark.parametrize("torn", ['["a", [{"x"', "\x00", "[]"])
def test_a_torn_line_is_measured_again(tmp_path, torn):
    path = tmp_path / "rows.jsonl"
    Kept(path).keep("a", [{"x": 1}])
    with path.open("a") as stream:
        stream.write(torn)
    again = Kept(path)
    assert again.rows("a") == [{"x": 1}] and again.rows("b") is None
    again.keep("b", [{"x": 2}])
    assert Kept(path).rows("b") == [{"x": 2}]


def squares(job: int) -> list[dict[str, int]]:
    if job == 5:
        raise KeyboardInterrupt
    return [{"job": job, "square": job**2}]


def cubes(job: int) -> list[dict[str, int]]:
    return [{"job": job, "cube": job**3}]


def test_an_interrupted_run_goes_on(tmp_path, capsys):
    """What was answered before the interrupt is not asked again: it comes from the first function."""
    path = tmp_path / "rows.jsonl"
    with pytest.raises(KeyboardInterrupt):
        list(measured(range(8), squares, "test", Kept(path)))
    done = len(Kept(path))
    assert 0 < done <= 5
    rows = list(measured(range(8), cubes, "test", Kept(path)))
    assert [r["job"] for r in rows] == list(range(8))
    assert ["square" in r for r in rows] == [k < done for k in range(8)]
    more = list(measured(range(10), cubes, "test", Kept(path)))  # a longer run takes up a shorter one's
    assert ["square" in r for r in more] == [k < done for k in range(10)]
    assert "were answered before" in capsys.readouterr().err
