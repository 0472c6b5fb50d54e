"""One run in a folder at a time, and no result over another command's."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from otsync.cli import main
from otsync.files.claim import LOCK, MARKS, claimed, owner, refuse_parts_of_a_result
from tests.docs.pages import ROOT

HOLD = """
import sys, time
from otsync.files.claim import claimed
with claimed(sys.argv[1], "otsync sync"):
    print("held", flush=True)
    time.sleep(3600)
"""


@pytest.fixture
def holder(tmp_path):
    """A folder that another process holds, and the process."""
    run = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "out")], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert run.stdout.readline() == "held\n"
    yield tmp_path / "out", run
    run.kill()
    run.wait()


def test_a_second_run_in_a_folder_is_refused_until_the_first_is_gone_however_it_went(holder):
    folder, run = holder
    with (
        pytest.raises(ValueError, match=rf"is in use by otsync sync \(process {run.pid}\)\. Wait"),
        claimed(folder, "otsync sync"),
    ):
        raise AssertionError
    run.send_signal(signal.SIGKILL)
    run.wait()
    with claimed(folder, "otsync sync") as held:
        assert held == folder


def test_a_folder_is_held_only_within_the_block(tmp_path):
    for _ in range(2):
        with claimed(tmp_path, "recon fit"):
            (tmp_path / "fit.npz").touch()
            with pytest.raises(ValueError, match="in use"), claimed(tmp_path, "recon fit"):
                raise AssertionError
    assert owner(tmp_path) == "recon fit"


@pytest.mark.parametrize("theirs", MARKS)
def test_the_result_of_another_command_is_refused_and_stays(tmp_path, theirs):
    with claimed(tmp_path, theirs):
        for name in MARKS[theirs]:
            (tmp_path / name).write_text("theirs")
    for ours in MARKS:
        if ours == theirs:
            continue
        with pytest.raises(ValueError, match=f"holds that of {theirs}. Choose another folder"), claimed(tmp_path, ours):
            raise AssertionError
    assert all((tmp_path / name).read_text() == "theirs" for name in MARKS[theirs])
    with claimed(tmp_path, theirs):
        pass


@pytest.mark.parametrize(
    "names, command",
    [
        (["offsets_coarse.json", "offsets.json", "sync.json", "run.json", "scene.npz"], "otsync run"),
        (["offsets.json", "run.json", "scene.npz"], "recon fit"),
        (["fit.npz"], "recon fit"),
        (["offsets.json", "report.html"], "otsync sync"),
        (["truth.json", "video0.npz"], "otsync simulate"),
        (["truth.json", "start.json", "scene.json"], "recon simulate"),
        (["scene.json", "left.mp4", "notes.txt"], None),
        (["stages"], None),
    ],
)
@pytest.mark.parametrize("told", [b"", b"{", b"[]", b'{"command": 7}', b'{"command": "rm"}', b"\xff" * 2000])
def test_folders_are_known_by_their_files_where_no_lock_tells(tmp_path, names, command, told):
    (tmp_path / LOCK).write_bytes(told)
    for name in names:
        (tmp_path / name).touch()
    assert owner(tmp_path) == command


def test_a_run_that_wrote_nothing_leaves_nothing_and_a_killed_ones_parts_go(tmp_path):
    with pytest.raises(KeyboardInterrupt), claimed(tmp_path / "new", "otsync sync"):
        raise KeyboardInterrupt
    assert not (tmp_path / "new").exists()
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    stages = tmp_path / "stages"
    stages.mkdir()
    dead, alive = stages / f".tracks.npz.{gone.pid}-7.part", stages / f".tracks.npz.{os.getpid()}-7.part"
    for path in (dead, alive):
        path.touch()
    with claimed(tmp_path, "otsync sync"):
        assert not dead.exists() and alive.exists()
    assert not (tmp_path / LOCK).exists()


def test_no_export_replaces_a_part_of_a_result(tmp_path):
    refuse_parts_of_a_result(tmp_path / "scene.npz")
    for name in MARKS["recon fit"]:
        (tmp_path / name).touch()
    refuse_parts_of_a_result(tmp_path / "tracks.npz")
    with pytest.raises(ValueError, match=r"scene\.npz belongs to that of recon fit\. Choose another name"):
        refuse_parts_of_a_result(tmp_path / "scene.npz")


def test_commands_refuse_before_they_work(tmp_path, capsys):
    """The inputs do not even exist: the folder is looked at first."""
    (tmp_path / "offsets_coarse.json").touch()
    for command in (
        ["sync", "nowhere"],
        ["sync", "a.npz", "b.npz"],
    ):
        assert main([*command, "--out", str(tmp_path)]) == 2
        assert "holds that of otsync run" in capsys.readouterr().err
    assert main(["simulate", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("holds that of otsync run") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["offsets_coarse.json"]


def test_commands_of_the_reconstruction_refuse_before_they_work(tmp_path, capsys):
    pytest.importorskip("torch")
    from recon.cli import main as recon

    (tmp_path / "offsets_coarse.json").touch()
    assert recon(["fit", "nowhere", "--offsets", "none.json", "--out", str(tmp_path)]) == 2
    assert recon(["simulate", str(tmp_path)]) == 2
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("holds that of otsync run") == 3
    assert [path.name for path in tmp_path.iterdir()] == ["offsets_coarse.json"]
