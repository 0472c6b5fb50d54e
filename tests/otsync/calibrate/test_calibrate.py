"""Four tripods far apart and a walk past them: every camera, against the truth; without the walk, refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pycolmap")
pytest.importorskip("poselib")

from otsync.calibrate.clips import Clip, pinhole
from otsync.calibrate.document import calibrated_document
from otsync.calibrate.found import WALK
from otsync.calibrate.verb import CalibrateOptions, calibrate_clips
from otsync.calibrate.world import centres, degrees, laid_over
from otsync.cli import main
from otsync.files.cache import Cache
from otsync.files.strict import checked
from otsync.io.layout import SceneFile
from otsync.report.cameras import write_cameras
from otsync.simulate.phones import Hand, Tripod, Walk
from otsync.simulate.room import RoomCamera, draw_room
from otsync.types import Offsets

SIZE = (480, 270)
OPTIONS = CalibrateOptions(key_frames=14)


@pytest.fixture(scope="module")
def world() -> tuple[list[Clip], dict[str, np.ndarray], dict[str, float]]:
    """Clips, true poses and true focal lengths. Tripods give one picture each: their background."""
    rng = np.random.default_rng(5)
    room = draw_room(5, things=1)
    clips, poses, focal = [], {}, {}
    azimuths = np.radians([-120.0, -40, 40, 120])
    films = [(f"phone{n}", Tripod()(float(a), np.zeros(1), rng)[None], "scene") for n, a in enumerate(azimuths)]
    walk = Walk(float(azimuths[0]), float(azimuths[-1]), sway=0.03)
    films.append(("walk", walk(0.0, np.arange(14) / 0.7, rng), "walk"))
    for name, w2c, kind in films:
        focal[name] = SIZE[0] * rng.uniform(0.75, 0.95)
        K = pinhole(focal[name], SIZE, "given").K
        eye = RoomCamera(room, K, SIZE, rng)
        images = [eye.film(pose, 0.1 * k)[0] for k, pose in enumerate(w2c)]
        clips.append(Clip(name, {"name": name}, images, SIZE, 30.0, pinhole(0.85 * SIZE[0], SIZE, "guessed"), kind))
        poses[name] = w2c
    return clips, poses, focal


@pytest.fixture(scope="module")
def stages(tmp_path_factory) -> Cache:
    return Cache(tmp_path_factory.mktemp("stages"))


@pytest.fixture(scope="module")
def found(world, stages):
    return calibrate_clips(world[0], OPTIONS, cache=stages)


def test_every_camera_is_where_it_stood(world, found):
    _, poses, focal = world
    every = [*found.cameras, *found.helpers]
    a = np.concatenate([c.w2c.reshape(-1, 4, 4) for c in every])
    b = np.concatenate([poses[c.name] for c in every])
    moved = laid_over(a, b).camera(a)
    turn = degrees(moved[:, :3, :3] @ np.swapaxes(b[:, :3, :3], 1, 2))
    assert found.ok
    assert turn.max() < 0.5 and np.linalg.norm(centres(moved) - centres(b), axis=1).max() < 0.04
    for camera in found.cameras:
        assert camera.K[0, 0] == pytest.approx(focal[camera.name], rel=0.01)
        assert camera.lens == "found" and camera.inliers > 50 and camera.sigma_degrees < 1


def test_the_world_is_upright_and_of_a_usual_size(world, found):
    _, poses, _ = world
    a = np.concatenate([c.w2c.reshape(-1, 4, 4) for c in found.cameras])
    b = np.concatenate([poses[c.name] for c in found.cameras])
    up = laid_over(b, a).R @ np.array([0, -1.0, 0])  # the room has y down
    assert np.degrees(np.arccos(up[2])) < 5
    assert 2 < np.median(np.linalg.norm(centres(a), axis=1)) < 4.5


def test_a_known_distance_gives_metres(world, found, stages):
    """And the same cameras: a second run takes up what the first kept."""
    clips, poses, _ = world
    true = float(np.linalg.norm(centres(poses["phone0"][0]) - centres(poses["phone2"][0])))
    metric = calibrate_clips(clips, replace(OPTIONS, distance=("phone0.mp4", "phone2", true)), cache=stages)
    assert [c.K[0, 0] for c in metric.cameras] == [c.K[0, 0] for c in found.cameras]
    ends = [metric[name].places[0] for name in ("phone1", "phone3")]
    want = np.linalg.norm(centres(poses["phone1"][0]) - centres(poses["phone3"][0]))
    assert metric.unit == "metres" and np.linalg.norm(ends[0] - ends[1]) == pytest.approx(want, rel=0.02)


def test_the_document_is_sound_and_names_every_camera(world, found, tmp_path):
    clips, _, _ = world
    before = {"videos": [{**clip.entry, "file": f"{clip.name}.mp4"} for clip in clips], "missing": ["phone0: camera.K"]}
    told = calibrated_document(before, found)
    checked(told, SceneFile, "scene.json")
    assert [video["name"] for video in told["videos"]] == [f"phone{n}" for n in range(4)]
    assert "missing" not in told and told["calibration"]["cameras"]["phone1"]["lens"] == "found"
    write_cameras(tmp_path / "page.html", found)
    page = (tmp_path / "page.html").read_text()
    assert "4 of 4" in page and page.count("<svg") == 3


@pytest.mark.slow
def test_a_lens_that_is_given_is_held_while_the_others_are_found(world):
    clips, poses, focal = world
    known = replace(clips[0], lens=pinhole(focal["phone0"], SIZE, "given"))
    some = calibrate_clips([known, *clips[1:]], OPTIONS)
    assert some["phone0"].K[0, 0] == focal["phone0"] and some["phone0"].lens == "given"
    assert some.ok and [some[f"phone{n}"].lens for n in (1, 2, 3)] == ["found"] * 3
    moved = np.stack([some[f"phone{n}"].w2c for n in range(4)])
    true = np.stack([poses[f"phone{n}"][0] for n in range(4)])
    again = laid_over(moved, true).camera(moved)
    assert degrees(again[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)).max() < 0.5


def test_without_the_walk_far_cameras_are_refused_with_what_to_film(world, tmp_path):
    alone = calibrate_clips([clip for clip in world[0] if clip.kind == "scene"], replace(OPTIONS, width=300))
    assert not any(camera.ok for camera in alone.cameras)
    assert any(WALK in camera.remedy for camera in alone.cameras)
    write_cameras(tmp_path / "page.html", alone)
    assert "walk.mp4" in (tmp_path / "page.html").read_text()


def test_a_distance_between_nobody_is_refused(world):
    with pytest.raises(ValueError, match="--distance: expected two of phone0"):
        calibrate_clips(world[0], replace(OPTIONS, distance=("phone0", "me", 2.0)))


def test_a_distance_without_metres_is_refused_in_words(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["calibrate", "--distance", "a", "b", "c", str(tmp_path)])
    said = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert "expected two videos and the metres between them; found a b c" in said and "class" not in said


def test_bad_options_are_refused_by_name():
    for field, value in (("key_frames", 1), ("width", 10), ("seed", -1), ("distance", ("a", "b", 0.0))):
        with pytest.raises(ValueError, match="--" + field.replace("_", "-")):
            CalibrateOptions(**{field: value})


@pytest.mark.slow
@pytest.mark.parametrize("handheld", [False, True])
def test_from_videos_alone_to_offsets(handheld, tmp_path, capsys):
    """Issue: from uncalibrated phones to offsets within .15 frame."""
    film = ["film", str(tmp_path / "w"), "--frames", "90", "--seed", "31"]
    more = ["--handheld", "--phones", "4", "--gap", "40", "--walk", "0"] if handheld else ["--walk", "200"]
    assert main([*film, *more]) == 0
    truth = tmp_path / "w" / "truth.json"
    assert main(["sync", str(tmp_path / "w"), "--out", str(tmp_path / "s"), "--truth", str(truth)]) == 0
    assert "walk" not in json.loads((tmp_path / "w" / "scene.json").read_text())["calibration"]["cameras"]
    found, true = Offsets.load(tmp_path / "s" / "offsets.json"), Offsets.load(truth)
    assert np.abs(found.frames - true.frames)[1:].mean() < 0.15
    # once more, from what is kept, with a distance, and without it
    capsys.readouterr()
    measured = main(["calibrate", str(tmp_path / "w"), "--distance", "phone0", "phone1", "4.2"])
    if handheld:  # phones in hands have no one distance
        assert measured == 2 and "--distance: expected two static cameras" in capsys.readouterr().err
        return
    assert measured == 0
    assert "in metres" not in capsys.readouterr().err
    assert main(["calibrate", str(tmp_path / "w")]) == 0
    assert "the cameras were in metres" in capsys.readouterr().err


def test_hands_shake_and_tripods_do_not():
    rng = np.random.default_rng(0)
    times = np.arange(60) / 30
    still, held = Tripod()(0.5, times, rng), Hand()(0.5, times, rng)
    assert still.shape == (4, 4) and held.shape == (60, 4, 4)
    assert 0.01 < centres(held).std(0).max() < 0.3
