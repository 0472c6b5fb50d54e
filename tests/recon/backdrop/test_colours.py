"""Gains and falloff that points seen by several cameras tell, against colours made by the formula, and on films."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon.backdrop.colours import Compared, first_colours, first_falloff, first_gains
from recon.backdrop.fit import backdrop_of, colour_gain, fit_backdrop
from recon.backdrop.seeds import seed_discs, surface_of
from recon.backdrop.stills import stills_of
from recon.backdrop.surroundings import surroundings
from recon.observe.vignetting import NO_FALLOFF, Falloff, darkening_
from recon.simulate.capture import synthetic
from recon.simulate.effects import DarkCorners, Exposure


def made(
    seed: int, falloff: Falloff, videos: int = 6, stills: int = 1, outlying: float = 0.08, seen: float = 0.6
) -> tuple[Compared, np.ndarray]:
    """Points of random colours in pictures that show each at a random place; a share of colours is of other things."""
    rng = np.random.default_rng(seed)
    video = np.repeat(np.arange(videos), stills)
    colors = np.broadcast_to(rng.uniform(-2, 0, (400, 3)), (len(video), 400, 3)).copy()
    radii, gains = rng.uniform(0, 1, (len(video), 400)), 0.1 * rng.standard_normal((videos, 3))
    colors += gains[video][:, None] + (falloff.second * radii + falloff.fourth * radii**2)[..., None]
    colors += 0.02 * rng.standard_normal(colors.shape)
    wrong = rng.random(radii.shape) < outlying
    colors[wrong] = rng.uniform(-2, 0, (int(wrong.sum()), 3))
    colors[rng.random(radii.shape) > seen] = np.nan
    return Compared(colors, radii, video).shared(), gains


def in_pairs(compared: Compared) -> Compared:
    """The same, each point hidden from one of three pictures."""
    colors = compared.colors.copy()
    colors[np.arange(colors.shape[1]) % 3, np.arange(colors.shape[1])] = np.nan
    return Compared(colors, compared.radii, compared.video).shared()


@pytest.mark.parametrize("seed", range(6))
def test_a_falloff_is_found_among_gains_and_hidden_points(seed):
    true = Falloff(-0.3 + 0.04 * seed, 0.0)
    compared, gains = made(seed, true)
    found = first_falloff(compared, 6)
    assert found.at(np.linspace(0, 1, 5)) == pytest.approx(true.at(np.linspace(0, 1, 5)), abs=0.015)
    gain = np.log(first_gains(compared.without(found), 6))
    assert gain == pytest.approx(gains - gains.mean(0), abs=0.04)


@pytest.mark.parametrize("seed", range(6, 12))
def test_none_is_made_up(seed):
    assert first_falloff(made(seed, NO_FALLOFF)[0], 6) == NO_FALLOFF
    # two videos are no witnesses of each other, however many pictures they have; and no lens brightens corners
    assert first_falloff(made(seed, Falloff(-0.3, 0.0), videos=2, stills=8)[0], 2) == NO_FALLOFF
    assert first_falloff(made(seed, Falloff(0.3, 0.0))[0], 6) == NO_FALLOFF
    middle = made(seed, Falloff(-0.3, 0.0))[0]
    near = np.where((middle.radii < 0.3)[..., None], middle.colors, np.nan)
    assert first_falloff(Compared(near, middle.radii, middle.video).shared(), 6) == NO_FALLOFF


@pytest.mark.parametrize("overlap", ["all", "pairs"])
def test_what_one_lamp_does_in_all_pictures_of_a_video_is_no_falloff(overlap):
    """Three videos of six pictures, each point as bright as its own video's lamp makes it: by pictures 7 of 12 seemed
    sure. Where points are seen by two of the videos, most are seen by one where a video is left out: they are no
    witnesses that nothing changes."""
    found = 0
    for seed in range(24):
        compared, _ = made(seed, NO_FALLOFF, videos=3, stills=6 if overlap == "all" else 1, seen=1.0)
        if overlap == "pairs":
            compared = in_pairs(compared)
        rng = np.random.default_rng([seed, 2])
        patch = (compared.radii * 8).astype(int)
        lamps = 0.08 * rng.standard_normal((3, 9))
        sheen = lamps[compared.video[:, None], patch]
        found += (
            first_falloff(Compared(compared.colors + sheen[..., None], compared.radii, compared.video), 3) != NO_FALLOFF
        )
    assert found <= 1


def test_three_cameras_that_overlap_in_pairs_tell_it():
    """Without one of them most points are seen once: those say nothing, rather than nothing at all changes."""
    for seed in range(4):
        compared, _ = made(seed, Falloff(-0.3, 0.0), videos=3, outlying=0.0, seen=1.0)
        assert first_falloff(in_pairs(compared), 3).second == pytest.approx(-0.3, abs=0.02)


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


def test_a_new_view_of_dark_corners():
    """With the falloff a camera that was held out is shown 2 dB better than without, and as well as an even one."""
    capture = synthetic(9, cameras=6, frames=8, size=(128, 76), offsets=0, effects=(DarkCorners(0.3),))
    held = capture.held_out[0]

    def score(falloff: Falloff | None = None) -> float:
        fitted = fit_backdrop(capture.footage, depth=capture.depth, falloff=falloff, steps=200, progress=False)
        drawn = backdrop_of(fitted, held)
        seen = held.background_seen
        drawn = drawn * colour_gain(drawn, held.background, seen)
        return float(-10 * np.log10(np.square(drawn - held.background / 255.0)[seen].mean()))

    modelled = score()
    assert modelled > 2 + score(NO_FALLOFF) and modelled > 30
    assert abs(score(Falloff(float(np.log(0.7)), 0.0)) - modelled) < 0.5


def test_seeds_have_the_colours_of_the_surface_wherever_they_were_seen():
    even, dark = (
        synthetic(9, cameras=4, frames=4, size=(128, 76), offsets=0, effects=effects)
        for effects in ((), (DarkCorners(0.5),))
    )
    falloff = Falloff(float(np.log(0.5)), 0.0)

    def colors(capture, falloff: Falloff) -> np.ndarray:
        stills = stills_of(capture.footage, capture.depth)
        around = surroundings(stills_of(even.footage, even.depth))
        surfaces = [surface_of(s, around, 0.6) for s in stills]
        return seed_discs(stills, surfaces, around, 0.6, falloff=falloff).color

    true = colors(even, NO_FALLOFF)
    assert np.abs(colors(dark, falloff) - true).mean() < 0.01 < np.abs(colors(dark, NO_FALLOFF) - true).mean() / 3


def test_a_falloff_that_is_known_stays():
    capture = synthetic(9, cameras=3, frames=4, size=(64, 40), offsets=0)
    for known in (NO_FALLOFF, Falloff(-0.2, 0.05)):
        assert fit_backdrop(capture.footage, steps=5, falloff=known, progress=False).falloff == known


def test_learned_ones_darken_all_the_way():
    for start in ((0.3, 0.2), (-0.1, 9.0), (-9.0, -9.0), (-0.2, 0.05)):
        falloff = torch.tensor(start)
        darkening_(falloff)
        v = Falloff(*falloff.tolist()).at(np.linspace(0, 1, 20))
        assert (np.diff(v) <= 1e-7).all() and falloff.abs().max() <= 5
    assert falloff.tolist() == pytest.approx((-0.2, 0.05))
