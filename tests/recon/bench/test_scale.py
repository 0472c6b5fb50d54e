"""Growth of a whole run: the law is fitted, films continue as they would have been, memory is told by kind."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from otsync.cli import main
from otsync.io import open_scene
from otsync.types import Offsets
from recon.bench import scale


def test_the_law_of_growth_is_found():
    rows = [
        {"cameras": c, "frames": f, "exit code": 0, "wall s": 3 * c * f**0.5, "CPU s": 2 * c**2 * f, "memory MB": 500.0}
        for c, f in scale.SIZES
    ]
    rows.append({"cameras": 99, "frames": 9, "exit code": 2, "wall s": 1e-3, "CPU s": 1.0, "memory MB": 9e9})
    told = scale.laws(rows)
    assert told["wall s"] == pytest.approx({"cameras": 1, "frames": 0.5})
    assert told["CPU s"] == pytest.approx({"cameras": 2, "frames": 1})
    assert told["memory MB"] == pytest.approx({"cameras": 0, "frames": 0})
    assert scale.laws(rows[:2]) == {}


def test_a_film_that_was_stopped_becomes_what_it_would_have_been(tmp_path, monkeypatch):
    monkeypatch.setattr(scale, "PIXELS", (64, 40))
    monkeypatch.setattr(scale, "AT_ONCE", 4)
    home = scale.film(tmp_path / "a", 7, 2, 10)
    scene, truth = open_scene(home), Offsets.load(home / "truth.json")
    assert [len(v.frames) for v in scene.videos] == [10, 10] and scene.names == truth.names
    assert all(v.depth is None for v in scene.videos) and scene.masks == (None, None)
    images = sorted((home / "images" / "cam1").iterdir())
    before = [p.read_bytes() for p in images]
    for path in images[5:]:
        path.unlink()
    scale.film(tmp_path / "a", 7, 2, 10)
    assert [p.read_bytes() for p in images] == before


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory by kind is told by Linux alone")
def test_memory_and_time_of_another_process():
    code = (
        "import time; x = bytearray(200_000_000); t = time.process_time()\nwhile time.process_time() < t + .2: pass\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code + "print('there', flush=True); input()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None and process.stdout.readline() == "there\n"
    used = scale.MemoryOf(process.pid)
    used.look()
    process.communicate("\n")
    used.look()  # one that has ended says nothing new
    assert 200 < used.own < 300 and used.all > used.own and used.seconds >= 0.2


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory by kind is told by Linux alone")
def test_what_a_process_begins_counts_while_it_lives_and_after():
    child = (
        "import time; x = bytearray(200_000_000); t = time.process_time()\nwhile time.process_time() < t + .3: pass\n"
        "print('there', flush=True); input()"
    )
    code = (
        f"import subprocess, sys; p = subprocess.Popen([sys.executable, '-c', {child!r}], stdin=subprocess.PIPE)\n"
        "input(); p.communicate(b'\\n'); print('ended', flush=True); input()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    assert process.stdin is not None and process.stdout is not None
    assert process.stdout.readline() == "there\n"
    living = scale.MemoryOf(process.pid)
    living.look()
    process.stdin.write("\n")
    assert process.stdout.readline() == "ended\n"
    after = scale.MemoryOf(process.pid)
    after.look()
    process.communicate("\n")
    assert 200 < living.own < 300 and after.own < 100
    assert living.seconds >= 0.3 and after.seconds >= 0.3


def test_a_size_that_there_is_not_is_refused(tmp_path, capsys):
    assert main(["bench", "scale", "--only", "3x3", "--out", str(tmp_path)]) == 2
    assert "--only: expected sizes among 7x150, 14x150, 14x300, 31x300, 31x900; found 3x3" in capsys.readouterr().err


@pytest.mark.slow
def test_runs_are_measured_and_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scale, "SIZES", ((5, 90), (6, 90), (6, 120)))
    monkeypatch.setattr(scale, "STEPS", 20)
    assert main(["bench", "scale", "--first-seed", "3", "--out", str(tmp_path)]) == 0
    told = json.loads((tmp_path / "scale.json").read_text())
    assert [row["frames"] for row in told["rows"]] == [90, 90, 120]
    for row in told["rows"]:
        assert row["wall s"] > 1 and row["CPU s"] > 1 and row["memory MB"] > 100 and row["error"] < 0.5
    assert np.isfinite(list(told["laws"]["wall s"].values())).all()
    monkeypatch.setattr(scale, "measured", None)  # what is there is not measured again
    assert main(["bench", "scale", "--first-seed", "3", "--out", str(tmp_path)]) == 0
    assert "cameras^" in capsys.readouterr().out
