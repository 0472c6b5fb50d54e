"""Cameras by what moves: depth cameras that nobody calibrated, through ``otsync calibrate``."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from otsync.cli import main
from otsync.io import open_scene
from otsync.types import Offsets
from tests.otsync.recordings.test_own_frames import BALLS, FRAMES, SHIFTS, UNIT, without_poses
from tests.recording_world import FPS, exact_depth, paths, ring, write_recording


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """Two depth cameras after ``otsync calibrate``: the folder, and the true cameras."""
    folder = tmp_path_factory.mktemp("depth") / "rec"
    cameras = without_poses(folder)
    document = json.loads((folder / "scene.json").read_text())
    document["videos"] = document["videos"][:2]
    (folder / "scene.json").write_text(json.dumps(document))
    assert main(["calibrate", str(folder)]) == 0
    return folder, cameras


def apart(folder, cameras):
    """Degrees and units by which the second camera is off, as the first one sees it."""
    first, second = (v.camera.w2c for v in open_scene(folder).videos)
    found = second @ np.linalg.inv(first)
    true = cameras[1].w2c @ np.linalg.inv(cameras[0].w2c)
    turn = np.degrees(np.arccos(np.clip((np.trace(found[:3, :3].T @ true[:3, :3]) - 1) / 2, -1, 1)))
    centre, there = (-m[:3, :3].T @ m[:3, 3] for m in (found, true))
    return turn, np.linalg.norm(centre - there)


def test_depth_cameras_are_calibrated_by_what_moves(calibrated):
    folder, cameras = calibrated
    turn, place = apart(folder, cameras)
    assert turn < 3 and place < 0.2
    document = json.loads((folder / "scene.json").read_text())
    told = document["calibration"]
    assert told["method"] == "motion" and set(told["cameras"]) == {"cam0", "cam1"}
    assert 0 < told["cameras"]["cam1"]["sigma_degrees"] < 3
    assert document["videos"][1]["depth"]["scale"] == pytest.approx(1 / UNIT, rel=0.05)
    assert "missing" not in document
    assert "units of the first video" in (folder / "calibration" / "calibration.html").read_text()
    down = open_scene(folder).videos[0].camera.w2c[1, :3]
    assert down[2] < 0  # z is up


def test_what_is_calibrated_so_can_be_synchronised(calibrated, tmp_path):
    folder, _ = calibrated
    assert main(["sync", str(folder), "--out", str(tmp_path / "out")]) in (0, 1)  # poses of 2° leave it weak at times
    found = Offsets.load(tmp_path / "out" / "offsets.json").frames[1]
    assert abs(found - (SHIFTS[1] - SHIFTS[0])) < 0.3


def test_done_again_it_says_the_same(calibrated):
    folder, cameras = calibrated
    before = json.loads((folder / "scene.json").read_text())
    assert main(["calibrate", str(folder), "--way", "motion"]) == 0
    after = json.loads((folder / "scene.json").read_text())
    assert after["videos"][1]["depth"]["scale"] == pytest.approx(before["videos"][1]["depth"]["scale"], rel=1e-3)
    turn, place = apart(folder, cameras)
    assert turn < 3 and place < 0.2


def test_what_the_way_by_motion_has_no_use_for_is_refused(calibrated, tmp_path, capsys):
    folder, _ = calibrated
    out = ["--out", str(tmp_path / "out")]
    assert main(["calibrate", str(folder), "--way", "motion", "--width", "300", *out]) == 2
    assert "--width" in capsys.readouterr().err
    document = json.loads((folder / "scene.json").read_text())
    poses_from_elsewhere = {k: v for k, v in document.items() if k != "calibration"}
    (folder / "scene.json").write_text(json.dumps(poses_from_elsewhere))
    assert main(["calibrate", str(folder), *out]) == 2
    assert "--force" in capsys.readouterr().err
    flat = {**document, "videos": [{k: v for k, v in x.items() if k != "depth"} for x in document["videos"]]}
    (folder / "scene.json").write_text(json.dumps(flat))
    assert main(["calibrate", str(folder), "--way", "motion", *out]) == 2
    assert "depth" in capsys.readouterr().err


def test_a_video_of_another_scene_is_doubted_or_left_out_and_nothing_is_lost(tmp_path, capsys):
    folder = tmp_path / "rec"
    without_poses(folder)
    document = json.loads((folder / "scene.json").read_text())
    write_recording(tmp_path / "other", SHIFTS[:1], frames=FRAMES, balls=BALLS, seed=7)
    shutil.copytree(tmp_path / "other" / "cam0", folder / "other")
    centres = paths((np.arange(FRAMES) + SHIFTS[0]) / FPS, BALLS, 7)
    camera = ring(1)[0]
    depth = np.stack([exact_depth(camera, centres[:, k], 0.16) for k in range(FRAMES)])
    np.save(folder / "other.npy", depth.astype(np.float32))
    stranger = dict(document["videos"][0], name="other", depth={"file": "other.npy"}, frames="other/*.jpg")
    document["videos"] = [*document["videos"][:2], stranger]
    (folder / "scene.json").write_text(json.dumps(document))
    assert main(["calibrate", str(folder)]) == 1
    assert "other: " in capsys.readouterr().err
    after = json.loads((folder / "scene.json").read_text())
    assert {"cam0", "cam1"} <= {v["name"] for v in after["videos"]}
    assert "doubtful" in after["calibration"]["cameras"]["other"]
    if len(after["videos"]) < 3:
        assert json.loads((folder / "scene.before.json").read_text()) == document
