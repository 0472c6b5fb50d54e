"""Recordings with depth and without poses: what is found, what is written, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from otsync.cli import main
from otsync.io import open_scene
from otsync.recordings.own_frames import found_document, open_without_poses
from otsync.types import Offsets, Similarity
from tests.recording_world import FPS, exact_depth, paths, ring, write_recording

FRAMES, BALLS, SHIFTS = 150, 12, [111.0, 115.0, 112.0, 113.0]
UNIT = 2.0
"""The second video measures lengths in units of half a metre."""


def without_poses(folder):
    """A recording of depth cameras that nobody calibrated; their true cameras."""
    write_recording(folder, SHIFTS, frames=FRAMES, balls=BALLS)
    cameras = ring(len(SHIFTS))
    document = json.loads((folder / "scene.json").read_text())
    for v, (video, camera) in enumerate(zip(document["videos"][:2], cameras[:2], strict=True)):
        centres = paths((np.arange(FRAMES) + SHIFTS[v]) / FPS, BALLS, 1)
        depth = np.stack([exact_depth(camera, centres[:, k], 0.16) for k in range(FRAMES)])
        np.save(folder / f"depth{v}.npy", (depth * (UNIT if v else 1.0)).astype(np.float32))
        video["depth"] = {"file": f"depth{v}.npy"}
        video["camera"]["w2c"] = None
    document["missing"] = ["cam0: camera.w2c"]
    (folder / "scene.json").write_text(json.dumps(document))
    return cameras


def test_clock_and_cameras_of_a_recording_without_poses(tmp_path, capsys):
    folder, out = tmp_path / "rec", tmp_path / "out"
    cameras = without_poses(folder)
    options = ["--recording.cameras", "cam0", "cam1", "--json"]
    code = main(["sync", str(folder), "--frames", "own", "--out", str(out), *options])
    printed = json.loads(capsys.readouterr().out)
    assert code == 0, printed["videos"]
    assert printed["route"] == "own frames"
    assert not any("labels" in line for line in json.loads((out / "sync.json").read_text())["why"])  # there are none
    assert "Frames of reference" in (out / "report.html").read_text()
    offsets = Offsets.load(out / "offsets.json")
    assert abs(offsets.frames[1] - (SHIFTS[1] - SHIFTS[0])) < 0.3
    (folder / "scene.json").write_text((out / "scene.json").read_text())
    scene = open_scene(folder)
    first, second = (v.camera.w2c for v in scene.videos)
    np.testing.assert_allclose(first, np.eye(4), atol=1e-9)
    true = cameras[1].w2c @ np.linalg.inv(cameras[0].w2c)
    turn = np.degrees(np.arccos(np.clip((np.trace(second[:3, :3].T @ true[:3, :3]) - 1) / 2, -1, 1)))
    centre, there = (-m[:3, :3].T @ m[:3, 3] for m in (second, true))
    assert turn < 3 and np.linalg.norm(centre - there) < 0.2
    scale = json.loads((out / "scene.json").read_text())["videos"][1]["depth"]["scale"]
    assert scale == pytest.approx(1 / UNIT, rel=0.05)


def test_what_a_recording_lacks_is_told(tmp_path, capsys):
    folder = tmp_path / "rec"
    write_recording(folder, [0.0, 1.0], frames=3)
    document = json.loads((folder / "scene.json").read_text())
    for video in document["videos"]:
        video["camera"]["w2c"] = None
    (folder / "scene.json").write_text(json.dumps(document))
    assert main(["sync", str(folder), "--out", str(tmp_path / "o")]) == 2
    assert "--frames own" in capsys.readouterr().err
    assert main(["sync", str(folder), "--frames", "own", "--out", str(tmp_path / "o")]) == 2
    assert "depth" in capsys.readouterr().err
    document["videos"][0]["camera"]["K"] = None
    (folder / "scene.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match="K missing"):
        open_without_poses(folder)
    for option in (["--recording.route", "stereo"], ["aligner:dtw"], ["--rematch", "0"]):
        assert main(["sync", str(folder), "--frames", "own", "--out", str(tmp_path / "o"), *option]) == 2


def test_a_video_that_was_not_found_keeps_no_pose():
    camera = {"K": [[9, 0, 5], [0, 9, 5], [0, 0, 1]], "w2c": None, "width": 10, "height": 10}
    document = {"videos": [{"name": name, "camera": dict(camera)} for name in "abc"], "missing": ["all"]}
    found = Similarity(0.5, np.eye(3), np.array([1.0, 2, 3]))
    offsets = Offsets.known("abc", np.zeros(3), 30, transforms=[Similarity(1.0, np.eye(3), np.zeros(3)), found, None])
    made = found_document(document, offsets)
    assert made["missing"] == ["c: camera.w2c could not be found (world to camera, OpenCV axes)"]
    assert made["videos"][2]["camera"]["w2c"] is None
    w2c = np.array(made["videos"][1]["camera"]["w2c"])
    np.testing.assert_allclose(-w2c[:3, :3].T @ w2c[:3, 3], [1, 2, 3])  # where its own origin lies
    assert document["videos"][1]["camera"]["w2c"] is None  # the document is not changed


def test_the_scene_tells_how_sure_its_cameras_are(tmp_path):
    folder = tmp_path / "rec"
    write_recording(folder, [0.0, 1.0], frames=3)
    document = json.loads((folder / "scene.json").read_text())
    names = [video["name"] for video in document["videos"]]
    loose = Similarity(1.0, np.eye(3), np.zeros(3)).with_covariance(np.diag([0.01**2] * 3 + [0] * 4))
    offsets = Offsets.known(names, np.zeros(2), 30, transforms=[Similarity(1.0, np.eye(3), np.zeros(3)), loose])
    (folder / "scene.json").write_text(json.dumps(found_document(document, offsets)))
    told = open_scene(folder).pose_sigma
    assert told == {names[1]: pytest.approx(loose.rotation_sigma, abs=1e-6)} and 0.5 < told[names[1]] < 1.1
