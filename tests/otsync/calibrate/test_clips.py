"""Which videos there are, what their names and metadata tell, intrinsics of a file, and whether a camera moves."""

from __future__ import annotations

import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from otsync.calibrate.clips import Lens, kind_of, read_clips, read_intrinsics, uncalibrated
from otsync.calibrate.mapping import colmap_camera
from otsync.calibrate.stills import background, key_frames, pictures_of, stands_still
from otsync.cli.recordings import Init
from otsync.io.document import document
from otsync.simulate.phones import write_video


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("walk", "walk"),
        ("Walk 2", "walk"),
        ("walk_past", "walk"),
        ("board1", "board"),
        ("walker", "scene"),
        ("sidewalk", "scene"),
        ("left", "scene"),
    ],
)
def test_helpers_are_known_by_their_names(name, kind):
    assert kind_of(name) == kind


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Three tiny videos, one of them a walk, with names as people give them."""
    home = tmp_path_factory.mktemp("Urlaub mit Möwe")
    for n, name in enumerate(("Möwe links", "rechts", "walk")):
        rng = np.random.default_rng(n)
        write_video(home / f"{name}.mp4", [rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)] * 3, 30)
    return home


def test_the_clips_of_a_folder(folder):
    clips, _ = read_clips(folder)
    assert [(c.name, c.kind, c.size) for c in clips] == [
        ("Möwe links", "scene", (64, 48)),
        ("rechts", "scene", (64, 48)),
        ("walk", "walk", (64, 48)),
    ]
    assert all(c.lens.source == "guessed" and not c.lens.known for c in clips)


def test_one_video_is_not_enough(tmp_path):
    write_video(tmp_path / "alone.mp4", [np.zeros((48, 64, 3), np.uint8)] * 2, 30)
    write_video(tmp_path / "walk.mp4", [np.zeros((48, 64, 3), np.uint8)] * 2, 30)
    with pytest.raises(ValueError, match=r"two videos and more.*found 1"):
        read_clips(tmp_path)


def test_metadata_tell_focal_length_and_turn(tmp_path):
    image = np.zeros((48, 64, 3), np.uint8)
    with av.open(str(tmp_path / "a.mov"), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata["com.apple.quicktime.camera.focal_length.35mm_equivalent"] = "26"
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    write_video(tmp_path / "b.mp4", [image] * 2, 30)
    a, b = read_clips(tmp_path)[0]
    assert a.lens.source == "file" and a.lens.K[0, 0] == pytest.approx(26 / 43.27 * 80, rel=1e-3)
    assert b.lens.source == "guessed"
    # otsync init writes what the file tells, and calibration takes that for no more than it is
    assert Init(tmp_path).run() == 1
    told = json.loads((tmp_path / "scene.json").read_text())
    assert told["videos"][0]["camera"]["K"] == a.lens.K.tolist() and told["videos"][1]["camera"]["K"] is None
    assert told["missing"][0].startswith("a: camera.w2c") and told["missing"][1].startswith("b: camera.K and")
    assert [clip.lens.source for clip in read_clips(tmp_path)[0]] == ["file", "guessed"]
    told["videos"][0]["camera"]["K"][0][0] += 1.0
    (tmp_path / "scene.json").write_text(json.dumps(told))
    assert read_clips(tmp_path)[0][0].lens.source == "given"


K = [[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([1, 2], "an object of cameras"),
        ({}, "an object of cameras"),
        ({"rechts": {"f": 3}}, "rechts"),
        ({"rechts": {"K": [[1, 0], [0, 1]]}}, "3x3"),
        ({"rechts": {"K": [[-5, 0, 1], [0, 5, 1], [0, 0, 1]]}}, "positive focal"),
        ({"rechts": {"K": K, "distortion": [1, 2, 3]}}, "4, 5 or 8"),
    ],
)
def test_unsound_intrinsics_are_refused_by_name(tmp_path, content, words):
    (tmp_path / "k.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=words):
        read_intrinsics(tmp_path / "k.json")


def test_intrinsics_are_given_by_name_or_for_all(folder, tmp_path):
    (tmp_path / "k.json").write_text(json.dumps({"rechts": {"K": K, "distortion": [0.1, 0, 0, 0]}}))
    (tmp_path / "all.json").write_text(json.dumps({"*": {"K": K}}))
    (tmp_path / "odd.json").write_text(json.dumps({"nobody": {"K": K}}))
    one, every = (read_clips(folder, tmp_path / f"{name}.json")[0] for name in ("k", "all"))
    assert [c.lens.source for c in one] == ["guessed", "given", "guessed"]
    assert [c.lens.source for c in every] == ["given"] * 3
    with pytest.raises(ValueError, match="nobody"):
        read_clips(folder, tmp_path / "odd.json")


def test_a_second_calibration_begins_with_all_videos_again(folder):
    """scene.json after the first lacks the walk and a video without a camera; found lenses do not count as given."""
    camera = {"K": K, "w2c": np.eye(4).tolist(), "width": 64, "height": 48}
    told = {"method": "global", "unit": "arbitrary", "cameras": {"rechts": {"lens": "found"}}}
    entry = {"name": "rechts", "file": "rechts.mp4", "camera": camera, "fps": 25}
    (folder / "scene.json").write_text(json.dumps(document([entry], calibration=told)))
    try:
        again = uncalibrated(folder)
    finally:
        (folder / "scene.json").unlink()
    assert [v["name"] for v in again["videos"]] == ["Möwe links", "rechts", "walk"]
    assert again["videos"][1]["fps"] == 25 and again["videos"][1]["camera"]["K"] is None
    assert all(v["camera"]["w2c"] is None for v in again["videos"])


@pytest.mark.parametrize("coefficients", [None, [0.1, -0.02, 0.001, 0.002], [0.1, -0.02, 0.001, 0.002, 0.03, 0, 0, 0]])
def test_lenses_are_handed_over_as_they_are(coefficients):
    """COLMAP's projection of a point is OpenCV's."""
    pycolmap = pytest.importorskip("pycolmap")
    lens = Lens(np.array([[500.0, 0, 330], [0, 510, 170], [0, 0, 1]]), coefficients and np.array(coefficients), "given")
    model, params = colmap_camera(lens)
    camera = pycolmap.Camera(model=model, width=640, height=360, params=[float(x) for x in params.split(",")])
    x = np.array([[0.3, -0.2, 1.5]])
    want = cv2.projectPoints(x, np.zeros(3), np.zeros(3), lens.K, lens.distortion)[0].ravel()
    np.testing.assert_allclose(np.ravel(camera.img_from_cam(x)), want, atol=1e-6)


def filmed(moves: bool, count: int = 9) -> list[np.ndarray]:
    """A textured wall with a disc that crosses it, by a camera that stands still or slides."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 255, (200, 400, 3)).astype(np.uint8), (0, 0), 1.5)
    out = []
    for k in range(count):
        image = wall[10:190, 20 + 4 * k * moves :][:, :320].copy()
        cv2.circle(image, (30 + 30 * k, 90), 22, (250, 20, 20), -1)
        out.append(np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
    return out


def test_tripods_are_told_from_hands():
    assert stands_still(pictures_of(filmed(False), (320, 180), 1000))
    assert not stands_still(pictures_of(filmed(True), (320, 180), 1000))


def test_the_background_of_a_static_camera_has_nothing_that_moves():
    frames = pictures_of(filmed(False, 15), (320, 180), 1000)
    clean = pictures_of([f for f in filmed(False, 15)], (320, 180), 1000)[14]
    left = background(frames).image[60:120, :200].astype(float)
    assert np.abs(left - clean[60:120, :200]).mean() < 6  # the disc has left this part by the last frame


def test_key_frames_are_spread_over_the_clip_and_pictures_shrunk():
    frames = pictures_of(filmed(True), (320, 180), 160)
    found = key_frames(frames, 4, 1)
    assert [p.frame for p in found] == [0, 3, 5, 8]
    assert found[0].image.shape == (90, 160, 3) and found[0].use.shape == (90, 160)
