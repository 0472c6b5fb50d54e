"""Offsets from elsewhere beside those of the pictures: contradictions, and one answer of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..types import Offsets, Status, in_order
from .graph import Edge, components, solve
from .verdict import SHARED

SIGMAS = 3.0
"""Standard deviations apart at which two answers contradict each other."""


class Told(Protocol):
    """What somebody says of two videos: b started ``seconds`` later than a, with ``sigma``."""

    @property
    def a(self) -> int: ...
    @property
    def b(self) -> int: ...
    @property
    def seconds(self) -> float: ...
    @property
    def sigma(self) -> float: ...
    @property
    def source(self) -> str: ...


@dataclass(frozen=True)
class Contradiction:
    """One thing that was told and that the pictures, or the others that were told, do not confirm.

    Args:
        a, b: names. told, found: seconds that b started later than a. sigma: of the difference. source: who told it.
        against: what it contradicts, in words.
    """

    a: str
    b: str
    told: float
    found: float
    sigma: float
    source: str
    against: str

    def __str__(self) -> str:
        return (
            f"{self.a} and {self.b}: told {self.told:+.4f} s, {self.against} say {self.found:+.4f} s, "
            f"{abs(self.told - self.found) / self.sigma:.1f} sigma apart ({self.source})"
        )


def from_told(names: Sequence[str], fps: Sequence[float], told: Sequence[Told]) -> tuple[Offsets, list[Contradiction]]:
    """Offsets from what was told alone; the first video is the reference. Videos that nobody tells of have none.

    What contradicts the rest of what was told is listed, and its videos are flagged INCONSISTENT.
    """
    edges = [Edge(k.a, k.b, k.seconds, k.sigma, True) for k in told]
    return _solved(tuple(names), np.asarray(fps, float), edges, told, None)


def with_told(offsets: Offsets, told: Sequence[Told]) -> tuple[Offsets, list[Contradiction]]:
    """The pictures' answer with what was told as further edges of its graph.

    What contradicts an unflagged answer by more than three sigma is listed and left out, and its videos are flagged
    INCONSISTENT: one of both is wrong, and nobody knows which. Where the pictures' own answer is flagged, or there is
    none, what was told decides; the flags stay.
    """
    contradictions, used = [], []
    clean = [not flags and np.isfinite(s) for flags, s in zip(offsets.flags, offsets.seconds, strict=True)]
    doubted: set[int] = set()
    for k in told:
        found = offsets.between(k.a, k.b)
        if clean[k.a] and clean[k.b] and np.isfinite(found):
            sigma = float(np.sqrt(k.sigma**2 + np.nansum(offsets.sigma[[k.a, k.b]] ** 2)))
            if abs(k.seconds - found) > SIGMAS * sigma:
                names = offsets.names[k.a], offsets.names[k.b]
                contradictions.append(Contradiction(*names, k.seconds, found, sigma, k.source, "the pictures"))
                doubted |= {k.a, k.b}
                continue
        used.append(k)
    linked = {v for k in used for v in (k.a, k.b)}
    edges = [Edge(k.a, k.b, k.seconds, k.sigma, True) for k in used]
    for (a, b), pair in offsets.alignments.items():
        seconds = float(offsets.rates[a] * pair.offset)
        if not np.isfinite(seconds):
            continue
        if not pair.status.ok and any(not clean[v] and v in linked for v in (a, b)):
            continue  # many doubtful pairs of one wrong peak would outvote the one who knows
        edges.append(Edge.of(a, b, seconds, pair))
    answer, more = _solved(offsets.names, offsets.fps, edges, used, offsets)
    flags = tuple(
        in_order((*flags, *((Status.INCONSISTENT,) if v in doubted and v != offsets.reference else ())))
        for v, flags in enumerate(answer.flags)
    )
    return replace(answer, flags=flags).judged_by_sigma(), [*contradictions, *more]


def _solved(
    names: tuple[str, ...],
    fps: np.ndarray,
    edges: Sequence[Edge],
    told: Sequence[Told],
    before: Offsets | None,
) -> tuple[Offsets, list[Contradiction]]:
    n = len(names)
    reference = 0 if before is None else before.reference
    answer = solve(n, edges, reference, shared=SHARED)
    group = components(n, edges) if edges else np.arange(n)
    inside = group == group[reference]
    component = np.where(inside, reference, np.arange(n) if before is None else before.component)
    seconds = np.where(inside, answer.x, np.nan if before is None else before.seconds)
    sigma = np.where(inside, answer.sigma, np.nan if before is None else before.sigma)
    alone = ~inside & (component == np.arange(n))
    seconds = np.where(alone, 0.0, seconds)
    sigma = np.where(alone, 0.0, sigma)
    flags: list[tuple[Status, ...]] = []
    for v in range(n):
        own = () if before is None else before.flags[v]
        if inside[v]:
            own = tuple(flag for flag in own if flag is not Status.DISCONNECTED)
        elif before is None:
            own = (Status.DISCONNECTED,)
        flags.append(own)
    contradictions = []
    for k in told:
        found = float(seconds[k.b] - seconds[k.a])
        # the answer is made of it too: three of its own sigmas away from what the others make of it
        if inside[k.a] and inside[k.b] and abs(k.seconds - found) > SIGMAS * k.sigma:
            contradictions.append(
                Contradiction(names[k.a], names[k.b], k.seconds, found, k.sigma, k.source, "the others")
            )
            for v in {k.a, k.b} - {reference}:
                flags[v] = in_order((*flags[v], Status.INCONSISTENT))
    return (
        Offsets(
            names=names,
            fps=fps,
            seconds=seconds,
            rates=np.ones(n) if before is None else before.rates,
            sigma=sigma,
            reference=reference,
            component=component,
            flags=tuple(flags),
            alignments={} if before is None else before.alignments,
            stats={"told": float(len(told)), "contradictions": float(len(contradictions))},
            breaks=() if before is None else before.breaks,
        ),
        contradictions,
    )
