"""The slot of matchers: what one is, and what it may declare."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..costs.linear import Cosine, Cost
from ..types import Clock, Matches, TrackSet

MatcherLike = Callable[[TrackSet, TrackSet], Matches]
"""Anything that matches two track sets: a :class:`Matcher`, or a callable of your own."""


class Matcher:
    """Base of otsync's matchers. A callable of your own needs none of it; what it lacks has these defaults.

    Attributes:
        costs: the linear costs that it minimises, by which its answer is checked (:mod:`otsync.match.vouch`) and pairs
            are matched once more at known times; () when it minimises something else.
    """

    costs: tuple[Cost, ...] = ()

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        raise TypeError(f"{type(self).__name__}: a matcher is called with two track sets; it defines no such call.")

    def at(self, clock: Clock) -> Matcher | None:
        """The matcher to use once the clock of b against a's is known.

        None: as for any matcher, mutual nearest neighbours at equal times (:class:`otsync.match.SynchronousMatching`).
        """
        return None

    def checked_by(self, a: TrackSet, b: TrackSet) -> tuple[Cost, ...]:
        """The costs by which its answer is checked."""
        return self.costs

    @property
    def clock(self) -> Clock | None:
        """The clock of b against a's that it compares by; None: it needs no time."""
        told = (getattr(cost, "clock", None) for cost in self.costs)
        return next((clock for clock in told if clock is not None), None)

    @property
    def needs_xyz(self) -> bool:
        """Whether it reads positions in space; one that reads pixels and features alone says False."""
        return any(getattr(cost, "needs_xyz", False) for cost in self.costs)

    @property
    def needs_features(self) -> bool:
        """Whether track sets without features are refused before any work."""
        return any(isinstance(cost, Cosine) for cost in self.costs)

    @staticmethod
    def of(matcher: MatcherLike) -> Matcher:
        """``matcher`` itself, or a callable of somebody else's with the defaults."""
        return matcher if isinstance(matcher, Matcher) else Foreign(matcher)


class StructuralMatcher(Matcher):
    """Base of matchers that compare distances among the tracks of one video: they read positions in space."""

    @property
    def needs_xyz(self) -> bool:
        return True


@dataclass(frozen=True)
class Foreign(Matcher):
    """A callable that knows nothing of :class:`Matcher`; attributes of the same names are heeded all the same."""

    call: MatcherLike

    @property
    def costs(self) -> tuple[Cost, ...]:  # type: ignore[override]
        return getattr(self.call, "costs", ())

    @property
    def needs_xyz(self) -> bool:
        return getattr(self.call, "needs_xyz", super().needs_xyz)

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        return self.call(a, b)

    def at(self, clock: Clock) -> Matcher | None:
        at = getattr(self.call, "at", None)
        return None if at is None else Matcher.of(at(clock))
