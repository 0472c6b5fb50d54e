"""The recon command: every verb on one small recording, what it refuses, and that a killed run continues."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
from PIL import Image

from otsync.cli import main as otsync
from otsync.files.arrays import read_npz
from otsync.io import open_scene
from otsync.types import Offsets, TrackSet
from recon.cli import main
from recon.pipeline.intake import only
from recon.result.folder import load_result
from recon.scene.gaussians4d import Gaussians4D
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture
from tests.plugins.outside import KINDS_OF_SCENES, OF_SCENES, file_with
from tests.recon.pipeline.test_pipeline import same_files
from tests.recon.worlds import FRAMES, SIZE, capture, filmed_anew, write_world

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("world"))


def fit(world: Path, out: Path, *more: str, steps: int = 30) -> int:
    return main(
        [
            "fit",
            str(world),
            "--offsets",
            str(world / "start.json"),
            "--out",
            str(out),
            "--width",
            str(SIZE[0]),
            "--steps",
            str(steps),
            "--backdrop-steps",
            "60",
            *more,
        ]
    )


@pytest.fixture(scope="module")
def result(world, tmp_path_factory):
    out = tmp_path_factory.mktemp("result")
    assert fit(world, out, "--held-out", "held0", "--truth", str(world / "truth.json")) == 0
    return out


def test_fit_writes_offsets_scene_metrics_and_report(world, result, tmp_path, capsys):
    shutil.copytree(result, tmp_path / "again")
    assert fit(world, tmp_path / "again", "--held-out", "held0", "--truth", str(world / "truth.json")) == 0
    told = capsys.readouterr()
    assert "before" in told.out and "error" in told.out and "cam1" in told.out and "held out" in told.out
    assert "LPIPS is left out: no weights given" in told.out and "fit:" in told.err
    assert same_files(result, tmp_path / "again")
    assert Offsets.load(result / "offsets.json").names == ("cam0", "cam1", "cam2")
    run = json.loads((result / "run.json").read_text())
    assert run["options"]["width"] == SIZE[0] and {"reading", "footage", "fit", "views"} <= run["seconds"].keys()


def test_a_fit_is_shown_as_it_goes_on_and_ends_the_same(world, result, tmp_path, capsys, monkeypatch):
    pytest.importorskip("viser", reason="no viser: pip install 'otsync[view]'")
    from recon.view.window import Window

    shown, show = [], Window.show
    monkeypatch.setattr(Window, "show", lambda window, *a: (shown.append((window.address, a[-1])), show(window, *a)))
    assert fit(world, tmp_path / "v", "--held-out", "held0", "--truth", str(world / "truth.json"), "--view") == 0
    addresses, words = {a for a, _ in shown}, [w for _, w in shown]
    assert len(addresses) == 1 and addresses.pop() in capsys.readouterr().err
    assert len(words) >= 2 and len(set(words)) == len(words)
    for name in ("offsets.json", "scene.npz"):  # to look at it changes nothing
        assert (tmp_path / "v" / name).read_bytes() == (result / name).read_bytes()


def test_a_camera_is_rendered_to_images_and_to_a_video(result, tmp_path):
    assert (
        main(["render", str(result), "--camera", "held0", "--times", "0.1", "0.3", "--out", str(tmp_path / "im")]) == 0
    )
    images = [np.asarray(Image.open(p)) for p in sorted((tmp_path / "im").iterdir())]
    assert [i.shape for i in images] == [(SIZE[1], SIZE[0], 3)] * 2
    filmed = capture().held_out[0].images[[3, 9]].astype(float)
    for image, true, other in zip(images, filmed, filmed[::-1], strict=True):
        assert ((image - true) ** 2).mean() < ((image - other) ** 2).mean()  # the right moment, not only the place
    assert main(["render", str(result), "--camera", "cam1", "--out", str(tmp_path / "v.mp4"), "--width", "48"]) == 0
    with av.open(str(tmp_path / "v.mp4")) as video:
        frames = [f.to_ndarray(format="rgb24") for f in video.decode(video=0)]
    # the world's span: from the earliest camera's first frame to the latest one's last
    low, high = load_result(result).scene.span
    assert len(frames) == int((high - low) * 30 + 1e-6) + 1 >= FRAMES and frames[0].shape == (32, 48, 3)


def test_every_camera_is_rendered_at_the_same_moments_between_frames(result, tmp_path, capsys):
    moments = ["--times", "0.1167", "0.2833"]  # half a frame beside those that were filmed
    args = ["render", str(result), "--every-camera", *moments, "--out", str(tmp_path / "s" / "{camera}")]
    assert main(args) == 0
    names = [v.name for v in load_result(result).videos]
    assert sorted(p.name for p in (tmp_path / "s").iterdir()) == sorted(names)
    for name in names:
        alone = tmp_path / f"{name} alone"
        assert main(["render", str(result), "--camera", name, *moments, "--out", str(alone)]) == 0
        for file in ("00000.png", "00001.png"):
            assert (alone / file).read_bytes() == (tmp_path / "s" / name / file).read_bytes()
    whole = ["render", str(result), "--every-camera", "--fps", "60", "--width", "48"]
    assert main([*whole, "--out", str(tmp_path / "v {camera}.mp4")]) == 0
    counts = set()
    for name in names:
        with av.open(str(tmp_path / f"v {name}.mp4")) as video:
            counts.add(sum(1 for _ in video.decode(video=0)))
    low, high = load_result(result).scene.span
    assert counts == {int((high - low) * 60 + 1e-6) + 1}


def test_a_path_goes_around_a_frozen_moment(result, tmp_path):
    args = ["render", str(result), "--path", "orbit", "--times", "0.2", "--frames", "5", "--out", str(tmp_path / "o")]
    assert main(args) == 0
    images = [np.asarray(Image.open(p)).astype(float) for p in sorted((tmp_path / "o").iterdir())]
    assert len(images) == 5 and all(np.abs(a - b).mean() > 1 for a, b in pairwise(images))


def test_exports_are_written_where_asked(result, tmp_path, capsys):
    for kind, name in (("ply", "a.ply"), ("splat", "a.splat"), ("tracks", "t.npz"), ("checkpoint", "c.npz")):
        at = ["--at", "0.2"] if kind in ("ply", "splat") else []
        assert main(["export", str(result), "--format", kind, *at, "--out", str(tmp_path / name)]) == 0
        assert (tmp_path / name).stat().st_size > 1000
    assert len(TrackSet.load(tmp_path / "t.npz")) == len(load_result(result).scene)
    one, two = read_npz(tmp_path / "c.npz"), read_npz(result / "scene.npz")
    assert all(np.array_equal(one[k], two[k]) for k in two)
    assert main(["export", str(result), "--format", "ply-sequence", "--fps", "10", "--out", str(tmp_path / "s")]) == 0
    assert len(list((tmp_path / "s").glob("*.ply"))) == 5
    assert main(["export", str(result), "--format", "tracks", "--at", "0.1"]) == 2
    assert "--at" in capsys.readouterr().err


def test_eval_repeats_the_figures_of_the_run(world, result, tmp_path, capsys):
    out = tmp_path / "eval.json"
    assert main(["eval", str(result), str(world), "--truth", str(world / "truth.json"), "--out", str(out)]) == 0
    assert "offset error: mean" in capsys.readouterr().out
    told, before = json.loads(out.read_text()), json.loads((result / "metrics.json").read_text())
    assert told["held_out"] == before["held_out"]
    assert told["offset_error"] == before["offset_error"]
    assert main(["eval", str(result), str(world), "--held-out", "cam1", "--views", "2", "--out", str(out)]) == 0
    assert json.loads(out.read_text())["views"][0]["held_out"] is False


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["render", "RESULT", "--out", "x.mp4"], "--camera, --every-camera, --path: expected one of them"),
        (["render", "RESULT", "--camera", "cam0", "--every-camera"], "--every-camera, --path: expected one of them"),
        (["render", "RESULT", "--every-camera", "--out", "x.mp4"], "--out: expected {camera} in it"),
        (["render", "RESULT", "--camera", "cam0", "--out", "{camera}.mp4"], "--out: expected {camera} in it"),
        (["render", "RESULT", "--camera", "cam9"], "expected one of cam0"),
        (["render", "RESULT", "--camera", "cam0", "--times", "99"], "which the videos cover"),
        (["render", "RESULT", "--camera", "cam0", "--out", "x.gif"], "expected .mp4"),
        (["render", "RESULT", "--camera", "cam0", "--width", "0"], "width: expected"),
        (["render", "RESULT", "--camera", "cam0", "--frames", "9"], "--frames: expected with --path"),
        (["render", "RESULT", "--camera", "cam0", "--turns", "2"], "--turns: expected with --path; found --camera"),
        (
            ["render", "RESULT", "--camera", "cam0", "--times", "0.1", "--fps", "9", "--out", "images"],
            "--fps: expected with a video in --out",
        ),
        (["export", "RESULT", "--format", "ply", "--fps", "9"], "--fps: expected with a format that holds frames"),
        (
            ["export", "RESULT", "--format", "checkpoint", "--at", "0"],
            "--at: expected with a format that holds one moment",
        ),
        (
            [
                "fit",
                "nowhere",
                "--offsets",
                "nowhere.json",
                "--exposure",
                "0.01",
                "--effects",
                "motion-blur:exposure=0.01",
            ],
            "exposure, effects: expected motion blur from one of them",
        ),
        (
            ["fit", "nowhere", "--offsets", "nowhere.json", "--losses", "photometric", "feature"],
            "losses, features: expected feature maps for Feature to compare with",
        ),
        (
            ["fit", "nowhere", "--offsets", "nowhere.json", "--losses", "photometric", "track", "densify:densify"],
            "losses, densify: expected one of Track and densification",
        ),
        (
            [
                "fit",
                "WORLD",
                "--offsets",
                "WORLD/start.json",
                "--effects",
                "rolling-shutter:bands=2",
                "--held-out",
                "held0",
            ],
            "readout: expected seconds, since no camera declares any",
        ),
        (
            ["bench", "WORLD", "--truth", "WORLD/truth.json", "--lengths", "3", "--steps", "3"],
            "lengths: expected without steps and budget",
        ),
        (
            ["bench", "WORLD", "--truth", "WORLD/truth.json", "--save-every", "3"],
            "save_every: expected in a single fit",
        ),
        (["render", "nowhere", "--camera", "cam0"], "expected a finished reconstruction"),
        (["export", "RESULT", "--format", "ply", "--at", "-4"], "which the videos cover"),
        (["eval", "RESULT", "WORLD", "--held-out", "cam9"], "expected some of"),
        (["render", "RESULT", "--path", "orbit", "--times", "0.1", "--frames", "-3"], "--frames: expected 1 to"),
        (["render", "RESULT", "--camera", "cam0", "--fps", "0"], "--fps: expected"),
        (["render", "RESULT", "--camera", "cam0", "--times", "0.1", "--fps", "-2"], "--fps: expected"),
        (["render", "RESULT", "--camera", "cam0", "--width", "16384"], "pixels each and"),
        (["export", "RESULT", "--format", "tracks", "--fps", "0"], "fps: expected frames per second above 0"),
        (["eval", "RESULT", "WORLD", "--views", "0"], "--views: expected at least 1"),
        (
            ["fit", "WORLD", "--offsets", "WORLD/start.json", "--budget", "0"],
            "budget: expected a finite number above 0",
        ),
        (
            ["fit", "WORLD", "--offsets", "WORLD/start.json", "--steps", "-1"],
            "steps: expected a whole number, 0 or more",
        ),
        (["fit", "WORLD", "--offsets", "nowhere.json"], "no such file"),
        (["fit", "WORLD", "--offsets", "WORLD/start.json", "--device", "gpu"], "device: expected 'cpu', 'cuda'"),
        (
            ["fit", "WORLD", "--offsets", "WORLD/start.json", "--device", "cuda:99"],
            "device: expected one of cpu",
        ),
        (
            ["bench", "WORLD", "--truth", "WORLD/truth.json", "--device", "cuda:99"],
            "device: expected one of cpu",
        ),
        (
            ["fit", "WORLD", "--offsets", "WORLD/start.json", "--device", "cpu:3"],
            "device: expected 'cpu', 'cuda' or 'cuda:N'; found 'cpu:3'",
        ),
        (["fit", "nowhere", "--offsets", "WORLD/start.json"], "nowhere"),
        # said before anything is read
        (
            ["fit", "nowhere", "--offsets", "nowhere.json", "--voxel", "nan"],
            "voxel: expected a finite number above 0; found nan",
        ),
        (
            ["fit", "nowhere", "--offsets", "nowhere.json", "--sh-degree", "5"],
            "sh_degree: expected a whole number, 0 to 4; found 5",
        ),
        (
            ["fit", "nowhere", "--offsets", "nowhere.json", "--batch", "0"],
            "batch: expected a whole number, 1 or more; found 0",
        ),
        (
            ["fit", "nowhere", "--offsets", "nowhere.json", "--width", "-4"],
            "width: expected a whole number, 1 or more; found -4",
        ),
        (
            ["fit", "nowhere", "--offsets", "nowhere.json", "--backdrop-steps", "-1"],
            "backdrop_steps: expected a whole number, 0 or more",
        ),
        (["fit", "nowhere", "--offsets", "nowhere.json", "--exposure", "nan"], "exposure: expected seconds"),
        (
            ["fit", "nowhere", "--offsets", "nowhere.json", "--budget", "nan"],
            "budget: expected a finite number above 0",
        ),
        (
            ["bench", "WORLD", "--truth", "WORLD/truth.json", "--sh-degree", "-1"],
            "sh_degree: expected a whole number, 0 to 4",
        ),
        (
            ["bench", "WORLD", "--truth", "WORLD/truth.json", "--voxel", "inf"],
            "voxel: expected a finite number above 0; found inf",
        ),
        (
            ["bench", "WORLD", "--truth", "WORLD/truth.json", "--batch", "0"],
            "batch: expected a whole number, 1 or more",
        ),
        (
            ["bench", "WORLD", "--truth", "WORLD/truth.json", "--lengths", "9", "-9"],
            "lengths: expected a whole number, 0 or more; found -9",
        ),
        (
            ["bench", "WORLD", "--truth", "WORLD/truth.json", "--budget", "0"],
            "budget: expected a finite number above 0",
        ),
        (["fit", "WORLD", "--offsets", "WORLD/start.json", "--steps", "3", "--budget", "4"], "expected one of them"),
        (["fit", "WORLD", "--offsets", "WORLD/start.json", "--frames", "50", "60"], "expected first < stop"),
        (["fit", "WORLD", "--offsets", "WORLD/start.json", "--held-out", "cam0"], "the reference (cam0)"),
        (
            ["fit", "WORLD", "--offsets", "WORLD/start.json", "--freeze", "nothing", "--held-out", "held0"],
            "freeze: expected",
        ),
    ],
)
def test_bad_arguments_exit_with_two_and_say_what_was_expected(
    world, result, tmp_path, monkeypatch, capsys, args, says
):
    monkeypatch.chdir(tmp_path)
    swapped = [a.replace("RESULT", str(result)).replace("WORLD", str(world)) for a in args]
    code = exit_code(main, swapped)
    told = " ".join(capsys.readouterr().err.split())
    assert code == 2, told
    assert says in told and "Traceback" not in told
    assert not (tmp_path / "bench").exists(), "refused after the work"


def exit_code(command, args: list[str]) -> int:
    """What the shell would see: a mistake in an option may end the process."""
    try:
        return command(args)
    except SystemExit as stop:
        return int(stop.code)


def test_a_damaged_result_is_named(result, tmp_path, capsys):
    for name in ("run.json", "scene.npz", "offsets.json"):
        folder = tmp_path / name
        shutil.copytree(result, folder)
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: len(whole) // 2])
        assert main(["export", str(folder)]) == 2
        assert name in capsys.readouterr().err
    run = json.loads((result / "run.json").read_text())
    run["videos"][0]["gain"] = ["red"]
    shutil.copytree(result, tmp_path / "odd")
    (tmp_path / "odd" / "run.json").write_text(json.dumps(run))
    assert main(["render", str(tmp_path / "odd"), "--camera", "cam0"]) == 2
    assert "run.json: videos[0].gain (of 'cam0'): expected a list" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("where", "value"),
    [
        (("options",), {}),
        (("options", "width"), 0),
        (("options", "width"), "320"),
        (("options", "optics"), 3),
        (("options", "optics"), [{"name": "no-such-effect"}]),
        (("videos", 0, "optics"), [{"name": "motion-blur", "exposure": -1}]),
        (("videos", 0, "optics"), [{"name": "motion-blur", "exposure": "long"}]),
        (("videos", 0, "optics"), [{"name": "motion-blur", "shutter": 0.1}]),
        (("options", "frames"), 5),
        (("options", "frames"), [4]),
        (("options", "frames"), [4, "x"]),
        (("videos", 0, "camera", "width"), 2_000_000),
        (("videos", 0, "camera", "height"), 2_000_000),
        (("videos", 0, "camera", "width"), float("inf")),
        (("videos", 0, "clock", "known"), "guess"),
        (("videos", 0, "clock", "known"), ["given"]),
        (("videos", 0, "clock", "offset_seconds"), float("nan")),
        (("videos", 0, "clock", "rate"), 0),
    ],
)
def test_a_strangers_run_json_is_refused_when_it_makes_no_sense(result, tmp_path, where, value):
    document = json.loads((result / "run.json").read_text())
    part = document
    for key in where[:-1]:
        part = part[key]
    part[where[-1]] = value
    for name in ("scene.npz", "offsets.json"):
        shutil.copy(result / name, tmp_path / name)
    (tmp_path / "run.json").write_text(json.dumps(document))
    with pytest.raises(
        ValueError, match=r"run\.json: (not a sound reconstruction|videos\[0\]\..*: expected .*; found )"
    ):
        load_result(tmp_path)


def test_a_backdrop_that_diverges_and_a_package_that_lacks_are_said(world, tmp_path, monkeypatch, capsys):
    for error, code, says in (
        (FloatingPointError("backdrop: the loss is no number at step 3"), 1, "backdrop: the loss is no number"),
        (ModuleNotFoundError("No module named 'cv2'", name="cv2"), 2, "needs cv2. Install it"),
    ):

        def failing(*args, error=error, **kwargs):
            raise error

        monkeypatch.setattr("recon.pipeline.verb.prepare", failing)
        assert fit(world, tmp_path / "r") == code
        assert says in capsys.readouterr().err


def test_offsets_that_are_not_to_be_trusted_end_in_one(world, tmp_path, capsys):
    document = json.loads((world / "start.json").read_text())
    document["videos"][2] |= {"status": "weak", "flags": ["weak"]}
    document["videos"][1] |= {
        "offset_seconds": None,
        "offset_frames": None,
        "status": "no_match",
        "flags": ["no_match"],
    }
    (tmp_path / "o.json").write_text(json.dumps(document))
    code = main(
        [
            "fit",
            str(world),
            "--offsets",
            str(tmp_path / "o.json"),
            "--out",
            str(tmp_path / "r"),
            "--width",
            "96",
            "--backdrop-steps",
            "9",
            "--steps",
            "3",
            "--held-out",
            "held0",
        ]
    )
    told = capsys.readouterr().err
    assert code == 1 and "cam1 is left out" in told and "not to be trusted: cam2" in told
    assert load_result(tmp_path / "r").offsets.names == ("cam0", "cam2")


@pytest.mark.parametrize("refined", [True, False])
def test_a_start_that_is_only_coarse_is_judged_by_the_fit(world, tmp_path, capsys, refined):
    """Its sigma after the fit is below a third of a frame, or as before where clocks are held."""
    document = json.loads((world / "start.json").read_text())
    for video in document["videos"][1:]:
        video |= {"sigma_seconds": 0.5 / 30, "status": "coarse", "flags": ["coarse"]}
    (tmp_path / "o.json").write_text(json.dumps(document))
    args = ["fit", str(world), "--offsets", str(tmp_path / "o.json"), "--out", str(tmp_path / "r"), "--width", "96"]
    args += ["--backdrop-steps", "9", "--steps", "120", "--held-out", "held0"]
    code = main(args if refined else [*args, "--freeze", "offsets"])
    told = capsys.readouterr().err
    offsets = load_result(tmp_path / "r").offsets
    assert offsets.ok == refined
    assert (code, "not to be trusted" in told) == ((0, False) if refined else (1, True))


@pytest.mark.parametrize("as_json", [False, True])
def test_a_clock_that_the_fit_alone_doubts_is_told_and_exits_with_one(tmp_path, capsys, as_json):
    """Four frames are lost in the middle of cam3; the clocks it begins with say nothing of it."""
    capture = synthetic(5, cameras=5, held_out=0, frames=40, size=SIZE, offsets=0.0)
    world = tmp_path / "w"
    write_capture(filmed_anew(capture, 3, [*range(20), *range(24, 40)]), world)
    start = Offsets.known([f.name for f in capture.footage], [0.0, 0.0, 0.0, 2 / 30, 0.0], 30)
    replace(start, sigma=np.r_[0, np.full(4, 0.2 / 30)]).save(world / "start.json")
    tracks = [str(p) for p in sorted((world / "tracks").glob("*.npz"))]
    code = fit(world, tmp_path / "r", "--tracks", *tracks, *["--json"] * as_json, steps=150)
    told = capsys.readouterr()
    assert code == 1 and "cam3: broken_clock: Parts of the overlap" in told.err and "begun from" not in told.err
    if as_json:
        assert json.loads(told.out)["doubtful"] == ["cam3"]


def test_simulate_writes_a_recording_that_the_printed_command_fits(tmp_path, capsys):
    args = [
        "simulate",
        str(tmp_path / "w"),
        "--cameras",
        "2",
        "--held-out",
        "1",
        "--frames",
        "4",
        "--width",
        "48",
        "--height",
        "32",
        "--seed",
        "9",
    ]
    assert main(args) == 0
    told = capsys.readouterr().out
    assert "recon fit" in told and "--held-out held0" in told
    scene = open_scene(tmp_path / "w")
    assert scene.names == ("cam0", "cam1", "held0") and len(scene.videos[0].frames) == 4
    assert all(v.depth is not None for v in scene.videos) and scene.masks[2] is not None
    truth, start = Offsets.load(tmp_path / "w" / "truth.json"), Offsets.load(tmp_path / "w" / "start.json")
    assert truth.seconds[0] == 0 != truth.seconds[1] and not start.seconds.any()
    assert main(args) == 2
    assert "found scene.json" in capsys.readouterr().err


@pytest.mark.slow
def test_a_recording_with_default_options_can_be_synchronised(tmp_path):
    """The held-out camera too: what the README recommends to try everything on."""
    assert main(["simulate", str(tmp_path / "w")]) == 0
    args = ["sync", str(tmp_path / "w"), "--out", str(tmp_path / "s"), "--truth", str(tmp_path / "w" / "truth.json")]
    assert otsync(args) == 0
    offsets, truth = (Offsets.load(tmp_path / name) for name in ("s/offsets.json", "w/truth.json"))
    assert all(status.ok for status in offsets.status)
    assert np.abs(offsets.frames - truth.frames).max() < 0.5


def test_declared_readouts_and_given_exposures_reach_the_fit(tmp_path, monkeypatch, capsys):
    import recon.pipeline.verb
    from recon.observe.effects import Gain, MotionBlur, RollingShutter

    world, seen, fit = tmp_path / "w", [], recon.pipeline.verb.fit

    def spied(*args, **kwargs):
        seen.append(args[3].effects)
        return fit(*args, **kwargs)

    monkeypatch.setattr(recon.pipeline.verb, "fit", spied)
    looked, view = {}, recon.pipeline.verb.view

    def looking(scene, footage, *args, **kwargs):
        looked[footage.name] = kwargs["optics"]
        return view(scene, footage, *args, **kwargs)

    monkeypatch.setattr(recon.pipeline.verb, "view", looking)
    assert (
        main(
            [
                "simulate",
                str(world),
                "--cameras",
                "2",
                "--held-out",
                "1",
                "--frames",
                "6",
                "--width",
                "64",
                "--height",
                "40",
                "--readout",
                "0.02",
                "--exposure",
                "0.01",
                "--sheen",
                "0.2",
            ]
        )
        == 0
    )
    assert open_scene(world).videos[0].camera.readout == 0.02
    args = [
        "fit",
        str(world),
        "--offsets",
        str(world / "start.json"),
        "--out",
        str(tmp_path / "r"),
        "--width",
        "64",
        "--tracks",
        *map(str, sorted((world / "tracks").glob("*.npz"))),
        "--steps",
        "3",
        "--backdrop-steps",
        "9",
        "--held-out",
        "held0",
    ]
    assert main([*args, "--exposure", "0.01", "--sh-degree", "1"]) == 0
    assert [type(e) for e in seen[0]] == [MotionBlur, RollingShutter, Gain]
    assert seen[0][0].exposure == 0.01 and seen[0][1].readout == (0.02, 0.02)
    assert set(looked) == {"cam0", "cam1", "held0"}
    assert all([type(e) for e in through] == [MotionBlur, RollingShutter] for through in looked.values())
    result = load_result(tmp_path / "r")
    assert result.scene.dynamic.sh_degree == 1 and result.optics == (MotionBlur(0.01),)
    assert result.video("cam0").optics == (MotionBlur(0.01), RollingShutter(0.02))
    assert result.video("held0").optics == (MotionBlur(0.01), RollingShutter((0.02,)))
    told = json.loads((tmp_path / "r" / "metrics.json").read_text())
    assert main(["eval", str(tmp_path / "r"), str(world), "--out", str(tmp_path / "eval.json")]) == 0
    assert json.loads((tmp_path / "eval.json").read_text())["held_out"] == told["held_out"]
    assert main([*args, "--exposure", "20"]) == 2
    assert "exposure: expected seconds, no longer than a frame" in capsys.readouterr().err
    document = json.loads((world / "scene.json").read_text())
    document["videos"][0]["camera"]["readout"] = 20
    (world / "scene.json").write_text(json.dumps(document))
    for verb in (args, ["eval", str(tmp_path / "r"), str(world), "--held-out", "cam0"]):
        assert main(verb) == 2
        assert "camera.readout of 'cam0': expected seconds" in capsys.readouterr().err
    assert otsync(["sync", str(world), "--out", str(tmp_path / "s")]) == 2
    assert "camera.readout of 'cam0': expected seconds" in capsys.readouterr().err
    assert main(["simulate", str(tmp_path / "x"), "--noise", "nan"]) == 2
    assert main(["simulate", str(tmp_path / "x"), "--pace", "0"]) == 2
    assert "--noise" in capsys.readouterr().err


def test_every_help_has_an_example(capsys):
    for verb in ("fit", "render", "eval", "export", "simulate", "bench", "lifting"):
        with pytest.raises(SystemExit) as stop:
            main([verb, "--help"])
        assert stop.value.code == 0 and f"recon {verb}" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(SystemExit):
        otsync(["run", "--help"])
    assert "Example: otsync run" in " ".join(capsys.readouterr().out.split())


def test_options_of_parts_are_told_apart_by_the_part(capsys):
    """A scaffold and a seeding both have a reach."""
    with pytest.raises(SystemExit):
        main(["fit", "--help"])
    told = capsys.readouterr().out
    assert "--scaffold.reach" in told and "--voxel" in told and "--held-out" in told


def test_bench_writes_a_row_for_every_configuration(world, tmp_path, monkeypatch, capsys):
    args = [
        "bench",
        str(world),
        "--truth",
        str(world / "truth.json"),
        "--held-out",
        "held0",
        "--width",
        str(SIZE[0]),
        "--steps",
        "4",
        "--backdrop-steps",
        "5",
        "--rows",
        "ours",
        "true time",
        "--out",
        str(tmp_path),
    ]
    assert main(args) == 0
    rows = json.loads((tmp_path / "recon.json").read_text())["rows"]
    assert [r["configuration"] for r in rows] == ["ours", "true time"]
    assert rows[1]["start"] == 0 < rows[0]["start"] < 1
    assert [r["steps"] for r in rows] == [4, 4] and "<svg" in (tmp_path / "recon.svg").read_text()
    told = capsys.readouterr()
    assert "ours" in told.err
    # the paper's layout, with a column that says what is missing
    for text in (told.out, (tmp_path / "recon.md").read_text()):
        assert "otsync, unsync." in text and "LPIPS: no weights given." in text and f"{rows[0]['psnr']:.2f}" in text

    # again, with a row more: those that are there are kept
    def measured(name, *args, **kwargs):
        assert name == "fixed", "measured again"
        return {**rows[0], "configuration": name}

    monkeypatch.setattr("recon.bench.fits.measure", measured)
    assert main([*args[:-4], "ours", "fixed", "true time", "--out", str(tmp_path)]) == 0
    again = json.loads((tmp_path / "recon.json").read_text())["rows"]
    assert again[:2] == rows and [r["configuration"] for r in again] == ["ours", "true time", "fixed"]
    assert "2 rows are kept from an earlier run; 1 are to be measured" in capsys.readouterr().err
    # another protocol is neither mixed with them nor written over them
    assert main([*args, "--batch", "3"]) == 2
    assert "protocol differs: batch 2, now 3" in capsys.readouterr().err
    assert json.loads((tmp_path / "recon.json").read_text())["rows"] == again
    assert main([*args[:-4], "theirs", "--out", str(tmp_path)]) == 2
    assert "rows: expected some of ours" in capsys.readouterr().err


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_row_measured_on_a_gpu_tells_its_memory(world, tmp_path):
    pytest.importorskip("gsplat", reason="gsplat is not installed: pip install 'otsync[cuda]'")
    args = [
        "bench",
        str(world),
        "--truth",
        str(world / "truth.json"),
        "--held-out",
        "held0",
        "--width",
        str(SIZE[0]),
        "--steps",
        "40",
        "--backdrop-steps",
        "5",
        "--rows",
        "ours",
        "--device",
        "cuda",
        "--batch",
        "8",
    ]
    assert main([*args, "--out", str(tmp_path)]) == 0
    (row,) = json.loads((tmp_path / "recon.json").read_text())["rows"]
    assert 0 < row["gpu_gb"] < 20 and row["mean"] < row["start"] + 0.1 and row["psnr"] > 15


def command(world: Path, out: Path) -> list[str]:
    return [
        sys.executable,
        "-m",
        "recon.cli",
        "fit",
        str(world),
        "--offsets",
        str(world / "start.json"),
        "--out",
        str(out),
        "--width",
        str(SIZE[0]),
        "--backdrop-steps",
        "60",
        "--steps",
        "200",
        "--save-every",
        "0.5",
        "--held-out",
        "held0",
    ]


@pytest.mark.slow
def test_a_run_killed_at_any_moment_ends_with_the_same_files(world, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    began = time.monotonic()
    subprocess.run(command(world, tmp_path / "whole"), check=True, capture_output=True, env=environment, timeout=3600)
    whole = time.monotonic() - began
    rng = np.random.default_rng(int(time.time()))
    for n in range(2):
        out, killed = tmp_path / f"killed{n}", 0
        for _ in range(12):
            run = subprocess.Popen(command(world, out), stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment)
            try:
                code = run.wait(rng.uniform(0.3, 0.9) * whole if killed < 3 else 3600)
            except subprocess.TimeoutExpired:
                run.send_signal(signal.SIGKILL)
                code = run.wait()
            if code == 0 and killed:
                break
            if code == 0:  # the machine was busier before: sooner, and from the beginning
                shutil.rmtree(out)
                whole /= 2
                continue
            assert code == -signal.SIGKILL, run.stderr.read().decode()
            killed += 1
        assert killed and code == 0
        assert same_files(tmp_path / "whole", out)
        assert not [*out.glob(".*.part"), *(out / "stages").glob(".*.part")]  # what killed writers left is removed


@pytest.mark.slow
def test_ctrl_c_exits_with_130_and_says_how_to_go_on(world, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    args = [*command(world, tmp_path / "r")]
    args[args.index("200")] = "100000"
    run = subprocess.Popen(args, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment)
    deadline = time.monotonic() + 3600
    while not (tmp_path / "r" / "fit.npz").exists() and time.monotonic() < deadline:
        time.sleep(0.2)
    run.send_signal(signal.SIGINT)
    _, told = run.communicate(timeout=3600)
    assert run.returncode == 130 and b"continues from here" in told and b"Traceback" not in told


@pytest.mark.slow  # an installed package is tested every time (tests/plugins/test_other_kinds.py)
def test_a_loss_an_effect_and_a_format_of_one_file_are_found_by_every_command(world, tmp_path):
    """In the help, in a fit, in its run.json and in the evaluation that reads it, in an export, and among bench's
    rows.
    """
    plugin = file_with(tmp_path, OF_SCENES, KINDS_OF_SCENES)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OTSYNC_PLUGINS": str(plugin), "COLUMNS": "2000"}

    def recon(*args: str) -> str:
        run = subprocess.run(
            [sys.executable, "-m", "recon.cli", *args], capture_output=True, text=True, env=environment, timeout=3600
        )
        assert run.returncode == 0, run.stderr
        return run.stdout

    told = recon("fit", "--help")
    assert "colourless" in told and "dimmed" in told
    assert "counted" in recon("export", "--help")
    told = recon("bench", "--help")
    assert "with colourless" in told and "with dimmed" in told
    out = tmp_path / "r"
    args = ["fit", str(world), "--offsets", str(world / "start.json"), "--out", str(out), "--width", "48"]
    args += ["--tracks", *map(str, sorted((world / "tracks").glob("*.npz"))), "--steps", "3", "--backdrop-steps", "9"]
    args += ["--losses", "photometric", "colourless:weight=0.2", "depth", "track", "--effects", "dimmed:share=0.8"]
    document = json.loads(recon(*args, "--held-out", "held0", "--views", "2", "--json"))
    assert [row["video"] for row in document["offsets"]] == ["cam0", "cam1", "cam2"] and document["metrics"]["views"]
    run = json.loads((out / "run.json").read_text())
    assert run["options"]["optics"] == [{"name": "dimmed", "share": 0.8}] == run["videos"][0]["optics"]
    again = json.loads(recon("eval", str(out), str(world), "--views", "2", "--json"))
    assert again["held_out"] == document["metrics"]["held_out"]
    recon("export", str(out), "--format", "counted")
    assert int((out / "count.txt").read_text()) == len(Gaussians4D.load(out / "scene.npz"))


@pytest.fixture
def synchronized(world, monkeypatch):
    """otsync run takes the world's offsets for what it found; here are the lengths of the videos that it was given."""
    part = only(Offsets.load(world / "start.json"), ("cam0", "cam1", "cam2"))
    lengths = []

    def found(scene, **kwargs):
        lengths.append([len(v.frames) for v in scene.videos])
        return SimpleNamespace(offsets=part, route="tracks", why=(), seconds={})

    monkeypatch.setattr("otsync.recordings.routes.synchronize_scene", found)
    monkeypatch.setattr("otsync.report.frames.write_recording_report", lambda *args: None)
    return lengths


def test_run_says_once_which_frames_it_leaves_out(world, synchronized, tmp_path, capsys):
    damaged, out = tmp_path / "damaged", tmp_path / "r"
    shutil.copytree(world, damaged)
    for k in (3, 5, 6, 7):
        (damaged / "images" / "cam1" / f"{k:04d}.png").write_bytes(b"\x89PNG broken")
    args = ["run", str(damaged), "--out", str(out), "--steps", "2", "--width", str(SIZE[0]), "--frames", "2", "12"]
    assert otsync([*args, "--held-out", "held0", "--backdrop-steps", "9"]) == 0
    told = capsys.readouterr().err
    assert synchronized == [[10, 6, 10]]
    for note in ("video cam1, frame 1 is left out", "video cam1: 1 further frames are left out"):
        assert told.count(note) == 1
        assert note in (out / "report.html").read_text()


def test_run_stops_in_one_line_where_fewer_than_two_videos_are_linked(world, tmp_path, monkeypatch, capsys):
    part = only(Offsets.load(world / "start.json"), ("cam0", "cam1", "cam2"))
    alone = replace(part, component=np.arange(3), sigma=np.zeros(3), alignments={})
    found = SimpleNamespace(offsets=alone, route="tracks", why=(), seconds={})
    monkeypatch.setattr("otsync.recordings.routes.synchronize_scene", lambda scene, **kwargs: found)
    monkeypatch.setattr("otsync.report.frames.write_recording_report", lambda *args: None)
    out = tmp_path / "r"
    assert otsync(["run", str(world), "--out", str(out), "--steps", "2", "--held-out", "held0"]) == 1
    assert "otsync: expected two videos and more on one clock; found 1 of 3" in capsys.readouterr().err
    assert (out / "offsets_coarse.json").exists() and not (out / "scene.npz").exists()


def test_run_looks_at_the_truth_before_it_works(world, synchronized, tmp_path, capsys):
    few = only(Offsets.load(world / "truth.json"), ("cam0", "cam1"))
    few.save(tmp_path / "few.json")
    for truth, says in (("few.json", "cam2"), ("none.json", "no such file")):
        args = [
            "run",
            str(world),
            "--out",
            str(tmp_path / "r"),
            "--truth",
            str(tmp_path / truth),
            "--held-out",
            "held0",
        ]
        assert otsync(args) == 2
        assert says in capsys.readouterr().err
    assert synchronized == [] and not (tmp_path / "r").exists()


def test_no_command_writes_over_a_result(world, result, tmp_path, capsys):
    folder = tmp_path / "r"
    shutil.copytree(result, folder)
    before = (folder / "scene.npz").read_bytes(), (folder / "offsets.json").read_bytes()
    tracks = [str(path) for path in sorted((world / "tracks").glob("*.npz"))]
    assert otsync(["sync", *tracks, "--out", str(folder)]) == 2
    assert otsync(["run", str(world), "--out", str(folder)]) == 2
    assert main(["export", str(folder), "--format", "tracks", "--out", str(folder / "scene.npz")]) == 2
    assert main(["eval", str(folder), str(world), "--out", str(folder / "metrics.json")]) == 2
    told = capsys.readouterr().err
    assert told.count("holds that of recon fit") == 2 and told.count("belongs to that of recon fit") == 2
    assert ((folder / "scene.npz").read_bytes(), (folder / "offsets.json").read_bytes()) == before


def test_a_shorter_rendering_over_a_longer_one_is_refused(result, tmp_path, capsys):
    args = ["render", str(result), "--camera", "cam0", "--width", "16", "--out", str(tmp_path / "f"), "--times", "0.1"]
    assert main([*args, "0.2"]) == 0
    assert main([*args, "0.2"]) == 0  # the same again
    assert main(args) == 2
    assert "it holds 00001.png" in capsys.readouterr().err
    assert sorted(p.name for p in (tmp_path / "f").iterdir()) == ["00000.png", "00001.png"]


def test_run_tells_the_reconstruction_which_frames_and_how_long_shutters_were_open(world, synchronized, tmp_path):
    """Evaluation compares only the frames that the scene was made from, as sharp: run.json must tell both."""
    out = tmp_path / "r"
    args = [
        "run",
        str(world),
        "--out",
        str(out),
        "--steps",
        "2",
        "--backdrop-steps",
        "9",
        "--width",
        str(SIZE[0]),
        "--frames",
        "2",
        "12",
        "--held-out",
        "held0",
        "--exposure",
        "0.015",
    ]
    assert otsync(args) == 0
    assert synchronized == [[10] * 3]
    options = json.loads((out / "run.json").read_text())["options"]
    assert options["frames"] == [2, 12]
    assert options["optics"] == [{"name": "motion-blur", "exposure": 0.015, "samples": 3}]
    times = load_result(out).video("cam1").times
    np.testing.assert_allclose(times, np.arange(2, 12) / 30)  # cut once, not twice
    before = json.loads((out / "metrics.json").read_text())
    assert main(["eval", str(out), str(world)]) == 0
    after = json.loads((out / "eval.json").read_text())
    assert after["views"][0]["frames"] == before["views"][0]["frames"] <= 10
    assert after["held_out"]["psnr"] == pytest.approx(before["held_out"]["psnr"], abs=1e-6)


def test_run_says_what_it_cannot_do(world, tmp_path, capsys):
    base = ["run", str(world), "--out", str(tmp_path / "r"), "--steps", "3"]
    for more, says in (
        (["--held-out", "cam1", "cam2", "held0"], "expected at least two videos; found 1"),
        (["--held-out", "nobody"], "expected some of cam0"),
        (["--held-out", "held0", "--reference", "held0"], "--reference: expected one of cam0, cam1, cam2"),
        (["--budget", "9"], "expected one of them"),
        (["--device", "cuda:99"], "device: expected one of cpu"),
        (["--width", "0"], "width: expected a whole number, 1 or more"),
        (["--exposure", "-0.1"], "exposure: expected seconds"),
        (["--frames", "5", "5"], "expected first < stop"),
        (["--recording.route", "stereo", "--held-out", "held0"], "3 videos are fewer than the 5"),
    ):
        assert exit_code(otsync, [*base, *more]) == 2, more
        assert says in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_run_goes_from_a_recording_to_a_scene_and_better_offsets(tmp_path, capsys):
    """Offsets of several frames, found from the tracks, then refined from the images to hundredths."""
    world, out = tmp_path / "world", tmp_path / "run"
    assert main(["simulate", str(world), "--frames", "60", "--max-offset", "6", "--seed", "4"]) == 0
    args = [
        "run",
        str(world),
        "--out",
        str(out),
        "--held-out",
        "held0",
        "--width",
        "160",
        "--steps",
        "500",
        "--truth",
        str(world / "truth.json"),
    ]
    assert otsync(args) in (0, 1)  # a coarse answer may be flagged
    told = capsys.readouterr()
    truth, coarse, found = (
        Offsets.load(p) for p in (world / "truth.json", out / "offsets_coarse.json", out / "offsets.json")
    )
    assert coarse.names == found.names == ("cam0", "cam1", "cam2", "cam3", "cam4")
    before, after = (np.abs(o.frames - truth.frames[:5])[1:] for o in (coarse, found))
    assert np.abs(truth.frames[:5]).max() > 3 and before.max() < 1.5
    assert after.mean() < 0.08 and after.max() < 0.16 and after.mean() < before.mean()
    metrics = json.loads((out / "metrics.json").read_text())
    view = metrics["views"][0]
    assert view["clock"] == "found" and abs(view["offset_seconds"]) * 30 < 0.15
    assert "route tracks" in told.err and (out / "sync.html").exists() and (out / "report.html").exists()
    assert otsync(args) in (0, 1)  # everything is there: the same again, at once
    assert json.loads((out / "metrics.json").read_text()) == metrics


def test_what_a_budget_went_into_before_anything_else_is_said(world, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("recon.cli.run.WORTH_TELLING", 0.0)
    nobody = ["run", str(world), "--out", str(tmp_path / "r"), "--budget", "60", "--held-out", "nobody"]
    assert otsync(nobody) == 2
    assert re.search(r"finding cameras took 0 s of the budget of 60 s; (59|60) s are left", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("options", "needs"),
    [
        ({}, False),
        ({"budget": 300.0}, False),
        ({"steps": 3000}, False),
        ({"steps": 300}, True),
        ({"steps": 0}, True),
        ({"freeze": ("offsets",)}, True),
        ({"rates": {"means": 1e-3}}, True),
    ],
)
def test_a_run_needs_stereo_where_its_fit_leaves_the_clocks(options, needs):
    from recon.cli.run import FINE_ENOUGH, fine_enough
    from recon.fit.options import FitOptions
    from recon.pipeline.plan import Plan

    assert fine_enough(Plan(fit=FitOptions(**options))) == (None if needs else FINE_ENOUGH)
