"""A ball as a witness of clocks: drawn balls with known clocks, wrong calibrations, hands, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from otsync.bench.rig import ball
from otsync.cli import main
from otsync.types import Camera, Offsets, Video

FPS, SIZE, RADIUS = 30.0, (160, 120), 0.2
TRUE = np.array([0.1, -0.25, 0.02, 0.13, 0.0])


def path(t: np.ndarray) -> np.ndarray:
    """Places (T,3) of the ball, m, at frames: it is thrown up and down, and swings."""
    return np.stack([0.5 * np.sin(t / 5), 0.4 * np.cos(t / 7), 0.3 * np.sin(t / 4 + 1)], -1)


def ring(count: int = 5) -> list[Camera]:
    cameras = []
    for turn in np.arange(count) * 2 * np.pi / count:
        forward = -np.array([np.cos(turn), 0.0, np.sin(turn)])
        right = np.cross([0.0, 1.0, 0.0], forward)
        R = np.stack([right, np.cross(forward, right), forward])
        w2c = np.eye(4)
        w2c[:3, :3], w2c[:3, 3] = R, R @ (3.5 * forward)
        K = np.array([[150.0, 0, SIZE[0] / 2 + 2], [0, 150.0, SIZE[1] / 2 - 1], [0, 0, 1]])
        cameras.append(Camera(K, w2c, *SIZE))
    return cameras


def drawn(camera: Camera, place: np.ndarray, fine: int = 4) -> np.ndarray:
    """A red ball over grey: every ray that passes the sphere is red; ``fine`` rays a pixel and axis."""
    local = camera.to_camera(place[None, None])[0, 0]
    far = np.linalg.norm(local)
    x0, y0 = (int(v) - 20 for v in camera.project(place[None, None])[0, 0])
    x, y = np.meshgrid(*(start + (np.arange(40 * fine) + 0.5) / fine for start in (x0, y0)))
    rays = np.stack([(x - camera.K[0, 2]) / camera.K[0, 0], (y - camera.K[1, 2]) / camera.K[1, 1], np.ones_like(x)], -1)
    inside = rays @ (local / far) > np.sqrt(1 - (RADIUS / far) ** 2) * np.linalg.norm(rays, axis=-1)
    share = np.zeros((SIZE[1] + 80, SIZE[0] + 80, 1))
    share[y0 + 40 : y0 + 80, x0 + 40 : x0 + 80, 0] = inside.reshape(40, fine, 40, fine).mean((1, 3))
    share = share[40:-40, 40:-40]
    return np.rint(share * np.array([190, 40, 50]) + (1 - share) * 128).astype(np.uint8)


@pytest.fixture(scope="module")
def videos() -> list[Video]:
    times = np.arange(60.0)
    return [
        Video([drawn(c, p) for p in path(times + late)], c, fps=FPS, name=f"cam{v}")
        for v, (c, late) in enumerate(zip(ring(), TRUE, strict=True))
    ]


@pytest.fixture(scope="module")
def seen(videos) -> ball.Centres:
    return ball.joined([ball.outlines(v) for v in videos])


def test_a_ball_tells_its_cameras_clocks(videos, seen):
    told = ball.witness([v.camera for v in videos], seen)
    error = told.frames - (TRUE - TRUE.mean())
    assert np.abs(error).max() < 0.01
    assert (np.abs(error) < 4 * told.sigma + 0.002).all() and told.sigma.max() < 0.02
    assert (told.seen >= 50).all() and told.residual < 0.15


def test_a_wrong_principal_point_moves_no_clock(videos, seen):
    """What is constant in the image is calibration; only what changes with the ball's motion is a clock."""
    cameras = [v.camera for v in videos]
    shifted = cameras[1].K + np.array([[0, 0, 1.5], [0, 0, -1.0], [0, 0, 0]])
    cameras[1] = replace(cameras[1], K=shifted)
    told = ball.witness(cameras, seen)
    assert np.abs(told.frames - (TRUE - TRUE.mean())).max() < 0.03


def test_the_middle_of_an_outline_is_not_the_centre_s_image():
    """Seen aslant, a ball's outline is an ellipse whose middle lies beyond, by its distance times sine squared."""
    camera = ring(1)[0]
    far = camera.to_world(np.array([[[x, 0.9, 3.0] for x in np.linspace(1.1, 1.25, 12)]]))[0]
    at = camera.project(far[:, None])[:, 0] - camera.K[:2, 2]
    found = np.array([ball.ball_in(drawn(camera, p, fine=8))[:2] for p in far]) - camera.K[:2, 2]
    distance = np.linalg.norm(at, axis=1)
    beyond = np.median(np.linalg.norm(found, axis=1) - distance)
    local = camera.to_camera(far[:, None])[:, 0]
    middle = ball.outline_middle(local, (RADIUS / np.linalg.norm(local, axis=1)) ** 2) * camera.K[0, 0]
    expected = np.median(np.linalg.norm(middle, axis=1) - distance)
    assert 0.2 < expected < 0.5 and beyond == pytest.approx(expected, abs=0.08)


def test_hands_and_edges(videos):
    whole = videos[0].frames[10]
    x, y, r = ball.ball_in(whole)
    covered = whole.copy()
    covered[:, : int(x - 0.4 * r)] = 128  # a hand before a third of it
    told = ball.ball_in(covered)
    assert told is None or np.hypot(told[0] - x, told[1] - y) < 0.5
    covered[:, : int(x + 0.3 * r)] = 128  # before most of it: a sickle is no ball
    assert ball.ball_in(covered) is None
    assert ball.ball_in(np.full_like(whole, 128)) is None
    square = np.full_like(whole, 128)
    square[40:80, 40:90] = (190, 40, 50)
    assert ball.ball_in(square) is None
    assert ball.ball_in(whole[:, int(x) :]) is None  # at the image's edge


def test_a_camera_that_sees_no_ball_has_no_answer_and_no_say(videos, seen):
    cameras = [v.camera for v in videos]
    told = ball.witness(cameras, seen.take((seen.camera != 2) | (seen.frame < 5)))
    others = [0, 1, 3, 4]
    assert np.isnan(told.frames[2]) and np.isnan(told.sigma[2]) and told.seen[2] == 5
    assert told.frames[others] == pytest.approx(TRUE[others] - TRUE[others].mean(), abs=0.01)


def test_a_ball_that_lies_still_tells_no_clock(videos):
    """What was drawn is far from the truth, and says so."""
    rng = np.random.default_rng(3)
    cameras = [v.camera for v in videos]
    uv = np.concatenate([c.project(path(np.full((60, 1), 3.0)))[:, 0] for c in cameras])
    n = len(cameras)
    still = ball.Centres(
        np.repeat(np.arange(n), 60),
        np.tile(np.arange(60), n),
        uv + 0.1 * rng.standard_normal(uv.shape),
        np.ones(60 * n) * 8,
    )
    try:
        told = ball.witness(cameras, still)
    except ValueError as error:
        assert "within 1 frame" in str(error)
    else:
        assert told.sigma.max() > 0.2
        assert (np.abs(told.frames - (TRUE - TRUE.mean())) < 3 * told.sigma + 0.01).all()


def test_what_is_refused(videos, seen):
    cameras = [v.camera for v in videos]
    moving = [replace(cameras[0], w2c=np.repeat(cameras[0].w2c[None], 60, 0)), *cameras[1:]]
    with pytest.raises(ValueError, match="expected static cameras"):
        ball.witness(moving, seen)
    with pytest.raises(ValueError, match="that three cameras see at one place in 20 frames or more; 0 do"):
        ball.witness(cameras, seen.take(seen.camera < 2))
    off = replace(seen, frame=seen.frame + (seen.camera == 1))
    with pytest.raises(ValueError, match="within 1 frame of each other; the ball says 1"):
        ball.witness(cameras, off)
    far = ball.witness(cameras, replace(seen, frame=seen.frame + 5 * (seen.camera == 1)))
    others = [0, 2, 3, 4]  # one that sees the ball elsewhere has no answer; those that agree have theirs
    assert np.isnan(far.frames[1])
    assert far.frames[others] == pytest.approx(TRUE[others] - TRUE[others].mean(), abs=0.01)


def test_answers_are_held_against_the_ball(videos, tmp_path, capsys):
    from PIL import Image

    entries = []
    for video in videos:
        (tmp_path / video.name).mkdir()
        for k, image in enumerate(video.frames):
            Image.fromarray(image).save(tmp_path / video.name / f"{k:04d}.png")
        c = video.camera
        camera = {"K": c.K.tolist(), "w2c": c.w2c.tolist(), "width": c.width, "height": c.height}
        entries.append({"name": video.name, "frames": f"{video.name}/*.png", "fps": FPS, "camera": camera})
    scene = {"format": "otsync.scene", "version": 1, "frame": "world", "videos": entries}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    names = [v.name for v in videos]
    Offsets.known(names, (TRUE - TRUE[0]) / FPS, FPS).save(tmp_path / "right.json")
    Offsets.known(names, np.zeros(len(names)), FPS).save(tmp_path / "said.json")
    out = tmp_path / "out"
    against = ["--against", str(tmp_path / "right.json"), str(tmp_path / "said.json")]
    assert main(["bench", "ball", str(tmp_path), "--out", str(out), *against]) == 0
    assert "cam1" in capsys.readouterr().out
    truth = Offsets.load(out / "ball_offsets.json")
    assert truth.seconds * FPS == pytest.approx(TRUE - TRUE[0], abs=0.015)
    right, said = json.loads((out / "ball_against.json").read_text())["rows"]
    assert right["mean, beside the ball"] < 0.01 < 0.05 < said["mean, beside the ball"]
    assert right["correlation"] > 0.99 and said["mean, beside 0"] == 0 and said["correlation"] is None
    Offsets.known(names[:2], np.zeros(2), FPS).save(tmp_path / "few.json")
    assert main(["bench", "ball", str(tmp_path), "--out", str(out), "--against", str(tmp_path / "few.json")]) == 2
    assert "expected offsets of three cameras that the ball tells of; found 2" in capsys.readouterr().err
    entries[0]["fps"] = 25.0
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    assert main(["bench", "ball", str(tmp_path), "--out", str(out)]) == 2
    assert "expected videos of one frame rate; found 25, 30 fps" in capsys.readouterr().err
