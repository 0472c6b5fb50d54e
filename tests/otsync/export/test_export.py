"""Synchronised videos: every timestamp, sample and row is where the offsets say."""

from __future__ import annotations

import contextlib
import csv
import io
import json
from fractions import Fraction
from pathlib import Path
from xml.etree import ElementTree

import av
import numpy as np
import pytest

from otsync.cli import main
from otsync.export import EXPORTS, aligned
from otsync.export.fcpxml import frame_length
from otsync.export.slot import file_names
from otsync.io import open_scene
from otsync.io.frames import VideoFrames
from otsync.types import Offsets

SIZE, FPS, RATE = (96, 64), 30.0, 48_000
OFFSETS = np.array([0.0, 0.2137, -0.1212])
RATES = np.array([1.0, 1.0, 1.001])
FRAMES = 40
FLASH, CLICK = 0.62, 0.81
"""World seconds of a flash that all cameras see and a click that all microphones hear."""


def frame_seconds(v: int) -> np.ndarray:
    """Of a video on its own clock: the second has a variable frame rate, the third begins late in its container."""
    even = np.arange(FRAMES) / FPS
    return (
        even + (0.009 * np.sin(np.arange(FRAMES)) * (np.arange(FRAMES) > 0) if v == 1 else 0) + (0.5 if v == 2 else 0)
    )


def picture(k: int, t: float) -> np.ndarray:
    """Frame ``k`` of a video: its number in eight black or white squares, and a bright half after the flash."""
    image = np.full((SIZE[1], SIZE[0], 3), 60, np.uint8)
    for bit in range(8):
        image[8:20, 8 + 10 * bit : 18 + 10 * bit] = 255 * (k >> bit & 1)
    image[32:] = 230 if t >= FLASH else 30
    return image


def number(image: np.ndarray) -> int:
    return sum(int(image[14, 13 + 10 * bit].mean() > 128) << bit for bit in range(8))


def film(path: Path, v: int) -> None:
    """An mp4 with B-frames, VFR, and a stereo click, as its own clock has them."""
    own = frame_seconds(v)
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=30, options={"crf": "12", "bf": "2", "g": "12"})
        video.width, video.height, video.pix_fmt = *SIZE, "yuv420p"
        video.time_base = video.codec_context.time_base = Fraction(1, 90_000)
        audio = container.add_stream("aac", rate=RATE, layout="stereo")
        for k, seconds in enumerate(own):
            t = RATES[v] * seconds + OFFSETS[v]
            frame = av.VideoFrame.from_ndarray(picture(k, t), format="rgb24")
            frame.pts, frame.time_base = round(seconds * 90_000), Fraction(1, 90_000)
            container.mux(video.encode(frame))
        container.mux(video.encode())
        first = own[0]
        n = round((own[-1] - first + 0.1) * RATE)
        heard = RATES[v] * (first + np.arange(n) / RATE) + OFFSETS[v]
        wave = (np.abs(heard - CLICK) < 0.002) * np.sin(2 * np.pi * 1500 * (heard - CLICK))
        sound = np.stack([wave, wave]).astype(np.float32)
        for k in range(0, n, 1024):
            piece = av.AudioFrame.from_ndarray(np.ascontiguousarray(sound[:, k : k + 1024]), "fltp", "stereo")
            piece.sample_rate, piece.pts, piece.time_base = RATE, k + round(first * RATE), Fraction(1, RATE)
            container.mux(audio.encode(piece))
        container.mux(audio.encode())


NAMES = ("left", "right/../odd name", "=late")


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    entries = []
    for v, name in enumerate(NAMES):
        film(folder / f"{v}.mp4", v)
        camera = {"K": [[90, 0, 48], [0, 90, 32], [0, 0, 1]], "w2c": np.eye(4).tolist()}
        entries.append({"name": name, "file": f"{v}.mp4", "camera": camera | {"width": SIZE[0], "height": SIZE[1]}})
    document = {"format": "otsync.scene", "version": 1, "frame": "world", "videos": entries}
    (folder / "scene.json").write_text(json.dumps(document))
    Offsets.known(NAMES, OFFSETS, FPS, RATES).save(folder / "offsets.json")
    return folder


@pytest.fixture(scope="module")
def exported(recording) -> Path:
    out = recording / "out"
    assert main(["export", str(recording), "--offsets", str(recording / "offsets.json"), "--out", str(out)]) == 0
    return out


def world(v: int) -> np.ndarray:
    return RATES[v] * frame_seconds(v) + OFFSETS[v]


START = max(world(v)[0] for v in range(3))
STOP = min(world(v)[-1] for v in range(3))


@pytest.mark.parametrize("v", range(3))
def test_clips_hold_every_shared_frame_at_its_own_world_second(exported, v):
    clip = VideoFrames(exported / "clips" / file_names(NAMES, ".mp4")[v])
    shared = np.flatnonzero((world(v) >= START - 1e-9) & (world(v) <= STOP + 1e-9))
    assert len(clip) == len(shared)
    np.testing.assert_allclose(clip.timestamps, world(v)[shared] - START, atol=2e-5)
    for n in (5, 0, len(clip) - 1, 2, 9, 8, len(clip) // 2):  # seeks to and fro
        assert number(clip[n]) == shared[n]


@pytest.mark.parametrize("v", range(3))
def test_the_sound_is_aligned_within_two_milliseconds(exported, v):
    path = exported / "clips" / file_names(NAMES, ".mp4")[v]
    heard, seconds = [], []
    with av.open(str(path)) as container:
        for frame in container.decode(audio=0):
            heard.append(np.abs(frame.to_ndarray()).max(0))
            seconds.append(frame.time + np.arange(frame.samples) / RATE)
    heard, seconds = np.concatenate(heard), np.concatenate(seconds)
    loud = seconds[heard > 0.3 * heard.max()]
    assert heard.max() > 0.3
    assert abs(loud.mean() - (CLICK - START)) < 0.002
    assert np.ptp(loud) < 0.01


def test_a_flash_appears_in_all_clips_at_the_same_second(exported):
    for v, name in enumerate(file_names(NAMES, ".mp4")):
        clip = VideoFrames(exported / "clips" / name)
        bright = [k for k in range(len(clip)) if clip[k][48].mean() > 128]
        first = world(v)[world(v) >= FLASH][0] - START
        assert clip.timestamps[bright[0]] == pytest.approx(first, abs=2e-5)


@pytest.fixture(scope="module")
def copied(recording) -> tuple[Path, str, float]:
    """The folder of the copies, what was said of them, and the world second of the first of their key frames."""
    err = io.StringIO()
    with contextlib.redirect_stderr(err):
        where = [str(recording), "--offsets", str(recording / "offsets.json"), "--out", str(recording / "raw")]
        assert main(["export", *where, "--what", "copies"]) == 0
    keys = []
    for v in range(3):
        with av.open(str(recording / f"{v}.mp4")) as container:
            at = np.array([float(p.pts * p.time_base) for p in container.demux(video=0) if p.is_keyframe and p.size])
        begun = RATES[v] * at + OFFSETS[v]
        keys.append(begun[begun <= START + 1e-6].max())
    return recording / "raw" / "copies", err.getvalue(), min(keys)


@pytest.mark.parametrize("v", range(3))
def test_copies_hold_the_files_own_frames_at_their_world_seconds(copied, recording, v):
    folder, told, begin = copied
    out = folder / file_names(NAMES, ".mp4")[v]
    source, copy = VideoFrames(recording / f"{v}.mp4"), VideoFrames(out)
    shown = np.flatnonzero((world(v) >= START - 1e-9) & (world(v) <= STOP + 1e-9))
    at = np.array([np.abs(copy.timestamps - (world(v)[k] - begin)).argmin() for k in shown])
    np.testing.assert_allclose(copy.timestamps[at], world(v)[shown] - begin, atol=2e-5)
    for k, n in zip(shown, at, strict=True):
        np.testing.assert_array_equal(copy[int(n)], source[int(k)])
    assert copy.timestamps[0] >= 0 and copy.timestamps[-1] <= STOP - begin + 4 / FPS
    assert f"all videos are there from second {START - begin:.3f} on" in told


@pytest.mark.parametrize("v", range(2))
def test_the_sound_of_copies_is_aligned_within_two_milliseconds(copied, v):
    with av.open(str(copied[0] / file_names(NAMES, ".mp4")[v])) as container:
        pieces = [(f.time, f.to_ndarray()[0]) for f in container.decode(audio=0)]
    seconds = np.concatenate([t + np.arange(len(x)) / RATE for t, x in pieces])
    loud = np.abs(np.concatenate([x for _, x in pieces]))
    middle = (seconds * loud**2).sum() / (loud**2).sum()
    assert middle == pytest.approx(CLICK - copied[2], abs=0.002)


def test_sound_that_would_change_its_pitch_is_left_out_of_copies_and_said(recording, tmp_path, capsys):
    offsets = tmp_path / "o.json"
    Offsets.known(NAMES, OFFSETS, FPS, np.array([1.0, 1.0, 1.01])).save(offsets)
    args = ["export", str(recording), "--offsets", str(offsets), "--out", str(tmp_path), "--what", "copies"]
    assert main(args) == 0
    assert "=late: its rate of 1.0100 would need other samples" in capsys.readouterr().err
    with av.open(str(tmp_path / "copies" / file_names(NAMES, ".mp4")[2])) as container:
        assert not container.streams.audio


def test_images_are_not_copied_and_clips_are_named(tmp_path, capsys):
    from tests.recording_world import write_recording

    write_recording(tmp_path, [0.0, 2.0], frames=8)
    names = [video["name"] for video in json.loads((tmp_path / "scene.json").read_text())["videos"]]
    Offsets.known(names, np.zeros(2), 30).save(tmp_path / "o.json")
    args = ["export", str(tmp_path), "--offsets", str(tmp_path / "o.json"), "--out", str(tmp_path / "x")]
    assert main([*args, "--what", "copies"]) != 0
    err = capsys.readouterr().err
    assert "expected a video that can be copied" in err
    assert f"{names[0]}: it is images, so it is not copied; --what clips" in err
    assert not list((tmp_path / "x").rglob("*.mp4"))


def test_the_table_names_the_nearest_frames(exported):
    rows = list(csv.reader((exported / "frames.csv").open()))
    assert rows[0][0] == "world_seconds" and rows[0][1] == "left frame" and len(rows[0]) == 10
    times = np.array([float(row[0]) for row in rows[1:]])
    np.testing.assert_allclose(np.diff(times), 1 / FPS, atol=2e-6)
    assert np.abs(times * FPS - np.round(times * FPS)).max() < 1e-3  # the reference's own frames
    for row, t in zip(rows[1:], times, strict=True):
        for v in range(3):
            k, own, late = row[1 + 3 * v : 4 + 3 * v]
            apart = np.abs(world(v) - t)
            if not k:
                assert apart.min() > 0.9 / FPS
                continue
            assert apart[int(k)] == pytest.approx(apart.min(), abs=1e-6)
            assert float(own) == pytest.approx(frame_seconds(v)[int(k)], abs=2e-5)
            assert float(late) == pytest.approx(world(v)[int(k)] - t, abs=2e-5)


def test_the_mosaic_shows_the_flash_at_once_on_the_right_and_not_on_the_left(exported):
    mosaic = VideoFrames(exported / "mosaic.mp4")
    half, first = mosaic.width // 2, [[], []]
    lit = np.array([[f[:, :half], f[:, half:]] for f in (mosaic[k] for k in range(len(mosaic)))]).astype(float)
    grid = (30 + (320 * 64 // 96 + 8) * np.array([0, 0, 1]) + 170, np.array([0, 1, 0]) * 328 + 168)
    for side in range(2):
        for y, x in zip(*grid, strict=True):
            bright = lit[:, side, y, x].mean(-1) > 180
            first[side].append(int(np.argmax(bright)))
    before, after = map(np.array, first)
    assert np.ptp(after) <= 1  # a frame: cameras are not in step
    assert np.ptp(before) >= 8


def test_the_timeline_holds_exact_offsets(exported, recording):
    document = json.loads((exported / "timeline.otio").read_text())
    assert document["OTIO_SCHEMA"] == "Timeline.1" and document["tracks"]["OTIO_SCHEMA"] == "Stack.1"
    begins = min(world(v)[0] for v in range(3))
    for v, track in enumerate(document["tracks"]["children"]):
        gap, clip = track["children"]
        assert track["name"] == clip["name"] == NAMES[v]
        length = gap["source_range"]["duration"]
        assert length["value"] / length["rate"] == pytest.approx(world(v)[0] - begins, abs=1e-4)
        assert clip["metadata"]["otsync"]["offset_seconds"] == OFFSETS[v]
        assert (exported / clip["media_references"]["DEFAULT_MEDIA"]["target_url"]).resolve() == recording / f"{v}.mp4"
        assert bool(clip["effects"]) == (RATES[v] != 1)


def test_fcpxml_has_whole_frames_and_the_exact_offsets(exported, recording):
    root = ElementTree.parse(exported / "timeline.fcpxml").getroot()

    def seconds(text: str) -> Fraction:
        return Fraction(text.removesuffix("s"))

    clips = root.findall(".//asset-clip")
    assert root.get("version") == "1.9" and [c.get("name") for c in clips] == list(NAMES)
    low = min(world(v)[0] for v in range(3))
    sources = {a.get("id"): a.find("media-rep").get("src") for a in root.findall(".//asset")}
    for v, clip in enumerate(clips):
        told = {md.get("key"): md.get("value") for md in clip.findall("metadata/md")}
        assert float(told["otsync.offset_seconds"]) == pytest.approx(OFFSETS[v])
        assert float(told["otsync.begins_seconds"]) == pytest.approx(world(v)[0] - low)
        begins = seconds(clip.get("offset"))
        assert (begins * 30).denominator == 1 and abs(float(begins) - (world(v)[0] - low)) <= 0.5 / FPS + 1e-9
        assert sources[clip.get("ref")] == (recording / f"{v}.mp4").resolve().as_uri()
        assert (clip.find("timeMap") is not None) == (RATES[v] != 1)


def test_rates_of_frames_are_those_of_editors():
    expected = {30: Fraction(1, 30), 30_000 / 1001: Fraction(1001, 30_000), 23.976: Fraction(1001, 24_000)}
    assert {fps: frame_length(fps) for fps in expected} == expected
    assert float(frame_length(12.34)) == pytest.approx(1 / 12.34, rel=1e-4)


def test_the_timeline_is_read_by_opentimelineio(exported):
    otio = pytest.importorskip("opentimelineio", reason="no OpenTimelineIO: pip install opentimelineio")
    timeline = otio.adapters.read_from_file(str(exported / "timeline.otio"))
    begins = [track[1].range_in_parent().start_time.to_seconds() for track in timeline.tracks]
    np.testing.assert_allclose(np.array(begins) - begins[0], [world(v)[0] - world(0)[0] for v in range(3)], atol=1e-4)
    assert [track[1].media_reference.target_url for track in timeline.tracks] == [f"../{v}.mp4" for v in range(3)]
    assert timeline.tracks[2][1].effects[0].time_scalar == pytest.approx(1 / RATES[2])


def test_images_become_sequences_in_the_timeline(tmp_path):
    from PIL import Image

    entries = []
    for v, name in enumerate("ab"):
        (tmp_path / name).mkdir()
        for k in range(6):
            Image.fromarray(picture(k, 0)).save(tmp_path / name / f"shot_{k + 7:04d}.png")
        camera = {"K": [[90, 0, 48], [0, 90, 32], [0, 0, 1]], "w2c": np.eye(4).tolist()}
        entries.append(
            {"name": name, "frames": f"{name}/*.png", "fps": 25 + v, "camera": camera | {"width": 96, "height": 64}}
        )
    (tmp_path / "scene.json").write_text(
        json.dumps({"format": "otsync.scene", "version": 1, "frame": "w", "videos": entries})
    )
    Offsets.known(("a", "b"), np.array([0, 0.05]), 25).save(tmp_path / "o.json")
    args = ["export", str(tmp_path), "--offsets", str(tmp_path / "o.json"), "--out", str(tmp_path / "out")]
    assert main([*args, "--what", "timeline", "clips"]) == 0
    media = json.loads((tmp_path / "out" / "timeline.otio").read_text())["tracks"]["children"][0]["children"][1]
    media = media["media_references"]["DEFAULT_MEDIA"]
    shown = {
        k: media[k] for k in ("target_url_base", "name_prefix", "name_suffix", "start_frame", "frame_zero_padding")
    }
    assert list(shown.values()) == ["../a/", "shot_", ".png", 7, 4]
    with av.open(str(tmp_path / "out" / "clips" / "a.mp4")) as container:
        assert not container.streams.audio


def test_nothing_is_replaced_unless_asked(exported, recording, capsys):
    args = ["export", str(recording), "--offsets", str(recording / "offsets.json"), "--out", str(exported)]
    before = (exported / "mosaic.mp4").stat().st_mtime_ns
    assert main([*args, "--what", "mosaic", "frames"]) == 2
    assert "exists already. Pass --force" in capsys.readouterr().err
    assert (exported / "mosaic.mp4").stat().st_mtime_ns == before
    assert main([*args, "--what", "frames", "--force", "--fps", "10"]) == 0
    rows = (exported / "frames.csv").read_text().splitlines()
    assert float(rows[2].split(",")[0]) - float(rows[1].split(",")[0]) == pytest.approx(0.1)
    main([*args, "--what", "frames", "--force"])


def test_videos_without_a_place_are_left_out_and_said(recording, tmp_path, capsys):
    known = Offsets.known(NAMES[:2], OFFSETS[:2], FPS)
    videos = aligned(open_scene(recording), known)
    assert [c.name for c in videos.clips] == list(NAMES[:2]) and videos.left_out == {NAMES[2]: "it has no offset"}
    known.save(tmp_path / "two.json")
    args = ["export", str(recording), "--offsets", str(tmp_path / "two.json"), "--out", str(tmp_path / "out")]
    assert main([*args, "--what", "frames"]) == 0
    assert "=late is left out: it has no offset" in capsys.readouterr().err
    assert main([*args, "--what", "frames", "--cameras", "left"]) == 2
    assert "expected two videos on one clock" in capsys.readouterr().err
    Offsets.known(NAMES, np.array([0, 9.0, 0]), FPS).save(tmp_path / "apart.json")
    args[3] = str(tmp_path / "apart.json")
    assert main([*args, "--what", "clips"]) == 2
    assert "left ends before right/../odd name begins" in capsys.readouterr().err


def test_names_become_file_names_that_differ():
    names = ["a/b", "a:b", "A_B", "..", "", "x" * 200]
    found = file_names(names, ".mp4")
    assert len({n.lower() for n in found}) == len(names)
    assert all("/" not in n and not n.startswith(".") and len(n) < 100 for n in found)
    assert len({e.name for e in EXPORTS}) == len(EXPORTS)
