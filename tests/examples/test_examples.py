"""The examples are the manual: each runs on a small world."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SMALL = [*("--width", "96", "--frames", "14"), *("--backdrop-steps", "20", "--steps", "20")]


FIRST = "01_match_tracks.py"
"""Runs in a process of its own, as a reader would start it; the others in this one, which has all packages loaded."""


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs a script with arguments in an empty folder; what it printed."""
    monkeypatch.chdir(tmp_path)

    def script(name: str, *args: str) -> str:
        path = ROOT / "examples" / name
        if name == FIRST:
            done = subprocess.run([sys.executable, path, *args], capture_output=True, text=True, timeout=3600)
            assert done.returncode == 0, done.stderr[-2000:]
            return done.stdout
        monkeypatch.setattr(sys, "argv", [str(path), *args])
        runpy.run_path(str(path), run_name="__main__")
        return capsys.readouterr().out

    return script


@pytest.mark.parametrize(
    ("script", "args", "expected"),
    [
        ("01_match_tracks.py", ["--n", "120"], "best three:"),
        ("02_synchronize.py", ["--videos", "3", "--out", "sync"], "report.html"),
        ("03_ot_versus_fgw.py", ["--n", "120", "--seeds", "0", "--out", "picture.png"], "fused (FGW)"),
        ("04_your_own_matcher.py", ["--videos", "3"], "given matches: errors"),
        (
            "07_ablations.py",
            ["--rows", "w/o scaffold", "--out", "ablations", *SMALL],
            "w/o scaffold",
        ),
        ("09_own_frames.py", ["--videos", "2", "--preset", "clean", "--out", "own"], "camera stands at"),
    ],
)
def test_example_runs(script, args, expected, tmp_path, run):
    assert expected in run(script, *args)
    if "--out" in args:
        assert (tmp_path / args[args.index("--out") + 1]).exists()


@pytest.mark.slow
def test_four_phones(run):
    pytest.importorskip("pycolmap")
    printed = run("11_four_phones.py", "--frames", "75", "--walk", "200")
    assert "phone3: to be trusted" in printed and "offsets: off by" in printed


@pytest.mark.slow
def test_a_set_in_the_layout_of_sync_nerf(run):
    small = ["--cameras", "5", "--frames", "40", "--width", "160", "--max-offset", "2"]
    printed = run("12_sync_nerf.py", *small, "--steps", "10", "--backdrop-steps", "10")
    assert "| refined" in printed and "| PSNR" in printed
