"""``match(a, b, matcher)``: correspondences between the tracks of two videos (paper, Sec. 3.3)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from ..clocks.common import thinned
from ..clocks.shutter import at_frame_times
from ..types import Matches, Refused, TrackSet
from ..types.checks import positive
from .anchored import AnchoredFGW
from .dense import FusedGromovWasserstein, NearestNeighbor, OptimalTransport, PartialFGW, log
from .frontier import ANCHORED_FROM, fitting
from .slot import Matcher, MatcherLike
from .vouch import vouch


def match(
    a: TrackSet, b: TrackSet, matcher: MatcherLike | None = None, *, budget: float | None = None, throw: bool = True
) -> Matches:
    """Correspondences between the tracks of two videos.

    Args:
        a, b: track sets; they need no common frame, clock or size.
        matcher: the algorithm; default: :func:`matcher_for` their sizes.
        budget: seconds; takes the most accurate matcher that is predicted to fit, and tells the log which.
        throw: raise :class:`otsync.Refused` when the answer is flagged, instead of returning it.

    Example:
        >>> from otsync import match, FusedGromovWasserstein
        >>> matches = match(a, b, FusedGromovWasserstein(alpha=0.222))  # doctest: +SKIP
        >>> best = matches.best(100)                                    # doctest: +SKIP
    """
    a.check("a", xyz=False)
    b.check("b", xyz=False)
    a, b = thinned(at_frame_times(a)), thinned(at_frame_times(b))
    if matcher is not None and budget is not None:
        raise ValueError("matcher, budget: expected one of them; found both. A budget chooses the matcher.")
    chosen = matcher_for(len(a), len(b), budget) if matcher is None else Matcher.of(matcher)
    if budget is not None:
        log.info("match: %s fits %g s for %d x %d tracks", chosen, budget, len(a), len(b))
    started = time.perf_counter()
    matches = chosen(a, b)
    matches.check("matcher", len(a), len(b))
    matches = vouch(matches, a, b, chosen.checked_by(a, b), chosen.clock)
    seconds = matches.stats.get("seconds", time.perf_counter() - started)
    matches = replace(matches, stats=matches.stats | {"seconds": seconds})
    if throw and not matches.status.ok:
        raise Refused("match", matches)
    return matches


def matcher_for(n_a: int, n_b: int, budget: float | None = None) -> Matcher:
    """The matcher for so many tracks: the most accurate one, or the most accurate that fits ``budget`` seconds.

    Without a budget the paper's :class:`FusedGromovWasserstein` up to 200 tracks and :class:`AnchoredFGW` above, where
    it is both faster and more precise than any dense solver. Seconds are those of one thread of the machine that the
    benchmark was measured on (:mod:`otsync.frontier`).
    """
    known: dict[str, Callable[[], Matcher]] = {
        "NearestNeighbor": NearestNeighbor,
        "OptimalTransport": OptimalTransport,
        "FusedGromovWasserstein": FusedGromovWasserstein,
        "PartialFGW": PartialFGW,
        "AnchoredFGW, small": lambda: AnchoredFGW(anchors=100, cells=500, restarts=1),
        "AnchoredFGW": AnchoredFGW,
    }
    n = max(n_a, n_b)
    if budget is None:
        return AnchoredFGW() if min(n_a, n_b) >= ANCHORED_FROM else FusedGromovWasserstein()
    positive("budget", budget)
    return known[fitting(n, budget)]()
