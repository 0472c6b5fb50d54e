"""Cameras in a wrong place: by how their pairs fare, and by what their calibration says."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from otsync.calibrate.document import came_later
from otsync.cli.calibrate import prepared
from otsync.io import open_scene
from otsync.priors.stereo import EmptyHull
from otsync.recordings import routes
from otsync.recordings.placement import misplaced, with_doubts
from otsync.types import Alignment, Offsets, Status
from tests.recording_world import write_recording


def offsets(bad: set[tuple[int, int]], videos: int = 5, residual: float = 0.0) -> Offsets:
    """Offsets whose pairs are sound, but for ``bad`` ones."""
    pairs = {
        (a, b): Alignment(
            0.0,
            fps=30.0,
            flags=(Status.WEAK,) if (a, b) in bad and not residual else (),
            stats={"residual": residual / 30 if (a, b) in bad else 0.0},
        )
        for a in range(videos)
        for b in range(a + 1, videos)
    }
    known = Offsets.known([f"v{n}" for n in range(videos)], np.zeros(videos), 30.0)
    return replace(known, alignments=pairs)


@pytest.mark.parametrize("residual", [0.0, 4.0])
def test_the_camera_whose_pairs_fail_is_named_and_no_other(residual):
    bad = {(min(a, 2), max(a, 2)) for a in (0, 1, 3, 4)}
    assert misplaced(offsets(bad, residual=residual)) == {"v2"}
    assert misplaced(offsets(set())) == set()
    assert misplaced(offsets({(0, 1), (1, 2)})) == set()  # half of its pairs: far cameras have such


@pytest.mark.parametrize("flag", [Status.SHORT_OVERLAP, Status.BROKEN_CLOCK, Status.RATE_MISMATCH])
def test_clocks_and_short_clips_accuse_no_camera_unless_pairs_contradict_the_answer(flag):
    """Real clips of 1.4 s, all pairs of which are too short: every camera stood where it stood."""
    sound = offsets(set())
    pairs = {pair: replace(a, flags=(flag,)) for pair, a in sound.alignments.items()}
    assert misplaced(replace(sound, alignments=pairs)) == set()
    bad = {(min(a, 2), max(a, 2)) for a in (0, 1, 3, 4)}
    away = offsets(bad, residual=4.0)
    pairs = {pair: replace(a, flags=(flag,)) for pair, a in away.alignments.items()}
    assert misplaced(replace(away, alignments=pairs)) == {"v2"}


def test_fast_cameras_may_miss_by_some_of_their_frames_and_slow_ones_by_one():
    bad = {(min(a, 2), max(a, 2)) for a in (0, 1, 3, 4)}
    for fps, frames, named in ((120.0, 3.0, False), (120.0, 5.0, True), (6.0, 0.8, False), (6.0, 1.2, True)):
        found = offsets(bad, residual=frames * 30 / fps)
        found = replace(found, fps=np.full(5, fps))
        assert misplaced(found) == ({"v2"} if named else set())


def test_two_pairs_tell_nothing_of_a_camera():
    assert misplaced(offsets({(0, 1), (1, 2)}, videos=3)) == set()


def test_doubts_become_flags_beside_others():
    found = with_doubts(offsets(set()), {"v1", "nobody"})
    assert [status.code for status in found.status] == ["ok", "misplaced", "ok", "ok", "ok"]
    assert with_doubts(found, {"nobody"}) is found


def test_what_calibrate_doubts_sync_flags(tmp_path):
    write_recording(tmp_path, [0.0, 2.0], frames=3)
    document = json.loads((tmp_path / "scene.json").read_text())
    cameras = {"cam0": {"lens": "found"}, "cam1": {"lens": "guessed", "doubtful": "its focal length is a guess."}}
    document["calibration"] = {"method": "global", "unit": "arbitrary", "cameras": cameras}
    (tmp_path / "scene.json").write_text(json.dumps(document))
    scene = open_scene(tmp_path)
    assert scene.doubtful == {"cam1": "its focal length is a guess."}
    assert scene.take(["cam1"]).doubtful == scene.doubtful


def test_an_empty_hull_leaves_the_epipolar_answer(tmp_path, monkeypatch):
    write_recording(tmp_path, [0.0] * 5, frames=2)
    scene, first = open_scene(tmp_path), offsets(set())

    def empty(*args, **more):
        raise EmptyHull("masks: their visual hull is empty.")

    monkeypatch.setattr(routes, "track_all", lambda *args: [None] * 5)
    monkeypatch.setattr(routes, "select", lambda *args: None)
    monkeypatch.setattr(routes, "pairs_in_pixels", lambda *args: first)
    monkeypatch.setattr(routes, "stereo_depth", empty)
    found = routes.synchronize_scene(scene)
    assert found.route == "epipolar" and any("visual hull is empty" in line for line in found.why)
    np.testing.assert_array_equal(found.offsets.seconds, first.seconds)
    with pytest.raises(EmptyHull):
        routes.synchronize_scene(scene, route="stereo")


@pytest.mark.parametrize(
    ("sigma", "enough", "doubted", "asked"),
    [(0.2, 0.25, set(), False), (0.3, 0.25, set(), True), (0.2, None, set(), True), (0.2, 0.25, {"v1"}, True)],
)
def test_stereo_is_left_out_where_pixels_are_fine_enough(tmp_path, monkeypatch, sigma, enough, doubted, asked):
    """Sigma in frames of the reference; a doubt of any video asks stereo, and so does the named route."""
    write_recording(tmp_path, [0.0] * 5, frames=2)
    known = offsets(set())
    first = with_doubts(replace(known, sigma=np.r_[0.0, np.full(4, sigma)] / known.fps[known.reference]), doubted)
    went = []

    def empty(*args, **more):
        went.append(args)
        raise EmptyHull("masks: their visual hull is empty.")

    monkeypatch.setattr(routes, "track_all", lambda *args: [None] * 5)
    monkeypatch.setattr(routes, "select", lambda *args: None)
    monkeypatch.setattr(routes, "pairs_in_pixels", lambda *args: first)
    monkeypatch.setattr(routes, "stereo_depth", empty)
    found = routes.synchronize_scene(open_scene(tmp_path), fine_enough=enough)
    assert bool(went) == asked
    assert any("pixels give every offset to 0.20 frame" in line for line in found.why) == (not asked)
    np.testing.assert_array_equal(found.offsets.seconds, first.seconds)
    with pytest.raises(EmptyHull):
        routes.synchronize_scene(open_scene(tmp_path), route="stereo", fine_enough=enough)
    with pytest.raises(ValueError, match="fine_enough: expected a finite number above 0; found -1"):
        routes.synchronize_scene(open_scene(tmp_path), fine_enough=-1.0)


def test_a_walk_that_was_filmed_since_is_told(tmp_path, capsys):
    """The remedy of a doubtful calibration is a new clip: sync says that it had no part in the cameras."""
    folder = tmp_path / "four phones"
    write_recording(folder, [0.0, 2.0], frames=3)
    document = json.loads((folder / "scene.json").read_text())
    names = [video["name"] for video in document["videos"]]
    pictures = (folder / document["videos"][0]["frames"]).parent
    cameras = {name: {"lens": "found"} for name in names}
    document["calibration"] = {"method": "global", "unit": "arbitrary", "cameras": cameras}
    (folder / "scene.json").write_text(json.dumps(document))
    assert came_later(folder) == ()  # of an earlier version: nobody knows what was there
    document["calibration"]["helpers"] = []
    (folder / "scene.json").write_text(json.dumps(document))
    before = set(came_later(folder))
    shutil.copytree(pictures, folder / "walk")
    assert set(came_later(folder)) == before | {"walk"}
    assert prepared(folder) == 0
    told = capsys.readouterr().err
    assert "walk" in told and f"otsync calibrate '{folder}'" in told


@pytest.mark.parametrize("told", [{"helpers": [[]]}, {"helpers": 3}, {"helpers": [], "cameras": None}, [], "walk"])
def test_a_calibration_that_is_none_is_left_to_its_reader(tmp_path, told):
    write_recording(tmp_path, [0.0, 2.0], frames=3)
    document = json.loads((tmp_path / "scene.json").read_text())
    (tmp_path / "scene.json").write_text(json.dumps({**document, "calibration": told}))
    assert came_later(tmp_path) == () and prepared(tmp_path) == 0
    with pytest.raises(ValueError, match="calibration"):
        open_scene(tmp_path)


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({"named": {"--held-out": ["cam1", "nope"]}}, "--held-out: .*cam0, cam1; found 'nope'"),
        ({"named": {"--reference": ["nope"]}}, "--reference: "),
        ({"truth": Path("nothere.json")}, "nothere.json"),
    ],
)
def test_options_are_read_before_cameras_are_looked_for(tmp_path, monkeypatch, given, field):
    write_recording(tmp_path, [0.0, 2.0], frames=3)
    document = json.loads((tmp_path / "scene.json").read_text())
    (tmp_path / "scene.json").unlink()
    bare = [{k: v for k, v in video.items() if k != "camera"} for video in document["videos"]]
    monkeypatch.setattr("otsync.io.scene.read_document", lambda path: ({**document, "videos": bare}, path))
    monkeypatch.setattr("otsync.cli.calibrate.calibrate_folder", lambda *_: pytest.fail("the work began"))
    with pytest.raises((ValueError, OSError), match=field):
        prepared(tmp_path, **given)


def test_clips_of_a_board_are_asked_about_before_the_work(tmp_path, monkeypatch):
    write_recording(tmp_path, [0.0, 2.0], frames=3)
    document = json.loads((tmp_path / "scene.json").read_text())
    (tmp_path / "scene.json").unlink()
    bare = [{k: v for k, v in video.items() if k != "camera"} for video in document["videos"]]
    videos = [*bare, {**bare[0], "name": "board cam0"}]
    monkeypatch.setattr("otsync.io.scene.read_document", lambda path: ({**document, "videos": videos}, path))
    monkeypatch.setattr("otsync.cli.calibrate.calibrate_folder", lambda *_: pytest.fail("the work began"))
    with pytest.raises(ValueError, match=r"board cam0: expected to know .* otsync calibrate .* --board 9x6"):
        prepared(tmp_path)
