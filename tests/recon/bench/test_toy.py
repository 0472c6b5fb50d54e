"""The toy photometric synchronisation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline

from recon.bench import toy


def test_the_spline_is_scipy_s_cubic_hermite():
    control = torch.randn(4, 9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    knots = np.arange(1, 8) * toy.KNOT_SPACING - toy.KNOT_SPACING
    tangents = (control[:, 2:] - control[:, :-2]).numpy() / (2 * toy.KNOT_SPACING)
    spline = CubicHermiteSpline(knots, control[:, 1:-1].numpy(), tangents, axis=1)
    for t in (0.0, 1.3, 5.0, 17.9, 29.0):
        time = torch.tensor(t, dtype=torch.float64, requires_grad=True)
        at = toy.positions(control, time)
        np.testing.assert_allclose(at.detach().numpy(), spline(t), atol=1e-12)
        (speed,) = torch.autograd.grad(at[0, 0], time)
        np.testing.assert_allclose(float(speed), spline(t, 1)[0, 0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_offsets_to_a_hundredth_of_a_frame(seed):
    """300 Gaussians, 5 cameras at 128 x 96, 40 frames; offsets start about half a frame off."""
    world = toy.world(seed=seed)
    assert world.videos.shape == (5, 40, 96, 128, 3)
    assert world.offsets.abs().mean() > 0.3
    result = toy.fit(world)
    assert result.errors.abs().max() <= 0.01
    assert result.loss[-50:].mean() < 0.1 * result.loss[:50].mean()
