"""One clock read on another: ``t_world = rate * t_own + offset``, written once; and where a clock breaks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

Source = Literal["given", "found", "fitted"]
"""Where a clock comes from: given by the user, found on the frozen scene, or refined by the fit."""


@dataclass(frozen=True)
class Clock:
    """A video's clock: seconds of the world (or of another video, for a pair) from seconds of its own.

    Args:
        offset: seconds; positive when the video started later. rate: seconds of the world per second of its own.
        how: how it is known.
    """

    offset: float = 0.0
    rate: float = 1.0
    how: Source = "given"

    def world(self, own: Any) -> Any:
        """``t_world = rate * t_own + offset``, of a number or an array."""
        return self.rate * own + self.offset

    def own(self, world: Any) -> Any:
        """``t_own = (t_world - offset) / rate``."""
        return (world - self.offset) / self.rate


@dataclass(frozen=True)
class Break:
    """A video that from some frame on shows another time than its own clock says: it froze, lost frames, or was cut.

    Args:
        at: seconds of the video's own clock from which on times are off.
        jump: seconds that must be added to the video's own times from then on. Negative behind a freeze, which was
            played out late; positive where frames were lost or the recorder paused.
        still: seconds before ``at`` in which the picture stood still; those frames tell no time.
        sigma: one standard deviation of ``jump``, s; nan when not estimated.
    """

    at: float
    jump: float
    still: float = 0.0
    sigma: float = math.nan

    def __post_init__(self) -> None:
        for name in ("at", "jump", "still"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"Break.{name}: expected a finite number of seconds; found {getattr(self, name)}.")
        if self.still < 0:
            raise ValueError(f"Break.still: expected seconds >= 0; found {self.still}.")

    def __str__(self) -> str:
        if self.still > 0:
            return f"stands still for {self.still:.3g} s before {self.at:.3f} s"
        return f"{'misses' if self.jump > 0 else 'goes back by'} {abs(self.jump):.3g} s at {self.at:.3f} s"


ROUNDING = 1e-6
"""Seconds by which a frame may lie beside the moment of a break."""


def mended_times(
    times: Float[np.ndarray, " T"], breaks: Sequence[Break]
) -> tuple[Float[np.ndarray, " T"], Bool[np.ndarray, " T"]]:
    """What a video's frames show, on its own clock as it was before the first break; and which frames tell a time.

    Where a jump goes back beyond frames before it (a cut), mended times do not increase.
    """
    shown, tells = np.array(times, float), np.ones(len(times), bool)
    for b in breaks:
        shown[times >= b.at - ROUNDING] += b.jump
        tells &= ~((times >= b.at - b.still - ROUNDING) & (times < b.at - ROUNDING))
    return shown, tells


def mended_frames(
    times: Float[np.ndarray, " T"], breaks: Sequence[Break]
) -> tuple[Int[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Which frames tell a time, in the order of what they show, and when that is; of two at one moment the first."""
    shown, tells = mended_times(times, breaks)
    keep = np.flatnonzero(tells)
    keep = keep[np.argsort(shown[keep], kind="stable")]
    keep = keep[np.concatenate([[True], np.diff(shown[keep]) > ROUNDING])]
    return keep, shown[keep]
