"""Gains and falloff that points seen by several cameras tell, against colours made by the formula, and on films."""

from __future__ import annotations

import numpy as np
import pytest

from recon.backdrop.colours import Compared, first_colours, first_falloff, first_gains
from recon.backdrop.fit import backdrop_of, colour_gain, fit_backdrop
from recon.backdrop.seeds import surface_of
from recon.backdrop.stills import stills_of
from recon.backdrop.surroundings import surroundings
from recon.observe.vignetting import NO_FALLOFF, Falloff
from recon.simulate.capture import synthetic
from recon.simulate.effects import DarkCorners, Exposure


def made(seed: int, falloff: Falloff, stills: int = 6, outlying: float = 0.08) -> tuple[Compared, np.ndarray]:
    """Points of random colours in pictures that show each at a random place; a share of colours is of other things."""
    rng = np.random.default_rng(seed)
    colors = np.broadcast_to(rng.uniform(-2, 0, (400, 3)), (stills, 400, 3)).copy()
    radii, gains = rng.uniform(0, 1, (stills, 400)), 0.1 * rng.standard_normal((stills, 3))
    colors += gains[:, None] + (falloff.second * radii + falloff.fourth * radii**2)[..., None]
    colors += 0.02 * rng.standard_normal(colors.shape)
    wrong = rng.random((stills, 400)) < outlying
    colors[wrong] = rng.uniform(-2, 0, (int(wrong.sum()), 3))
    colors[rng.random((stills, 400)) < 0.4] = np.nan
    twice = np.isfinite(colors[..., 0]).sum(0) >= 2
    return Compared(colors[:, twice], radii[:, twice], np.arange(stills)), gains


@pytest.mark.parametrize("seed", range(6))
def test_a_falloff_is_found_among_gains_and_hidden_points(seed):
    true = Falloff(-0.25 + 0.05 * seed, 0.1)
    compared, gains = made(seed, true)
    found = first_falloff(compared, 6)
    if abs(sum(true)) >= 0.04:
        assert sum(found) == pytest.approx(sum(true), abs=0.02)
        gain = np.log(first_gains(compared.without(found), 6))
        assert gain == pytest.approx(gains - gains.mean(0), abs=0.04)


@pytest.mark.parametrize("seed", range(6, 12))
def test_none_is_made_up(seed):
    assert first_falloff(made(seed, NO_FALLOFF)[0], 6) == NO_FALLOFF
    assert first_falloff(made(seed, Falloff(-0.3, 0.0), stills=2)[0], 2) == NO_FALLOFF


def test_nothing_in_common_tells_nothing():
    nothing = Compared(np.zeros((4, 0, 3)), np.zeros((4, 0)), np.arange(4))
    assert first_falloff(nothing, 5) == NO_FALLOFF and (first_gains(nothing, 5) == 1).all()


@pytest.mark.parametrize("seed", range(12, 18))
def test_points_that_look_unlike_tell_nothing(seed):
    """Of a wrong surface: other things in each picture, whose margins are dark by themselves."""
    compared, _ = made(seed, Falloff(-0.5, 0.0), outlying=0.0)
    rng = np.random.default_rng([seed, 1])
    unlike = np.where(rng.random(compared.radii.shape) < 0.5, 0.0, rng.uniform(-2, 2, compared.radii.shape))
    others = Compared(compared.colors + unlike[..., None], compared.radii, compared.video)
    assert first_falloff(compared, 6) != NO_FALLOFF and first_falloff(others, 6) == NO_FALLOFF


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_films_tell_what_corners_lose(lost):
    effects = (Exposure(0.05), *((DarkCorners(lost),) if lost else ()))
    capture = synthetic(9, cameras=6, frames=8, size=(128, 76), offsets=0, effects=effects)
    stills = stills_of(capture.footage, capture.depth)
    points = np.concatenate([surface_of(s, surroundings(stills), 0.6).at for s in stills])
    _, found = first_colours(stills, points, 6)
    assert found == NO_FALLOFF if not lost else found.corner == pytest.approx(1 - lost, abs=0.06)


def test_a_new_view_of_dark_corners(monkeypatch):
    """With the falloff a camera that was held out is shown 2 dB better than without, and as well as an even one."""
    capture = synthetic(9, cameras=6, frames=8, size=(128, 76), offsets=0, effects=(DarkCorners(0.3),))
    held = capture.held_out[0]

    def score() -> float:
        fitted = fit_backdrop(capture.footage, depth=capture.depth, steps=200, progress=False)
        drawn = backdrop_of(fitted, held)
        seen = held.background_seen
        drawn = drawn * colour_gain(drawn, held.background, seen)
        return float(-10 * np.log10(np.square(drawn - held.background / 255.0)[seen].mean()))

    modelled = score()
    monkeypatch.setattr("recon.backdrop.colours.first_falloff", lambda *_: NO_FALLOFF)
    assert modelled > 2 + score() and modelled > 30
