"""Samples as they were seen: read between neighbours, and of a gap in a clock nothing is known."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync.sync.alike import Raw

FPS = 30.0


def test_a_rate_that_falls_leaves_no_gap():
    """60 frames a second, then 20 in which each lies 3 usual steps from the next; a single frame tells nothing."""
    times = np.concatenate([np.arange(90) / 60, 1.5 + np.arange(20) / 20])
    raw = Raw(times, np.repeat(times[None, :, None], 3, 2))
    t = np.linspace(0, times[-1], 300)
    assert raw.sampled(t).all()
    np.testing.assert_allclose(raw.at(t)[0, :, 0], t, atol=1e-12)
    twice = np.sort(np.concatenate([times, times[20:60] + 1e-4]))  # a replay, put right
    assert Raw(twice, np.zeros((1, len(twice), 3))).sampled(t).all()
    lone = Raw(times[:1], raw.x[:, :1])
    assert np.isnan(lone.at(t)).all() and not lone.sampled(t).any()


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    frames=st.integers(12, 60),
    at=st.integers(2, 6),
    missing=st.integers(2, 40),
    moments=st.lists(st.floats(-1, 4), min_size=1, max_size=20),
)
def test_positions_lie_on_lines_between_samples_and_nowhere_in_a_gap(seed, frames, at, missing, moments):
    rng = np.random.default_rng(seed)
    k = np.arange(frames) + np.where(np.arange(frames) >= at, missing, 0)
    x = rng.normal(size=(5, frames, 3))
    raw, t = Raw(k / FPS, x), np.array([*moments, *(k / FPS)])
    found = raw.at(t)
    outside = (t < raw.times[0]) | (t > raw.times[-1])
    inside = (t > raw.times[at - 1]) & (t < raw.times[at])
    assert np.isnan(found[:, outside | inside]).all()
    asked = ~outside & ~inside
    lines = [[np.interp(t[asked], raw.times, axis) for axis in track.T] for track in x]
    np.testing.assert_allclose(found[:, asked], np.swapaxes(lines, 1, 2), atol=1e-9)
