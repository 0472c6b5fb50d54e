"""From pixels to offsets: routes, resuming after SIGKILL, the command line, the report, the bench's row."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from otsync import DTW, PAPER, Graph, Method, OptimalTransport, PartialFGW, SplineRefine, Unrefined, synchronize
from otsync.cli import main
from otsync.compute.processes import Processes
from otsync.costs import Cosine, EpipolarDistance
from otsync.files.digest import content_key
from otsync.io import open_scene
from otsync.match import UnbalancedOT
from otsync.plugins import forget, register
from otsync.priors import Cache, ChainedFlow, Daisy, MedianBackground
from otsync.progress import Deadline
from otsync.recordings.kept_pairs import MANY, KeptPairs, pack, unpack
from otsync.recordings.routes import (
    _refuse_unused,
    _too_late,
    breaking,
    choose_route,
    synchronize_scene,
    without_times,
)
from otsync.recordings.stages import PIXELS, SPACE, Stages, stages_from, with_labels, with_method
from otsync.recordings.tracking import Tracking, track_labels
from otsync.simulate import simulate
from otsync.sync.pairs import Job, run
from otsync.types import Break, Offsets, Similarity, TrackSet
from tests.otsync.epipolar.test_epipolar import world
from tests.recording_world import exact_depth, exact_labels, paths, ring, write_recording

TRUE = [0.0, 7.0, -5.0, 3.5]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    write_recording(folder, TRUE, frames=60)
    return folder


@pytest.fixture(scope="module")
def synced(recording, tmp_path_factory) -> Path:
    """``otsync sync`` on the recording, once for all tests; exit code 0 means that nothing is flagged."""
    out = tmp_path_factory.mktemp("out")
    assert main(["sync", str(recording), "--out", str(out)]) == 0
    return out


def test_pixels_to_offsets(synced):
    found = Offsets.load(synced / "offsets.json")
    np.testing.assert_allclose(found.frames, TRUE, atol=0.25)
    told = json.loads((synced / "sync.json").read_text())
    assert told["route"] == "epipolar"
    assert any("fewer than the 5" in line for line in told["why"])
    assert set(told["seconds"]) == {"tracks", "epipolar"}


def test_report_has_pictures_and_no_script(synced):
    page = (synced / "report.html").read_text()
    assert page.count("<b>Before</b>") == page.count("<b>After</b>") == 1
    assert 'alt="matches on ' in page and page.count("data:image/webp;base64,") >= 3
    assert "<script" not in page and 'src="http' not in page and 'href="http' not in page
    assert len(page) < 400_000


def test_a_warm_run_repeats_the_answer_without_work(synced, recording, tmp_path):
    before = {p.name: p.stat().st_mtime_ns for p in (synced / "stages").iterdir()}
    out = tmp_path / "again"
    main(["sync", str(recording), "--out", str(out), "--recording.cache", str(synced / "stages")])
    assert (out / "offsets.json").read_bytes() == (synced / "offsets.json").read_bytes()
    assert before == {p.name: p.stat().st_mtime_ns for p in (synced / "stages").iterdir()}


def test_videos_without_a_camera_are_named_beside_the_answer(synced, recording, tmp_path, capsys):
    shutil.copytree(recording, tmp_path / "r")
    document = json.loads((recording / "scene.json").read_text())
    lost = {"phone9": {"lens": "guessed", "doubtful": "nothing in common with the others."}}
    document["calibration"] = {"method": "global", "unit": "metres", "cameras": lost}
    (tmp_path / "r" / "scene.json").write_text(json.dumps(document))
    command = ["sync", str(tmp_path / "r"), "--out", str(tmp_path / "o"), "--recording.cache", str(synced / "stages")]
    main(command)
    assert "phone9 is left out, it has no camera: nothing in common with the others." in capsys.readouterr().out
    main([*command, "--json"])
    assert json.loads(capsys.readouterr().out)["left_out"] == {"phone9": "nothing in common with the others."}


def test_lost_and_broken_stages_are_made_again(synced, recording, tmp_path):
    out = tmp_path / "again"
    shutil.copytree(synced / "stages", out / "stages")
    stages = sorted((out / "stages").glob("*.npz"))
    next(p for p in stages if p.name.startswith("pair")).unlink()
    broken = next(p for p in stages if p.name.startswith("tracks"))
    broken.write_bytes(broken.read_bytes()[: broken.stat().st_size // 2])
    assert main(["sync", str(recording), "--out", str(out)]) == 0
    assert (out / "offsets.json").read_bytes() == (synced / "offsets.json").read_bytes()


@pytest.mark.slow
def test_killed_at_ten_moments_it_continues_to_the_same_file(synced, recording, tmp_path):
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "otsync.cli", "sync", str(recording), "--out", str(out)]
    rng = np.random.default_rng(0)
    kept = -1
    for _ in range(10):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(float(rng.uniform(1.0, 7.0)))
        process.send_signal(signal.SIGKILL)
        process.wait()
        names = list((out / "stages").glob("*.npz")) if (out / "stages").is_dir() else []
        assert len(names) >= kept
        kept = len(names)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    assert (out / "offsets.json").read_bytes() == (synced / "offsets.json").read_bytes()


def test_an_unreadable_frame_stops_with_its_name_and_keeps_the_rest(recording, synced, tmp_path, capsys):
    broken = tmp_path / "broken"
    shutil.copytree(recording, broken)
    victim = broken / "cam3" / "031.jpg"
    victim.write_bytes(victim.read_bytes()[:300])
    out = tmp_path / "out"
    shutil.copytree(synced / "stages", out / "stages")
    assert main(["sync", str(broken), "--out", str(out)]) == 2
    assert "031.jpg" in capsys.readouterr().err
    assert not (out / "offsets.json").exists()
    assert len(list((out / "stages").glob("tracks-*"))) == 4


def test_a_full_disk_is_an_error_that_keeps_what_is_done(recording, tmp_path, monkeypatch, capsys):
    import otsync.files.cache as cache_module

    written = []

    def full(path, arrays):
        if len(written) >= 3:
            raise OSError(28, "No space left on device", str(path))
        written.append(path)
        real(path, arrays)

    real = cache_module.write_npz
    monkeypatch.setattr(cache_module, "write_npz", full)
    assert main(["sync", str(recording), "--out", str(tmp_path), "--recording.workers", "1"]) == 2
    assert "No space left" in capsys.readouterr().err
    assert sorted(p.name for p in (tmp_path / "stages").iterdir()) == sorted(p.name for p in written)


def test_routes_and_their_reasons(recording):
    scene = open_scene(recording)
    assert choose_route(scene, "auto", Stages())[0] == "epipolar"
    with pytest.raises(ValueError, match="depth is missing for cam0"):
        choose_route(scene, "tracks", Stages())
    with pytest.raises(ValueError, match="fewer than the 5"):
        choose_route(scene, "stereo", Stages())
    with pytest.raises(ValueError, match="route"):
        choose_route(scene, "other", Stages())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="two videos"):
        choose_route(scene.take(["cam0"]), "auto", Stages())
    depth = [np.ones((4, 4))] * 60
    deep = replace(scene, videos=tuple(replace(v, depth=depth) for v in scene.videos))
    assert choose_route(deep, "auto", Stages())[0] == "tracks"
    moving = [replace(v, camera=replace(v.camera, w2c=np.stack([v.camera.w2c] * 60))) for v in scene.videos]
    many = replace(scene, videos=tuple(moving) * 2, masks=(None,) * 8)
    route, why = choose_route(many, "auto", Stages())
    assert route == "epipolar" and any("cameras move" in line for line in why)


def test_priors_are_spelled_as_the_shell_spells_them():
    base = Stages(selection=replace(Stages().selection, count=7))
    assert stages_from(base) == base
    made = stages_from(base, masks="median-background:threshold=20", points="chained-flow:every=5", features="daisy")
    assert made.selection == base.selection
    # a tracker that is named goes before tracks that came with the recording
    assert made.tracking == Tracking(MedianBackground(threshold=20), ChainedFlow(every=5), Daisy(), given=False)
    with pytest.raises(ValueError, match=r"--features: expected some of lab-histogram, daisy, .*onnx; found 'dino'"):
        stages_from(features="dino")
    with pytest.raises(ValueError, match=r"--points: 'chained-flow:pace=3' cannot be made"):
        stages_from(points="chained-flow:pace=3")


class Everything:
    """A masker of a stranger's: all pixels."""

    cache_key = "everything"

    def __init__(self):
        self.calls = []

    def __call__(self, frames, camera):
        self.calls.append(len(frames))
        return np.ones((len(frames), frames.size[1], frames.size[0]), bool)


def test_a_registered_masker_goes_in_its_slot_and_is_kept_by_its_own_key(recording, tmp_path):
    masker = Everything()
    register("maskers")(masker)
    try:
        tracking = stages_from(masks="everything").tracking
        video, cache = open_scene(recording).videos[0], Cache(tmp_path)
        for _ in range(2):
            assert all(mask.all() for mask in tracking.masks(video, None, cache))
        assert masker.calls == [60]
    finally:
        forget(masker)


@pytest.mark.slow
def test_given_depth_takes_the_tracks_route(tmp_path):
    """Exact depth of the drawn balls; three seconds of a dozen, for the evidence that the tracks route asks for."""
    write_recording(tmp_path, TRUE, frames=100, balls=12)
    scene = open_scene(tmp_path)
    videos = []
    for video, camera, offset in zip(scene.videos, ring(4), TRUE, strict=True):
        centres = paths((np.arange(100) + offset) / 30, 12, 1)
        videos.append(replace(video, depth=[exact_depth(camera, centres[:, k], 0.16) for k in range(100)]))
    deep, cache = replace(scene, videos=tuple(videos)), Cache(tmp_path / "stages")
    with ThreadPoolExecutor(2) as pool:
        found = synchronize_scene(deep, map=pool.map, cache=cache)
    assert found.route == "tracks"
    np.testing.assert_allclose(found.offsets.frames, TRUE, atol=0.15)
    assert found.offsets.ok
    paper = synchronize_scene(deep, method=PAPER, cache=cache)
    assert set(paper.offsets.alignments) == {(0, 1), (0, 2), (0, 3)}
    np.testing.assert_array_equal(paper.offsets.seconds, synchronize(paper.tracks, method=PAPER).seconds)


def test_labels_are_read_and_keep_things_apart(recording, synced, tmp_path):
    """Images of which ball is where: every track gets its ball's number, and partners are of the same ball."""
    document = json.loads((recording / "scene.json").read_text())
    for v, (camera, offset) in enumerate(zip(ring(4), TRUE, strict=True)):
        home = tmp_path / f"cam{v}"
        shutil.copytree(recording / f"cam{v}", home)
        (home / "who").mkdir()
        centres = paths((np.arange(60) + offset) / 30, 7, 1)
        for k in range(60):
            cv2.imwrite(str(home / "who" / f"{k:03d}.png"), exact_labels(camera, centres[:, k], 0.16))
        document["videos"][v]["labels"] = f"cam{v}/who/*.png"
    (tmp_path / "scene.json").write_text(json.dumps(document))
    scene, cache = open_scene(tmp_path), Cache(synced / "stages")
    found = synchronize_scene(scene, cache=cache)
    np.testing.assert_allclose(found.offsets.frames, TRUE, atol=0.25)
    for tracks, camera, offset in zip(found.tracks, ring(4), TRUE, strict=True):
        ball = camera.project(paths((np.arange(60) + offset) / 30, 7, 1))
        assert (tracks.labels > 0).mean() > 0.9
        for n in np.flatnonzero(tracks.labels > 0):
            away = np.linalg.norm(tracks.uv[n] - ball[tracks.labels[n] - 1], axis=1)[tracks.seen[n]]
            assert np.median(away) < 24  # the largest ball's radius in pixels
    for (a, b), matches in found.offsets.matches.items():
        la, lb = (found.tracks[v].labels[i] for v, i in zip((a, b), matches.pairs.T, strict=True))
        best = matches.score > np.quantile(matches.score, 0.9)
        assert (la == lb)[best & (la > 0) & (lb > 0)].all()
    assert with_labels(Stages(), open_scene(recording)) == Stages()
    assert main(["check", str(tmp_path)]) == 0
    cv2.imwrite(str(tmp_path / "cam0" / "who" / "000.png"), np.zeros((4, 4, 3), np.uint8))
    assert main(["check", str(tmp_path)]) == 1


def test_a_method_stands_in_the_slots_of_the_answer():
    named = Method(matcher=OptimalTransport(), graph=Graph(extra=0), rematch=2)
    for route in ("tracks", "stereo"):
        space = with_method(Stages(), route, named).space
        assert (space.matcher, space.graph, space.rematch) == (OptimalTransport(), Graph(extra=0), 2)
        assert space.aligner == SPACE.aligner and with_method(Stages(), route, named).pixels == PIXELS
    flat = with_method(Stages(), "epipolar", named)
    assert flat.pixels.matcher == OptimalTransport() and flat.pixels.aligner == PIXELS.aligner and flat.space == SPACE
    for slots in ({"matcher": PartialFGW()}, {"aligner": DTW()}, {"refiner": SplineRefine()}):
        with pytest.raises(ValueError, match=f"{next(iter(slots))}, route: expected one that reads pixels"):
            with_method(Stages(), "epipolar", Method(**slots))
    assert with_method(Stages(), "epipolar", Method(refiner=Unrefined())).pixels.refiner == Unrefined()
    again = Method(matcher=UnbalancedOT(costs=(Cosine(), EpipolarDistance())))
    with pytest.raises(ValueError, match="costs, rematch: expected --rematch 1 beside EpipolarDistance"):
        with_method(Stages(), "epipolar", again)
    assert with_method(Stages(), "epipolar", replace(again, rematch=1)).pixels.rematch == 1
    with pytest.raises(ValueError, match=r"matcher, aligner, .*: expected lifted tracks to use them on; no depth"):
        _refuse_unused(PAPER, "no depth")
    _refuse_unused(Method(), "no depth")
    assert with_method(Stages(), "tracks", PAPER).space.slots() == PAPER.slots()


def test_a_budget_leaves_stereo_out_where_it_would_take_too_much():
    assert _too_late(10.0, Deadline(1e6)) == ""
    assert "no stereo: it would take about 15 s of the 0 s" in _too_late(10.0, Deadline(0.0))


def test_a_tracks_label_is_what_most_of_it_lies_on():
    images = [np.array([[0, 7], [9, 9]], np.uint16)] * 4
    uv = np.array(
        [
            [[1.5, 0.5]] * 4,
            [[0.5, 1.5], [0.5, 1.5], [0.5, 1.5], [1.5, 0.5]],
            [[0.5, 1.5], [0.5, 1.5], [0.5, 0.5], [1.5, 0.5]],
            [[0.5, 0.5]] * 4,
            [[np.nan, np.nan]] * 3 + [[1.5, 0.5]],
        ]
    )
    np.testing.assert_array_equal(track_labels(images, uv, (2, 2)), [7, 9, -1, -1, 7])
    np.testing.assert_array_equal(track_labels(images, 10 * uv, (20, 20)), [7, 9, -1, -1, 7])


def test_a_pair_survives_the_cache():
    from otsync.epipolar.refine import EpipolarRefine
    from otsync.epipolar.scan import EpipolarScan
    from otsync.match.candidates import Candidates

    a, b = world(5.0)
    job = Job((0, 1), a, b, Candidates(8, None), EpipolarScan(), EpipolarRefine(), None)
    answer = run(job)
    again = unpack((0, 1), pack(answer))
    np.testing.assert_array_equal(again.matches.pairs, answer.matches.pairs)
    for name in ("scanned", "refined"):
        before, after = getattr(answer, name), getattr(again, name)
        assert (before.offset, before.sigma, before.fps, before.flags) == (
            after.offset,
            after.sigma,
            after.fps,
            after.flags,
        )
        np.testing.assert_array_equal(before.curve, after.curve)
        np.testing.assert_array_equal(before.hypotheses, after.hypotheses)
    assert content_key(a) == content_key(replace(a)) != content_key(b)
    moved = Similarity(2.0, np.eye(3)[[1, 2, 0]], np.arange(3.0), np.eye(7))
    turned = replace(answer, refined=replace(answer.refined, transform=moved))
    back = unpack((0, 1), pack(turned)).refined.transform
    assert back is not None and back.scale == 2.0 and back.covariance is not None
    np.testing.assert_array_equal(back.R, moved.R)
    np.testing.assert_array_equal(back.t, moved.t)


def test_kept_pairs_compute_once_and_tell_algorithms_apart(tmp_path):
    from otsync.epipolar.scan import EpipolarScan
    from otsync.match.candidates import Candidates
    from otsync.refine.unrefined import Unrefined

    a, b = world(5.0)
    calls = []

    def counted(job):
        calls.append(job)
        return run(job)

    kept = KeptPairs(Cache(tmp_path))
    job = Job((0, 1), a, b, Candidates(8, None), EpipolarScan(), Unrefined(), None)
    first, second = kept(counted, [job, job])
    assert len(calls) == 1 and first.refined.offset == second.refined.offset
    kept(counted, [replace(job, aligner=EpipolarScan(motion_scale=3.0))])
    assert len(calls) == 2
    assert KeptPairs(Cache())(lambda x: x + 1, [1, 2]) == [2, 3]


def test_many_pairs_are_spread_over_processes_with_the_same_answers(tmp_path):
    tracks, _ = simulate("tennis", preset="mid", videos=6, tracks=40, seed=9)
    here = synchronize(tracks, rematch=0)
    asked = []
    with Processes(2) as call, ThreadPoolExecutor(2) as pool:

        def spread(function, item):
            found, there = call(with_process, (function, item))
            asked.append((function, there))
            return found

        kept = KeptPairs(Cache(tmp_path), pool.map, spread)
        there = synchronize(tracks, rematch=0, map=kept)
        before = len(asked)
        again = synchronize(tracks, rematch=0, map=kept)
    assert {pid for _, pid in asked}.isdisjoint({os.getpid()})
    assert sum(function is run for function, _ in asked[:before]) >= 15
    assert not any(function is run for function, _ in asked[before:])  # they are kept
    for other in (there, again):
        np.testing.assert_array_equal(other.seconds, here.seconds)
        np.testing.assert_array_equal(other.sigma, here.sigma)
        assert other.flags == here.flags


def with_process(task):
    function, item = task
    return function(item), os.getpid()


def test_few_pairs_begin_no_processes():
    def spread(function, item):
        raise AssertionError("asked for a process")

    kept = KeptPairs(Cache(), call=spread)
    assert kept(abs, range(MANY - 1)) == list(range(MANY - 1))
    with pytest.raises(AssertionError, match="asked for a process"):
        kept(abs, range(MANY))


def test_a_scene_spreads_its_pairs_as_it_is_told(recording, synced, monkeypatch):
    asked = []
    monkeypatch.setattr("otsync.recordings.routes.Processes", lambda n: asked.append(n) or Processes(1))
    synchronize_scene(open_scene(recording), cache=Cache(synced / "stages"), processes=3)
    assert asked and set(asked) == {3}
    with pytest.raises(ValueError, match="processes: expected a whole number, 1 or more; found 0"):
        synchronize_scene(open_scene(recording), processes=0)


def test_init_check_and_sync_from_the_shell(recording, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(recording, copy)
    assert main(["check", str(copy)]) == 0
    assert "0 errors" in capsys.readouterr().out
    assert main(["init", str(copy)]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["init", str(copy), "--force"]) == 1
    assert "camera.K" in capsys.readouterr().err
    assert main(["check", str(copy)]) == 1
    assert main(["sync", str(copy), "--out", str(tmp_path / "o")]) == 2
    assert main(["sync", str(tmp_path / "nowhere.json")]) == 2
    assert main(["sync", str(recording), "--recording.cameras", "camX"]) == 2
    assert "cam0, cam1" in capsys.readouterr().err


def test_without_times_leaves_no_wall_clock(synced):
    text = (synced / "offsets.json").read_text()
    assert '"seconds"' not in text.replace('"unit": "seconds"', "") and "refine_seconds" not in text
    found = without_times(Offsets.load(synced / "offsets.json"))
    assert not any(k.endswith("seconds") for a in found.alignments.values() for k in a.stats)


def test_an_answer_on_mended_tracks_has_their_breaks_and_their_errors():
    def told(breaks: tuple[tuple[Break, ...], ...]) -> Offsets:
        one = np.ones(3)
        return Offsets(
            ("a", "b", "c"), 30 * one, 0 * one, one, 0.01 * one, 0, np.zeros(3, int), ((),) * 3, breaks=breaks
        )

    tracks = [TrackSet(np.zeros((1, 90, 3)), fps=30.0, name=name) for name in "abc"]
    first = told(((), (Break(1.0, 0.5, sigma=0.02),), ()))
    # found half a second behind the first one, on the mended clock
    found = breaking(told(((), (Break(2.0, -0.2, 0.2, 0.0),), (Break(0.5, 0.1, sigma=0.0),))), first, tracks)
    assert [(b.at, b.jump) for b in found.breaks[1]] == [(1.0, 0.5), (1.5, -0.2)] and not found.breaks[0]
    assert [(b.at, b.jump) for b in found.breaks[2]] == [(0.5, 0.1)]
    np.testing.assert_allclose(found.sigma, [0.01, np.hypot(0.01, 0.02), 0.01])


@pytest.mark.slow
def test_the_papers_scene_without_depth(data, tmp_path):
    """Four cameras of the paper's own scene, cut by known shifts: every error below .6 frame."""
    from otsync.io.scene import read_document, scene_from_document

    document, root = read_document(data / "panoptic_basketball")
    starts = {"5": 3, "21": 17, "23": 29, "27": 8}
    entries = [v for v in document["videos"] if v["name"] in starts]
    for v in entries:
        v["range"] = [starts[v["name"]], starts[v["name"]] + 110]
        v.pop("masks", None)
    scene = scene_from_document({**document, "videos": entries}, root)
    true = np.array([starts[n] for n in scene.names]) - starts[scene.names[0]]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        found = synchronize_scene(scene, route="epipolar", cache=Cache(tmp_path), map=pool.map)
    assert np.abs(found.offsets.frames - true).max() < 0.6
    assert found.offsets.ok
