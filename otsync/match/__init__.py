"""Matching: ``match(a, b, matcher)`` and the matchers that go in its slot (paper, Sec. 3.3).

verb.py         match()
slot.py         what a matcher is, and what it may declare
problem.py      one FGW problem in the paper's units; from a plan to matches
dense.py        the matchers over a full cost matrix: nearest neighbour, OT, FGW, GW, entropic and partial FGW
sinkhorn.py     stabilised Sinkhorn
anchored/       FGW for tens of thousands of tracks
candidates.py   several partners a track, by cost alone
unbalanced.py   transport with relaxed marginals, several partners a track
synchronous.py  matching once more, at known times
vouch.py        whether matches are to be trusted
frontier.py     which matcher fits which time
"""

from .anchored import AnchoredFGW
from .candidates import Candidates
from .dense import EntropicFGW, FusedGromovWasserstein, GromovWasserstein, NearestNeighbor, OptimalTransport, PartialFGW
from .slot import Matcher
from .synchronous import SynchronousMatching
from .unbalanced import SemirelaxedFGW, UnbalancedFGW, UnbalancedOT
from .verb import match, matcher_for

__all__ = [
    "AnchoredFGW",
    "Candidates",
    "EntropicFGW",
    "FusedGromovWasserstein",
    "GromovWasserstein",
    "Matcher",
    "NearestNeighbor",
    "OptimalTransport",
    "PartialFGW",
    "SemirelaxedFGW",
    "SynchronousMatching",
    "UnbalancedFGW",
    "UnbalancedOT",
    "match",
    "matcher_for",
]

MATCHERS = (
    AnchoredFGW,
    FusedGromovWasserstein,
    PartialFGW,
    EntropicFGW,
    GromovWasserstein,
    UnbalancedFGW,
    SemirelaxedFGW,
    OptimalTransport,
    UnbalancedOT,
    NearestNeighbor,
    Candidates,
)
"""Matchers that the shell, the benchmarks and the catalogue of hard cases offer; plugins come on top."""
