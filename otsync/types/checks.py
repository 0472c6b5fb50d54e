"""Checks of options that are numbers, before any work. ValueError names the option, what was expected and found."""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np


def positive(name: str, value: float, *, zero: bool = False) -> None:
    real = isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)
    if not (real and np.isfinite(value) and (value > 0 or (zero and value == 0))):
        found = f"{value}" if real else repr(value)
        raise ValueError(f"{name}: expected a number {'>=' if zero else '>'} 0; found {found}.")


def check_number(name: str, value: Any, above: float = 0.0, below: float = math.inf) -> None:
    """Refuse what is no number strictly between the bounds; True and False are none."""
    real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not (real and above < value < below):
        bounds = (
            f"a finite number above {above:g}" if below == math.inf else f"a number between {above:g} and {below:g}"
        )
        raise ValueError(f"{name}: expected {bounds}; found {value!r}.")


def check_whole(name: str, value: Any, least: int, most: float = math.inf) -> None:
    """Refuse what is no whole number from ``least`` to ``most``; True and False are none."""
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not (whole and least <= value <= most):
        bounds = f"{least} or more" if most == math.inf else f"{least} to {most:g}"
        raise ValueError(f"{name}: expected a whole number, {bounds}; found {value!r}.")
