"""Dark corners from films to a finished result: told by the static part, kept, looked through, and given by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync.io import open_scene
from otsync.progress import Progress
from otsync.types import Offsets
from recon.backdrop.fit import StaticFit
from recon.fit.options import FitOptions
from recon.observe import Vignetting
from recon.observe.vignetting import NO_FALLOFF, Falloff
from recon.pipeline.plan import Plan
from recon.pipeline.prepare import check_vignetting, prepare
from recon.pipeline.verb import evaluate, reconstruct
from recon.result.folder import load_result
from recon.result.images import rendered
from recon.simulate.capture import synthetic
from recon.simulate.effects import DarkCorners
from recon.simulate.recording import write_capture
from tests.recon.worlds import write_world

SIZE, LOST = (96, 64), 0.4
PLAN = Plan(width=SIZE[0], views=4, backdrop_steps=120, fit=FitOptions(steps=30))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dark")
    dark = synthetic(5, cameras=6, held_out=1, frames=14, size=SIZE, offsets=0.8, effects=(DarkCorners(LOST),))
    write_capture(dark, folder)
    return folder


@pytest.fixture(scope="module")
def done(world, tmp_path_factory):
    out = tmp_path_factory.mktemp("done")
    start = Offsets.load(world / "start.json")
    return reconstruct(open_scene(world), start, out, plan=PLAN, held_out=("held0",)), out


def found(effects) -> Vignetting:
    (one,) = [e for e in effects if isinstance(e, Vignetting)]
    return one


def test_a_result_remembers_what_the_static_part_told(done):
    result = load_result(done[1])
    effect = found(result.optics)
    assert Falloff(effect.second, effect.fourth).corner == pytest.approx(1 - LOST, abs=0.08)
    assert all(found(v.optics) == effect for v in result.videos)


def test_held_out_and_rendered_corners_are_as_dark_as_filmed(done, world):
    outcome, out = done
    result = load_result(out)
    (score,), _ = evaluate(result, open_scene(world), ["held0"], most=PLAN.views)
    assert score.mean["psnr"] == pytest.approx(outcome.views[0].mean["psnr"], abs=1e-3)
    even = replace(result, videos=tuple(replace(v, optics=()) for v in result.videos))
    (without,), _ = evaluate(even, open_scene(world), ["held0"], most=PLAN.views)
    assert score.mean["psnr"] > without.mean["psnr"] + 1
    (image,) = rendered(result, [0.2], "held0")
    (flat,) = rendered(even, [0.2], "held0")
    h, w = image.shape[:2]
    ratio = image.astype(float).sum(-1) / np.maximum(flat.astype(float).sum(-1), 1)
    assert ratio[h // 2, w // 2] == pytest.approx(1, abs=0.02)
    assert ratio[0, 0] == pytest.approx(1 - LOST, abs=0.1)


def test_it_is_kept(done, world, monkeypatch):
    """The second run takes the static part from the first one's stages, and sees the same."""
    from otsync.files.cache import Cache

    monkeypatch.setattr("recon.pipeline.stages.fit_backdrop", None)
    start = Offsets.load(world / "start.json")
    again = prepare(open_scene(world), start, plan=PLAN, held_out=("held0",), cache=Cache(done[1] / "stages"))
    effect = found(load_result(done[1]).optics)
    assert again.falloff == Falloff(effect.second, effect.fourth)


@pytest.mark.parametrize("own", [Vignetting(-0.2, 0.05), pytest.param(Vignetting(0.0), marks=pytest.mark.slow)])
def test_coefficients_of_ones_own_hold_for_the_static_part_too(own, world, tmp_path):
    plan = replace(PLAN, backdrop_steps=40, fit=FitOptions(steps=2, effects=(own,)))
    start = Offsets.load(world / "start.json")
    reconstruct(open_scene(world), start, tmp_path / "own", plan=plan, held_out=("held0",))
    assert found(load_result(tmp_path / "own").optics) == own
    again = prepare(open_scene(world), start, plan=plan, held_out=("held0",))
    assert again.falloff == Falloff(own.second, own.fourth)


def test_what_was_asked_for_and_is_not_there_is_told(tmp_path):
    even = write_world(tmp_path / "even")
    plan = replace(PLAN, backdrop_steps=20, fit=FitOptions(steps=2, effects=(Vignetting(),)))
    progress = Progress()
    prepare(open_scene(even), Offsets.load(even / "start.json"), plan=plan, progress=progress)
    assert any("vignetting was asked for, but the static part shows none" in line for line in progress.notes)


def test_a_static_part_of_another_falloff_is_refused(done):
    def static(falloff: Falloff) -> StaticFit:
        return StaticFit(done[0].fitted.scene.static, np.ones((6, 3)), 0.1, np.ones(6), falloff=falloff)

    check_vignetting((), None, Progress())
    check_vignetting((Vignetting(-0.2),), static(Falloff(-0.2, 0.0)), Progress())
    with pytest.raises(
        ValueError, match=r"backdrop: expected one fitted with the vignetting of the plan, \(-0.2, 0.0\)"
    ):
        check_vignetting((Vignetting(-0.2),), static(NO_FALLOFF), Progress())
    with pytest.raises(ValueError, match="effects: expected a static part that tells the vignetting; found none"):
        check_vignetting((Vignetting(),), None, Progress())
