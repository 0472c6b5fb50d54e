"""Frontier of whole runs: the truth is what was cut off, rows are kept, a run that failed is told."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

from otsync.io import open_scene
from otsync.types import Offsets
from recon.bench import budget
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Four videos of one clock."""
    home = tmp_path_factory.mktemp("synchronous")
    write_capture(synthetic(5, cameras=4, held_out=0, frames=34, size=(64, 40), offsets=[0] * 4), home)
    return home


def test_videos_lose_what_the_truth_says(recording, tmp_path):
    folder, truth = budget.cut(recording, tmp_path / "a", 3)
    whole, short, known = open_scene(recording), open_scene(folder), Offsets.load(truth)
    assert known.names == whole.names[1:] and short.names == whole.names
    late = [len(a.frames) - len(b.frames) for a, b in zip(whole.videos, short.videos, strict=True)]
    assert 0 <= min(late) < max(late) <= budget.MOST
    for v, name in enumerate(whole.names):
        np.testing.assert_array_equal(short.videos[v].frames[0], whole.videos[v].frames[late[v]])
        if v:
            assert known.frames[known.names.index(name)] == pytest.approx(late[v] - late[1])
        # nothing that was measured before the cut is handed on
        assert short.videos[v].depth is None and short.masks[v] is None
    images = sorted(p for p in recording.rglob("*") if p.suffix in (".png", ".jpg"))
    assert os.path.samefile(images[0], folder / images[0].relative_to(recording))  # linked, not copied


def test_short_recordings_are_refused(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "MOST", 17)
    with pytest.raises(ValueError, match="expected three videos and more, of more than 34 frames"):
        budget.cut(recording, tmp_path / "a", 3)


def test_results_inside_of_the_recording_are_refused(recording):
    with pytest.raises(ValueError, match="--out: expected a folder outside of the recording"):
        budget.cut(recording, recording / "bench" / "a", 3)
    assert not (recording / "bench").exists()


def test_rows_that_are_kept_are_not_measured_again(recording, tmp_path, monkeypatch):
    asked = []

    def measured(folder, truth, seconds, result):
        asked.append(seconds)
        row = {"budget": seconds, "wall s": seconds + 1.0, "exit code": 0}
        return {**row, "steps": 7, "error": 1 / seconds, "psnr": 20.0 + seconds, "mask_psnr": None}

    monkeypatch.setattr(budget, "measured", measured)
    assert budget.run(tmp_path, scene=recording, sizes=(30, 20)) == 0 and asked == [20, 30]
    assert budget.run(tmp_path, scene=recording, sizes=(30, 20, 40)) == 0 and asked == [20, 30, 40]
    document = json.loads((tmp_path / "budget.json").read_text())
    assert [row["budget"] for row in document["rows"]] == [20, 30, 40]
    assert "wall seconds" in (tmp_path / "budget.svg").read_text()


def test_a_run_that_fails_is_told(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "cut", lambda *_: (tmp_path / "nowhere", tmp_path / "nowhere"))
    (tmp_path / "nowhere").mkdir()
    (tmp_path / "nowhere" / "scene.json").write_text('{"videos": [{"name": "a"}]}')
    assert budget.run(tmp_path / "out", scene=recording, sizes=(20,)) == 1
    row = json.loads((tmp_path / "out" / "budget.json").read_text())["rows"][0]
    assert row["exit code"] == 2 and "error" not in row
    assert not (tmp_path / "out" / "budget.svg").exists()
    assert not list((tmp_path / "out").glob("budget-*.json"))  # it is tried again
