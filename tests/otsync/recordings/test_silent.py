"""A video in which nothing moves leaves the others their clocks."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from otsync.cli import main
from otsync.io import open_scene
from otsync.recordings.routes import synchronize_scene
from otsync.recordings.silent import NothingToFollow, followed, tried
from otsync.types import Offsets, Status
from tests.recording_world import write_recording

TRUE = [0.0, 7.0, -5.0, 3.5]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Four cameras, of which the third filmed a wall."""
    folder = tmp_path_factory.mktemp("silent") / "rec"
    write_recording(folder, TRUE, frames=60)
    for image in sorted((folder / "cam2").iterdir())[1:]:
        shutil.copy(folder / "cam2" / "000.jpg", image)
    return folder


def test_the_others_are_synchronised_and_it_is_named(recording, tmp_path, capsys):
    out, alone = tmp_path / "out", tmp_path / "alone"
    assert main(["sync", str(recording), "--out", str(out)]) == 1
    told = capsys.readouterr()
    assert "cam2 has no clock: nothing in it can be followed" in json.loads((out / "sync.json").read_text())["why"]
    assert "cam2: static" in told.err and "video cam2: expected moving foreground" in told.err
    found = Offsets.load(out / "offsets.json")
    assert found.names == ("cam0", "cam1", "cam2", "cam3") and found.reference == 0
    assert found.component.tolist() == [0, 0, 2, 0] and set(found.flags[2]) == {Status.STATIC, Status.DISCONNECTED}
    assert (found.seconds[2], found.sigma[2]) == (0.0, 0.0)
    others = ["--recording.cameras", "cam0", "cam1", "cam3"]
    main(["sync", str(recording), "--out", str(alone), *others, "--recording.cache", str(out / "stages")])
    same = Offsets.load(alone / "offsets.json")
    np.testing.assert_array_equal(found.seconds[[0, 1, 3]], same.seconds)
    np.testing.assert_array_equal(found.sigma[[0, 1, 3]], same.sigma)
    np.testing.assert_allclose(same.frames, [TRUE[v] for v in (0, 1, 3)], atol=0.25)
    assert "cam2" in (out / "report.html").read_text()


def test_the_last_of_many_as_reference_keeps_its_place(recording):
    answer = synchronize_scene(open_scene(recording), reference=-1)
    assert answer.offsets.reference == 3 and answer.offsets.component.tolist() == [3, 3, 2, 3]
    assert [len(t) > 0 for t in answer.tracks] == [True, True, False, True]
    assert set(answer.offsets.alignments) == {(0, 1), (0, 3), (1, 3)}
    np.testing.assert_allclose(answer.offsets.frames[:2], np.array(TRUE[:2]) - TRUE[3], atol=0.25)


def test_where_it_is_the_reference_or_nothing_is_left_it_is_an_error(recording, tmp_path, capsys):
    assert main(["sync", str(recording), "--out", str(tmp_path / "a"), "--reference", "cam2"]) == 2
    told = capsys.readouterr().err
    assert "video cam2" in told and "--reference cam0" in told
    two = ["--recording.cameras", "cam0", "cam2"]
    assert main(["sync", str(recording), "--out", str(tmp_path / "b"), *two]) == 2
    assert "video cam2" in capsys.readouterr().err


def test_all_that_are_silent_are_named_at_once():
    def make(n: int) -> int:
        if n % 2:
            raise NothingToFollow({str(n): f"video {n}."})
        return n

    with pytest.raises(NothingToFollow, match=r"^video 1\. video 3\.$") as caught:
        followed([tried(make, n) for n in range(5)])
    assert list(caught.value.why) == ["1", "3"]
    assert followed([tried(make, n) for n in (0, 2)]) == [0, 2]
    with pytest.raises(ZeroDivisionError):
        tried(lambda: 1 // 0)
