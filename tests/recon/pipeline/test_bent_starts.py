"""A scene is made with bent clocks, and the fit unbends them and says how much it left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.progress import Progress
from otsync.types import Offsets
from recon.fit.options import FitOptions
from recon.fit.verb import fit
from recon.fit.witnesses import Told
from recon.footage.bends import bent, bent_tracks
from recon.pipeline.plan import Plan
from recon.pipeline.prepare import bends_of, prepare
from recon.scene.gaussians4d import scene_arrays
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture
from recon.simulate.world import World
from tests.recon.worlds import SIZE, capture, write_world

PLAN = Plan(SIZE[0], backdrop_steps=3)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def unsure(world) -> Offsets:
    """The true clocks, a fifth of a frame unsure; the reference and the held-out video are known."""
    truth = Offsets.load(world / "truth.json")
    loose = [n != truth.names[truth.reference] for n in truth.names]
    return replace(truth, sigma=np.where(loose, 0.2 / 30, 0.0))


@pytest.mark.parametrize("given", [True, False], ids=["tracks given", "tracks lifted"])
def test_a_scene_with_bends_is_that_of_bent_videos(world, unsure, given: bool):
    scene, tracks, cache = open_scene(world), capture().tracks if given else None, Cache(world / "stages")
    if not given:
        prepare(scene, unsure, None, plan=replace(PLAN, bend=0.0), held_out=("held0",), cache=cache)
    ready = prepare(scene, unsure, tracks, plan=PLAN, held_out=("held0",), cache=cache)
    bends = [f.bend for f in ready.footage]
    assert np.allclose(np.abs(bends), 0.2 / 30) and min(bends) < 0 < max(bends)
    by_name = {f.name: (f.bend, f.wave) for f in ready.footage}
    videos = tuple(bent(v, *by_name[v.name])[0] if v.name in by_name else v for v in scene.videos)
    if tracks is not None:
        known = {v.name: v for v in scene.videos}
        tracks = tuple(bent_tracks(t, known[t.name], *by_name[t.name]) if t.name in by_name else t for t in tracks)
    plan = replace(PLAN, bend=0.0)
    crooked = prepare(replace(scene, videos=videos), unsure, tracks, plan=plan, held_out=("held0",), cache=cache)
    one, other = scene_arrays(ready.initial), scene_arrays(crooked.initial)
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)
    for f, g in zip(ready.footage, crooked.footage, strict=True):
        np.testing.assert_array_equal(f.times, scene.videos[scene.names.index(f.name)].times)
        np.testing.assert_allclose(g.times, f.times + f.bend * f.wave)
        assert g.bend == 0
    if not given:  # a bend is of clocks alone: pixels are tracked once, bent or not
        assert len(list((world / "stages").glob("tracks-*"))) == len(ready.footage)


def test_a_fit_unbends_clocks_and_tells_what_it_left(world, unsure):
    ready = prepare(open_scene(world), unsure, capture().tracks, plan=PLAN, held_out=("held0",), cache=Cache())
    still = fit(ready.initial, ready.footage, ready.offsets, steps=0)
    assert still.stats["start_kept"] == 1.0
    np.testing.assert_allclose(still.offsets.seconds, ready.offsets.seconds)
    assert (still.offsets.sigma >= 0.99 * ready.offsets.sigma).all()
    moved = fit(ready.initial, ready.footage, ready.offsets, steps=200)
    assert moved.stats["start_kept"] < 0.8 and moved.stats["start_kept_sigma"] > 0
    straight = [replace(f, bend=0.0) for f in ready.footage]
    assert "start_kept" not in fit(ready.initial, straight, ready.offsets, steps=0).stats


def test_a_fit_that_left_all_of_its_bends_says_nothing(world, unsure, monkeypatch):
    """However far it moved the clocks, and however well its frames agree: the start stands."""
    ready = prepare(open_scene(world), unsure, capture().tracks, plan=PLAN, held_out=("held0",), cache=Cache())
    steps, started = 60, ready.offsets
    said = fit(ready.initial, ready.footage, started, steps=steps).offsets
    monkeypatch.setattr("recon.fit.run.Run.told", lambda self, sigma: Told(1.0, 0.0, 1.0))
    deaf = fit(ready.initial, ready.footage, started, steps=steps).offsets
    assert np.abs(said.seconds - started.seconds).max() > 1e-4
    np.testing.assert_allclose(deaf.seconds, started.seconds, atol=1e-9)
    assert (deaf.sigma >= 0.999 * started.sigma).all()


def test_clocks_that_a_fit_does_not_move_are_not_bent(unsure):
    told: list[str] = []
    progress = Progress(told.append)
    frozen = replace(PLAN, fit=FitOptions(freeze=("offsets",)))
    assert bends_of(PLAN, unsure, progress).any() and not bends_of(frozen, unsure, progress).any() and not told
    assert not bends_of(replace(PLAN, bend=0.0), unsure, progress).any() and not told
    assert not bends_of(replace(frozen, bend=0.3), unsure, progress).any()
    assert "bend" in " ".join(told) and "unused" in " ".join(told)


def test_bends_that_nothing_unbends_are_refused():
    with pytest.raises(ValueError, match=r"freeze: .* Give bend 0 to go without"):
        replace(PLAN, fit=FitOptions(freeze=("bends",)))
    with pytest.raises(ValueError, match="bend: expected a number >= 0"):
        replace(PLAN, bend=-0.1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [331, 333])
def test_a_bend_is_no_offset_where_things_move_for_a_while_alone(seed, tmp_path, monkeypatch):
    """Half a second of motion amid standstill: a wave by the video's clock moved offsets by .35 frame there."""
    with monkeypatch.context() as patch:
        for name in ("positions", "facing"):
            usual = getattr(World, name)
            patch.setattr(World, name, lambda self, t, usual=usual: usual(self, 2 * np.clip(t, 0.56, 1.04)))
        filmed = synthetic(seed, frames=48, held_out=0)
        write_capture(filmed, tmp_path / "world")
    truth = Offsets.load(tmp_path / "world" / "truth.json")
    error = np.random.default_rng(seed).normal(size=len(truth.names)) * 0.2 / 30
    others = np.arange(len(truth.names)) != truth.reference
    sigma = np.where(others, 0.2 * np.sqrt(2) / 30, 0.0)
    start = replace(truth, seconds=truth.seconds + error - error[truth.reference], sigma=sigma)
    plan = Plan(160, backdrop_steps=200)
    ready = prepare(open_scene(tmp_path / "world"), start, filmed.tracks, plan=plan, cache=Cache())
    found = fit(ready.initial, ready.footage, ready.offsets, steps=400).offsets
    off = np.abs(found.seconds - truth.seconds)[others] * 30
    print(f"seed {seed}: off {np.round(off, 3)}, sigma {np.round(found.sigma[others] * 30, 3)} frames")
    assert (off < 0.12).all() and (off < 3 * found.sigma[others] * 30).all()
