"""From a recording on disk to a result folder: what comes out, what is left out, and that a killed run continues."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from otsync.files.arrays import read_npz
from otsync.files.cache import Cache
from otsync.files.claim import clear_parts
from otsync.io import open_scene
from otsync.io.mend import cut, keep_frames, unreadable
from otsync.priors.points import ChainedFlow
from otsync.priors.stereo import EmptyHull
from otsync.progress import Deadline, Progress
from otsync.recordings.routes import synchronize_scene
from otsync.types import Offsets, Status, TrackSet
from recon.backdrop.fit import TIMED
from recon.cli import main
from recon.cli.tables import offset_table
from recon.fit.optimize import initial_rates
from recon.fit.options import FitOptions
from recon.footage.footage import footage_of
from recon.pipeline.intake import only, readable, split
from recon.pipeline.plan import Plan
from recon.pipeline.prepare import prepare
from recon.pipeline.stages import lifted_tracks
from recon.pipeline.starts import world_footprint
from recon.pipeline.verb import clocks_kept, reconstruct
from recon.result.folder import load_result
from recon.scene.gaussians4d import Gaussians4D
from tests.recon.worlds import CAMERAS, FRAMES, SIZE, capture, write_world

STEP = 1 / 30
QUICK = Plan(width=SIZE[0], views=4, backdrop_steps=60)


def quick(steps: int, **changes: Any) -> Plan:
    return replace(QUICK, fit=FitOptions(steps=steps, **changes))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def start(world):
    return Offsets.load(world / "start.json")


@pytest.fixture(scope="module")
def done(world, start, tmp_path_factory):
    """A whole run, and where it lies."""
    out = tmp_path_factory.mktemp("done")
    truth = Offsets.load(world / "truth.json")
    outcome = reconstruct(open_scene(world), start, out, plan=quick(60), held_out=("held0",), truth=truth)
    return outcome, out


def test_a_run_writes_everything_and_reads_it_back(done):
    outcome, out = done
    assert {p.name for p in out.iterdir()} == {
        "scene.npz",
        "offsets.json",
        "run.json",
        "metrics.json",
        "report.html",
        "scene.html",
        "strips.npz",
        "fit.npz",
        "stages",
    }
    result = load_result(out)
    assert [v.name for v in result.videos] == ["cam0", "cam1", "cam2", "held0"]
    assert [v.held_out for v in result.videos] == [False] * CAMERAS + [True]
    np.testing.assert_array_equal(result.offsets.seconds, outcome.fitted.offsets.seconds)
    assert result.video("cam1").clock.offset == outcome.fitted.offsets.seconds[1]
    assert result.video("held0").clock.how == "given"
    np.testing.assert_allclose(result.video("cam2").camera.K, capture().footage[2].K)
    with pytest.raises(ValueError, match="expected one of cam0"):
        result.video("cam9")


def test_the_scene_covers_every_frame_and_metrics_hold_no_wall_time(done):
    outcome, out = done
    low, high = outcome.fitted.scene.span
    assert low <= 0 and high >= (FRAMES - 1) * STEP
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["held_out"]["psnr"] == metrics["views"][0]["psnr"] > 15
    assert "seconds" not in metrics["fit"] and metrics["fit"]["steps"] == 60
    assert metrics["offset_error"]["max_frames"] < 0.8
    assert metrics["held_out"]["lpips"] is None and "weights" in metrics["lpips"]


def test_the_reference_keeps_its_place(done):
    assert done[0].fitted.offsets.seconds[0] == 0


def test_running_again_changes_nothing(done, world, start, tmp_path):
    outcome, out = done
    shutil.copytree(out, tmp_path / "again")
    again = reconstruct(
        open_scene(world),
        start,
        tmp_path / "again",
        plan=quick(60),
        held_out=("held0",),
        truth=Offsets.load(world / "truth.json"),
    )
    assert same_files(out, tmp_path / "again")
    np.testing.assert_array_equal(again.fitted.offsets.seconds, outcome.fitted.offsets.seconds)


def same_files(a, b) -> bool:
    for name in ("offsets.json", "metrics.json"):
        assert json.loads((a / name).read_text()) == json.loads((b / name).read_text()), name
    one, two = read_npz(a / "scene.npz"), read_npz(b / "scene.npz")
    assert one.keys() == two.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
    return True


@pytest.mark.parametrize("step", [3, 41])
def test_an_interrupted_fit_continues_to_the_same_numbers(done, world, start, tmp_path, monkeypatch, step):
    from recon.fit.run import Run

    shutil.copytree(done[1] / "stages", tmp_path / "stages")
    real = Run.one_step

    def stopping(self, *args, **kwargs):
        if self.step == step:
            raise KeyboardInterrupt
        return real(self, *args, **kwargs)

    args = {"plan": quick(60), "held_out": ("held0",), "truth": Offsets.load(world / "truth.json")}
    monkeypatch.setattr(Run, "one_step", stopping)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(open_scene(world), start, tmp_path, **args)
    assert not (tmp_path / "run.json").exists() and (tmp_path / "fit.npz").exists()
    monkeypatch.setattr(Run, "one_step", real)
    reconstruct(open_scene(world), start, tmp_path, **args)
    assert same_files(done[1], tmp_path)


def test_held_out_videos_change_nothing_in_the_fit(done, world, start, tmp_path):
    """Their images are never seen: a run without them ends with the same scene."""
    scene = open_scene(world).take(["cam0", "cam1", "cam2"])
    shutil.copytree(done[1] / "stages", tmp_path / "stages")
    reconstruct(scene, start, tmp_path, plan=quick(60))
    one, two = read_npz(done[1] / "scene.npz"), read_npz(tmp_path / "scene.npz")
    assert all(np.array_equal(one[k], two[k]) for k in one)


def test_a_camera_that_cannot_be_compared_does_not_cost_the_fit(done, world, start, tmp_path):
    shutil.copytree(done[1] / "stages", tmp_path / "stages")
    at = start.names.index("held0")
    far = replace(start, seconds=start.seconds + 9.0 * (np.arange(len(start)) == at))
    progress = Progress()
    outcome = reconstruct(open_scene(world), far, tmp_path, plan=quick(3), held_out=("held0",), progress=progress)
    assert any("held-out video held0 is not compared" in n and "Check its offset" in n for n in progress.notes)
    assert not any(v.held_out for v in outcome.views) and outcome.views
    assert [v.name for v in load_result(tmp_path).videos] == ["cam0", "cam1", "cam2"]
    assert "held0 is not compared" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize("killed_in", ["view", "metrics_of", "save_run"])
def test_a_kill_while_writing_leaves_scene_and_clocks_but_nothing_finished(
    done, world, start, tmp_path, monkeypatch, killed_in
):
    def killed(*args, **kwargs):
        raise KeyboardInterrupt

    shutil.copytree(done[1], tmp_path, dirs_exist_ok=True)
    (tmp_path / "scene.npz").unlink()
    monkeypatch.setattr(f"recon.pipeline.verb.{killed_in}", killed)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(open_scene(world), start, tmp_path, plan=quick(60), held_out=("held0",))
    assert (tmp_path / "scene.npz").exists() and (tmp_path / "offsets.json").exists()
    with pytest.raises(FileNotFoundError, match="expected a finished reconstruction"):
        load_result(tmp_path)


def test_what_killed_writers_left_is_removed(tmp_path):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    dead = [tmp_path / f".scene.npz.{gone.pid}-7.part", tmp_path / f".v.mp4.{gone.pid}.part"]
    stay = [tmp_path / f".scene.npz.{os.getpid()}-7.part", tmp_path / ".notes.part", tmp_path / "scene.npz"]
    for path in (*dead, *stay):
        path.touch()
    clear_parts(tmp_path, tmp_path / "nowhere")
    assert sorted(tmp_path.iterdir()) == sorted(stay)


def test_frozen_offsets_stay(world, start, done, tmp_path):
    shutil.copytree(done[1] / "stages", tmp_path / "stages")
    outcome = reconstruct(open_scene(world), start, tmp_path, plan=quick(3, freeze=("offsets",)), held_out=("held0",))
    np.testing.assert_array_equal(outcome.fitted.offsets.seconds, np.zeros(CAMERAS))
    with pytest.raises(ValueError, match="freeze: expected some of"):
        reconstruct(open_scene(world), start, tmp_path, plan=quick(3, freeze=("clocks",)), held_out=("held0",))


def test_clocks_stay_where_cameras_are_not_known_well_enough(world, start, done, tmp_path):
    """A fit holds cameras still, so a camera's error would go into its clock; who names a rate for clocks gets it."""
    scene = replace(open_scene(world), pose_sigma={start.names[1]: 0.7})
    told: list[str] = []
    shutil.copytree(done[1] / "stages", tmp_path / "stages")
    outcome = reconstruct(scene, start, tmp_path, plan=quick(3), held_out=("held0",), progress=Progress(told.append))
    assert any("clocks stay" in line and start.names[1] in line for line in told)
    np.testing.assert_array_equal(outcome.fitted.offsets.seconds, outcome.coarse.seconds)
    for options, sigma in (
        (FitOptions(freeze=("offsets",)), {start.names[1]: 0.7}),
        (FitOptions(rates=initial_rates(FitOptions().groups.values()) | {"offsets": 0.01}), {start.names[1]: 0.7}),
        (FitOptions(), {start.names[1]: 0.1}),
        (FitOptions(), {"held out": 0.7}),
    ):
        assert clocks_kept(options, replace(scene, pose_sigma=sigma), start.names) == (options, "")


def test_bad_frames_are_left_out_and_named(world, start, tmp_path):
    folder = tmp_path / "damaged"
    shutil.copytree(world, folder)
    (folder / "images" / "cam1" / "0004.png").write_bytes(b"\x89PNG broken")
    whole = (folder / "images" / "cam2" / "0007.png").read_bytes()
    (folder / "images" / "cam2" / "0007.png").write_bytes(whole[: len(whole) // 2])
    (folder / "depth" / "cam0" / "0002.png").write_bytes(b"no depth")
    told: list[str] = []
    progress = Progress(told.append)
    ready = prepare(open_scene(folder), start, plan=QUICK, held_out=("held0",), progress=progress)
    assert [len(f) for f in ready.footage] == [FRAMES - 1] * 3
    np.testing.assert_allclose(ready.footage[1].times, np.delete(np.arange(FRAMES), 4) * STEP)
    notes = " ".join(progress.notes)
    assert "video cam1, frame 4" in notes and "video cam2, frame 7" in notes and "video cam0, frame 2" in notes
    assert all(f"note: {n}" in told for n in progress.notes)


def test_frames_with_nan_are_left_out(world):
    scene = open_scene(world).take(["cam0"])
    frames = [np.asarray(f) for f in scene.videos[0].frames]
    frames[3] = np.full((*frames[3].shape,), np.nan, np.float32)
    video = replace(scene.videos[0], frames=frames)
    assert list(unreadable(video, scene.masks[0])) == [3]
    progress = Progress()
    mended = readable(replace(scene, videos=(video,)), Cache(), map, progress)
    assert len(mended.videos[0].frames) == FRAMES - 1 and "NaN" in progress.notes[0]
    assert footage_of(mended.videos[0], mended.masks[0], width=SIZE[0]).bad.sum() == 0


def test_a_video_without_any_readable_frame_is_an_error(world):
    scene = open_scene(world).take(["cam1"])
    frames = [np.zeros((3, 3, 3), np.uint8)] * FRAMES
    broken = replace(scene, videos=(replace(scene.videos[0], frames=frames),))
    with pytest.raises(ValueError, match="cam1: expected frames that can be read"):
        readable(broken, Cache(), map, Progress())


def test_parts_of_a_scene_keep_their_times(world):
    scene = cut(open_scene(world), 3, 9)
    assert [len(v.frames) for v in scene.videos] == [6] * (CAMERAS + 1)
    np.testing.assert_allclose(scene.videos[1].times, np.arange(3, 9) * STEP)
    np.testing.assert_array_equal(scene.videos[0].frames[0], open_scene(world).videos[0].frames[3])
    np.testing.assert_array_equal(scene.videos[0].depth[2], open_scene(world).videos[0].depth[5])
    assert len(scene.masks[0]) == 6
    for first, stop in ((4, 4), (-1, 3), (FRAMES, FRAMES + 2)):
        with pytest.raises(ValueError, match="frames: expected first < stop"):
            cut(scene, first, stop)
    moving = keep_frames(scene, [[0, 5], [1], *[range(6)] * 2])
    np.testing.assert_allclose(moving.videos[0].times, np.array([3, 8]) * STEP)
    assert len(moving.videos[1].frames) == 1 and moving.videos[2] is scene.videos[2]


def test_videos_without_a_common_clock_are_left_out(world):
    offsets = Offsets.load(world / "start.json")
    seconds = offsets.seconds.copy()
    seconds[1] = np.nan
    offsets = replace(offsets, seconds=seconds, flags=((), (Status.NO_MATCH,), *offsets.flags[2:]))
    progress = Progress()
    train, held, own, known = split(open_scene(world), offsets, ("held0",), progress)
    assert train.names == ("cam0", "cam2") == own.names and held.names == ("held0",)
    assert known["held0"].offset == 0 and own.reference == 0
    assert "cam1 is left out: it has no offset" in progress.notes[0]
    with pytest.raises(ValueError, match=r"the reference .cam0. among the videos to fit"):
        split(open_scene(world), offsets, ("cam0",), progress)
    with pytest.raises(ValueError, match="held_out: expected some of"):
        split(open_scene(world), offsets, ("nobody",), progress)


def test_some_offsets_keep_their_differences():
    offsets = replace(
        Offsets.known(("a", "b", "c"), np.array([0.0, 0.2, -0.4]), 30), reference=1, component=np.array([1, 1, 1])
    )
    some = only(offsets, ("c", "b"))
    assert some.names == ("c", "b") and some.reference == 1 and some.between(0, 1) == offsets.between(2, 1)


def test_a_footprint_is_a_pixel_at_the_things_depth():
    c = capture()
    found = world_footprint(c.tracks, c.footage)
    z = np.concatenate([t.camera.to_camera(t.positions())[..., 2].ravel() for t in c.tracks])
    assert found == pytest.approx(np.nanmedian(z) / c.footage[0].K[0, 0], rel=1e-6)
    with pytest.raises(ValueError, match="tracks: expected tracks in space"):
        world_footprint([replace(t, camera=None) for t in c.tracks], c.footage)


def test_nothing_that_moves_is_said(world, start, tmp_path):
    still = tmp_path / "still"
    shutil.copytree(world, still)
    for image in sorted((still / "images").rglob("*.png")):
        shutil.copy(image.parent / "0000.png", image) if image.name != "0000.png" else None
    shutil.rmtree(still / "masks")
    document = json.loads((still / "scene.json").read_text())
    for video in document["videos"]:
        video.pop("masks")
    (still / "scene.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match="expected something that moves"):
        prepare(open_scene(still), start, plan=QUICK, held_out=("held0",))
    with pytest.raises(ValueError, match="masks are empty"):
        prepare(open_scene(still), start, capture().tracks, plan=QUICK, held_out=("held0",))


def test_too_few_cameras_without_depth_begin_on_hulls_and_say_so(world, start):
    scene, progress = open_scene(world), Progress()
    flat = replace(scene, videos=tuple(replace(v, depth=None) for v in scene.videos))
    ready = prepare(flat, start, plan=QUICK, held_out=("held0",), progress=progress)
    told = " ".join(progress.notes)
    assert "depth: none was given for cam0, cam1, cam2" in told and "3 videos are fewer than the 5" in told
    assert "begins on visual hulls" in told
    assert ready.tracks == () and len(ready.initial) > 100
    masks = {f.name: f.masks for f in ready.footage}
    focus = ready.initial.dynamic.means.mean(0).numpy()
    for f in ready.footage:
        x = f.K @ (f.pose(0)[:3] @ np.append(focus, 1))
        assert 0 < x[0] / x[2] < f.size[0] and 0 < x[1] / x[2] < f.size[1] and masks[f.name] is not None


def test_an_empty_hull_is_no_end(world, start, monkeypatch):
    scene, progress = open_scene(world), Progress()

    def empty(*args, **kwargs):
        raise EmptyHull("masks: their visual hull is empty.")

    monkeypatch.setattr("otsync.recordings.routes.stereo_depth", empty)
    monkeypatch.setattr("otsync.recordings.routes.lacks_stereo", lambda *args: "")
    flat = replace(scene, videos=tuple(replace(v, depth=None) for v in scene.videos))
    ready = prepare(flat, start, plan=QUICK, held_out=("held0",), progress=progress)
    assert ready.tracks == () and "visual hull is empty" in " ".join(progress.notes)
    one = tuple(v if v.name == "cam0" else replace(v, depth=None) for v in scene.videos)
    ready = prepare(replace(scene, videos=one), start, plan=QUICK, held_out=("held0",), progress=progress)
    assert [t.name for t in ready.tracks] == ["cam0"]


def test_a_video_without_depth_only_adds_its_images(world, start, tmp_path):
    scene = open_scene(world)
    videos = tuple(replace(v, depth=None) if v.name == "cam2" else v for v in scene.videos)
    progress = Progress()
    ready = prepare(replace(scene, videos=videos), start, plan=QUICK, held_out=("held0",), progress=progress)
    assert [t.name for t in ready.tracks] == ["cam0", "cam1"] and len(ready.footage) == 3
    assert "no tracks in space from cam2: 3 videos are fewer" in " ".join(progress.notes)
    assert len(ready.initial) > 100


def test_one_camera_with_depth_is_a_scene(world, start, tmp_path):
    outcome = reconstruct(
        open_scene(world).take(["cam0", "held0"]),
        start,
        tmp_path,
        plan=quick(4),
        held_out=("held0",),
        truth=Offsets.load(world / "truth.json"),
    )
    assert outcome.fitted.offsets.names == ("cam0",) and len(outcome.fitted.scene) > 100
    # no other video, no error of a clock: said so, in a file that any reader of JSON takes
    error = json.loads((tmp_path / "metrics.json").read_text())["offset_error"]
    assert error == {"mean_frames": None, "max_frames": None, "mean_apart_frames": None, "frames": [0.0]}
    assert (tmp_path / "report.html").exists() and "nan" not in offset_table(outcome)
    assert main(["eval", str(tmp_path), str(world), "--held-out", "held0", "--truth", str(world / "truth.json")]) == 0
    assert isinstance(Gaussians4D.load(tmp_path / "scene.npz"), Gaussians4D)


def test_one_track_carries_the_whole_scene(world, start, tmp_path):
    longest = capture().tracks[0]
    one = longest.take(np.argsort(-longest.seen.sum(1))[:1])
    assert isinstance(one, TrackSet) and len(one) == 1
    outcome = reconstruct(open_scene(world), start, tmp_path, tracks=[one], plan=quick(4), held_out=("held0",))
    assert outcome.fitted.scene.motion.parameters()["knots"].shape[1] == 1


def test_stages_are_shared_with_the_synchronisation_before(world, start, tmp_path, monkeypatch):
    """What otsync sync has tracked and masked is neither tracked nor masked again."""
    cache = Cache(tmp_path)
    train, _, offsets, _ = split(open_scene(world), start, ("held0",), Progress())
    synchronize_scene(train, cache=cache)
    shared = {kind: sorted(tmp_path.glob(f"{kind}-*.npz")) for kind in ("tracks", "masks")}
    assert all(len(files) == CAMERAS for files in shared.values())
    monkeypatch.setattr(ChainedFlow, "__call__", lambda *args: pytest.fail("tracked again"))
    assert lifted_tracks(train, offsets, cache, map, Progress())
    assert shared == {kind: sorted(tmp_path.glob(f"{kind}-*.npz")) for kind in shared}
    with pytest.raises(pytest.fail.Exception, match="tracked again"):
        lifted_tracks(train, offsets, Cache(tmp_path / "elsewhere"), map, Progress())


def test_a_budget_is_the_whole_jobs_and_says_what_it_left_out(world, start, tmp_path):
    """With no time left: as few steps as a stage can be measured by."""
    progress, plan = Progress(), replace(QUICK, fit=FitOptions(budget=1e-9))
    deadline = Deadline(1e-9)
    outcome = reconstruct(
        open_scene(world), start, tmp_path, plan=plan, held_out=("held0",), progress=progress, deadline=deadline
    )
    assert outcome.fitted.stats["steps"] == 120
    assert f"budget: the static part takes {TIMED} steps in place of 60" in progress.notes
    assert any("are left for the fit" in note for note in progress.notes)
    assert any("a longer one gives a better scene" in note for note in progress.notes)
    assert json.loads((tmp_path / "metrics.json").read_text())
