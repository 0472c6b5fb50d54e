"""Readers of datasets: what a sample was made from comes back; what is malformed is refused with the remedy."""

from __future__ import annotations

import json
import re
import shutil
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.io import loadmat, savemat

from otsync.cli import main
from otsync.io import describe_folder, find_reader, open_scene, scene_from_document
from otsync.io.datasets import DATASETS
from otsync.io.page import with_table
from otsync.types import Camera
from tests.docs.pages import ROOT
from tests.otsync.io.datasets import samples
from tests.otsync.io.datasets.samples import SAMPLES, H, T, W

Break = Callable[[Path], Any]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> dict[str, tuple[Path, dict[str, Camera]]]:
    """A sample of every layout, and the cameras it was made from."""
    out = {}
    for name, make in (*SAMPLES.items(), ("colmap text", samples.colmap_text)):
        folder = tmp_path_factory.mktemp(name.replace(" ", "-"))
        out[name] = folder, make(folder)
    return out


def test_every_reader_has_a_sample_and_five_malformed_variants():
    assert set(SAMPLES) == {reader.name for reader in DATASETS}
    count = Counter(name for name, *_ in MALFORMED)
    assert {name: n for name, n in count.items() if n < 5} == {}
    assert set(count) == set(SAMPLES)


@pytest.mark.parametrize("name", [*SAMPLES, "colmap text"])
def test_what_a_sample_was_made_from_comes_back(name, made, tmp_path):
    source, cameras = made[name]
    folder = tmp_path / "recording"
    shutil.copytree(source, folder)
    reader = name.partition(" ")[0]
    assert find_reader(folder)[0] == reader
    filmed = any(folder.rglob("*.mp4"))  # video files have a clock of their own
    document = describe_folder(folder, reader=reader, fps=None if filmed else 25.0)
    (folder / "scene.json").write_text(json.dumps(document))
    if name == "mosca":
        assert document["missing"] and all("camera.K" in item for item in document["missing"])
        return
    scene = open_scene(folder)
    assert scene.names == tuple(cameras)
    for video, camera in zip(scene.videos, cameras.values(), strict=True):
        np.testing.assert_allclose(video.camera.K, camera.K, atol=1e-9)
        np.testing.assert_allclose(video.camera.w2c, camera.w2c, atol=1e-9)
        assert (video.camera.width, video.camera.height) == (W, H)
        if camera.distortion is None:
            assert video.camera.distortion is None
        else:
            n = min(len(camera.distortion), len(video.camera.distortion))
            assert not camera.distortion[n:].any()
            np.testing.assert_allclose(video.camera.distortion[:n], camera.distortion[:n], atol=1e-12)
            assert not video.camera.distortion[n:].any()
        assert len(video.frames) in (3, 5) if name == "d-nerf" else len(video.frames) == T
        assert video.frames[len(video.frames) - 1].shape == (H, W, 3)
        np.testing.assert_allclose(np.diff(video.times), np.diff(video.times)[0])


def test_nerfstudio_brings_depth_in_metres_masks_and_times_in_any_order(made):
    folder, _ = made["nerfstudio"]
    document = describe_folder(folder, fps=10.0)
    assert [Path(f).name for f in document["videos"][0]["frames"]] == sorted(
        Path(f).name for f in document["videos"][0]["frames"]
    )
    assert document["videos"][0]["timestamps"] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    scene = scene_from_document(document, folder)
    assert scene.videos[0].depth is not None
    assert scene.videos[0].depth[0][0, 0] == pytest.approx(1.5)
    assert scene.masks[1] is not None and scene.masks[1][2].shape == (H, W)
    assert describe_folder(folder)["missing"] == ["cam0: fps or timestamps", "cam1: fps or timestamps"]


def test_d_nerfs_splits_share_one_unit_of_time(made):
    document = describe_folder(made["d-nerf"][0], fps=2.0)
    train, test = (np.array(video["timestamps"]) for video in document["videos"])
    np.testing.assert_allclose(train, [0, 0.5, 1, 1.5, 2])
    np.testing.assert_allclose(test, [0, 1, 2])


def test_depth_tracks_and_masks_of_mosca_are_found(made):
    folder, _ = made["mosca"]
    document = describe_folder(folder, fps=30.0)
    left = document["videos"][0]
    assert left["tracks"] == {"file": "left/dynamic_dep=uniform_spatracker_tap.npz", "size": [W, H]}
    for video in document["videos"]:
        told = samples.cameras(1)[0]
        video["camera"] |= {"K": told.K.tolist(), "w2c": told.w2c.tolist()}
    scene = scene_from_document({k: v for k, v in document.items() if k != "missing"}, folder)
    assert scene.videos[0].depth is not None and scene.videos[0].depth[3][5, 5] == 5.0
    assert scene.masks[0] is not None
    np.testing.assert_array_equal(scene.masks[0][0], np.arange(H * W).reshape(H, W) % 2 > 0)


def test_colmap_reads_what_pycolmap_wrote_and_pycolmap_what_the_sample_holds(made, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    folder, cameras = made["colmap"]
    model = pycolmap.Reconstruction(str(folder / "sparse/0"))
    for image in model.images.values():
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        known = cameras[Path(image.name).stem]
        np.testing.assert_allclose(pose.matrix(), known.w2c[:3], atol=1e-9)
    written = tmp_path / "again"
    shutil.copytree(folder, written)
    for text in (False, True):
        shutil.rmtree(written / "sparse")
        (written / "sparse/0").mkdir(parents=True)
        (model.write_text if text else model.write_binary)(str(written / "sparse/0"))
        document = describe_folder(written, reader="colmap")
        for video in document["videos"]:
            np.testing.assert_allclose(video["camera"]["w2c"], cameras[video["name"]].w2c, atol=1e-9)
            np.testing.assert_allclose(video["camera"]["K"], cameras[video["name"]].K, atol=1e-9)


def test_images_without_a_pose_keep_the_times_of_the_others(made, tmp_path):
    folder = tmp_path / "model"
    shutil.copytree(made["colmap text"][0], folder)
    path = folder / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:3] + lines[5:]) + "\n")  # the second image of cam0 leaves
    with pytest.raises(ValueError, match=r"1 of 4 have none\. Give --fps"):
        describe_folder(folder)
    document = describe_folder(folder, fps=10.0)
    assert document["videos"][0]["timestamps"] == pytest.approx([0.0, 0.2, 0.3])
    assert "1 of 4 images have no pose" in document["notes"][-1]


def test_dannces_videos_are_paired_by_number_or_by_a_given_order(made, tmp_path):
    folder = tmp_path / "mouse"
    source, cameras = made["dannce"]
    shutil.copytree(source, folder)
    shutil.move(folder / "videos/Camera1/0.mp4", folder / "R.mp4")
    shutil.move(folder / "videos/Camera2/0.mp4", folder / "L.mp4")
    with pytest.raises(ValueError, match="--order"):
        describe_folder(folder)
    document = describe_folder(folder, order=("R", "L"))
    assert [v["name"] for v in document["videos"]] == ["R", "L"]
    np.testing.assert_allclose(document["videos"][0]["camera"]["K"], cameras["Camera1"].K, atol=1e-9)


def test_the_real_mouse_is_read_from_its_mat_files(data):
    """Pixels of MATLAB begin at 1: half a pixel from ours. (Its own scene.json was made with a whole one.)"""
    folder = data / "mouse"
    document = describe_folder(folder, reader="dannce", order=("R", "L", "E", "U", "S"))
    known = {v["name"]: v["camera"] for v in json.loads((folder / "scene.json").read_text())["videos"]}
    for video in document["videos"]:
        camera, own = known[video["name"]], video["camera"]
        np.testing.assert_allclose(np.array(own["w2c"])[:3, :3], np.array(camera["w2c"])[:3, :3], atol=1e-9)
        np.testing.assert_allclose(np.array(own["w2c"])[:3, 3] / 1000, np.array(camera["w2c"])[:3, 3], atol=1e-9)
        shift = np.array(own["K"]) - np.array(camera["K"])
        np.testing.assert_allclose(shift, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], atol=1e-9)
        assert own["distortion"] == camera["distortion"][:4]


def edit_json(name: str, change: Callable[[dict], Any]) -> Break:
    def broken(folder: Path) -> None:
        document = json.loads((folder / name).read_text())
        change(document)
        (folder / name).write_text(json.dumps(document))

    return broken


def edit_npy(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Break:
    return lambda folder: np.save(folder / name, change(np.load(folder / name)))


def edit_text(name: str, old: str, new: str) -> Break:
    def broken(folder: Path) -> None:
        text = (folder / name).read_text()
        assert re.search(old, text)
        (folder / name).write_text(re.sub(old, new, text, count=1))

    return broken


def edit_bytes(name: str, change: Callable[[bytes], bytes]) -> Break:
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def edit_mat(name: str, change: Callable[[dict], Any]) -> Break:
    def broken(folder: Path) -> None:
        fields = {k: v for k, v in loadmat(folder / name).items() if not k.startswith("_")}
        change(fields)
        savemat(folder / name, fields)

    return broken


def drop(name: str) -> Break:
    return lambda folder: (folder / name).unlink()


def mirror(document: dict) -> None:
    for frame in document["frames"]:
        frame["transform_matrix"][0] = [-x for x in frame["transform_matrix"][0]]


def flipped(rows: np.ndarray) -> np.ndarray:
    rows[:, [0, 5, 10]] *= -1
    return rows


def half(rows: np.ndarray) -> np.ndarray:
    rows[1, 9] = 2 * H
    return rows


def with_nan(rows: np.ndarray) -> np.ndarray:
    rows[1, 3] = np.nan
    return rows


def rename(old: str, new: str) -> Break:
    return lambda folder: (folder / old).rename(folder / new)


def blob(name: str) -> Break:
    return lambda folder: np.save(folder / name, np.array([{"a": 1}], object), allow_pickle=True)


def small(path: str) -> Break:
    return lambda folder: Image.fromarray(np.zeros((H // 2, W // 2, 3), np.uint8)).save(folder / path)


def set_frame(n: int, field: str, value: Any) -> Callable[[dict], Any]:
    return lambda d: d["frames"][n].__setitem__(field, value)


MAT, INTRI, EXTRI = "calibration/hires_cam1_params.mat", "intri.yml", "extri.yml"
CAMERAS, IMAGES = "sparse/0/cameras.bin", "sparse/0/images.bin"
MALFORMED: list[tuple[str, Break, str]] = [
    ("sync-nerf-blender", drop("cam_01.mp4"), r"expected 3; found 2\. They are paired by order"),
    ("sync-nerf-blender", edit_json("transforms.json", mirror), r"det\(R\) = \+1; found -1.*negate columns 1 and 2"),
    ("sync-nerf-blender", edit_json("transforms.json", lambda d: d.update(camera_angle_x=40)), r"below pi.*Degrees"),
    ("sync-nerf-blender", edit_json("transforms.json", lambda d: d.update(width=4 * W)), r"expected 192 x 32 pixels"),
    ("sync-nerf-blender", rename("cam_00.mp4", "cam_10.mp4"), "fine"),
    (
        "sync-nerf-blender",
        lambda f: (f / "cam_01.mp4").rename(f / "cam_2.mp4") and (f / "cam_02.mp4").rename(f / "cam_10.mp4"),
        r"sort alike.*Pad the numbers",
    ),
    ("sync-nerf-blender", edit_json("transforms.json", lambda d: d.pop("camera_angle_x")), r"camera_angle_x.*Mend"),
    ("neural-3d-video", drop("cam01.mp4"), r"expected 3; found 2\. .*delete its row"),
    ("neural-3d-video", edit_npy("poses_bounds.npy", flipped), r"row 0.*mirrored frame"),
    ("neural-3d-video", edit_npy("poses_bounds.npy", with_nan), r"finite numbers; found nan"),
    ("neural-3d-video", edit_npy("poses_bounds.npy", lambda r: r[:, :15]), r"\(nx17\); found 3x15"),
    ("neural-3d-video", edit_npy("poses_bounds.npy", half), r"row 1: expected the shape of cam01.mp4"),
    ("neural-3d-video", blob("poses_bounds.npy"), r"plain .npy array"),
    ("sync-nerf-plenoptic", lambda f: shutil.rmtree(f / "frames_2/cam01"), r"expected 3; found 2"),
    ("sync-nerf-plenoptic", edit_npy("poses_bounds.npy", flipped), r"mirrored frame"),
    ("sync-nerf-plenoptic", edit_npy("poses_bounds.npy", lambda r: 2 * r), r"not orthonormal \(scale about 2\)"),
    ("sync-nerf-plenoptic", rename("frames_2/cam00/0001.png", "frames_2/cam00/0001.jpg"), r"images of one kind"),
    ("sync-nerf-plenoptic", edit_npy("poses_bounds.npy", half), r"expected the shape of cam01"),
    ("nerfstudio", edit_json("transforms.json", mirror), r"frames\[7\].*mirrored frame|mirrored frame"),
    ("nerfstudio", drop("images/cam0/0002.png"), r"file_path.*no such file"),
    (
        "nerfstudio",
        edit_json("transforms.json", lambda d: d["frames"][2].pop("mask_path")),
        r"in all 8 frames or in none",
    ),
    ("nerfstudio", edit_json("transforms.json", lambda d: d.update(camera_model="OPENCV_FISHEYE")), r"Undistort"),
    ("nerfstudio", edit_json("transforms.json", set_frame(1, "time", 0.75)), r"one image a moment"),
    ("nerfstudio", edit_json("transforms.json", set_frame(1, "fl_x", 90.0)), r"one lens for all frames"),
    ("nerfstudio", small("images/cam0/0000.png"), r"expected 48 x 32 pixels as w and h say"),
    ("nerfstudio", edit_json("transforms.json", lambda d: d.update(frames=[])), r"expected a list of frames"),
    (
        "nerfstudio",
        edit_json("transforms.json", set_frame(0, "transform_matrix", [[1, 2], [3, 4]])),
        r"\(nx4\); found 2x2",
    ),
    ("d-nerf", edit_json("transforms_train.json", mirror), r"mirrored frame"),
    ("d-nerf", edit_json("transforms_train.json", lambda d: d["frames"][1].pop("time")), r"frames\[1\].time"),
    ("d-nerf", drop("train/0003.png"), r"no such file"),
    ("d-nerf", edit_json("transforms_test.json", lambda d: d.pop("camera_angle_x")), r"Add the focal length"),
    ("d-nerf", edit_json("transforms_test.json", lambda d: d.update(frames="all")), r"frames\[0\].time"),
    ("d-nerf", edit_json("transforms_train.json", set_frame(1, "time", "soon")), r"expected numbers \(one number\)"),
    ("colmap", edit_bytes(IMAGES, lambda b: b[:-5]), r"bytes more at .*the file ends"),
    ("colmap", edit_bytes(IMAGES, lambda b: b + b"more"), r"expected its end at"),
    ("colmap", edit_bytes(IMAGES, lambda b: struct.pack("<Q", 2**60) + b[8:]), r"the file ends"),
    (
        "colmap",
        edit_bytes(CAMERAS, lambda b: b[:12] + struct.pack("<i", 5) + b[16:]),
        r"OPENCV_FISHEYE.*image_undistorter",
    ),
    ("colmap", edit_bytes(IMAGES, lambda b: b[:12] + struct.pack("<d", 7.0) + b[20:]), r"unit quaternion"),
    ("colmap", drop("cam1.mp4"), r"no video of cam1"),
    ("colmap", lambda f: samples.video(f / "cam9.mp4"), r"no image of cam9"),
    ("colmap", lambda f: samples.video(f / "cam0.mp4", size=(2 * W, 2 * H)), r"expected 48 x 32 pixels as the model"),
    (
        "anipose",
        edit_text("calibration.toml", r"rotation = \[", "rotation = [9.0, "),
        r"rotation: expected numbers \(3\)",
    ),
    ("anipose", edit_text("calibration.toml", r"size = \[ 48", "size = [ 480"), r"expected the size of .*mp4, 48 x 32"),
    ("anipose", edit_text("calibration.toml", 'name = "camA"', 'name = "camA"\nfisheye = true'), r"Undistort"),
    ("anipose", edit_text("calibration.toml", "translation", "translations"), r"translation: expected a value"),
    ("anipose", edit_text("calibration.toml", r"\[cam_0\]", "[cam_0"), r"expected TOML"),
    ("anipose", drop("videos-raw/trial1-camA.mp4"), r"one video of the camera 'camA'"),
    ("anipose", lambda f: samples.video(f / "videos-raw/trial1-camC.mp4"), r"a camera for every video.*camC"),
    ("easymocap", edit_text(INTRI, "!!opencv-matrix", "none"), r"expected OpenCV's YAML"),
    ("easymocap", edit_text(EXTRI, r'- "?02"?|"02"', '- "03"'), r"expected those of intri.yml"),
    ("easymocap", edit_text(INTRI, "%YAML", "YAMS"), r"expected OpenCV's YAML"),
    ("easymocap", drop("videos/02.mp4"), r"one video of the camera '02'"),
    ("easymocap", edit_text(EXTRI, "T_01", "S_01"), r"T_01: expected a matrix; found none"),
    ("easymocap", lambda f: samples.video(f / "videos/03.mp4"), r"a camera for every video.*03"),
    ("dannce", edit_mat(MAT, lambda m: m.update(K=m["K"].T)), r"transposed"),
    ("dannce", edit_mat(MAT, lambda m: m.update(r=-m["r"])), r"mirrored frame"),
    ("dannce", edit_mat(MAT, lambda m: m.pop("TDistort")), r"TDistort missing"),
    ("dannce", edit_mat(MAT, lambda m: m.update(t=np.zeros((1, 2)))), r"t: expected 3 numbers"),
    ("dannce", edit_mat(MAT, lambda m: m.update(K=np.zeros((400, 400)))), r"small matrices"),
    ("dannce", edit_bytes(MAT, lambda b: b[: len(b) // 2]), r"expected a MATLAB file"),
    ("dannce", drop("videos/Camera2/0.mp4"), r"--order"),
    ("dannce", lambda f: samples.video(f / "videos/Camera1/1.mp4"), r"parts of one recording"),
    ("mosca", drop("left/uniform_depth/0002.npz"), r"none for 0002.jpg"),
    ("mosca", lambda f: shutil.copy(f / "left/masks/0001.npz", f / "left/masks/0009.npz"), r"expected 4; found 5"),
    ("mosca", lambda f: shutil.copytree(f / "left/uniform_depth", f / "left/metric_depth"), r"depth of one kind"),
    ("mosca", lambda f: (f / "left/images/0000.jpg").write_bytes(b"no image"), r"readable image"),
    ("mosca", drop("right/masks/0000.npz"), r"none for 0000.jpg"),
]


@pytest.mark.parametrize("case", range(len(MALFORMED)), ids=[f"{n}-{k}" for k, (n, *_) in enumerate(MALFORMED)])
def test_what_is_malformed_is_refused_with_the_remedy(case, made, tmp_path):
    name, spoil, says = MALFORMED[case]
    folder = tmp_path / "recording"
    shutil.copytree(made[name][0], folder)
    spoil(folder)
    if says == "fine":  # a break that is none, so that the others are seen to matter
        assert describe_folder(folder, reader=name)["videos"]
        return
    with pytest.raises((ValueError, FileNotFoundError), match=says) as refused:
        describe_folder(folder, reader=name)
    assert str(folder) in str(refused.value) or "order" in str(refused.value)


@pytest.mark.parametrize("cut", [0, 3, 8, 40, 90, 200])
def test_any_bytes_of_a_model_are_read_or_refused(cut, made, tmp_path):
    folder = tmp_path / "recording"
    shutil.copytree(made["colmap"][0], folder)
    rng = np.random.default_rng(cut)
    for file in (CAMERAS, IMAGES):
        data = bytearray((folder / file).read_bytes())
        for at in rng.integers(0, len(data), 6):
            data[at] = int(rng.integers(256))
        (folder / file).write_bytes(bytes(data[: len(data) - cut]))
    try:
        describe_folder(folder, reader="colmap")
    except (ValueError, FileNotFoundError) as error:
        assert str(folder) in str(error)


def test_init_says_who_took_the_folder_who_else_could_and_what_looks_wrong(made, tmp_path, capsys):
    folder = tmp_path / "recording"
    shutil.copytree(made["sync-nerf-blender"][0], folder)
    assert main(["init", str(folder)]) == 0
    said = capsys.readouterr()
    assert "(reader: sync-nerf-blender)" in said.out and "nerfstudio, video-files (--reader)" in said.out
    assert not said.err
    inverted = json.loads((folder / "transforms.json").read_text())
    for frame in inverted["frames"]:
        frame["transform_matrix"] = np.linalg.inv(frame["transform_matrix"]).tolist()
    (folder / "transforms.json").write_text(json.dumps(inverted))
    main(["init", str(folder), "--force"])
    assert "do not look at a common volume" in capsys.readouterr().err


def test_the_docs_have_the_table_that_the_readers_declare():
    page = (ROOT / "docs/recording.md").read_text()
    assert with_table(page) == page, "python -m otsync.io.page docs/recording.md"
