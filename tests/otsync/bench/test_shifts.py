"""``otsync bench shifts`` on a small filmed rig: shifts come back, by tracks, by keypoints, by Pose2Sim's own code."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from otsync.bench.rig import shifts, their_sync
from otsync.cli import main
from otsync.io.scene import read_document
from tests.recording_world import FPS, paths, ring, write_recording

FRAMES, CAMERAS, POINTS = 96, 3, 33


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """Balls before a wall, all cameras at the same moments; and a "person" of 33 points as Pose2Sim keeps keypoints."""
    home = tmp_path_factory.mktemp("rig")
    write_recording(home, [0.0] * CAMERAS, frames=FRAMES, balls=5)
    points = paths(np.arange(FRAMES) / FPS, POINTS, 3) + np.array([0, 0.4, 0])
    for v, camera in enumerate(ring(CAMERAS)):
        folder = home / "pose" / f"cam{v}_json"
        folder.mkdir(parents=True)
        for k, uv in enumerate(camera.project(points).transpose(1, 0, 2)):
            person = {"pose_keypoints_2d": np.append(uv, np.full((POINTS, 1), 0.9), axis=1).ravel().tolist()}
            (folder / f"cam{v}_{k:06d}.json").write_text(json.dumps({"version": 1.3, "people": [person]}))
    return home


def test_keypoints_tell_the_shifts(recording):
    document, root = read_document(recording)
    files = their_sync.keypoint_files(recording, [f"cam{v}" for v in range(CAMERAS)])
    rows = shifts._keypoints(document, root, files, {shifts.AS_FILMED: np.zeros(3, int), 1: np.array([3, 17, 0])}, map)
    assert [r["shift"] for r in rows] == [0, 0, 14, -3]
    assert max(abs(r["error"]) for r in rows) < 0.25


@pytest.mark.slow
def test_shifts_come_back(recording, tmp_path, capsys):
    args = ["bench", "shifts", str(recording), "--out", str(tmp_path), "--seeds", "1", "--first-seed", "5300"]
    assert main(args) == 0
    with open(tmp_path / "shifts_draws.csv") as stream:
        rows = list(csv.DictReader(stream))
    starts = np.random.default_rng(5300).integers(0, shifts.MOST + 1, CAMERAS)
    for way, most in (("otsync", 0.25), ("otsync, their keypoints", 0.25)):
        own = [r for r in rows if r["way"] == way]
        assert [int(r["shift"]) for r in own] == [0, 0, *(starts[1:] - starts[0])]
        assert max(abs(float(r["error"])) for r in own) < most
    ways = {r["way"] for r in rows}
    if their_sync.lacking():
        assert "Pose2Sim" not in ways and "Pose2Sim's own synchronisation is left out" in capsys.readouterr().out
    else:
        assert "Pose2Sim" in ways


def test_keypoints_of_all_videos_or_none(recording):
    names = [f"cam{v}" for v in range(CAMERAS)]
    assert [len(own) for own in their_sync.keypoint_files(recording, names)] == [FRAMES] * CAMERAS
    assert their_sync.keypoint_files(recording, [*names, "cam9"]) == []


@pytest.mark.skipif(bool(their_sync.lacking()), reason=their_sync.lacking() or "installed")
def test_pose2sims_own_code_runs_on_shifted_keypoints(tmp_path):
    """A hop that every camera sees at the same moment: theirs finds whole frames of it, with our sign."""
    t = np.arange(120)
    height = 300 + 80 * np.sin(t / 9) + 60 * np.sin(t / 5.3 + 1)
    files = []
    for v in range(3):
        folder = tmp_path / "pose" / f"cam{v}_json"
        folder.mkdir(parents=True)
        for k in t:
            points = [[100 + 5 * n, (1 + 0.1 * v) * height[k] + 7 * n, 0.9] for n in range(POINTS)]
            (folder / f"cam{v}_{k:06d}.json").write_text(
                json.dumps({"people": [{"pose_keypoints_2d": np.ravel(points).tolist()}]})
            )
        files.append(sorted(folder.glob("*.json")))
    names = ["cam0", "cam1", "cam2"]
    (none, found) = their_sync.their_frames(files, names, 60.0, [[0, 0, 0], [4, 11, 0]], tmp_path / "out")
    np.testing.assert_allclose(none, 0, atol=1)
    np.testing.assert_allclose(found, [0, 7, -4], atol=1)


def test_another_number_of_keypoints_is_refused(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": [1.0] * 9}]}))
    with pytest.raises(ValueError, match=r"expected people of 17, .* keypoints; found 3"):
        their_sync.their_frames([[tmp_path / "a.json"]] * 2, ["a", "b"], 30.0, [[0, 0]], tmp_path / "out")


def test_trusted_answers_that_are_wrong_are_counted():
    def row(draw, error, flags, way="otsync"):
        return {
            "way": way, "draw": draw, "camera": "b", "shift": 0, "error": error, "sigma": 0.1, "flags": flags,
            "seconds": 1.0,
        }  # fmt: skip

    rows = [row("as filmed", 0.5, ""), row(1, 0.6, ""), row(2, -3.0, ""), row(3, 9.0, "weak"), row(4, None, "refused")]
    told = shifts._summary("otsync", rows)
    assert told["answers"] == 4 and told["none"] == 1 and told["trusted"] == 2 and told["trusted, wrong"] == 1
    assert told["largest"] == 9.0 and told["within 1"] == 0.25
    assert told["from as filmed"] == pytest.approx(np.mean([0.1, 3.5, 8.5]), abs=1e-3)
    theirs = [row(1, 5.0, "", "Pose2Sim"), row("as filmed", 0.0, "", "Pose2Sim")]
    assert shifts._summary("Pose2Sim", theirs)["trusted, wrong"] == 1


def test_short_recordings_are_refused(tmp_path):
    write_recording(tmp_path, [0.0, 0.0], frames=20, balls=1)
    assert main(["bench", "shifts", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
