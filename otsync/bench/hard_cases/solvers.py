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
from ...match import MATCHERS, AnchoredFGW, EntropicFGW, FusedGromovWasserstein, OptimalTransport, match
from ...refine import REFINERS, Unrefined, refine
from ...types import Alignment, Matches
from .case import FLAGGED, REFUSED, RIGHT, Case

Solver = Callable[..., Matches | Alignment]

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
    """Every refiner that refines."""
    return {name: r for name, r in _objects("refiners", REFINERS).items() if not isinstance(r, Unrefined)}


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
    check_sane(answer)
    if not answer.status.ok:
        return FLAGGED, answer.flags
    return (RIGHT if case.check is None or case.check(answer) else WRONG), answer


WRONG = "WRONG"


def accepted(case: Case, name: str, kind: str, detail: Any) -> bool:
    """Whether the catalogue accepts an outcome of the named solver: its expectations, or a limit that it states."""
    if kind == REFUSED:
        return REFUSED in case.expect and case.message in detail
    return kind in case.expect or name in case.limits


def check_sane(answer: Matches | Alignment) -> None:
    """AssertionError for nan where there is an answer, indices that repeat, or a plan of more than mass one."""
    if isinstance(answer, Alignment):
        assert np.isfinite(answer.offset) or not answer.status.ok
        return
    assert answer.score is not None and np.isfinite(answer.score).all()
    for column in answer.pairs.T:
        assert len(np.unique(column)) == len(column)
    if answer.plan is not None:
        total = answer.plan.sum()
        assert np.isfinite(total) and total <= 1 + 1e-6
