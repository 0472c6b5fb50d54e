"""How long a break is: whole frames, by how clear it is how many."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otsync.clocks.lengths import PAUSED_WHOLE, WHOLE, in_frames, jumping, lasting


@pytest.mark.parametrize(
    "length, sigma, frames, off",
    [
        (29.1, 0.05, 29, 0.02),  # surely 29
        (29.38, 0.126, 29.15, 0.2),  # 29, or no whole number
        (29.45, 0.02, 29.45, 0.03),  # no whole number
        (29.1, 0.35, 29.03, 0.2),  # it may be 30
        (29.5, 0.25, 29.5, 0.5),  # it is one of the two
        (29.2, 4.0, 29.2, 4.0),  # nobody knows
    ],
)
def test_a_pause_has_whole_frames_by_how_clear_it_is_how_many(length, sigma, frames, off):
    found = lasting(2.0, length / 30, sigma / 30, 1 / 30)
    assert found.still == -found.jump and found.at == 2.0 + found.still
    assert found.still * 30 == pytest.approx(frames, abs=0.02)
    assert found.sigma * 30 == pytest.approx(off, abs=0.05)


def test_a_pause_that_nobody_could_measure_has_whole_frames():
    found = lasting(2.0, 29.2 / 30, float("nan"), 1 / 30)
    assert found.still * 30 == pytest.approx(29) and np.isnan(found.sigma)
    lost = jumping(2.0, 29.2 / 30, float("nan"), 1 / 30)
    assert lost.jump * 30 == pytest.approx(29.2) and np.isnan(lost.sigma)


@given(
    length=st.floats(-60, 60),
    sigma=st.floats(0, 2),
    whole=st.sampled_from((WHOLE, PAUSED_WHOLE)),
    more=st.integers(-40, 40),
    fps=st.sampled_from((24.0, 30.0, 120.0)),
)
def test_a_likely_length_goes_with_what_is_measured(length, sigma, whole, more, fps):
    told, known = in_frames(length / fps, sigma / fps, 1 / fps, whole)
    assert known >= 0 and abs(told * fps - length) <= 0.5 + 1e-9
    later = in_frames((length + more) / fps, sigma / fps, 1 / fps, whole)
    np.testing.assert_allclose(np.multiply(later, fps), [told * fps + more, known * fps], atol=1e-5)
    back = in_frames(-length / fps, sigma / fps, 1 / fps, whole)
    np.testing.assert_allclose(np.multiply(back, fps), [-told * fps, known * fps], atol=1e-5)


@pytest.mark.parametrize("whole", (WHOLE, PAUSED_WHOLE))
@pytest.mark.parametrize("sigma, share", [(0.05, 0.8), (0.15, 0.8), (0.3, 0.95)])
def test_sigma_of_a_likely_length_is_what_it_is_off_by(whole, sigma, share):
    """Drawn as it is said: whole numbers with that probability, else any; measured to within sigma."""
    rng = np.random.default_rng(5)
    true = rng.uniform(8, 20, 4000)
    true = np.where(rng.random(4000) < whole, np.round(true), true)
    measured = true + sigma * rng.standard_normal(4000)
    told, known = np.transpose([in_frames(m / 30, sigma / 30, 1 / 30, whole) for m in measured]) * 30
    off = float(np.sqrt(np.mean((told - true) ** 2)))
    assert off == pytest.approx(float(np.sqrt(np.mean(known**2))), rel=0.1)
    assert off < share * sigma
