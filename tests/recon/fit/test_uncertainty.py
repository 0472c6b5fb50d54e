"""Sigma of a refined clock against experiments whose spread is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon.fit.uncertainty import newton_sigma, sandwich


def test_sandwich_is_the_variance_of_the_weighted_step():
    rng = np.random.default_rng(0)
    h = rng.uniform(0.5, 2.0, 12)
    noise = 0.3 * rng.normal(size=(4000, 12)) * np.sqrt(h)
    steps = -noise.sum(1) / h.sum()
    told = np.array([sandwich(g, h) for g in noise])
    # the told variance holds the spread once and the step itself once more
    assert told.mean() == pytest.approx(2 * steps.var(), rel=0.1)


def test_a_common_pull_counts_as_bias():
    h = np.ones(12)
    assert sandwich(-0.2 * h, h) == pytest.approx(0.04)
    assert np.isnan(sandwich(np.zeros(12), np.zeros(12))) and np.isnan(sandwich(np.ones(1), np.ones(1)))


def test_offset_errors_are_told():
    """Sinusoidal pixels, a wrong offset per video and errors that each frame shares among all its pixels."""
    true, frame_step = np.array([0.0, 0.002, -0.004]), 1 / 30
    phase = torch.linspace(0, 6, 400).reshape(10, 40, 1).repeat(1, 1, 3)

    def pixels(seconds: float) -> torch.Tensor:
        return torch.sin(phase + 9 * seconds)

    keys = np.array([(v, k) for v in range(3) for k in range(24)])
    wobble = np.random.default_rng(1).normal(size=(3, 24)) * 0.003
    sigma = newton_sigma(
        lambda v, k, later: pixels(k * frame_step + later),
        lambda v, k: pixels(k * frame_step + true[v] + wobble[v, k]),
        keys,
        0,
        3,
        frame_step,
        frames=24,
    )
    expected = np.sqrt(0.003**2 / 24 * 2 + true**2)
    assert sigma[0] == 0
    assert sigma[1:] == pytest.approx(expected[1:], rel=0.5)


def test_a_video_that_shows_no_motion_has_no_sigma():
    still = torch.zeros(2, 2, 3)
    keys = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    sigma = newton_sigma(lambda v, k, later: still, lambda v, k: still, keys, 0, 2, 1 / 30)
    assert sigma[0] == 0 and np.isnan(sigma[1])


def test_the_reference_s_own_error_counts():
    """Offsets are relative to the reference: where that is wrong, all others are as unsure."""
    phase = torch.linspace(0, 6, 400).reshape(10, 40, 1).repeat(1, 1, 3)

    def pixels(seconds: float) -> torch.Tensor:
        return torch.sin(phase + 9 * seconds)

    sigma = newton_sigma(
        lambda v, k, later: pixels(k / 30 + later),
        lambda v, k: pixels(k / 30 + (0.004 if v == 0 else 0.0)),
        np.array([(v, k) for v in range(2) for k in range(12)]),
        0,
        2,
        1 / 30,
    )
    assert sigma[0] == 0 and sigma[1] == pytest.approx(0.004, rel=0.1)
