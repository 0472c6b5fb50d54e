"""Calibrations of Pose2Sim, Caliscope and Qualisys, beside their videos."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import av
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from otsync.io import describe_folder, find_reader, open_scene
from otsync.io.pose2sim import rotation
from tests.recording_world import ring


def write_video(path: Path, width: int, height: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for k in range(3):
            image = np.full((height, width, 3), 40 * k, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        container.mux(stream.encode())


def toml(names, cameras, vector=True, **more) -> str:
    text = "[metadata]\nadjusted = false\n"
    for name, c in zip(names, cameras, strict=True):
        turn = Rotation.from_matrix(c.w2c[:3, :3]).as_rotvec() if vector else c.w2c[:3, :3]
        fields = {
            "name": f'"{name}"',
            "size": [float(c.width), float(c.height)],
            "matrix": c.K.tolist(),
            "distortions": [0.1, -0.2, 0.0, 0.0],
            "rotation": turn.tolist(),
            "translation": c.w2c[:3, 3].tolist(),
        } | more
        text += f"[{name}]\n" + "".join(f"{k} = {v}\n" for k, v in fields.items())
    return text


def qualisys(names, cameras) -> str:
    out = '<?xml version="1.0"?><calibration><cameras>'
    for name, c in zip(names, cameras, strict=True):
        M = np.diag([1.0, -1.0, -1.0]) @ c.w2c[:3, :3]
        r = " ".join(f'r{i + 1}{j + 1}="{M[i, j]!r}"' for i in range(3) for j in range(3)).replace("np.float64(", "")
        x, y, z = 1000 * c.center
        f, u, v = 64 * c.K[0, 0], 64 * (c.K[0, 2] + 10), 64 * (c.K[1, 2] + 20)
        out += (
            f'<camera serial="{name}"><fov_video left="10" top="20" right="{c.width + 9}" bottom="{c.height + 19}"/>'
            f'<transform {r.replace(")", "")} x="{x}" y="{y}" z="{z}"/><intrinsic focalLengthU="{f}" '
            f'focalLengthV="{f}" centerPointU="{u}" centerPointV="{v}" radialDistortion1="0.1" '
            'radialDistortion2="-0.2" radialDistortion3="0" tangentalDistortion1="0" tangentalDistortion2="0"/>'
            "</camera>"
        )
    return out + "</cameras></calibration>"


@pytest.mark.parametrize("kind", ["vector", "matrix", "qualisys"])
def test_cameras_of_videos_by_their_names(tmp_path, kind):
    cameras = ring(2)
    for n in (1, 2):
        write_video(tmp_path / "videos" / f"cam{n:02d}.mp4", 320, 180)
    home = tmp_path / "calibration"
    home.mkdir()
    if kind == "qualisys":
        (home / "Calib.qca.txt").write_text(qualisys(["cam_1", "cam_2"], cameras))
    else:
        (home / "Calib.toml").write_text(toml(["cam_1", "cam_2"], cameras, kind == "vector"))
        (tmp_path / "Config.toml").write_text("[project]\nframe_rate = 'auto'\n")
    assert find_reader(tmp_path)[0] == "pose2sim"
    scene = open_scene(tmp_path)
    assert scene.names == ("cam01", "cam02")
    for video, camera in zip(scene.videos, cameras, strict=True):
        np.testing.assert_allclose(video.camera.w2c, camera.w2c, atol=1e-9)
        np.testing.assert_allclose(video.camera.K, camera.K, atol=1e-9)
        np.testing.assert_allclose(video.camera.distortion[:2], [0.1, -0.2])


def test_other_sizes_and_videos_without_a_camera_are_told(tmp_path):
    cameras = ring(3)
    for name, size in (("cam1", (160, 90)), ("cam2", (316, 180)), ("cam3", (180, 320)), ("cam9", (320, 180))):
        write_video(tmp_path / f"{name}.mp4", *size)
    (tmp_path / "c.toml").write_text(toml(["cam1", "cam2", "cam3"], cameras))
    told = describe_folder(tmp_path)
    one, two, three, nine = (video["camera"] for video in told["videos"])
    assert one["K"][0][0] == pytest.approx(cameras[0].K[0, 0] / 2)
    assert two["K"][0][0] == pytest.approx(cameras[1].K[0, 0]) and two["width"] == 316
    assert three["K"] is None and nine["K"] is None
    assert "another shape" in " ".join(told["notes"]) and "K scaled" in " ".join(told["notes"])
    assert [m.partition(":")[0] for m in told["missing"]] == ["cam3", "cam9"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"fisheye": "true"}, "expected a pinhole camera"),
        ({"matrix": "[[1, 2], [3, 4]]"}, r"\[cam1\] matrix: expected finite numbers of shape \(3, 3\)"),
        ({"size": "[320]"}, "size: expected finite numbers"),
        ({"translation": "[0, 0, nan]"}, "translation: expected finite numbers"),
    ],
)
def test_a_calibration_that_does_not_fit_is_named(tmp_path, more, words):
    write_video(tmp_path / "cam1.mp4", 320, 180)
    (tmp_path / "c.toml").write_text(toml(["cam1"], ring(1), **more))
    with pytest.raises(ValueError, match=words):
        describe_folder(tmp_path)


def test_a_damaged_qualisys_file_is_named(tmp_path):
    write_video(tmp_path / "cam1.mp4", 320, 180)
    for text, words in (
        ("<calibration>", "expected XML"),
        ("<!DOCTYPE x><calibration/>", "found a document type"),
        ("<calibration/>", "expected cameras; found none"),
        ("<c><camera/></c>", "expected transform, intrinsic, fov_video"),
    ):
        (tmp_path / "c.qca.txt").write_text(text)
        with pytest.raises(ValueError, match=words):
            describe_folder(tmp_path)


def test_rotations_about_a_vector():
    for turn in np.random.default_rng(0).normal(size=(5, 3)):
        np.testing.assert_allclose(rotation(turn), Rotation.from_rotvec(turn).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(rotation(np.zeros(3)), np.eye(3))


@pytest.mark.skipif(importlib.util.find_spec("Pose2Sim") is None, reason="pose2sim==0.10.49 is not installed")
@pytest.mark.parametrize("demo", ["Demo_SinglePerson", "Demo_MultiPerson"])
def test_the_demos_of_pose2sim_read_as_they_are(demo):
    spec = importlib.util.find_spec("Pose2Sim")
    assert spec is not None and spec.origin is not None
    scene = open_scene(Path(spec.origin).parent / demo)
    assert len(scene.videos) == 4 and all(len(v.frames) == 100 for v in scene.videos)
    assert all(v.camera.height == 1920 and v.camera.width in (1080, 1088) for v in scene.videos)
