"""How long a break of a clock is: mostly a whole number of its frames."""

from __future__ import annotations

import math

import numpy as np

from ..types import Break

WHOLE, PAUSED_WHOLE = 0.8, 0.98
"""How likely it is that lost frames are a whole number, and that repeated ones are. A camera whose clock runs on while
frames are lost loses whole ones; a recorder that paused goes on anywhere."""

ROUNDING, MOST_FRAMES = 1e-6, 3.0
"""Frames: a sigma below the first is that, and one above the second tells no whole number."""


def lasting(start: float, length: float, sigma: float, frame: float) -> Break:
    """A pause from ``start`` on, of the likeliest length, in whole frames where nothing tells how well it is known: all
    in s.
    """
    if not math.isfinite(sigma):
        length = round(length / frame) * frame
    length, sigma = in_frames(length, sigma, frame, PAUSED_WHOLE)
    return Break(start + length, -length, length, sigma)


def jumping(at: float, jump: float, sigma: float, frame: float) -> Break:
    """A clock that jumps as lost frames and cuts make it, by the likeliest length: all in s."""
    jump, sigma = in_frames(jump, sigma, frame, WHOLE)
    return Break(at, jump, 0.0, sigma)


def in_frames(length: float, sigma: float, frame: float, whole: float) -> tuple[float, float]:
    """The mean and one standard deviation, s, of a length that was measured, where it is a whole number of frames with
    the probability ``whole``, each as likely as the next, and else any length.

    A sigma of nan (its own parts cannot tell) stays.
    """
    if not math.isfinite(sigma):
        return length, sigma
    known = max(sigma / frame, ROUNDING)
    if known > MOST_FRAMES:
        return length, sigma  # whole numbers are too dense to tell
    told = length / frame
    values = np.round(told) + np.arange(-np.ceil(6 * known), np.ceil(6 * known) + 1)
    each = math.log(whole) - math.log(known * math.sqrt(2 * math.pi)) - (values - told) ** 2 / (2 * known**2)
    each = np.append(each, math.log1p(-whole))
    weight = np.exp(each - each.max())
    weight /= weight.sum()
    mean = float(weight @ np.append(values, told))
    variance = float(weight @ (np.append(values, told) - mean) ** 2 + weight[-1] * known**2)
    return mean * frame, math.sqrt(variance) * frame
