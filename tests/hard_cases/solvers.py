"""The solvers that run the catalogue, by slot, and how an outcome is read."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from otsync import (
    DTW,
    Alignment,
    AnchoredFGW,
    ConstantShift,
    Cosine,
    EntropicFGW,
    FusedGromovWasserstein,
    GromovWasserstein,
    Labels,
    LikelihoodScan,
    Matches,
    NearestNeighbor,
    OptimalTransport,
    PartialFGW,
    SplineRefine,
    align,
    match,
    refine,
)
from tests.hard_cases.case import FLAGGED, REFUSED, RIGHT, Case

MATCHERS = {
    "NearestNeighbor": NearestNeighbor(),
    "OptimalTransport": OptimalTransport(),
    "Sinkhorn": OptimalTransport(reg=0.02),
    "GromovWasserstein": GromovWasserstein(),
    "FusedGromovWasserstein": FusedGromovWasserstein(),
    "EntropicFGW": EntropicFGW(),
    "PartialFGW": PartialFGW(),
    "AnchoredFGW": AnchoredFGW(),
}
#: only for the rows that name them
SPECIAL = {
    "AnchoredFGW, labels": AnchoredFGW(costs=(Cosine(), Labels())),
    "AnchoredFGW, grouped": AnchoredFGW(cells=80),
    "FusedGromovWasserstein, torch": FusedGromovWasserstein(device="cpu"),
    "Sinkhorn 0.001": OptimalTransport(reg=1e-3),
    "Sinkhorn 1e-06": OptimalTransport(reg=1e-6),
    "EntropicFGW 0.001": EntropicFGW(reg=1e-3),
    "EntropicFGW 1e-05": EntropicFGW(reg=1e-5, max_iter=40),
}
ALIGNERS = {"DTW": DTW(), "ConstantShift": ConstantShift(), "LikelihoodScan": LikelihoodScan()}
REFINERS = {"SplineRefine": SplineRefine()}


def run_match(name: str) -> Callable[..., Matches]:
    return lambda a, b: match(a, b, (MATCHERS | SPECIAL)[name], throw=False)


def run_align(name: str) -> Callable[..., Alignment]:
    if name in ALIGNERS:
        return lambda a, b, m: align(a, b, m, ALIGNERS[name], throw=False)

    def refined(a, b, m) -> Alignment:
        return refine(a, b, m, align(a, b, m, LikelihoodScan(), throw=False), REFINERS[name], throw=False)

    return refined


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


def outcome(case: Case, solver: Callable[..., Any]) -> tuple[str, Any]:
    """(right, flagged, refused or WRONG, detail)."""
    try:
        found = solver(*case.make())
    except ValueError as error:
        return REFUSED, str(error)
    assert_sane(found)
    if not found.status.ok:
        return FLAGGED, found.flags
    return (RIGHT if case.check is None or case.check(found) else "WRONG"), found


def assert_sane(found: Matches | Alignment) -> None:
    """No nan where there is an answer, indices one-to-one, a plan of no more than mass one."""
    if isinstance(found, Alignment):
        assert np.isfinite(found.offset) or not found.status.ok
        return
    assert np.isfinite(found.score).all()
    for column in found.pairs.T:
        assert len(np.unique(column)) == len(column)
    if found.plan is not None:
        total = found.plan.sum()
        assert np.isfinite(total) and total <= 1 + 1e-6
