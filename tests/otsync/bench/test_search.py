"""A search for a confident wrong answer: worlds that hypothesis makes up, steered to errors of many sigmas.

An answer is judged by most of its frames, and by all where a step of the clock would be heard. A clock that steps so
near to an end that noise hides it is beyond what an answer promises (:attr:`otsync.Offsets.steps_heard`).
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings, target
from hypothesis import strategies as st

from otsync import synchronize
from otsync.bench.sync_acceptance import WRONG
from otsync.bench.sync_worlds import FPS, MOVING
from otsync.bench.trust.worlds import plain
from otsync.simulate.effects import (
    ClockDrift,
    ClockRamp,
    ClockSway,
    Cut,
    Drop,
    Freeze,
    In,
    Lag,
    LimbDrift,
    Repeats,
    Replay,
    SharedDrift,
    SlowMotion,
)

WORLDS = 400
"""Ten minutes on one core. The worlds are the same in every run, so that the verdict is, too."""

FAULTS = st.one_of(
    st.integers(4, 45).map(Freeze),
    st.tuples(st.floats(0.1, 1.5), st.floats(0.1, 0.9)).map(lambda x: Drop(x[0], at=x[1])),
    st.builds(Cut),
    st.sampled_from([15.0, 20.0, 24.0, 25.0]).map(Repeats),
    st.tuples(st.floats(0.2, 2.0), st.floats(0.1, 0.9)).map(lambda x: Replay(*x)),
    st.floats(1.3, 4.0).map(SlowMotion),
    st.floats(0.02, 0.3).map(ClockDrift),
    st.floats(-0.1, 0.1).map(ClockRamp),
    st.floats(0.002, 0.1).map(ClockSway),
    st.floats(0.005, 0.05).map(LimbDrift),
    st.floats(0.01, 0.2).map(Lag),
    st.floats(0.02, 0.3).map(SharedDrift),
)


@pytest.mark.slow
@settings(
    max_examples=WORLDS,
    derandomize=True,
    database=None,
    deadline=None,
    phases=(Phase.generate, Phase.target, Phase.shrink),
    suppress_health_check=list(HealthCheck),
)
@given(
    seed=st.integers(0, 9_999),
    motion=st.sampled_from(MOVING),
    preset=st.sampled_from(["clean", "mid", "hard", "brutal"]),
    frames=st.integers(60, 240),
    tracks=st.integers(20, 160),
    within=st.floats(0, 45),
    faults=st.lists(st.tuples(st.integers(0, 1), FAULTS), max_size=2),
)
def test_no_answer_is_trusted_and_wrong(seed, motion, preset, frames, tracks, within, faults):
    effects = tuple(In(video, fault) for video, fault in faults)
    try:
        world = plain(seed, motion=motion, preset=preset, frames=frames, tracks=tracks, within=within, first=effects)
    except ValueError:
        return  # a fault that does not fit into the clip
    offsets = synchronize(world.tracks)
    if not offsets.status[1].ok or not np.isfinite(offsets.seconds[1]):
        return
    error = float(world.where_heard(offsets)[0])
    target(min(error / (float(offsets.sigma[1]) * FPS), 1e3), label="sigmas")
    assert error <= WRONG, f"{error:.2f} frames at sigma {offsets.sigma[1] * FPS:.3f}"
