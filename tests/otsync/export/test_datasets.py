"""Datasets that are exported are read back by other readers: cameras, times and pictures are the recording's."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from otsync.cli import main
from otsync.io import describe_folder, open_scene
from otsync.io.document import write_document
from otsync.types import Offsets
from tests.recording_world import ring

SIZE, FRAMES = (64, 48), 6
OFFSETS = np.array([0.0, 0.213, -0.05])
LENS = [0.05, -0.02, 0.001, 0.002, 0.003]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Three cameras, one with distortion, one that moves; the grey level tells the frame."""
    home = tmp_path_factory.mktemp("recording")
    videos = []
    for v, camera in enumerate(ring(3, width=SIZE[0], height=SIZE[1])):
        (home / f"cam{v}").mkdir()
        for k in range(FRAMES):
            Image.fromarray(np.full((SIZE[1], SIZE[0], 3), 40 * k + 10, np.uint8)).save(home / f"cam{v}/{k}.png")
        poses = np.repeat(camera.w2c[None], FRAMES, 0)
        poses[:, 0, 3] += 0.01 * np.arange(FRAMES)
        told = {"K": camera.K.tolist(), "w2c": (poses if v == 2 else camera.w2c).tolist(), "width": 64, "height": 48}
        if v == 1:
            told["distortion"] = LENS
        videos.append({"name": f"cam{v}", "frames": f"cam{v}/*.png", "fps": 10, "camera": told})
    write_document(home / "scene.json", videos)
    Offsets.known([f"cam{v}" for v in range(3)], OFFSETS, 10).save(home / "offsets.json")
    return home


@pytest.fixture(scope="module")
def out(folder, tmp_path_factory) -> Path:
    home = tmp_path_factory.mktemp("out")
    args = ["export", str(folder), "--offsets", str(folder / "offsets.json"), "--out", str(home)]
    assert main([*args, "--what", "nerfstudio", "dynamic3dgs", "colmap"]) == 0
    return home


def grey(image: np.ndarray) -> int:
    return round((float(image.mean()) - 10) / 40)


def test_nerfstudio_keeps_every_frames_own_world_second(folder, out):
    scene, source = open_scene(out / "nerfstudio"), open_scene(folder)
    for video, own, late in zip(scene.videos, source.videos, OFFSETS, strict=True):
        np.testing.assert_allclose(video.times, own.times + late - OFFSETS.min(), atol=1e-9)
        np.testing.assert_allclose(video.camera.K, own.camera.K, atol=1e-9)
        np.testing.assert_allclose(video.camera.w2c, own.camera.w2c, atol=1e-9)
        assert [grey(frame) for frame in video.frames] == list(range(FRAMES))
    np.testing.assert_allclose(scene.videos[1].camera.distortion[:5], LENS)
    # what their own parser reads: shares of the whole, OpenGL axes
    told = json.loads((out / "nerfstudio/transforms.json").read_text())
    assert min(f["time"] for f in told["frames"]) == 0 and max(f["time"] for f in told["frames"]) == 1
    c2w = np.array(told["frames"][0]["transform_matrix"])
    np.testing.assert_allclose(c2w[:3, 3], source.videos[0].camera.center, atol=1e-9)
    assert c2w[:3, 2] @ -source.videos[0].camera.center < 0  # z points away from what it looks at


def test_dynamic3dgaussians_gets_frames_of_one_moment(folder, out):
    scene = open_scene(out / "dynamic3dgs", reader="panoptic")
    source = open_scene(folder)
    fn = json.loads((out / "dynamic3dgs/train_meta.json").read_text())["fn"]
    # all three overlap from .213 to .45 s; on the beat of the first: .3 and .4 s
    assert len(fn) == 2 and {len(v.frames) for v in scene.videos} == {2}
    assert [grey(frame) for frame in scene.videos[0].frames] == [3, 4]
    assert [grey(frame) for frame in scene.videos[1].frames] == [1, 2]
    np.testing.assert_allclose(scene.videos[1].camera.w2c, source.videos[1].camera.w2c)


def test_colmaps_own_reader_takes_the_model(folder, out):
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(out / "colmap/sparse/0"))
    assert len(model.images) == 3 * FRAMES
    source = {v.name: v.camera for v in open_scene(folder).videos}
    for image in model.images.values():
        name, k = image.name.split("/")[0], int(Path(image.name).stem)
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        w2c = source[name].w2c if source[name].w2c.ndim == 2 else source[name].w2c[k]
        np.testing.assert_allclose(pose.matrix(), w2c[:3], atol=1e-9)
        camera = model.cameras[image.camera_id]
        np.testing.assert_allclose(camera.calibration_matrix(), source[name].K, atol=1e-9)
    # and ours, which shares nothing with the writer
    for video in describe_folder(out / "colmap", fps=10.0)["videos"]:
        np.testing.assert_allclose(video["camera"]["w2c"], source[video["name"]].w2c, atol=1e-9)


def test_datasets_are_written_where_they_are_asked_for(folder, tmp_path):
    args = ["export", str(folder), "--offsets", str(folder / "offsets.json"), "--out", str(tmp_path)]
    assert main([*args, "--what", "frames"]) == 0
    assert not (tmp_path / "nerfstudio").exists()
