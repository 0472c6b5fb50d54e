"""Every finding of the check, made on purpose; and silence on a sound scene."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from otsync.io.document import FORMAT, VERSION
from otsync.recordings.check import FROM_OPENGL, READINGS, check_scene, flip
from tests.recording_world import ring


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("scene")
    videos = []
    for n, camera in enumerate(ring(4, width=32, height=18)):
        (folder / f"c{n}").mkdir()
        (folder / f"d{n}").mkdir()
        for k in range(50):
            Image.fromarray(np.full((18, 32, 3), 5 * k, np.uint8)).save(folder / f"c{n}" / f"{k:02d}.jpg")
            Image.fromarray(np.full((18, 32), 3300, np.uint16)).save(folder / f"d{n}" / f"{k:02d}.png")
        told = {"K": camera.K.tolist(), "w2c": camera.w2c.tolist(), "width": 32, "height": 18}
        depth = {"frames": f"d{n}/*.png", "scale": 0.001}
        videos.append({"name": f"c{n}", "frames": f"c{n}/*.jpg", "fps": 30, "camera": told, "depth": depth})
    return folder, {"format": FORMAT, "version": VERSION, "videos": videos}


def findings(sound, change=None) -> list:
    folder, document = sound
    document = copy.deepcopy(document)
    if change is not None:
        change(document["videos"])
    (folder / "scene.json").write_text(json.dumps(document))
    return check_scene(folder)


def text(found) -> str:
    return " | ".join(f"{f.severity} {f.video}: {f.what} {f.remedy}" for f in found)


def test_a_sound_scene_has_no_findings(sound):
    assert findings(sound) == []


def test_a_video_that_players_turn_is_told(tmp_path, sound):
    _, document = sound
    for name, turned in (("level", 0), ("upside", 180)):
        with av.open(str(tmp_path / f"{name}.mp4"), "w") as out:
            stream = out.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = 32, 18, "yuv420p"
            stream.set_display_rotation(turned)
            for k in range(50):
                image = np.full((18, 32, 3), 5 * k, np.uint8)
                out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            out.mux(stream.encode())
    videos = [
        {"name": n, "file": f"{n}.mp4", "camera": document["videos"][v]["camera"]}
        for v, n in enumerate(("level", "upside"))
    ]
    told = [f for f in findings((tmp_path, document | {"videos": videos})) if "players" in f.what]
    assert [(f.severity, f.video) for f in told] == [("warning", "upside")] and "by 180 degrees" in told[0].what
    document = document | {"videos": videos, "calibration": {"method": "global", "unit": "metres", "cameras": {}}}
    assert not [f for f in findings((tmp_path, document)) if "players" in f.what]


def each_pose(videos, function):
    for v in videos:
        v["camera"]["w2c"] = function(np.array(v["camera"]["w2c"])).tolist()


def test_the_mirrored_camera_to_world_trap(sound):
    mirror = np.diag([1.0, 1, -1, 1])

    def change(videos):
        each_pose(videos, lambda m: np.linalg.inv(m) @ mirror)

    found = findings(sound, change)
    assert any(f.severity == "error" and "det(R) = -1" in f.what and "invert" in f.remedy for f in found)


@pytest.mark.parametrize("told", READINGS)
def test_readings_of_mirrored_matrices_do_what_they_say(sound, told):
    """The remedy that is printed gives back the poses of the scene, once it is the one that was spoilt."""
    _, document = sound
    true = [np.array(video["camera"]["w2c"]) for video in document["videos"]]
    row = int(told[-1]) if "row" in told else int(told.split(",")[0][-1])
    spoil = (lambda m: flip(row) @ m) if "row" in told else (lambda m: np.linalg.inv(m) @ flip(row))
    for m in true:
        np.testing.assert_allclose(READINGS[told](spoil(m)), m, atol=1e-9)
    found = findings(sound, lambda videos: each_pose(videos, spoil))
    assert any("det(R) = -1" in f.what and told in f.remedy for f in found), text(found)


def test_mirrored_matrices_that_fit_nothing_are_said_to(sound):
    def change(videos):
        for n, v in enumerate(videos):
            angle = 1.7 * n
            turn = np.eye(4)
            turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            v["camera"]["w2c"] = (flip(2) @ turn[[1, 2, 0, 3]] @ np.array(v["camera"]["w2c"])).tolist()

    assert any("No reading" in f.remedy for f in findings(sound, change))


def test_a_principal_point_that_no_resizing_explains_is_a_warning(sound):
    """A public laboratory recording is calibrated so, and synchronises."""
    found = findings(sound, lambda v: set_camera(v, "K", [[26, 0, 0.5], [0, 26, 25], [0, 0, 1]]))
    assert [f.severity for f in found if "principal point" in f.what] == ["warning"], text(found)


@pytest.mark.parametrize(
    ("spoil", "remedy"),
    [
        (lambda m: np.linalg.inv(m), "camera-to-world matrices: invert"),
        (lambda m: FROM_OPENGL @ m, "negate rows 1 and 2"),
        (lambda m: np.linalg.inv(m) @ FROM_OPENGL, "negate columns 1 and 2"),
    ],
)
def test_poses_in_another_convention_are_recognised(sound, spoil, remedy):
    found = findings(sound, lambda videos: each_pose(videos, spoil))
    assert any(f.severity == "error" and remedy in f.remedy for f in found), text(found)


def set_camera(videos, key, value):
    videos[1]["camera"][key] = value


def in_whole_numbers(videos):
    """The first video's pose, both made whole numbers: as an int here, as a float there."""
    pose = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    videos[0]["camera"]["w2c"] = np.array(pose, float).tolist()
    return pose


@pytest.mark.parametrize(
    ("change", "severity", "words"),
    [
        (lambda v: set_camera(v, "K", [[460, 0, 320], [0, 460, 180], [0, 0, 1]]), "error", "another resolution"),
        (lambda v: set_camera(v, "K", [[3.6, 0, 16], [0, 3.6, 9], [0, 0, 1]]), "warning", "millimetres"),
        (lambda v: set_camera(v, "width", 64), "error", "32 x 18"),
        (lambda v: set_camera(v, "w2c", None), "error", "w2c is missing"),
        (lambda v: set_camera(v, "w2c", np.array(v[1]["camera"]["w2c"]).T.tolist()), "error", "transpose"),
        (lambda v: v[1].update(depth={"frames": "d1/*.png", "scale": 1}), "error", "times 0.001"),
        (lambda v: v[1].update(frames="nowhere/*.jpg"), "error", "no files"),
        (lambda v: v[1].update(range=[0, 20], depth=None), "warning", "few"),
        (lambda v: v[1].update(name="c0"), "error", "2 videos have this name"),
        (lambda v: set_camera(v, "w2c", v[0]["camera"]["w2c"]), "error", "stands where that of c0 stands"),
        (lambda v: set_camera(v, "w2c", in_whole_numbers(v)), "error", "stands where that of c0 stands"),
        (lambda v: v[1].update(name=" \u200b"), "error", "blank"),
        (lambda v: v[1].update(name="C0"), "warning", "reads like 'c0'"),
        (lambda v: v[1].update(frames="c0/*.jpg"), "error", "made of files that c0 is made of"),
        (lambda v: set_camera(v, "width", 160.9), "error", "videos[1].camera.width (of 'c1'): expected a whole number"),
        (lambda v: v[1].update(nmae="x"), "error", "Did you mean 'name'?"),
        (lambda v: set_camera(v, "readout", 20.0), "error", "phones: 0.005 to 0.03"),
        (lambda v: v[1].update(fps=25, timestamps=[k / 30 for k in range(50)]), "error", "25"),
    ],
)
def test_each_fault_is_found_and_named(sound, change, severity, words):
    found = findings(sound, change)
    assert any(f.severity == severity and words in f"{f.what} {f.remedy}" for f in found), text(found)


def test_slips_of_several_videos_are_all_found_and_the_sound_ones_are_still_checked(sound):
    def change(videos):
        videos[0]["fps"] = True
        videos[1]["name"] = None
        set_camera(videos[1:], "K", [[460, 0, 320], [0, 460, 180], [0, 0, 1]])

    found = text(findings(sound, change))
    assert "videos[0].fps" in found and "videos[1].name" in found and "another resolution" in found


def test_a_scaled_pose_is_found(sound):
    def change(videos):
        m = np.array(videos[2]["camera"]["w2c"])
        m[:3, :3] *= 2
        videos[2]["camera"]["w2c"] = m.tolist()

    assert any("no rotation" in f.what and f.video == "c2" for f in findings(sound, change))


def test_one_camera_that_looks_elsewhere_is_a_warning(sound):
    def change(videos):
        m = np.array(videos[2]["camera"]["w2c"])
        turn = np.diag([-1.0, 1, -1, 1])
        videos[2]["camera"]["w2c"] = (turn @ m).tolist()

    found = findings(sound, change)
    assert any(f.severity == "warning" and f.video == "c2" and "others look" in f.what for f in found), text(found)


def test_what_calibrate_said_of_a_camera_is_said_again(sound):
    folder, document = sound
    told = {"lens": "given", "doubtful": "two pictures only.", "remedy": "Walk past it."}
    calibration = {"method": "global", "unit": "metres", "cameras": {"c1": told, "c2": {"lens": "given"}}}
    (folder / "scene.json").write_text(json.dumps({**document, "calibration": calibration}))
    (found,) = check_scene(folder)
    assert (found.severity, found.video) == ("warning", "c1")
    assert found.what == "its camera is doubtful: two pictures only." and found.remedy == "Walk past it."


@pytest.mark.parametrize("turned", [0.0, 0.2, 5.0])
def test_cameras_that_look_in_parallel_are_a_warning_that_says_so(sound, turned):
    """Side by side they are sound; where their axes meet says nothing. Turned outwards they do look away."""

    def change(videos):
        for n, video in enumerate(videos):
            angle = np.radians(turned) * (n - 1.5)
            c, s = np.cos(angle), np.sin(angle)
            m = np.eye(4)
            m[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
            m[:3, 3] = m[:3, :3] @ [-n, 0, 0]
            video["camera"]["w2c"] = m.tolist()

    found = findings(sound, change)
    if turned < 5:
        assert [f.severity for f in found] == ["warning"] and "in parallel" in found[0].what, text(found)
    else:
        assert any(f.severity == "error" and "common volume" in f.what for f in found), text(found)


def test_truncated_and_missing_files_are_counted(sound):
    folder, _ = sound
    path = folder / "c3" / "07.jpg"
    whole = path.read_bytes()
    try:
        path.write_bytes(whole[:200])
        found = findings(sound)
        assert any(f.video == "c3" and "1 of 50 frames" in f.what and "07.jpg" in f.what for f in found), text(found)
        path.write_bytes(b"")
        assert any(f.video == "c3" and f.severity == "error" for f in findings(sound))
    finally:
        path.write_bytes(whole)


def test_a_file_that_is_no_scene_is_a_finding(tmp_path):
    (tmp_path / "scene.json").write_text("{")
    assert check_scene(tmp_path)[0].severity == "error"
    assert check_scene(tmp_path / "nowhere")[0].severity == "error"


def test_the_papers_scene_is_sound(data):
    assert [f for f in check_scene(data / "panoptic_basketball", every_frame=False) if f.severity == "error"] == []


def test_findings_say_which_video_of_the_file_and_that_files_lie_outside(sound):
    def elsewhere(videos):
        videos[2]["frames"] = "../c2/*.jpg"

    (found,) = [f for f in findings(sound, elsewhere) if f.video == "c2"]
    assert "videos[2] (c2)" in found.what and "points outside" in found.what
