"""Runs that are killed, doubled, or find the disk full: nothing is lost or half written, and the same comes out."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from otsync.files.arrays import read_json, read_npz
from otsync.files.claim import LOCK
from tests.docs.pages import ROOT

pytest.importorskip("torch")
pytestmark = pytest.mark.slow

FAULTS = str(Path(__file__).with_name("faults.py"))


def started(package: str, *args: object, fault: str = "", at: int = 0, **options) -> subprocess.Popen:
    """The command in a process of its own, with a fault at some moment."""
    command = [sys.executable, "-m", f"{package}.cli", *map(str, args), *(["--plugin", FAULTS] if fault else [])]
    environment = os.environ | {"FAULT": fault, "FAULT_AT": str(at)}
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options
    )


def ended(*args: object, **options) -> tuple[int, str]:
    """Exit code and what was told on stderr."""
    run = started(*args, **options)
    _, err = run.communicate()
    return run.returncode, err


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("killed") / "world"
    options = [
        "--frames",
        "48",
        "--width",
        "96",
        "--height",
        "64",
        "--cameras",
        "3",
        "--held-out",
        "0",
        "--max-offset",
        "3",
        "--seed",
        "4",
    ]
    code, err = ended("recon", "simulate", folder, *options)
    assert code == 0, err
    return folder


def run_of(world: Path, out: Path) -> list[object]:
    few = ["--width", "96", "--steps", "20", "--backdrop-steps", "20", "--views", "2", "--recording.workers", "1"]
    return ["otsync", "run", world, "--out", out, *few]


@pytest.fixture(scope="module")
def whole(world, tmp_path_factory) -> Path:
    """The result of a run that nothing disturbs."""
    out = tmp_path_factory.mktemp("whole") / "out"
    code, err = ended(*run_of(world, out))
    assert code in (0, 1), err
    return out


def sound(folder: Path) -> list[str]:
    """The names of all files, every one of which reads."""
    names = []
    for path in folder.rglob("*"):
        if path.is_dir() or path.name.startswith("."):
            continue
        names.append(str(path.relative_to(folder)))
        if path.suffix == ".npz":
            read_npz(path)
        elif path.suffix == ".json":
            read_json(path)
        else:
            assert path.stat().st_size, path
    return sorted(names)


def same(a: Path, b: Path) -> None:
    """Two results are equal but for wall times."""
    assert sound(a) == sound(b)
    for name in ("offsets_coarse.json", "offsets.json", "metrics.json"):
        assert (a / name).read_text() == (b / name).read_text(), name
    documents = [json.loads((out / "run.json").read_text()) for out in (a, b)]
    assert documents[0] | {"seconds": 0} == documents[1] | {"seconds": 0}
    scenes = [read_npz(out / "scene.npz") for out in (a, b)]
    assert scenes[0].keys() == scenes[1].keys()
    for name in scenes[0]:
        np.testing.assert_array_equal(scenes[0][name], scenes[1][name], err_msg=name)


def clean(err: str) -> str:
    """The last line; there is no traceback, nor one that Python ignored."""
    assert "Traceback" not in err and "Exception ignored" not in err, err
    return err.strip().splitlines()[-1]


def test_twenty_kills_of_a_run(world, whole, tmp_path):
    """Each process is killed some files further on: half written, before and after it gets its name."""
    out, kills, before = tmp_path / "out", 0, []
    for kills in range(1, 21):
        code, err = ended(*run_of(world, out), fault="kill", at=(3, 4, 5, 9)[kills % 4])
        if code != -signal.SIGKILL:
            break
        after = sound(out)
        # what is begun anew goes first: the cameras of an earlier result, never a stage
        assert {n for n in before if n.startswith("stages")} <= set(after)
        before = after
    assert kills >= 12, err
    code, err = ended(*run_of(world, out))
    assert code in (0, 1), err
    same(out, whole)
    assert not [path for path in out.rglob(".*") if path.name != LOCK]


def test_a_full_disk_at_every_stage_of_a_run(world, whole, tmp_path):
    """Each process may write one file more than the last; the rest fails, as on a full disk, and is said in one line.

    More, because what is no stage is written anew each time.
    """
    out, fails = tmp_path / "out", 0
    while fails < 40:
        code, err = ended(*run_of(world, out), fault="full", at=2 + fails)
        last = clean(err)
        if code in (0, 1):
            break
        assert code == 2 and "No space left on device" in last and str(out) in last and "Free some space" in last, last
        fails += 1
        sound(out)
        assert not list(out.rglob(".*.part"))
    assert fails >= 6
    same(out, whole)


def test_two_runs_in_one_folder(world, whole, tmp_path):
    out = tmp_path / "out"
    first = started(*run_of(world, out), fault="wait", at=20, stdin=subprocess.PIPE)
    assert first.stdout.readline() == "waiting\n"
    before = sound(out)
    code, err = ended(*run_of(world, out))
    assert code == 2 and f"in use by otsync run (process {first.pid})" in clean(err)
    assert sound(out) == before
    first.communicate("go on\n")
    assert first.returncode in (0, 1)
    same(out, whole)


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path.name != LOCK
    }


SHOWN = [
    (["export", "--format", "ply"], "a.ply", 1),
    (["export", "--format", "ply"], "a.ply", 2),
    (["export", "--format", "splat"], "a.splat", 1),
    (["export", "--format", "tracks"], "a.npz", 1),
    (["export", "--format", "checkpoint"], "a.npz", 2),
    (["export", "--format", "ply-sequence", "--fps", "6"], "sequence", 5),
    (["export", "--format", "ply-sequence", "--fps", "6"], "sequence", 9),
    (["render", "--camera", "cam0", "--fps", "6"], "frames", 4),
    (["render", "--camera", "cam0", "--fps", "6"], "frames", 9),
    (["render", "--camera", "cam0", "--fps", "6"], "a.mp4", 1),
]


@pytest.mark.parametrize("fault", ["kill", "full"])
def test_exports_and_renderings_that_are_killed_or_find_the_disk_full(whole, tmp_path, fault):
    before = digests(whole)
    for n, ((command, *options), name, at) in enumerate(SHOWN):
        if fault == "full" and name == "a.mp4":  # FFmpeg writes by itself
            continue
        out, other = tmp_path / f"{fault}{n}" / name, tmp_path / f"whole{n}" / name
        at = at if fault == "kill" else max(1, at // 3)
        code, err = ended("recon", command, whole, *options, "--out", out, fault=fault, at=at)
        if fault == "kill":
            assert code == -signal.SIGKILL, (n, err)
        else:
            assert code == 2 and "No space left on device" in clean(err), (n, err)
        assert not out.is_file()
        assert digests(whole) == before
        for target in (out, other):
            code, err = ended("recon", command, whole, *options, "--out", target)
            assert code == 0, (n, err)
        if name != "a.mp4":  # a container holds the moment of its writing
            left, right = (digests(target.parent) for target in (out, other))
            assert {k: v for k, v in left.items() if not k.endswith(".part")} == right, n
        assert digests(whole) == before
