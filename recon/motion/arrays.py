"""Tensors from a stranger's arrays, checked here: compiled kernels trust shapes and indices."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

FLOATS = (np.float32, np.float64)

Arrays = Mapping[str, np.ndarray]


def numbers(
    arrays: Arrays, name: str, shape: tuple[int | None, ...], dtypes: tuple[type, ...] = FLOATS, *, like: str = ""
) -> Tensor:
    """A copy of an array of finite numbers, of one of ``dtypes`` and of ``shape`` (None: any length), which the arrays
    named in ``like`` tell.

    KeyError where there is no such array; ValueError names one that does not fit.
    """
    array = np.asarray(arrays[name])
    fits = array.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, array.shape, strict=True))
    if not fits or array.dtype not in [np.dtype(kind) for kind in dtypes]:
        raise ValueError(
            f"{name}: expected {' or '.join(kind.__name__ for kind in dtypes)} of shape ({_text(shape)})"
            f"{like and f' as {like} say'}; found {array.dtype} of shape {array.shape}."
        )
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers; found nan or infinity.")
    return torch.from_numpy(np.array(array, order="C"))


def indices(arrays: Arrays, name: str, shape: tuple[int | None, ...], count: int, *, like: str = "") -> Tensor:
    """A copy of int64 indices 0..count - 1 of ``shape``; errors and ``like`` as of :func:`numbers`."""
    index = numbers(arrays, name, shape, (np.int64,), like=like)
    if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < count:
        raise ValueError(
            f"{name}: expected indices 0 to {count - 1}{like and f' as {like} say'}; found {int(index.min())} to "
            f"{int(index.max())}."
        )
    return index


def scalar(arrays: Arrays, name: str) -> float:
    """A finite number > 0; errors as of :func:`numbers`."""
    value = float(numbers(arrays, name, ()))
    if not value > 0:
        raise ValueError(f"{name}: expected a number > 0; found {value}.")
    return value


def _text(shape: tuple[int | None, ...]) -> str:
    return ", ".join("any" if n is None else str(n) for n in shape)
