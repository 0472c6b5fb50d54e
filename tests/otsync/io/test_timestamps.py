"""Seconds of every frame from a CSV."""

from __future__ import annotations

import json

import numpy as np
import pytest

from otsync.cli import main
from otsync.io import open_scene
from otsync.io.timestamps import read_timestamps
from tests.otsync.io.datasets import samples


@pytest.fixture
def folder(tmp_path):
    samples.neural_3d_video(tmp_path)
    return tmp_path


def write(folder, text: str):
    path = folder / "times.csv"
    path.write_text(text)
    return path


def test_times_of_a_csv_go_before_the_containers(folder, capsys):
    times = {"cam00": [5.0, 5.1, 5.3, 5.4], "cam02": [0.0, 0.5, 0.6, 0.7]}
    rows = [f"{video},{k},{1000 * t}" for video, own in times.items() for k, t in enumerate(own)]
    path = write(folder, "video,frame,milliseconds\n" + "\n".join(rows) + "\n")
    assert main(["init", str(folder), "--timestamps", str(path)]) == 0
    scene = open_scene(folder)
    np.testing.assert_allclose(scene.videos[0].times, times["cam00"])
    np.testing.assert_allclose(scene.videos[2].times, times["cam02"])
    np.testing.assert_allclose(np.diff(scene.videos[1].times), 0.04)  # its own


def test_times_stand_for_the_rate_that_images_lack(tmp_path):
    samples.images(tmp_path / "left")
    path = write(tmp_path, "seconds\n0\n0.1\n0.2\n0.4\n")
    assert main(["init", str(tmp_path), "--timestamps", str(path)]) == 1
    document = json.loads((tmp_path / "scene.json").read_text())
    assert document["videos"][0]["timestamps"] == [0.0, 0.1, 0.2, 0.4]
    assert not any("fps" in item for item in document["missing"])


@pytest.mark.parametrize(
    "text, says",
    [
        ("video,seconds\ncam00,0\ncam00,1\n", r"expected 4 lines, one a frame; found 2"),
        ("video,seconds\ncam09,0\n", r"expected some of cam00, .*; found 'cam09'"),
        ("seconds\n0\n1\n2\n3\n", r"expected a column video"),
        ("video,second\ncam00,0\n", r"one of seconds, .*Did you mean seconds"),
        ("video,seconds\ncam00,0\ncam00,0\n", r"line 3: expected a time after 0 s"),
        ("video,seconds\ncam00,soon\n", r"line 2: seconds: expected a number; found 'soon'"),
        ("video,frame,seconds\ncam00,0,0\ncam00,2,1\n", r"line 3: frame: expected 1; found '2'"),
        ("video,seconds\n", r"a line for every frame; found none"),
        ("seconds,milliseconds\n0,0\n", r"once"),
    ],
)
def test_times_that_do_not_fit_are_refused(folder, capsys, text, says):
    import re

    assert main(["init", str(folder), "--timestamps", str(write(folder, text))]) == 2
    assert re.search(says, capsys.readouterr().err)


def test_a_file_without_a_column_of_videos_is_of_one(tmp_path):
    assert read_timestamps(write(tmp_path, "Frame,Seconds\n0,1.5\n1,2.5\n")) == {None: [1.5, 2.5]}
