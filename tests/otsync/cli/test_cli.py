"""The command line: what it prints, writes, refuses and leaves behind."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

from otsync import Offsets, TrackSet, __version__
from otsync.bench.sync_worlds import MOVING
from otsync.cli import main
from otsync.cli.shell import EXTRAS
from otsync.cli.simulate import Simulate
from otsync.files.arrays import write_json
from otsync.files.claim import LOCK
from otsync.types import Alignment, Refused, Status

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("world")
    assert (
        main(
            [
                "simulate",
                str(folder),
                "--motion",
                "tennis",
                "--preset",
                "clean",
                "--videos",
                "3",
                "--seed",
                "5",
                "--max-offset",
                "9",
            ]
        )
        == 0
    )
    return folder


def test_simulate_writes_track_sets_and_the_truth(world):
    assert sorted(p.name for p in world.glob("[!.]*")) == ["truth.json", "video0.npz", "video1.npz", "video2.npz"]
    truth = Offsets.load(world / "truth.json")
    assert truth.names == ("video0", "video1", "video2") and truth.seconds[0] == 0
    assert 0 < np.abs(truth.frames[1:]).max() <= 9 and len(TrackSet.load(world / "video1.npz")) > 50


@pytest.mark.parametrize(
    "error, code, says",
    [
        (Refused("align", Alignment(0.0, flags=(Status.WEAK,))), 1, "otsync: align: weak"),
        (
            ModuleNotFoundError("No module named 'torch'", name="torch"),
            2,
            "otsync: needs torch. Install it: pip install 'otsync[recon]'.",
        ),
        (
            ModuleNotFoundError("No module named 'PIL'", name="PIL.Image"),
            2,
            "otsync: needs PIL.Image. Install it: pip install 'otsync[video]'.",
        ),
        (
            ModuleNotFoundError("No module named 'ott'", name="ott"),
            2,
            "otsync: needs ott. Install it: pip install 'otsync[rivals]'.",
        ),
        (
            ModuleNotFoundError("No module named 'tqdm'", name="tqdm"),
            2,
            "otsync: needs tqdm. Install it: pip install otsync.",
        ),
        (
            ModuleNotFoundError("nothing to decode with"),
            2,
            "otsync: needs a package that is not installed: nothing to decode",
        ),
        (ValueError("videos: expected two"), 2, "otsync: videos: expected two"),
        (FileNotFoundError("no such file"), 2, "otsync: no such file"),
        (KeyboardInterrupt(), 130, "otsync: interrupted; nothing half-written is left, and the same command may"),
    ],
)
def test_what_stops_a_command_decides_its_exit_code(error, code, says, tmp_path, monkeypatch, capsys):
    def stop(self):
        raise error

    monkeypatch.setattr(Simulate, "run", stop)
    assert main(["simulate", str(tmp_path)]) == code
    assert capsys.readouterr().err.startswith(says)


def test_every_optional_package_names_the_extra_that_brings_it():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    sold_as = {"cv2": "opencv-contrib-python-headless", "PIL": "pillow", "ott": "ott-jax", "jax": "ott-jax"}
    for package, extra in EXTRAS.items():
        assert any(re.match(r"[\w-]+", line)[0] == sold_as.get(package, package) for line in extras[extra]), package
    optional = {
        re.match(r"[\w-]+", line)[0] for name in extras if name not in ("test", "docs") for line in extras[name]
    }
    assert {sold_as.get(package, package) for package in EXTRAS} == optional - {"otsync"}


def test_any_other_error_is_a_defect_and_shows_where(tmp_path, monkeypatch):
    monkeypatch.setattr(Simulate, "run", lambda self: [][1])
    with pytest.raises(IndexError):
        main(["simulate", str(tmp_path)])


def test_sync_prints_a_table_and_writes_offsets_and_report(world, tmp_path, capsys):
    files = [str(p) for p in sorted(world.glob("*.npz"))]
    code = main(["sync", *files, "--out", str(tmp_path / "out"), "--truth", str(world / "truth.json"), "aligner:dtw"])
    out = capsys.readouterr().out
    assert code == 0 and "video1" in out and "reference" in out and "error" in out
    found, truth = Offsets.load(tmp_path / "out" / "offsets.json"), Offsets.load(world / "truth.json")
    assert np.abs(found.frames - truth.frames).max() < 1.5
    assert "On the common clock" in (tmp_path / "out" / "report.html").read_text()


def test_algorithms_are_chosen_from_the_shell(world, tmp_path, capsys):
    files = [str(world / "video0.npz"), str(world / "video1.npz")]
    assert (
        main(["match", *files, "--out", str(tmp_path / "m.csv"), "matcher:optimal-transport", "--matcher.reg", "0.05"])
        == 0
    )
    lines = (tmp_path / "m.csv").read_text().splitlines()
    assert lines[0] == "a,b,score" and len(lines) > 50
    out = capsys.readouterr().out
    assert f"{len(lines) - 1} matches" in out and "objective" in out and "marginal_error" in out


def test_reference_is_chosen_by_name(world, tmp_path):
    files = [str(p) for p in sorted(world.glob("*.npz"))]
    args = ["sync", *files, "--out", str(tmp_path), "--reference", "video1", "aligner:constant-shift"]
    assert main([*args[:-1], "aligner:constant-shift"]) == 0
    found = Offsets.load(tmp_path / "offsets.json")
    assert found.reference == 1 and found.seconds[1] == 0


@pytest.mark.slow
def test_workers_change_nothing(world, tmp_path):
    files = [str(p) for p in sorted(world.glob("*.npz"))]
    for n in ("1", "2"):
        assert main(["sync", *files, "--out", str(tmp_path / n), "--workers", n, "matcher:optimal-transport"]) == 0
    one, two = (json.loads((tmp_path / n / "offsets.json").read_text()) for n in ("1", "2"))
    assert one["videos"] == two["videos"]


def test_a_refused_answer_exits_with_one(tmp_path, capsys):
    same = TrackSet(np.ones((6, 40, 3)), features=np.ones((6, 3)), fps=30, name="a")
    for name in ("a", "b"):
        same.save(tmp_path / f"{name}.npz")
    files = [str(tmp_path / "a.npz"), str(tmp_path / "b.npz")]
    assert main(["match", *files]) == 1
    assert "no_information" in capsys.readouterr().err
    assert main(["sync", *files, "--out", str(tmp_path)]) == 1
    assert "a~2: no_information" in capsys.readouterr().err
    assert json.loads((tmp_path / "offsets.json").read_text())["videos"][1]["offset_seconds"] is None


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["sync", "nowhere.npz", "b.npz"], "nowhere.npz: no such file"),
        (["sync", "{world}/video0.npz"], "tracks: expected at least two"),
        (["sync", "{world}/video0.npz", "{world}/truth.json"], "truth.json: expected a readable .npz"),
        (
            ["sync", "{world}/video0.npz", "{world}/video1.npz", "--reference", "x"],
            "--reference: expected auto or one of video0, video1",
        ),
        (
            ["sync", "{world}/video0.npz", "{world}/video1.npz", "--truth", "{world}/video0.npz"],
            "video0.npz: expected JSON",
        ),
        (["match", "{world}/video0.npz", "{world}"], "expected a file; found a folder"),
        (
            ["match", "{world}/video0.npz", "{world}/video1.npz", "matcher:partial-fgw", "--matcher.mass", "7"],
            "PartialFGW.mass",
        ),
        (["simulate", "{world}/x", "--motion", "waltz"], "waltz"),
        (["simulate", "{world}/x", "--fps", "0"], "fps"),
        (
            ["bench", "raster", "--first-seed", "3"],
            "--first-seed: benchmark raster does not take it. It takes --gate, --rebase.",
        ),
        (
            ["bench", "panoptic", "--seeds", "3"],
            "--seeds: benchmark panoptic does not take it. It takes scene, --gate, --rebase, --first-seed, "
            "--features, --json, --cache.",
        ),
        (["bench", "sync", "--gate", "--first-seed", "8100"], "--first-seed: expected without --gate and --rebase"),
        (["bench", "panoptic"], "scene: expected a recording"),
        (["bench", "panoptic", "{world}", "--features", "colour"], "--features: expected some of lab-histogram, daisy"),
        (["bench", "panoptic", "{world}", "--gate", "--features", "daisy"], "--features: expected without --gate"),
        (["bench", "core", "somewhere"], "scene: benchmark core does not take it"),
        (["bench", "sync", "--json"], "--json: benchmark sync does not take it"),
        (["bench", "sync", "--seeds", "0"], "--seeds: expected 1 or more; found 0"),
    ],
)
def test_bad_arguments_and_files_exit_with_two(args, message, world, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    try:
        code = main([a.format(world=world) for a in args])
    except SystemExit as stop:  # the parser's own way out
        code = stop.code
    assert code == 2
    captured = capsys.readouterr()
    assert message in captured.err + captured.out
    assert list(tmp_path.iterdir()) == []


def shell(*args: str, **options) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "otsync.cli", *args], capture_output=True, text=True, cwd=ROOT, timeout=3600, **options
    )


@pytest.mark.parametrize(
    ("args", "module", "drawn"),
    [
        (["sync", "--first-seed", "8100", "--seeds", "5"], "sync", {"first_seed": 8100, "seeds": 5}),
        (["sync", "--first-seed", "0", "--promises"], "sync", {"first_seed": 0, "promises": True}),
        (["match", "--seeds", "3", "--promises"], "match", {"seeds": 3, "promises": True}),
        (["core", "--first-seed", "7100"], "core", {"first_seed": 7100}),
        (["sync"], "sync", {}),
    ],
)
def test_chosen_seeds_reach_every_benchmark_that_draws(args, module, drawn, monkeypatch):
    seen = []
    monkeypatch.setattr(f"otsync.bench.{module}.run", lambda out, **options: seen.append(options) or 0)
    assert main(["bench", *args]) == 0
    assert [{k: v for k, v in options.items() if k not in ("gate", "rebase")} for options in seen] == [drawn]


def test_version_help_and_unknown_commands(capsys):
    assert shell("--version").stdout.strip() == f"otsync {__version__}"
    command = [sys.executable, "-m", "otsync", "--version"]
    as_module = subprocess.run(command, capture_output=True, text=True, check=True)
    assert as_module.stdout.strip() == f"otsync {__version__}"
    for command in ("demo", "simulate", "match", "sync"):
        with pytest.raises(SystemExit) as stop:
            main([command, "--help"])
        assert not stop.value.code
        assert f"Example: otsync {command}" in capsys.readouterr().out
    for args in (["dance"], []):
        with pytest.raises(SystemExit) as stop:
            main(args)
        assert stop.value.code == 2


@pytest.mark.parametrize("args", [["--version"], ["--help"], ["bench", "trust", "--help"]], ids=" ".join)
def test_a_reader_that_has_gone_ends_a_command_without_a_word(args):
    """As in ``otsync bench trust --help | head -5``, once head is done."""
    reads, writes = os.pipe()
    os.close(reads)
    try:
        command = [sys.executable, "-m", "otsync.cli", *args]
        done = subprocess.run(command, cwd=ROOT, stdout=writes, stderr=subprocess.PIPE, text=True, timeout=3600)
    finally:
        os.close(writes)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")


def test_a_pipe_to_another_program_that_breaks_is_told(monkeypatch, capsys):
    def breaks(self) -> int:
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

    monkeypatch.setattr("otsync.cli.match.Match.run", breaks)
    assert main(["match", "a.npz", "b.npz"]) == 2
    assert "Broken pipe" in capsys.readouterr().err


def test_no_progress_bar_when_the_output_is_no_terminal(world, tmp_path):
    two = sorted(world.glob("*.npz"))[:2]
    done = shell("sync", *map(str, two), "--out", str(tmp_path))
    assert done.returncode == 0 and "it/s" not in done.stderr and "pair/s" not in done.stderr


def test_track_sets_are_synchronised_and_reported(world, tmp_path, capsys):
    files = [str(p) for p in sorted(world.glob("*.npz"))]
    assert main(["sync", *files, "--out", str(tmp_path), "--truth", str(world / "truth.json")]) == 0
    found = Offsets.load(tmp_path / "offsets.json")
    assert found.ok and len(found) == 3 and np.isfinite(found.sigma).all()
    assert (tmp_path / "report.html").read_text().count("<svg") >= 5
    out = capsys.readouterr().out
    assert "true" in out and out.count("reference") >= 1


def test_only_the_reference_is_called_so(tmp_path, capsys):
    """A video without an answer heads a component of its own, but it is no reference."""
    rng = np.random.default_rng(0)
    for name in ("a", "b"):
        TrackSet(rng.normal(size=(6, 40, 3)), features=rng.normal(size=(6, 3)), fps=30, name=name).save(
            tmp_path / f"{name}.npz"
        )
    main(["sync", str(tmp_path / "a.npz"), str(tmp_path / "b.npz"), "--out", str(tmp_path)])
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("b ")]
    assert len(rows) == 1 and "reference" not in rows[0]


SLOW_WRITE = """
import sys, time, numpy as np
from otsync import TrackSet
savez = np.savez
def slow(stream, **arrays):
    stream.write(b"half"); stream.flush(); print("writing", flush=True); time.sleep(30)
np.savez = slow
TrackSet(np.zeros((4, 5, 3)), fps=30).save(sys.argv[1])
"""


def test_an_interrupt_amid_a_write_leaves_nothing_half_written(tmp_path):
    """SIGINT while bytes are being written: the old file stays, the temporary one goes."""
    path = tmp_path / "a.npz"
    TrackSet(np.ones((1, 2, 3)), fps=30).save(path)
    before = path.read_bytes()
    run = subprocess.Popen(
        [sys.executable, "-c", SLOW_WRITE, str(path)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert run.stdout.readline().strip() == "writing"
    assert len(list(tmp_path.iterdir())) == 2
    run.send_signal(signal.SIGINT)
    assert "KeyboardInterrupt" in run.communicate(timeout=3600)[1]
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"] and path.read_bytes() == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_command_says_so(world, tmp_path, number):
    """SIGINT or SIGTERM in the midst of matching and synchronising: exit code 130, and no files but whole ones."""
    files = [str(p) for p in sorted(world.glob("*.npz"))]
    command = [sys.executable, "-m", "otsync.cli", "sync", *files, "--out", str(tmp_path / "out")]
    run = subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    while not (tmp_path / "out" / LOCK).exists():  # from then on it works
        assert run.poll() is None
        time.sleep(0.02)
    time.sleep(0.3)
    run.send_signal(number)
    _, err = run.communicate(timeout=3600)
    # a compiled extension that is just being imported may abort instead; a signal that reaches the interpreter's own
    # end gives -SIGINT, which a shell shows as 130 too
    assert run.returncode in (130, -number, -signal.SIGINT, -signal.SIGABRT), err
    left = list((tmp_path / "out").iterdir()) if (tmp_path / "out").exists() else []
    assert {path.name for path in left} <= {LOCK}


def test_a_gate_without_the_classes_of_its_baseline_judges_nothing(monkeypatch, tmp_path, capsys):
    """Medians over other pairs would be called worse, or better."""
    monkeypatch.setattr("otsync.bench.sync.motions", lambda: MOVING)
    assert main(["bench", "sync", "--gate", "--out", str(tmp_path)]) == 2
    assert "Set OTSYNC_DATA" in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "error, says",
    [
        (
            OSError(errno.ENOSPC, "cannot be written (No space left on device)", "out/a.json"),
            "otsync: out/a.json: cannot be written (No space left on device). Free some space",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied", "b.json"),
            "otsync: b.json: Permission denied. Check its permissions.",
        ),
        (
            MemoryError("a.npz: expected arrays that fit into memory; they do not. Use fewer or smaller ones."),
            "smaller ones.\n",
        ),
        (MemoryError(), "otsync: not enough memory. Use fewer frames"),
        (FileNotFoundError("a.npz: no such file. Check the path."), "otsync: a.npz: no such file. Check the path."),
    ],
)
def test_errors_of_the_system_name_the_file_and_the_remedy(monkeypatch, tmp_path, capsys, error, says):
    def stop(self):
        raise error

    monkeypatch.setattr(Simulate, "run", stop)
    assert main(["simulate", str(tmp_path)]) == 2
    assert says in capsys.readouterr().err


def test_a_write_that_fails_keeps_the_old_file_and_names_it(monkeypatch, tmp_path):
    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "a.json").write_text("old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"cannot be written \(No space left on device\).*a\.json"):
        write_json(tmp_path / "a.json", [1])
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"] and (tmp_path / "a.json").read_text() == "old"


@pytest.mark.parametrize(("words", "lean"), [(["--version"], True), (["--device", "cuda", "--version"], False)])
def test_the_command_leaves_tensor_libraries_out_unless_a_device_is_named(monkeypatch, words, lean):
    """As a library, and where the environment already says otherwise, nothing is changed."""
    keys = [f"POT_BACKEND_DISABLE_{library}" for library in ("PYTORCH", "JAX", "CUPY", "TENSORFLOW")]
    for key in keys:
        monkeypatch.delenv(key, raising=False)
    monkeypatch.setattr("sys.argv", ["otsync", *words])
    monkeypatch.setattr("otsync.cli.run_command", lambda *args, **options: 0)
    main(["--version"])
    assert not any(key in os.environ for key in keys)
    monkeypatch.setenv(keys[1], "")
    main()
    assert [os.environ.get(key) for key in keys] == (["1", "", "1", "1"] if lean else [None, "", None, None])
    for key in keys:
        os.environ.pop(key, None)
