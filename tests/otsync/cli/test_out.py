"""What a command writes to: never over another command's result, never over a file that is not its own."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from otsync.cli import main
from otsync.files.claim import MARKS, claimed
from otsync.simulate import simulate
from otsync.types import Offsets, TrackSet
from tests.recording_world import write_recording


@pytest.fixture(scope="module")
def tracks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tracks")
    sets, _ = simulate("tennis", preset="clean", videos=2, frames=45, tracks=12, seed=1)
    for n, each in enumerate(sets):
        each.save(folder / f"v{n}.npz")
    return folder


@pytest.mark.parametrize("name", ["v0.npz", "truth.json"])
def test_a_table_of_matches_goes_over_no_other_file(tracks, tmp_path, capsys, name):
    home = shutil.copytree(tracks, tmp_path / "home")
    (home / "truth.json").write_text("{}")
    before = (home / name).read_bytes()
    assert main(["match", str(home / "v0.npz"), str(home / "v1.npz"), "--out", str(home / name)]) == 2
    assert (home / name).read_bytes() == before
    told = capsys.readouterr().err
    assert "--out" in told and name in told


def test_a_table_of_matches_goes_over_an_earlier_one(tracks, tmp_path):
    pairs = [str(tracks / "v0.npz"), str(tracks / "v1.npz")]
    for _ in range(2):
        assert main(["match", *pairs, "--out", str(tmp_path / "m.csv"), "--budget", "5"]) in (0, 1)
    assert (tmp_path / "m.csv").read_text().startswith("a,b,score\n")


@pytest.mark.parametrize("theirs", ["otsync sync", "otsync run", "recon fit", "otsync simulate"])
@pytest.mark.parametrize(
    "command",
    [
        ["import-offsets", "told.csv", "scene.json"],
        ["bench", "core"],
        ["audit", "scene.json"],
    ],
)
def test_another_commands_result_stays_as_it_is(tmp_path, monkeypatch, capsys, theirs, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "told.csv").write_text("a,b,0.5\n")
    (tmp_path / "scene.json").write_text("{}")
    with claimed(tmp_path / "result", theirs) as folder:
        for name in MARKS[theirs]:
            (folder / name).write_text("theirs")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert main([*command, "--out", "result"]) == 2
    assert f"holds that of {theirs}" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_an_export_goes_into_no_result(tmp_path, capsys):
    write_recording(tmp_path / "recording", [0.0, 2.0], frames=6)
    Offsets.known(("cam0", "cam1"), np.zeros(2), 30.0).save(tmp_path / "offsets.json")
    with claimed(tmp_path / "result", "otsync sync") as folder:
        (folder / "offsets.json").write_text("theirs")
    given = [str(tmp_path / "recording"), "--offsets", str(tmp_path / "offsets.json"), "--out", str(folder)]
    assert main(["export", *given]) == 2
    assert "--out" in capsys.readouterr().err and {p.name for p in folder.iterdir()} <= {"offsets.json", ".otsync.lock"}


@pytest.mark.parametrize(
    ("costs", "field"),
    [("cosine:weight=abc", "weight"), ("cosine:center=3", "center"), ("cosine:weight=True", "weight")],
)
def test_a_value_of_another_type_is_refused_before_the_work(tracks, capsys, costs, field):
    with pytest.raises(SystemExit) as stopped:
        main(["match", str(tracks / "v0.npz"), str(tracks / "v1.npz"), "--costs", costs])
    assert stopped.value.code == 2 and f"cosine:{field}" in capsys.readouterr().err


def test_an_error_about_tracks_names_their_file(tracks, tmp_path, capsys):
    replace(TrackSet.load(tracks / "v1.npz"), features=None).save(tmp_path / "bare.npz")
    assert main(["sync", str(tracks / "v0.npz"), str(tmp_path / "bare.npz"), "--out", str(tmp_path / "o")]) == 2
    assert f"{tmp_path / 'bare.npz'}: features: expected" in capsys.readouterr().err
