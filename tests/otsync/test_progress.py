"""Bars on a terminal, lines in a log, which change nothing; notes and times of stages."""

from __future__ import annotations

import io
import sys

import pytest

from otsync import progress
from otsync.bench.sync_shutter import shutter_rows
from otsync.bench.sync_worlds import pair_cases
from otsync.cli import main


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def attach(monkeypatch):
    """Makes a stream standard error; from within a test, since pytest attaches its own when one begins."""

    def attached(stream: io.StringIO, patience: float = 0) -> io.StringIO:
        monkeypatch.setattr(progress, "PATIENCE", patience)
        monkeypatch.setattr(sys, "stderr", stream)
        return stream

    return attached


def test_a_long_run_is_counted_on_a_terminal(attach):
    terminal = attach(Terminal())
    assert list(progress.counted(range(3), "worlds", "world")) == [0, 1, 2]
    assert list(progress.counted((k for k in "ab"), "letters", "letter", 2)) == ["a", "b"]
    told = terminal.getvalue()
    assert "worlds:   0%" in told and "0/3" in told and "letters" in told and "0/2" in told


@pytest.mark.parametrize("stream, patience", [(Terminal(), progress.PATIENCE), (io.StringIO(), 0)])
def test_a_short_run_and_a_pipe_are_left_alone(attach, stream, patience):
    attach(stream, patience)
    assert list(progress.counted(range(3), "worlds", "world")) == [0, 1, 2]
    assert stream.getvalue() == ""


def test_a_long_run_tells_a_log_in_lines_now_and_then(attach, monkeypatch):
    log = attach(io.StringIO())
    monkeypatch.setattr(progress, "EVERY", 0.0)
    with progress.bar("fit", "step", 3, initial=1) as shown:
        shown.set_postfix_str("PSNR 20.1", refresh=False)
        shown.update()
        shown.total = 5
        shown.update()
    lines = log.getvalue().splitlines()
    assert "2/3" in lines[-2] and "PSNR 20.1" in lines[-2] and "3/5" in lines[-1]
    assert all(line.startswith("fit:") for line in lines) and "\r" not in log.getvalue()
    monkeypatch.setattr(progress, "EVERY", 3600.0)
    assert list(progress.counted(range(9), "worlds", "world")) == list(range(9))
    assert log.getvalue().splitlines() == lines


def test_what_is_quiet_or_not_to_be_shown_tells_nobody(attach, monkeypatch):
    monkeypatch.setattr(progress, "EVERY", 0.0)
    for stream in (Terminal(), io.StringIO()):
        attach(stream)
        assert list(progress.bar("worlds", "world", items=range(3), shown=False)) == [0, 1, 2]
        monkeypatch.setattr(progress, "_quiet", True)
        assert list(progress.counted(range(3), "worlds", "world")) == [0, 1, 2]
        monkeypatch.setattr(progress, "_quiet", False)
        assert stream.getvalue() == ""


def test_lines_go_to_standard_output_between_bars(attach, capsys):
    attach(Terminal())
    for k in progress.counted(range(2), "worlds", "world"):
        progress.say(f"line {k}")
    assert capsys.readouterr().out == "line 0\nline 1\n"


@pytest.mark.slow
def test_simulations_and_benchmarks_are_counted(attach, tmp_path):
    terminal = attach(Terminal())
    assert main(["simulate", str(tmp_path), "--videos", "2", "--frames", "20"]) == 0
    assert "simulating:   0%" in terminal.getvalue() and "0/2" in terminal.getvalue()
    cases = list(pair_cases(("clean",), (1,), ("boxes", "tennis")))
    assert [(c.motion, c.band) for c in cases] == [(m, b) for m in ("boxes", "tennis") for b in range(3)]
    assert "pairs:   0%" in terminal.getvalue() and "0/6" in terminal.getvalue()
    few, more = (shutter_rows(seeds, ("clean",), (2, 3), ("boxes",)) for seeds in ((1,), (1, 2)))
    told = terminal.getvalue()
    assert "shutters, clean, 2 videos:   0%" in told and "0/2" in told
    assert [a == b for a, b in zip(few, more, strict=True)] == [False] * 3 + [True] * 3  # of many videos the first seed


def test_stages_are_timed_and_notes_are_told_once():
    told = []
    kept = progress.Progress(told.append)
    for _ in range(2):
        with kept.stage("reading"):
            kept.note("one frame is damaged")
    assert kept.notes == ["one frame is damaged"] and list(kept.seconds) == ["reading"]
    assert [line.split(":")[0] for line in told] == ["reading ...", "note", "reading", "reading ...", "reading"]
    with pytest.raises(KeyError), kept.stage("writing"):
        raise KeyError
    assert list(kept.seconds) == ["reading"]
