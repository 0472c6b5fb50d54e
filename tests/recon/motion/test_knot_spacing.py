"""How far apart knots may stand is read off the tracks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otsync.types import TrackSet
from recon.motion import ScaffoldOptions, build_scaffold
from recon.motion.solve import FRAME
from recon.motion.track_curves import WIDEST, knot_spacing

FOOTPRINT = 0.01


def swinging(hertz, *, tracks=40, frames=60, fps=30.0, amplitude=30.0, noise=0.8, seed=0) -> TrackSet:
    """Points that swing at the given rates, one after another; amplitude and noise in footprints."""
    rng = np.random.default_rng(seed)
    rates, t = np.resize(np.atleast_1d(hertz), tracks), np.arange(frames) / fps
    phase = 2 * np.pi * (rates[:, None] * t + rng.random((tracks, 1)))
    way = rng.standard_normal((tracks, 1, 3))
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    xyz = amplitude * np.sin(phase)[..., None] * way + noise * rng.standard_normal((tracks, frames, 3))
    return TrackSet(FOOTPRINT * (xyz + 500), np.ones((tracks, frames), bool), fps=fps)


def spacing(*tracks, footprint=FOOTPRINT, **given):
    return knot_spacing(tracks, spline="b-spline", footprint=footprint, **given)


@pytest.mark.parametrize("hertz", [0.0, 0.3, 1.0])
def test_what_swings_once_a_second_needs_no_more_knots(hertz):
    assert spacing(swinging(hertz), swinging(hertz, seed=1)) == WIDEST


def test_what_swings_faster_does():
    assert spacing(swinging(3.5)) < WIDEST
    assert spacing(swinging([*[0.5] * 3, 3.5])) < WIDEST  # a hand is a part of a body
    assert spacing(swinging([*[0.5] * 19, 3.5])) == WIDEST  # a track that went astray is a small one


def test_what_nobody_sees_asks_for_nothing():
    assert spacing(swinging(3.5, amplitude=0.4, noise=0.01)) == WIDEST
    assert spacing(swinging(3.5, amplitude=30, noise=0.01)) < WIDEST


def test_cameras_that_see_faster_follow_faster_things():
    slow, fast = (swinging(12.0, fps=240.0, frames=480, tracks=20, amplitude=a) for a in (0.2, 30.0))
    assert spacing(slow) == WIDEST  # a fifth of a pixel
    assert spacing(fast) <= WIDEST / 3
    assert spacing(swinging(12.0), fast) <= WIDEST / 3  # the finest that any video asks for


def test_a_clock_s_rate_counts():
    """Four times slower as filmed: a swing a second by the video's clock is one in a quarter of a second."""
    filmed = swinging(1.0, frames=240)
    assert spacing(filmed) == WIDEST
    assert spacing(filmed, rates=np.array([0.25])) < WIDEST


@given(st.floats(1e-3, 1e4), st.integers(0, 50))
def test_units_do_not_matter(scale, seed):
    tracks = swinging([0.5, 3.5], tracks=12, seed=seed)
    scaled = TrackSet(scale * tracks.xyz, tracks.visible, fps=30)
    assert spacing(scaled, footprint=scale * FOOTPRINT) == spacing(tracks)


@given(st.integers(0, 200))
def test_noise_asks_for_nothing(seed):
    assert spacing(swinging(0.5, noise=8.0, seed=seed)) == WIDEST


def test_tracks_too_short_to_tell_ask_for_nothing():
    assert spacing(swinging(3.5, frames=15)) == WIDEST
    assert spacing(swinging(3.5, frames=1)) == WIDEST
    assert spacing() == spacing(swinging(3.5).take(slice(0, 0))) == WIDEST


def test_gaps_are_no_motion():
    tracks = swinging(0.5)
    holes = tracks.visible.copy()
    holes[:, 20:24] = holes[::2, 40] = False
    assert spacing(TrackSet(tracks.xyz, holes, fps=30)) == WIDEST
    fast = swinging(3.5)
    assert spacing(TrackSet(fast.xyz, holes, fps=30)) < WIDEST


def test_a_scaffold_has_the_spacing_that_its_tracks_ask_for():
    units = {"footprint": FOOTPRINT, "frame_step": FRAME}
    fast, offsets = [swinging(3.5), swinging(3.5, seed=1)], np.zeros(2)
    found = build_scaffold(fast, offsets, **units).path.spacing
    assert found == spacing(*fast) < WIDEST
    for options in (ScaffoldOptions(spacing=0.1), ScaffoldOptions(spacing=0.1, per_video=True)):
        assert build_scaffold(fast, offsets, options=options, **units).path.spacing == 0.1
    assert build_scaffold(fast, offsets, options=ScaffoldOptions(per_video=True), **units).path.spacing == found
