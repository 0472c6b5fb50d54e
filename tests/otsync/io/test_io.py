"""Scenes, lazy frames, and files from strangers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from otsync.cli import main
from otsync.files.arrays import write_npz
from otsync.io import READERS, ImageFrames, VideoFrames, describe_folder, find_reader, open_scene, readers
from otsync.io.datasets import DATASETS
from otsync.io.document import FORMAT, VERSION, document, write_document
from otsync.io.frames import ArrayFrames, _Errors
from otsync.io.images import read_depth, read_image, read_mask
from otsync.io.mend import keep_frames
from otsync.plugins import forget, register
from tests.recording_world import ring

GUARD = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


def entry(name: str, **more) -> dict:
    camera = ring(3, width=32, height=24)[0]
    told = {"K": camera.K.tolist(), "w2c": camera.w2c.tolist(), "width": 32, "height": 24}
    return {"name": name, "frames": f"{name}/*.png", "fps": 30, "camera": told, **more}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two cameras of twelve 32 x 24 frames; the grey level tells the frame."""
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        for k in range(12):
            Image.fromarray(np.full((24, 32, 3), 10 * k + 5, np.uint8)).save(tmp_path / name / f"f{k}.png")
    write_document(tmp_path / "scene.json", [entry("left"), entry("right", range=[3, 9])])
    return tmp_path


def rewrite(folder: Path, *entries: dict) -> None:
    write_document(folder / "scene.json", entries)


def test_frames_come_in_natural_order_and_ranges_cut_them(folder):
    scene = open_scene(folder)
    left, right = scene.videos
    assert [int(left.frames[k][0, 0, 0]) for k in range(12)] == [10 * k + 5 for k in range(12)]
    assert len(right.frames) == 6
    assert int(right.frames[0][0, 0, 0]) == 35
    assert int(right.frames[-1][0, 0, 0]) == 85
    assert [int(f[0, 0, 0]) for f in left.frames[2:8:3]] == [25, 55]
    with pytest.raises(IndexError):
        right.frames[6]


def test_digest_follows_content_not_names(folder):
    scene = open_scene(folder)
    before = scene.videos[1].frames.digest()
    assert before == ImageFrames([folder / "right" / f"f{k}.png" for k in range(3, 9)]).digest()
    Image.fromarray(np.zeros((24, 32, 3), np.uint8)).save(folder / "right" / "f4.png")
    assert open_scene(folder).videos[1].frames.digest() != before
    Image.fromarray(np.zeros((24, 32, 3), np.uint8)).save(folder / "right" / "f11.png")
    after = open_scene(folder).videos[1].frames.digest()
    assert after == open_scene(folder).videos[1].frames.digest()


def test_take_names_what_there_is(folder):
    assert open_scene(folder).take(["right"]).names == ("right",)
    with pytest.raises(ValueError, match="left, right"):
        open_scene(folder).take(["middle"])


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"frames": "../*.png"}, "pattern|outside"),
        ({"frames": "/etc/*.png"}, "outside"),
        ({"frames": ["../secret.png"] * 12}, "outside"),
        ({"frames": "**/*.png"}, "pattern"),
        ({"frames": 7}, r"videos\[0\]\.frames .*expected text or a list; found 7"),
        ({"frames": "a.png"}, "pattern"),
        ({"frames": "nothing/*.png"}, "no files"),
        ({"camera": None}, "calibration"),
        ({"camera": {"K": 1}}, r"videos\[0\]\.camera\.K .*expected a list or null; found 1"),
        ({"camera": {"width": 32}}, "w2c"),
        ({"fps": None}, "fps"),
        ({"fps": -3}, "fps"),
        ({"timestamps": [0.0] * 12}, "increasing"),
        ({"range": [5, 99]}, "range"),
        ({"range": "x"}, "range"),
        ({"masks": "right/f1*.png"}, "12 files"),
        ({"labels": "right/f1*.png"}, "12 files"),
        ({"labels": "../who/*.png"}, "pattern|outside"),
        ({"depth": "right/*.png"}, "depth"),
        ({"depth": {"frames": "right/*.png", "scale": 0}}, "scale"),
        ({"file": "a.mp4"}, "either"),
    ],
)
def test_unsound_entries_are_named(folder, change, expected):
    rewrite(folder, entry("left", **change), entry("right"))
    with pytest.raises((ValueError, FileNotFoundError), match=expected) as caught:
        open_scene(folder)
    assert "left" in str(caught.value)


def test_no_file_outside_is_read_even_through_a_link(folder, tmp_path_factory):
    secret = tmp_path_factory.mktemp("elsewhere")
    Image.fromarray(np.zeros((24, 32, 3), np.uint8)).save(secret / "f0.png")
    (folder / "linked").symlink_to(secret)
    (folder / "sneaky").mkdir()
    (folder / "sneaky" / "f0.png").symlink_to(secret / "f0.png")
    for pattern in ("linked/*.png", "sneaky/*.png", ["sneaky/f0.png"]):
        rewrite(folder, {**entry("left"), "frames": pattern}, entry("right"))
        with pytest.raises(ValueError, match="outside"):
            open_scene(folder)
        assert len(open_scene(folder, allow_outside=True).videos[0].frames) == 1


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", '{"format": "other"}', '{"format": "otsync.scene", "version": 99}', "[" * 5000]
)
def test_documents_that_are_no_scene(tmp_path, text):
    (tmp_path / "scene.json").write_text(text)
    with pytest.raises(ValueError, match=r"scene\.json"):
        open_scene(tmp_path)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=8,
)


@GUARD
@given(
    field=st.sampled_from(["name", "frames", "fps", "timestamps", "range", "masks", "depth", "camera", "file"]),
    value=values,
)
def test_any_json_in_any_field_is_read_or_refused(folder, field, value):
    document = {"format": FORMAT, "version": VERSION, "videos": [{**entry("left"), field: value}, entry("right")]}
    (folder / "scene.json").write_text(json.dumps(document))
    try:
        open_scene(folder)
    except (ValueError, OSError) as error:
        assert str(folder) in str(error) or field in str(error) or "videos" in str(error)  # the message says where


@GUARD
@given(data=st.data())
def test_damaged_images_are_clean_errors(tmp_path, data):
    path = tmp_path / "x.jpg"
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(path)
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 8))):
            content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(bytes(content))
    try:
        image = read_image(path)
    except ValueError as error:
        assert "x.jpg" in str(error)
    else:
        assert image.ndim == 3 and image.dtype == np.uint8


def test_a_truncated_image_is_not_grey(tmp_path):
    path = tmp_path / "x.jpg"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:-900])
    with pytest.raises(ValueError, match=r"x\.jpg.*truncated"):
        read_image(path)


def test_an_image_that_claims_to_be_huge_is_refused(tmp_path):
    path = tmp_path / "x.png"
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(path)
    content = bytearray(path.read_bytes())
    content[16:24] = (60000).to_bytes(4, "big") * 2
    import zlib

    content[29:33] = zlib.crc32(bytes(content[12:29])).to_bytes(4, "big")
    path.write_bytes(bytes(content))
    with pytest.raises(ValueError, match=r"x\.png"):
        read_image(path)


def test_depth_in_three_formats_agrees(tmp_path):
    depth = np.random.default_rng(0).uniform(1, 5, (6, 8)).round(3)
    depth[0, 0] = 0
    Image.fromarray((depth * 1000).round().astype(np.uint16)).save(tmp_path / "d.png")
    np.save(tmp_path / "d.npy", depth)
    write_npz(tmp_path / "d.npz", {"depth": depth})
    for name, scale in (("d.png", 0.001), ("d.npy", 1.0), ("d.npz", 1.0)):
        np.testing.assert_allclose(read_depth(tmp_path / name, scale), depth, atol=1e-6)
    np.save(tmp_path / "bad.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(ValueError, match="plain"):
        read_depth(tmp_path / "bad.npy", 1.0)
    with open(tmp_path / "huge.npy", "wb") as stream:  # claims 80 GB in a hundred bytes
        np.lib.format.write_array_header_1_0(
            stream, {"descr": "<f8", "fortran_order": False, "shape": (100_000, 100_000)}
        )
    with pytest.raises(ValueError, match=r"huge\.npy: expected a plain .npy array; it declares 80000000000 bytes"):
        read_depth(tmp_path / "huge.npy", 1.0)
    np.save(tmp_path / "nan.npy", np.array([[np.nan, -1.0, np.inf, 2.0]]))
    np.testing.assert_array_equal(read_depth(tmp_path / "nan.npy", 1.0), [[0, 0, 0, 2]])


def test_masks_of_ones_and_of_255s_mean_the_same(tmp_path):
    mask = np.random.default_rng(0).random((6, 8)) < 0.5
    for top in (1, 255):
        Image.fromarray((mask * top).astype(np.uint8)).save(tmp_path / "m.png")
        np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), mask)


def write_video(path: Path, times: list[int], b_frames: int = 2) -> None:
    """A video whose frame k is of grey level 4k + 20, at ``times`` in 1/90000 s."""
    from fractions import Fraction

    import av

    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=30, options={"crf": "1", "bf": str(b_frames), "g": "12"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 90000)
        for k, pts in enumerate(times):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 4 * k + 20, np.uint8), format="rgb24")
            frame.pts, frame.time_base = pts, Fraction(1, 90000)
            for packet in stream.encode(frame):
                out.mux(packet)
        for packet in stream.encode():
            out.mux(packet)


@pytest.mark.parametrize("turned", [0, 90, 180, 270])
def test_a_phones_video_is_read_as_it_is_stored(tmp_path, turned):
    """B-frames, a late start, sound beside it, and a flag by which players turn the image."""
    with av.open(str(tmp_path / "v.mp4"), "w") as out:
        stream = out.add_stream("libx264", rate=30, options={"crf": "1", "bf": "2", "g": "12"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        if not hasattr(stream, "set_display_rotation"):
            pytest.skip("this PyAV reads a rotation, but writes none")
        stream.set_display_rotation(-turned)
        sound = out.add_stream("aac", rate=48000, layout="mono")
        for k in range(20):
            image = np.full((48, 64, 3), 4 * k + 20, np.uint8)
            image[:12, :16] = 250  # top left
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = k + 15
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
        tone = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        tone.sample_rate = 48000
        out.mux(sound.encode(tone))
        out.mux(sound.encode())
    video = VideoFrames(tmp_path / "v.mp4")
    assert (video.width, video.height, len(video), video.turned) == (64, 48, 20, turned)
    np.testing.assert_allclose(video.timestamps, (np.arange(20) + 15) / 30, atol=1e-4)
    for k in (19, 0, 7):
        assert video[k][:8, :12].mean() > 240 and abs(float(video[k][24:].mean()) - (4 * k + 20)) < 4, k


def test_video_frames_keep_the_containers_clock(tmp_path):
    times = [3000 * k + (1500 if k % 7 == 3 else 0) for k in range(50)]
    write_video(tmp_path / "v.mp4", times)
    video = VideoFrames(tmp_path / "v.mp4")
    assert len(video) == 50
    np.testing.assert_allclose(np.diff(video.timestamps), np.diff(times) / 90000, atol=2e-5)
    for k in (0, 1, 2, 30, 12, 49, 13, 48, 0, 25):
        assert abs(float(video[k].mean()) - (4 * k + 20)) < 2.5, k


@pytest.mark.parametrize(
    "text",
    [
        "ffconcat version 1.0\nfile whole.mp4\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\nwhole.mp4\n#EXT-X-ENDLIST\n",
    ],
)
def test_a_playlist_that_calls_itself_a_video_reads_no_other_file(tmp_path, text):
    write_video(tmp_path / "whole.mp4", [3000 * k for k in range(20)])
    for name in ("list.mp4", "list.m3u8", "list.txt"):
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match="list"):
            VideoFrames(tmp_path / name)


@GUARD
@given(data=st.data())
def test_damaged_videos_are_clean_errors(tmp_path, data):
    path = tmp_path / "v.mp4"
    if not (tmp_path / "whole.mp4").exists():
        write_video(tmp_path / "whole.mp4", [3000 * k for k in range(20)])
    content = bytearray((tmp_path / "whole.mp4").read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 6))):
            content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(bytes(content))
    try:
        video = VideoFrames(path)
        for k in range(len(video)):
            video[k]
    except ValueError as error:
        assert "v.mp4" in str(error)


def test_a_video_of_more_pixels_than_are_decoded_is_refused(tmp_path, monkeypatch):
    """By its header; and, where a frame says more than the header, by the decoder."""
    write_video(tmp_path / "v.mp4", [3000 * k for k in range(5)])
    monkeypatch.setattr("otsync.io.frames.MAX_PIXELS", 64 * 48)
    assert VideoFrames(tmp_path / "v.mp4")[4].shape == (48, 64, 3)
    monkeypatch.setattr("otsync.io.frames.MAX_PIXELS", 64 * 48 - 1)
    with pytest.raises(ValueError, match=r"v\.mp4: .*64 x 48 pixels, more than the 3071 allowed"):
        VideoFrames(tmp_path / "v.mp4")


def test_an_array_that_claims_a_hundred_thousand_squared_takes_no_memory(tmp_path):
    with open(tmp_path / "huge.npy", "wb") as stream:
        about = {"descr": "<f4", "fortran_order": False, "shape": (100_000, 100_000)}
        np.lib.format.write_array_header_1_0(stream, about)
        stream.write(bytes(2**20))
    for read in (lambda path: read_depth(path, 1.0), ArrayFrames):
        with pytest.raises(ValueError, match=r"huge\.npy: .* it declares 40000000000 bytes but holds 1048576"):
            read(tmp_path / "huge.npy")


def test_sizes_that_a_damaged_video_makes_up_are_no_lack_of_memory():
    import av

    with (
        pytest.raises(ValueError, match=r"v\.mp4: expected a readable video; found MemoryError"),
        _Errors(Path("v.mp4")),
    ):
        raise av.error.MemoryError(12, "Cannot allocate memory")
    with pytest.raises(MemoryError), _Errors(Path("v.mp4")):
        raise MemoryError


def test_init_names_what_is_missing(folder):
    (folder / "scene.json").unlink()
    write_video(folder / "third.mp4", [3000 * k for k in range(10)])
    described = describe_folder(folder)
    assert [v["name"] for v in described["videos"]] == ["third", "left", "right"]
    assert any("left" in m and "fps" in m for m in described["missing"])
    assert not any("third" in m and "fps" in m for m in described["missing"])
    (folder / "scene.json").write_text(json.dumps(described))
    with pytest.raises(ValueError, match="missing"):
        open_scene(folder)
    with pytest.raises(ValueError, match=r"panoptic: .*ims/.*video-files: .*image-folders: "):
        describe_folder(folder / "left")


def test_panoptic_layout(tmp_path):
    cameras = ring(2, width=32, height=24)
    for c in range(2):
        for kind in ("ims", "seg"):
            (tmp_path / kind / str(c)).mkdir(parents=True)
        for k in range(4):
            Image.fromarray(np.full((24, 32, 3), 40 * k, np.uint8)).save(tmp_path / "ims" / str(c) / f"{k:06d}.jpg")
            Image.fromarray(np.full((24, 32), k % 2, np.uint8)).save(tmp_path / "seg" / str(c) / f"{k:06d}.png")
    meta = {
        "w": 32,
        "h": 24,
        "fn": [[f"{c}/{k:06d}.jpg" for c in range(2)] for k in range(4)],
        "k": [[c.K.tolist() for c in cameras]] * 4,
        "w2c": [[c.w2c.tolist() for c in cameras]] * 4,
        "cam_id": [[0, 1]] * 4,
    }
    (tmp_path / "train_meta.json").write_text(json.dumps(meta))
    scene = open_scene(tmp_path)
    assert scene.names == ("0", "1")
    assert scene.videos[1].camera.w2c.shape == (4, 4)
    np.testing.assert_allclose(scene.videos[1].camera.center, cameras[1].center)
    assert scene.masks[0] is not None and not scene.masks[0][0].any()
    assert any("30 fps" in note for note in scene.notes)
    mirrored = [(np.linalg.inv(c.w2c) @ np.diag([1.0, 1, -1, 1])).tolist() for c in cameras]
    zoomed = [[c.K.tolist() for c in cameras]] * 3 + [[(2 * c.K).tolist() for c in cameras]]
    for change, words in (
        ({"w2c": [[c.w2c.tolist() for c in cameras]] * 3}, "do not agree.*Mend"),
        ({"w2c": [mirrored] * 4}, r"camera 0: .*det.*\+1"),
        ({"k": zoomed}, "zoom is not supported"),
        ({"cam_id": [[1, 1]] * 4}, "expected every camera once; found 1 again.*Mend"),
        ({"cam_id": None}, "expected w, h, fn, k, w2c and cam_id"),
        ({"fn": [*meta["fn"][:3], ["0/000003.jpg"]]}, "do not agree"),
    ):
        (tmp_path / "train_meta.json").write_text(json.dumps(meta | change))
        with pytest.raises(ValueError, match=r"train_meta\.json.*" + words):
            open_scene(tmp_path)


def test_the_papers_scene_opens(data):
    scene = open_scene(data / "panoptic_basketball")
    assert len(scene.videos) == 15
    assert {len(v.frames) for v in scene.videos} == {150}
    assert scene.videos[3].frames[149].shape == (360, 640, 3)
    assert sum(m is not None for m in scene.masks) == 14


def test_the_first_reader_that_claims_a_folder_takes_it_and_a_named_one_goes_before(folder):
    (folder / "scene.json").unlink()
    assert find_reader(folder)[0] == "image-folders"
    write_video(folder / "third.mp4", [3000 * k for k in range(10)])
    assert find_reader(folder)[0] == "videos-and-images"
    assert [v["name"] for v in describe_folder(folder, reader="video-files")["videos"]] == ["third"]
    assert [v["name"] for v in describe_folder(folder, reader="image-folders")["videos"]] == ["left", "right"]
    with pytest.raises(ValueError, match=r"panoptic: train_meta.json .*; found 'left', 'right', 'third.mp4'"):
        find_reader(folder, "panoptic")
    with pytest.raises(ValueError, match=r"reader: expected one of panoptic, .*; found 'panoptik'"):
        find_reader(folder, "panoptik")


def test_an_option_that_a_reader_does_not_take_is_refused(folder):
    (folder / "scene.json").unlink()
    assert describe_folder(folder, fps=25.0)["videos"][0]["fps"] == 25.0
    write_video(folder / "third.mp4", [3000 * k for k in range(10)])
    with pytest.raises(ValueError, match="fps: the reader video-files does not take it"):
        describe_folder(folder, reader="video-files", fps=25.0)


class Slides:
    """Folders that hold a file named slides.txt."""

    def claims(self, folder):
        return (folder / "slides.txt").is_file()

    def describe(self, folder, *, fps=10.0):
        return document([entry("left", fps=fps), entry("right", fps=fps)], "stage")


@pytest.mark.parametrize("thing", [Slides, Slides()], ids=["class", "object"])
def test_a_registered_reader_is_asked_first_and_opens_its_folders(folder, thing):
    (folder / "scene.json").unlink()
    (folder / "slides.txt").touch()
    register("readers", "slides")(thing)
    try:
        assert next(iter(readers())) == "slides"
        scene = open_scene(folder)
        assert (scene.names, scene.frame, scene.videos[0].fps) == (("left", "right"), "stage", 10.0)
        assert describe_folder(folder, fps=20.0)["videos"][0]["fps"] == 20.0
        (folder / "slides.txt").unlink()
        with pytest.raises(ValueError, match="missing"):
            open_scene(folder)
        with pytest.raises(ValueError, match=r"slides: Folders that hold a file named slides.txt"):
            open_scene(folder, reader="slides")
    finally:
        forget(thing)
    assert "slides" not in readers()


FOOTAGE = ("videos-and-images", "video-files", "image-folders")


def test_the_readers_of_otsync_are_asked_from_the_most_special_to_the_most_general():
    assert list(readers()) == [reader.name for reader in READERS]
    assert [reader.name for reader in READERS] == ["panoptic", "pose2sim", *(r.name for r in DATASETS), *FOOTAGE]


def test_init_says_which_reader_took_the_folder(folder, capsys):
    (folder / "scene.json").unlink()
    assert main(["init", str(folder), "--fps", "30"]) == 1
    assert "(reader: image-folders)" in capsys.readouterr().out
    assert main(["init", str(folder), "--force", "--reader", "video-files"]) == 2
    assert "video-files: video files" in capsys.readouterr().err


def test_what_is_cut_from_a_scene_keeps_masks_labels_and_frames_together(folder):
    for name in ("seg", "who"):
        (folder / name).mkdir()
        for k in range(12):
            Image.fromarray(np.full((24, 32), k, np.uint8)).save(folder / name / f"f{k}.png")
    rewrite(folder, entry("left", masks="seg/*.png", labels="who/*.png"), entry("right"))
    scene = keep_frames(open_scene(folder), [[2, 5, 6], range(12)])
    assert [int(f[0, 0, 0]) for f in scene.videos[0].frames] == [25, 55, 65]
    assert scene.masks[0] is not None and len(scene.masks[0]) == 3
    assert scene.labels[0] is not None
    assert [int(labels[0, 0]) for labels in scene.labels[0]] == [2, 5, 6]
    assert scene.labels[1] is None
    assert keep_frames(replace(scene, labels=()), [[0], [1]]).labels == ()
