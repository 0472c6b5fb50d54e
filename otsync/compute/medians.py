"""Medians and quantiles of what is known. numpy's own go by way of masked arrays, one row at a time: far longer."""

from __future__ import annotations

from typing import Any

import numpy as np


def known_median(x: Any, axis: int) -> np.ndarray:
    """Median along an axis of what is finite, (..., N, ...) to (...); nan where nothing is, without a warning.

    Example:
        >>> known_median([[1.0, np.nan, 4.0], [np.inf, np.nan, 3.0]], 0)
        array([1. , nan, 3.5])
    """
    values = np.moveaxis(np.asarray(x, float), axis, -1)
    if not values.shape[-1]:
        return np.full(values.shape[:-1], np.nan)
    known = np.isfinite(values)
    ordered = np.sort(np.where(known, values, np.nan), -1)  # nan comes last
    count = known.sum(-1)
    middle = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, values.shape[-1] - 1)
    low, high = (np.take_along_axis(ordered, k[..., None], -1)[..., 0] for k in middle)
    return np.mean([low, high], axis=0)  # of nothing, both are nan


def known_quantiles(x: Any, quantiles: Any, axis: int) -> np.ndarray:
    """Quantiles along an axis of what is finite, (..., N, ...) to (Q, ...); nan where nothing is, without a warning.

    Between two values on a line, as numpy's ``linear``.

    Example:
        >>> known_quantiles([[1.0, np.nan, 4.0], [np.inf, np.nan, 3.0]], [0.5, 1.0], 0)
        array([[1. , nan, 3.5],
               [1. , nan, 4. ]])
    """
    values = np.moveaxis(np.asarray(x, float), axis, -1)
    asked = np.asarray(quantiles, float).reshape(-1, *[1] * (values.ndim - 1))
    if not values.shape[-1]:
        return np.full((len(asked), *values.shape[:-1]), np.nan)
    known = np.isfinite(values)
    ordered = np.sort(np.where(known, values, np.nan), -1)  # nan comes last
    at = asked * np.maximum(known.sum(-1) - 1, 0)
    low = np.floor(at).astype(int)
    high = np.ceil(at).astype(int)
    below, above = (np.take_along_axis(ordered[None], k[..., None], -1)[..., 0] for k in (low, high))
    return below + (at - low) * (above - below)
