"""Track sets that do not match the videos of a fit: out of order, missing, of other videos, of another world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import recon.pipeline.starts
from otsync.files.cache import Cache
from otsync.files.digest import content_key, sequence_key
from otsync.io import open_scene
from otsync.progress import Progress
from otsync.recordings.routes import Stages
from otsync.types import Offsets
from recon.fit.optimize import RATES
from recon.fit.verb import fit
from recon.motion import ScaffoldOptions
from recon.pipeline.intake import given_clocks, only, split
from recon.pipeline.plan import Plan
from recon.pipeline.prepare import prepare
from recon.pipeline.stages import lifted_tracks, read_footage, scene_key
from recon.pipeline.starts import Given, OnScaffold
from recon.pipeline.track_sets import of_every_video, tracks_of
from recon.scene.gaussians4d import Gaussians4D, scene_arrays
from recon.scene.seed import cloud_at, shown_at
from tests.recon.worlds import SIZE, capture, write_world

STEP = 1 / 30
PER_VIDEO = Plan(width=SIZE[0], scaffold=ScaffoldOptions(per_video=True), backdrop_steps=20)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def given(world):
    """Scene, offsets and footage of the three training videos."""
    scene, _, offsets, _ = split(open_scene(world), Offsets.load(world / "truth.json"), ("held0",), Progress())
    return scene, offsets, read_footage(scene, SIZE[0], Cache(), map, Progress())


def begun(given, tracks, plan=PER_VIDEO, offsets=None) -> Gaussians4D:
    scene, known, footage = given
    gains = np.ones((3, 3))
    return OnScaffold()(Given(scene, offsets or known, tuple(tracks), footage, gains, plan, Cache(), map, Progress()))


def test_the_order_of_the_tracks_is_no_matter(given):
    a, b, c = capture().tracks
    expected, found = (scene_arrays(begun(given, tracks)) for tracks in ((a, b, c), (c, a, b)))
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


def test_clocks_of_a_scaffold_are_those_of_the_fits_videos(given):
    """With tracks of the first and the last of three videos, a shift of the last moves the last one's nodes."""
    _, offsets, footage = given
    a, _, c = capture().tracks
    scene = begun(given, [c, a])
    motion, start = scene.motion, torch.as_tensor(offsets.seconds)
    assert set(motion.clock.tolist()) == {0, 2}
    np.testing.assert_array_equal(motion.offsets, offsets.seconds)
    before = motion.nodes(0.2, start)[0]
    for video in range(3):
        moved = start.clone()
        moved[video] += 0.1
        changed = (motion.nodes(0.2, moved)[0] != before).any(1)
        assert torch.equal(changed, motion.clock == video)
    found = fit(scene, footage, offsets, steps=2, rates=RATES)
    assert len(found.offsets.seconds) == 3


def test_videos_without_tracks_have_empty_sets():
    a, b, c = capture().tracks
    sets = of_every_video([c, a], ["cam0", "cam1", "cam2"])
    assert [s.name for s in sets] == ["cam0", "cam1", "cam2"] and [len(s) for s in sets] == [len(a), 0, len(c)]
    assert sets[0] is a and sets[2] is c and len(b) > 0


def test_tracks_of_other_videos_are_left_out_and_noted(given):
    scene, notes = given[0], []
    tracks = capture().tracks
    stranger, held = replace(tracks[1], name="elsewhere"), replace(tracks[1], name="held0")
    kept = tracks_of(scene, [tracks[0], held, stranger], ("held0",), notes.append)
    assert kept == (tracks[0],) and len(notes) == 2
    assert "'held0' are left out: the video is held out" in notes[0] and "'elsewhere'" in notes[1]
    for wrong, match in (
        ([tracks[0], tracks[0]], "one set a video; found several of 'cam0'"),
        ([held], "expected sets named like videos to fit .cam0, cam1, cam2.; found 'held0'"),
        ([], "found none"),
        ([replace(tracks[0], frame="another")], "world frame 'world'; found 'another'"),
        ([replace(tracks[0], xyz=np.full_like(tracks[0].xyz, np.nan))], "'cam0'.xyz: expected finite"),
    ):
        with pytest.raises(ValueError, match=match):
            tracks_of(scene, wrong, ("held0",), notes.append)


def test_a_held_out_videos_tracks_do_not_end_a_run(world):
    """``recon simulate`` writes the tracks of every camera; --held-out takes one of them away."""
    progress = Progress()
    start = Offsets.load(world / "start.json")
    plan = replace(PER_VIDEO, scaffold=ScaffoldOptions())
    ready = prepare(open_scene(world), start, capture().tracks, plan=plan, held_out=("cam1",), progress=progress)
    assert [t.name for t in ready.tracks] == ["cam0", "cam2"] and len(ready.initial) > 100
    assert any("tracks of 'cam1' are left out" in n for n in progress.notes)


@pytest.mark.parametrize("shift", [1.5, 2.5])
def test_every_frame_that_seeding_asks_for_has_its_depth(given, monkeypatch, shift):
    """Where a moment lies halfway between two frames, the frame that is prepared is the one that is asked for."""
    _, offsets, _ = given
    asked = []

    def watched(motion, footage, offsets, depth, *, frame_step, times, **others):
        def of(maps):
            return lambda k: asked.append(maps(k)) or asked[-1]

        for t in times:
            cloud_at(footage, [of(maps) for maps in depth], offsets, float(t), frame_step)
        return None

    monkeypatch.setattr(recon.pipeline.starts, "seed", watched)
    early = replace(offsets, seconds=np.array([0, shift, 0]) * STEP)
    begun(given, capture().tracks, offsets=early)
    assert len(asked) >= 6 and all(z is not None for z in asked)


def test_the_frames_shown_are_the_nearest_readable_ones(given):
    _, offsets, footage = given
    late = replace(offsets, seconds=np.array([0, 0.4, 5]) * STEP)
    assert shown_at(footage, late, 6 * STEP, STEP) == [6, 6, 1]
    assert shown_at(footage, late, 1 * STEP, STEP) == [1, 1, None]
    bad = footage[0].bad.copy()
    bad[6] = True
    assert shown_at([replace(footage[0], bad=bad)], late, 6.1 * STEP, STEP) == [7]


def test_offsets_without_their_reference_keep_their_seconds(given):
    _, offsets, _ = given
    some = only(offsets, ("cam2", "cam1"))
    assert some.reference == 0 and some.component.tolist() == [0, 0]
    np.testing.assert_array_equal(some.seconds, offsets.seconds[[2, 1]])
    assert set(given_clocks(some)) == {"cam1", "cam2"}


def test_depth_is_measured_where_the_reference_sees_nothing_that_moves(given, monkeypatch):
    """Its tracks fail, the others' are lifted by stereo at the same offsets."""
    from otsync.recordings import routes as recordings

    scene, offsets, _ = given
    flat = replace(scene, videos=tuple(replace(v, depth=None) for v in scene.videos))
    few = replace(Stages(), stereo=replace(Stages().stereo, min_views=2))
    still = flat.videos[0].name
    choose, at = recordings.select, []

    def select(video, *others):
        if video.name == still:
            raise ValueError("nothing moves")
        return choose(video, *others)

    def depth(part, sets, offsets, *others):
        at.append(offsets)
        return [np.where(t.seen, 2.6, 0).astype(np.float32) for t in sets]

    monkeypatch.setattr(recordings, "select", select)
    monkeypatch.setattr(recordings, "stereo_depth", depth)
    progress = Progress()
    tracks = lifted_tracks(flat, offsets, Cache(), map, progress, few)
    assert {t.name for t in tracks} == {"cam1", "cam2"} and still in progress.notes[0]
    np.testing.assert_array_equal(at[0].seconds, offsets.seconds[1:])


def test_frames_without_a_depth_map_are_part_of_the_key(given):
    """As None: an array that holds None would count by its address, which no other run has."""
    scene = given[0]

    def key(maps):
        videos = (replace(scene.videos[0], depth=maps), *scene.videos[1:])
        return content_key(scene_key(replace(scene, videos=videos), capture().tracks))

    maps = [np.asarray(z) for z in scene.videos[0].depth]
    some = [None, *maps[1:]]
    assert key(some) == key([None, *(z.copy() for z in maps[1:])]) != key(maps)
    assert sequence_key(some) != sequence_key(maps)


def test_a_scene_begins_from_depth_of_some_frames(given):
    """None where a frame has no map: such frames show nothing, and nothing fails."""
    scene, _, _ = given
    some = tuple(
        replace(v, depth=[z if k % 2 else None for k, z in enumerate(map(np.asarray, v.depth))]) for v in scene.videos
    )
    whole = begun(given, capture().tracks)
    thin = begun((replace(scene, videos=some), *given[1:]), capture().tracks)
    assert 50 < len(thin) <= len(whole)


def test_given_tracks_of_a_rolling_shutter_are_brought_to_their_frames_times(world):
    plain = capture().tracks
    rolled = [replace(t, camera=replace(t.camera, readout=0.02)) for t in plain[:1]]
    plan, start = replace(PER_VIDEO, scaffold=ScaffoldOptions()), Offsets.load(world / "start.json")
    ready = prepare(open_scene(world), start, [*rolled, *plain[1:]], plan=plan, held_out=("held0",))
    assert ready.tracks[0].camera.readout is None and not np.array_equal(ready.tracks[0].xyz, plain[0].xyz)
    assert ready.tracks[1] is plain[1]  # nothing declared, nothing done
