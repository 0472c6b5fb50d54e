"""One clock read on another: ``t_world = rate * t_own + offset``, written once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

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
