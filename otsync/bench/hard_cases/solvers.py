"""Who runs the catalogue: every algorithm of a slot at its defaults, plugins included; and how an outcome is read."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ... import plugins
from ...align import ALIGNERS, LikelihoodScan, align
from ...costs.linear import Cosine, Labels
from ...epipolar import EpipolarRefine, EpipolarScan
from ...match import (
    MATCHERS,
    AnchoredFGW,
    Candidates,
    EntropicFGW,
    FusedGromovWasserstein,
    OptimalTransport,
    SynchronousMatching,
    UnbalancedOT,
    match,
)
from ...refine import REFINERS, refine
from ...sync import Graph, synchronize
from ...types import Alignment, Clock, Matches, Offsets, TrackSet
from .case import FLAGGED, REFUSED, RIGHT, Case

Answer = Matches | Alignment | Offsets
Solver = Callable[..., Answer]

SPECIAL = {
    "AnchoredFGW, labels": AnchoredFGW(costs=(Cosine(), Labels())),
    "AnchoredFGW, grouped": AnchoredFGW(cells=80),
    "FusedGromovWasserstein, torch": FusedGromovWasserstein(device="cpu"),
    "Sinkhorn 0.001": OptimalTransport(reg=1e-3),
    "Sinkhorn 1e-06": OptimalTransport(reg=1e-6),
    "EntropicFGW 0.001": EntropicFGW(reg=1e-3),
    "EntropicFGW 1e-05": EntropicFGW(reg=1e-5, max_iter=40),
}
"""Matchers for the rows that name them, and for no others."""


def matchers() -> dict[str, Any]:
    """Every matcher that the whole catalogue is for, by name."""
    return _objects("matchers", MATCHERS) | {"Sinkhorn": OptimalTransport(reg=0.02)}


def aligners() -> dict[str, Any]:
    """Every aligner."""
    return _objects("aligners", ALIGNERS)


def refiners() -> dict[str, Any]:
    """Every refiner."""
    return _objects("refiners", REFINERS)


def rematchers() -> dict[str, Callable[[Clock], Any]]:
    """What matches a pair once more at a known clock, by name."""
    return {
        "SynchronousMatching": lambda clock: SynchronousMatching(clock.offset, clock.rate),
        "Candidates, at equal times": Candidates().at,
        "UnbalancedOT, at equal times": UnbalancedOT().at,
    }


def graphs() -> dict[str, Graph]:
    """Ways to combine pairs."""
    return {"Graph": Graph(), "Graph, star": Graph(extra=0), "Graph, no curves": Graph(curves=False)}


def own_frames_solver(tracks: list[TrackSet], _: None) -> Offsets:
    """(tracks, None) to offsets and transforms, each video in a frame of its own."""
    return synchronize(tracks, frames="own")


def _objects(group: str, own: Iterable[Any]) -> dict[str, Any]:
    """By class name; what plugins add as the shell spells it."""
    own = tuple(own)
    things = plugins.available(group, own)
    return {
        thing.__name__ if thing in own else name: thing() if isinstance(thing, type) else thing
        for name, thing in things.items()
    }


def matching_solver(matcher: Any) -> Solver:
    """(a, b) to matches."""
    return lambda a, b: match(a, b, matcher, throw=False)


def aligning_solver(aligner: Any) -> Solver:
    """(a, b, matches) to an alignment."""
    return lambda a, b, m: align(a, b, m, aligner, throw=False)


def refining_solver(refiner: Any) -> Solver:
    """(a, b, matches) to a refined alignment, from the default aligner's."""
    return lambda a, b, m: refine(a, b, m, align(a, b, m, LikelihoodScan(), throw=False), refiner, throw=False)


def rematching_solver(at: Callable[[Clock], Any]) -> Solver:
    """(a, b, clock) to matches."""
    return lambda a, b, clock: match(a, b, at(clock), throw=False)


def scanning_solver(a: Any, b: Any, m: Matches) -> Alignment:
    """(a, b, candidates) to an alignment, from pixels."""
    return align(a, b, m, EpipolarScan(), throw=False)


def flattening_solver(a: Any, b: Any, m: Matches) -> Alignment:
    """(a, b, candidates) to a refined alignment, from pixels."""
    return refine(a, b, m, scanning_solver(a, b, m), EpipolarRefine(), throw=False)


def graph_solver(graph: Graph) -> Solver:
    """(tracks, matches or None) to offsets."""
    return lambda tracks, matches: synchronize(tracks, matches=matches, graph=graph)


@contextmanager
def watchdog(seconds: int) -> Iterator[None]:
    """AssertionError after so many seconds: a bound against hanging, not a measurement."""

    def bark(*_: Any) -> None:
        raise AssertionError(f"still running after {seconds} s")

    before = signal.signal(signal.SIGALRM, bark)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def outcome(case: Case, solver: Solver) -> tuple[str, Any]:
    """(right, flagged, refused or WRONG, detail)."""
    try:
        answer = solver(*case.make())
    except ValueError as error:
        return REFUSED, str(error)
    return judged(case, answer), answer


WRONG = "WRONG"


def judged(case: Case, answer: Answer) -> str:
    """Right, flagged, or WRONG: an answer without a flag that is not right."""
    check_sane(answer)
    if isinstance(answer, Offsets):
        others = np.arange(len(answer.names)) != answer.reference
        plain = others & np.array([not flags for flags in answer.flags])
        right = np.ones(len(plain), bool) if case.check is None else np.asarray(case.check(answer))
        if (plain & ~right).any():
            return WRONG
        return RIGHT if plain[others].all() else FLAGGED
    if not answer.status.ok:
        return FLAGGED
    return RIGHT if RIGHT in case.expect and (case.check is None or case.check(answer)) else WRONG


def accepted(case: Case, name: str, kind: str, detail: Any) -> bool:
    """Whether the catalogue accepts an outcome of the named solver: its expectations, or a limit that it states.

    A limit excuses a flag or a refusal where others answer, never a wrong answer without a flag. Wrong ones of rows
    that an issue is to mend are listed by the page, not accepted.
    """
    if kind == REFUSED:
        return (REFUSED in case.expect and case.message in detail) or name in case.limits
    return kind in case.expect or (kind == FLAGGED and name in case.limits)


def check_sane(answer: Answer) -> None:
    """AssertionError for nan where there is an answer, pairs that repeat, or a plan of more than mass one."""
    if isinstance(answer, Offsets):
        assert all(np.isfinite(s) or flags for s, flags in zip(answer.seconds, answer.flags, strict=True))
        return
    if isinstance(answer, Alignment):
        assert np.isfinite(answer.offset) or not answer.status.ok
        return
    assert answer.score is not None and np.isfinite(answer.score).all()
    assert len(np.unique(answer.pairs, axis=0)) == len(answer.pairs)
    if answer.plan is not None:
        total = answer.plan.sum()
        assert np.isfinite(total) and total <= 1 + 1e-6
