"""Evenly spread indices."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from otsync.compute.indices import evenly


@given(st.integers(0, 300), st.integers(1, 300))
def test_indices_are_evenly_spread_from_the_first_to_the_last(count, most):
    chosen = evenly(count, most)
    assert len(chosen) == min(count, most)
    if count <= most:
        np.testing.assert_array_equal(chosen, np.arange(count))
    elif most > 1:
        assert (chosen[0], chosen[-1]) == (0, count - 1)
        steps = np.diff(chosen)
        assert steps.min() >= 1 and np.ptp(steps) <= 1
    else:
        assert chosen.tolist() == [0]
