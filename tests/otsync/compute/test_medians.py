"""Medians of what is known, against numpy's own."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from otsync.compute.medians import known_median, known_quantiles

VALUES = st.floats(-1e6, 1e6) | st.just(np.nan)


@given(st.data(), array_shapes(min_dims=1, max_dims=3, max_side=6))
def test_it_is_numpys(data, shape):
    x = data.draw(arrays(float, shape, elements=VALUES))
    axis = data.draw(st.integers(-len(shape), len(shape) - 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # numpy's, of slices without a number
        expected = np.nanmedian(x, axis)
    np.testing.assert_array_equal(known_median(x, axis), expected)


@given(st.data(), array_shapes(min_dims=1, max_dims=3, max_side=6), st.lists(st.floats(0, 1), max_size=4))
def test_quantiles_are_numpys(data, shape, asked):
    x = data.draw(arrays(float, shape, elements=VALUES))
    axis = data.draw(st.integers(-len(shape), len(shape) - 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        expected = np.nanquantile(x, asked, axis)
    np.testing.assert_allclose(known_quantiles(x, asked, axis), expected, rtol=1e-12, atol=1e-6)


@pytest.mark.parametrize("axis, expected", [(0, [np.nan] * 3), (1, [])])
def test_of_nothing_nothing_is_known(axis, expected):
    np.testing.assert_array_equal(known_median(np.zeros((0, 3)), axis), expected)


def test_infinity_is_not_known():
    assert known_quantiles([np.inf, 1.0, -np.inf, 2.0], [0.25], 0) == [1.25]
    assert known_median([np.inf, 1.0, -np.inf, 2.0], 0) == 1.5
