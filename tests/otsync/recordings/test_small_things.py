"""Swarms of small things that all look alike, and points that other programs found."""

from __future__ import annotations

import json

import numpy as np
import pytest

from otsync.io import open_scene
from otsync.io.keypoints import Detections
from otsync.recordings.given import names_of, tracks_of
from otsync.recordings.routes import synchronize_scene
from tests.recording_world import ring
from tests.swarm_world import paths, swarm


def errors(scene, shifts, fps):
    """(V,) frames of the reference, their sigma, and which videos are trusted."""
    found = synchronize_scene(scene, route="epipolar").offsets
    return np.abs(found.seconds - shifts) * fps, found.sigma * fps, np.array([s.ok for s in found.status])


def test_a_swarm_of_ten_pixels_a_thing_is_synchronised():
    shifts = np.array([0.0, 0.31])
    error, _, sure = errors(swarm(shifts, count=24, frames=75, width=320, seed=3), shifts, 30)
    assert sure.all() and error.max() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "world",
    [
        {},
        {"width": 320},
        {"fps": [60.0, 50.0, 30.0], "frames": 180, "width": 320},
        {"fps": 240.0, "frames": 480, "width": 320},
        {"fps": 6.0, "frames": 40, "pace": 0.5, "width": 320},
        {"count": 5, "width": 320},
    ],
    ids=["640", "320", "60, 50, 30 fps", "240 fps", "6 fps", "five things"],
)
def test_a_swarm_is_right_or_flagged(world, seed):
    shifts = np.array([0.0, *np.random.default_rng(900 + seed).uniform(-0.7, 0.7, 2)])
    rate = world.get("fps", 30.0)
    fps = rate if isinstance(rate, float) else rate[0]
    error, sigma, sure = errors(swarm(shifts, seed=seed, **world), shifts, fps)
    # a frame of 240 a second is 4 ms; six frames a second leave little to tell the time by, and sigma says so
    assert (error[sure] < (0.2 if rate == 30 else 0.5)).all()
    assert (error[sure] <= 3 * sigma[sure] + 0.05).all()


def test_points_without_features_are_synchronised_by_geometry(tmp_path):
    """Tables of five points each, which nobody followed or named, in the place of pictures that show nothing."""
    shifts, frames, rng = [0.0, 0.4, -0.25], 120, np.random.default_rng(5)
    ways, videos = rng.bit_generator.state, []
    for v, (camera, shift) in enumerate(zip(ring(3), shifts, strict=True)):
        rng.bit_generator.state = ways
        uv = camera.project(paths(shift + np.arange(frames) / 30, 5, rng))
        rows = [f"{k},{x:.2f},{y:.2f}" for k in range(frames) for x, y in uv[np.argsort(uv[:, k, 0]), k]]
        (tmp_path / f"cam{v}.csv").write_text("\n".join(["frame,x,y", *rows]))
        told = {"K": camera.K.tolist(), "w2c": camera.w2c.tolist(), "width": camera.width, "height": camera.height}
        videos.append({"name": f"cam{v}", "frames": "nothing/*.png", "fps": 30, "camera": told})
        videos[-1]["points"] = {"files": f"cam{v}.csv"}
    (tmp_path / "nothing").mkdir()
    for k in range(frames):
        (tmp_path / "nothing" / f"{k:03d}.png").touch()
    scene = {"format": "otsync.scene", "version": 1, "videos": videos}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    found = synchronize_scene(open_scene(tmp_path)).offsets
    assert all(s.ok for s in found.status)
    assert np.abs(found.frames - np.array(shifts) * 30).max() < 0.1
    videos[1].pop("points")
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    with pytest.raises(ValueError, match=r"points: expected them of every video.*cam1 have none"):
        synchronize_scene(open_scene(tmp_path))
    videos[1]["points"] = {"files": "cam0.csv", "least": 1.5}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    with pytest.raises(ValueError, match=r"expected points with a score of 1.5 and more"):
        open_scene(tmp_path)
    videos[1]["points"] = {"files": "cam0.csv", "kind": "sleep"}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    with pytest.raises(ValueError, match=r"points.kind: expected one of deeplabcut, sleap"):
        open_scene(tmp_path)
    videos[1]["points"], videos[1]["range"] = {"files": "cam0.csv"}, [0, 100]
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    cut = open_scene(tmp_path).points[1]
    assert cut is not None and cut.last == 99
    (tmp_path / "cam0.csv").write_text("frame,x,y\n120,1,2\n")
    with pytest.raises(ValueError, match="expected points of the 120 frames of the video; found one of frame 120"):
        open_scene(tmp_path)


def test_names_mean_the_same_in_every_video_and_the_surer_of_two_points_counts():
    one = Detections.of([(0, 1.0, 1.0, "tail", 0, 0.9), (0, 5.0, 5.0, "tail", 0, 0.5), (1, 2.0, 1.0, "tail", 0, 0.9)])
    two = Detections.of([(0, 3.0, 3.0, "nose", 2, 1.0), (0, 4.0, 4.0, "tail", 2, 1.0)])
    names = names_of([one, None, two])
    assert names == ("nose", "tail")
    first, second = (tracks_of(found, 3, 30.0, 1.0, names) for found in (one, two))
    assert first["features"].tolist() == [[0, 1]] and second["features"].tolist() == [[1, 0], [0, 1]]
    assert first["uv"][0, :2].tolist() == [[1, 1], [2, 1]] and np.isnan(first["uv"][0, 2]).all()
