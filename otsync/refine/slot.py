"""The slot of refiners: what one is, and what it may declare."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from ..types import Alignment, Matches, TrackSet
from ..types.trust import Trust

RefinerLike = Callable[[TrackSet, TrackSet, Matches, Alignment], Alignment]
"""Anything that refines an alignment: a :class:`Refiner`, or a callable of your own."""

Rate = Literal["fixed", "fit"]

JUDGED_BY = ("evidence", "margin", "rate_sigmas", "lag")
"""The limits of a refiner's ``trust`` that the graph of pairs reads."""


class Refiner:
    """Base of otsync's refiners. A callable of your own needs none of it; what it lacks has these defaults.

    Attributes:
        needs_xyz: whether it reads positions in space; one that reads pixels alone says False.
        rate: whether it fits the rate of the clocks.
        trust: the thresholds behind its flags, by which the graph of pairs judges too.
    """

    needs_xyz: bool = True
    rate: Rate = "fixed"
    trust: Trust = Trust()

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment) -> Alignment:
        raise TypeError(
            f"{type(self).__name__}: a refiner is called with (a, b, matches, alignment); it defines no such call."
        )

    def with_rate(self, rate: Rate) -> Refiner:
        """The refiner told to fit the rate of the clocks, or to take it as declared.

        ValueError where it cannot fit one.
        """
        if rate == "fit":
            raise ValueError(
                f"rate: expected 'fixed' with {self}, which fits no rates; found 'fit'. Use SplineRefine, or leave the "
                "rates as declared."
            )
        return self

    @staticmethod
    def of(refiner: RefinerLike) -> Refiner:
        """``refiner`` itself, or a callable of somebody else's with the defaults."""
        return refiner if isinstance(refiner, Refiner) else Foreign(refiner)


@dataclass(frozen=True)
class Foreign(Refiner):
    """A callable that knows nothing of :class:`Refiner`; attributes of the same names are heeded all the same."""

    call: RefinerLike

    @property
    def needs_xyz(self) -> bool:  # type: ignore[override]
        return getattr(self.call, "needs_xyz", True)

    @property
    def trust(self) -> Trust:  # type: ignore[override]
        return getattr(self.call, "trust", Trust())

    def __call__(self, a: TrackSet, b: TrackSet, matches: Matches, alignment: Alignment) -> Alignment:
        return self.call(a, b, matches, alignment)

    @property
    def rate(self) -> Rate:  # type: ignore[override]
        return getattr(self.call, "rate", "fixed")

    def with_rate(self, rate: Rate) -> Refiner:
        told = getattr(self.call, "with_rate", None)
        return super().with_rate(rate) if told is None else Refiner.of(told(rate))
