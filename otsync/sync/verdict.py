"""From the answers of pairs to the clocks of videos: robust solution, contradictions settled, trust decided."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ..types import Alignment, Matches, Stats, Status, in_order
from ..types.trust import Trust
from .graph import CurveSum, Edge, Graph, Pair, agreeing, components, cycle_errors, solve, spanning_trees

FRAME = 1 / 30
"""The frame, s, that tolerances of this module are multiples of."""

UNKNOWN_SIGMA = 0.5 * FRAME
"""Of a pair whose algorithm gives none: an answer on the frame grid."""

FLAGGED = 3.0
"""Factor on the sigma of a pair that does not vouch for its answer."""

MOVED = 1.5 * FRAME
"""A video that the summed curves put further than this from the robust solution has moved."""

ASTRAY = 1.0 * FRAME
"""A pair further than this from the solution, and than four sigmas or CAPTURED, is fitted anew from there."""

CONFIRMED = 1.5 * FRAME
"""Doubtful pairs this close to the solution by themselves confirm it."""

STANDING_MARGIN = 0.1
"""Lead of the summed curves' peak, as a share of it, that keeps a flagged estimate; sums are steadier than one curve."""

CAPTURED = 3.0 * FRAME
"""The new fit counts when it ends this close to where it began."""

INFLATION = 1.5
"""Sigmas of the graph take pairs as independent; they share tracks and their errors."""

ROUNDS = 2

NOTHING_COMMON = frozenset(
    {
        Status.POOR_FIT,
        Status.STATIC,
        Status.NO_INFORMATION,
        Status.NO_MATCH,
        Status.NO_OVERLAP,
        Status.DISCONNECTED,
        Status.FAILED,
    }
)
"""A pair with one of these shows no common motion: it makes no video trusted."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What one pair came to: its matches, the aligner's answer, and the refiner's."""

    pair: Pair
    matches: Matches
    scanned: Alignment
    refined: Alignment

    @property
    def finite(self) -> bool:
        return math.isfinite(self.refined.offset)


Refit = Callable[[list[tuple[Answer, float, float]]], list[Alignment]]
"""Fit answers anew, each from an offset (s of a's clock) and at a rate."""


@dataclass(frozen=True, eq=False)
class Settled:
    """The clocks: fields as of :class:`otsync.Offsets`; ``answers`` with what the last solution used."""

    x: Float[np.ndarray, " V"]
    rates: Float[np.ndarray, " V"]
    sigma: Float[np.ndarray, " V"]
    reference: int
    component: Int[np.ndarray, " V"]
    flags: tuple[tuple[Status, ...], ...]
    answers: tuple[Answer, ...]
    stats: Stats


def settle(
    n: int, answers: Sequence[Answer], reference: int | None, centre: int, graph: Graph, trust: Trust, refit: Refit
) -> Settled:
    """Offsets of ``n`` videos from the answers of pairs.

    Args:
        reference: the video that has offset 0, or None to choose the one that the others are best tied to.
        centre: the middle of the star, where the search begins.
        refit: how contradicting pairs are fitted anew.
    """
    anchor = centre if reference is None else reference
    answers, rates = _rates(n, list(answers), anchor, trust, refit)
    linked = [a for a in answers if a.finite]
    x = _first_guess(n, linked, anchor, rates, graph)
    lone = n == 2
    for _ in range(ROUNDS):
        linked = _relocate(linked, x, rates, refit)
        x = _by_component(n, linked, rates, anchor, x)[0]
    by_pair = {a.pair: a for a in answers} | {a.pair: a for a in linked}
    links = linked if lone else _links(n, linked, x, rates, anchor, trust)
    chosen = _best_tied(n, links, rates) if reference is None else reference
    rates = rates / rates[chosen]  # they were fitted relative to the anchor; the reference's clock is the world's
    x, sigma, component = _by_component(n, links, rates, chosen, None if chosen != anchor else x)
    final = tuple(by_pair[a.pair] for a in answers)
    return _judge(n, final, links, x, sigma, rates, component, chosen, graph, trust)


def _links(n: int, answers: list[Answer], x: np.ndarray, rates: np.ndarray, anchor: int, trust: Trust) -> list[Answer]:
    """The pairs that link videos: those that vouch for themselves, and flagged ones between videos that stand out.

    A flagged pair must agree with the solution. A video stands out when the sum of all its pairs' curves peaks at its place as an undoubted pair's curve would. That
    keeps an estimate for videos that no pair vouches for, on the clock of the anchor's group. Groups of three and more held
    together by pairs that vouch are never joined by flagged ones: the curves of strangers with the views of one scene add up too.
    """
    edges = [as_edge(a, rates) for a in answers]
    curves = CurveSum(n, edges, FRAME)
    stands = np.array([undoubted(curves, v, x, trust, STANDING_MARGIN) for v in range(n)])
    sound = np.array([e.trusted for e in edges], bool)
    group = components(n, [a.pair for a, ok in zip(answers, sound, strict=True) if ok])
    size = np.bincount(group, minlength=n)[group]
    main = group[anchor] if size[anchor] > 1 else group[int(np.argmax(size))]
    welcome = stands & ((size == 1) | (group == main))
    residual = np.array([x[e.b] - x[e.a] - e.offset for e in edges])
    agrees = agreeing(edges, residual, CONFIRMED)
    kept = zip(answers, edges, sound, agrees, strict=True)
    return [a for a, e, good, ok in kept if good or (ok and welcome[e.a] and welcome[e.b])]


def is_sound(answer: Answer) -> bool:
    """Whether the fit shows a common motion at all, whatever else is flagged."""
    return not NOTHING_COMMON & set(answer.refined.flags)


def undoubted(curves: CurveSum, v: int, x: np.ndarray, trust: Trust, margin: float) -> bool:
    """Whether the summed curves of v's pairs peak at x[v], high enough and without a rival."""
    if not curves.around[v]:
        return True  # aligners without curves: nothing to doubt by
    here, rival = curves.standing(v, x)
    return here >= trust.evidence and (here - rival) >= margin * here


def as_edge(answer: Answer, rates: np.ndarray) -> Edge:
    """The pair in world seconds."""
    a, b = answer.pair
    found = answer.refined
    sigma = found.sigma if math.isfinite(found.sigma) else UNKNOWN_SIGMA
    scale = 1.0 if found.status.ok else FLAGGED
    return Edge(a, b, float(rates[a] * found.offset), scale * sigma, found.status.ok, answer.scanned.curve)


def _rates(
    n: int, answers: list[Answer], anchor: int, trust: Trust, refit: Refit
) -> tuple[list[Answer], Float[np.ndarray, " V"]]:
    """Rates of the videos from fitted rates of pairs, where significant; the pairs fitted anew at these rates."""
    rates = np.ones(n)
    if all(a.refined.rate == 1.0 for a in answers):
        return answers, rates
    edges = []
    for a in answers:
        sigma = a.refined.stats.get("rate_sigma", math.nan)
        if a.finite and math.isfinite(sigma):
            rate = a.refined.stats["fitted_rate"]
            edges.append(Edge(*a.pair, math.log(rate), max(sigma, 1e-9), True))
    solution = solve(n, edges, anchor, inflation=INFLATION)
    significant = np.abs(solution.x) > trust.rate_sigmas * solution.sigma
    rates[significant] = np.exp(solution.x[significant])
    tasks = [(a, a.refined.offset, rates[a.pair[1]] / rates[a.pair[0]]) for a in answers if a.finite]
    fresh = {t[0].pair: found for t, found in zip(tasks, refit(tasks), strict=True)}
    return [replace(a, refined=fresh.get(a.pair, a.refined)) for a in answers], rates


def _first_guess(n: int, answers: list[Answer], anchor: int, rates: np.ndarray, graph: Graph) -> np.ndarray:
    """Robust solution; by the summed curves where pairs are flagged or contradict it, and cycles can tell."""
    edges = [as_edge(a, rates) for a in answers]
    x, _, component = _by_component(n, answers, rates, anchor, None)
    if not graph.curves:
        return x
    for root in np.unique(component):
        own = [k for k, e in enumerate(edges) if component[e.a] == root]
        inside = [edges[k] for k in own]
        members = int((component == root).sum())
        residual = np.array([x[e.b] - x[e.a] - e.offset for e in inside])
        settled = agreeing(inside, residual, ASTRAY) & np.array([e.trusted for e in inside], bool)
        if len(inside) < members or settled.all():
            continue
        weight = [
            answers[k].refined.stats.get("evidence", 1.0) * answers[k].refined.stats.get("margin", 1.0) for k in own
        ]
        fps = max(answers[k].refined.fps for k in own)
        y = np.where(component == root, x, 0.0)
        star = y.copy()
        for e in inside:
            if root in (e.a, e.b):
                star[e.b if e.a == root else e.a] = e.offset if e.a == root else -e.offset
        trees = spanning_trees(n, inside, weight, int(root), graph.starts, graph.seed)
        best = CurveSum(n, inside, 1 / fps).search([y, star, *trees], int(root))
        moved = (component == root) & (np.abs(best - y) > MOVED)
        x = np.where(moved, best, x)
    return x


def _relocate(answers: list[Answer], x: np.ndarray, rates: np.ndarray, refit: Refit) -> list[Answer]:
    """Pairs astray are fitted anew from the solution's prediction; those that do not stay near it are left out."""
    tasks, kept = [], []
    for answer in answers:
        e = as_edge(answer, rates)
        predicted = x[e.b] - x[e.a]
        if abs(predicted - e.offset) <= max(ASTRAY, min(4 * e.sigma, CAPTURED)):
            kept.append(answer)
        else:
            tasks.append((answer, predicted / rates[e.a], rates[e.b] / rates[e.a]))
    for (answer, start, _), found in zip(tasks, refit(tasks), strict=True):
        if abs(found.offset - start) <= CAPTURED:
            moved = {"relocated": found.offset - answer.scanned.offset}
            kept.append(replace(answer, refined=replace(found, stats=found.stats | moved)))
    return sorted(kept, key=lambda a: a.pair)


def _by_component(
    n: int, answers: list[Answer], rates: np.ndarray, reference: int, start: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, sigma and each video's anchor: ``reference`` in its component, the best tied video in others."""
    edges = [as_edge(a, rates) for a in answers]
    near = components(n, edges)
    x, sigma, anchor = np.full(n, np.nan), np.full(n, np.nan), np.arange(n)
    for root in np.unique(near):
        inside = near == root
        own = [e for e in edges if near[e.a] == root]
        middle = reference if inside[reference] else _most_tied(np.flatnonzero(inside), own)
        began = None if start is None or not np.isfinite(start[inside]).all() else start
        found = solve(n, own, middle, began, INFLATION)
        x[inside], sigma[inside], anchor[inside] = found.x[inside], found.sigma[inside], middle
    return x, sigma, anchor


def _best_tied(n: int, links: list[Answer], rates: np.ndarray) -> int:
    """The video with the surest pairs within the largest component."""
    edges = [as_edge(a, rates) for a in links]
    near = components(n, edges)
    roots, counts = np.unique(near, return_counts=True)
    inside = np.flatnonzero(near == roots[np.argmax(counts)])
    return _most_tied(inside, [e for e in edges if near[e.a] == near[inside[0]]])


def _most_tied(videos: np.ndarray, edges: list[Edge]) -> int:
    """Largest sum of 1/sigma over its pairs; the first on ties."""
    tie = {int(v): 0.0 for v in videos}
    for e in edges:
        tie[e.a] += 1 / e.sigma
        tie[e.b] += 1 / e.sigma
    return max(sorted(tie), key=tie.__getitem__)


def _judge(
    n: int,
    answers: tuple[Answer, ...],
    links: list[Answer],
    x: np.ndarray,
    sigma: np.ndarray,
    rates: np.ndarray,
    component: np.ndarray,
    reference: int,
    graph: Graph,
    trust: Trust,
) -> Settled:
    """Flags of every video, residuals of every pair."""
    edges = [as_edge(a, rates) for a in links]
    residual = np.array([x[e.b] - x[e.a] - e.offset for e in edges])
    agrees = agreeing(edges, residual, ASTRAY) if edges else np.zeros(0, bool)
    sound = agrees & np.array([is_sound(a) for a in links], bool)
    trusted = _trusted(n, edges, sound, x, component, graph, trust)
    x = x.copy()
    alone = np.bincount(component, minlength=n)[component] == 1
    x[alone & (np.arange(n) != reference)] = sigma[alone & (np.arange(n) != reference)] = np.nan
    flags = tuple(
        _flags(v, answers, links, agrees, bool(trusted[v]), component[v] == reference, v == reference) for v in range(n)
    )
    used = {a.pair: float(r) for a, r in zip(links, residual, strict=True)}
    answers = tuple(_with_residual(a, used.get(a.pair)) for a in answers)
    cycles = cycle_errors(edges)
    stats: Stats = {
        "pairs": float(len(answers)),
        "pairs_used": float(len(links)),
        "pairs_relocated": float(sum("relocated" in a.refined.stats for a in links)),
        "components": float(len(np.unique(component))),
    }
    if len(residual):
        stats["residual_median"] = float(np.median(np.abs(residual)))
        stats["residual_max"] = float(np.abs(residual).max())
    if len(cycles):
        stats["cycle_median"], stats["cycle_max"] = float(np.median(cycles)), float(cycles.max())
    return Settled(x, rates, sigma, reference, component, flags, answers, stats)


def _with_residual(answer: Answer, residual: float | None) -> Answer:
    """The answer with what the solution made of it among its statistics; residual: None where it was not used."""
    stats = answer.refined.stats | ({} if residual is None else {"residual": residual})
    stats["used"] = float(residual is not None)
    return replace(answer, refined=replace(answer.refined, stats=stats))


def _trusted(
    n: int, edges: list[Edge], agrees: np.ndarray, x: np.ndarray, component: np.ndarray, graph: Graph, trust: Trust
) -> np.ndarray:
    """Videos that hang on their reference by pairs that vouch, or by summed curves that leave no doubt.

    Trust grows from the reference: a video joins by one agreeing pair that vouches for itself, or by two sound agreeing
    pairs, at least half of all its pairs, with trusted videos, whose summed curves pass the limits for evidence and
    ambiguity.
    """
    degree = np.zeros(n, int)
    for e in edges:
        degree[[e.a, e.b]] += 1
    trusted = component == np.arange(n)
    growing = True
    while growing:
        growing = False
        for v in np.flatnonzero(~trusted):
            near = [
                k
                for k, e in enumerate(edges)
                if agrees[k] and ((e.a == v and trusted[e.b]) or (e.b == v and trusted[e.a]))
            ]
            joined = any(edges[k].trusted for k in near)
            if not joined and graph.curves and len(near) >= max(2, degree[v] / 2):
                joined = undoubted(CurveSum(n, [edges[k] for k in near], FRAME), int(v), x, trust, trust.margin)
            if joined:
                trusted[v] = growing = True
    return trusted


def _flags(
    v: int,
    answers: tuple[Answer, ...],
    links: list[Answer],
    agrees: np.ndarray,
    trusted: bool,
    in_reach: bool,
    is_reference: bool,
) -> tuple[Status, ...]:
    """What the user should know about video v."""
    if is_reference:
        return ()
    own = [(a, bool(ok)) for a, ok in zip(links, agrees, strict=True) if v in a.pair]
    vouching = [ok for a, ok in own if a.refined.status.ok]
    contradicted = len(vouching) > 0 and sum(vouching) <= len(vouching) / 2
    mismatch = sum(Status.RATE_MISMATCH in a.refined.flags for a, _ in own) > len(own) / 2
    found: list[Status] = []
    if contradicted:
        found.append(Status.INCONSISTENT)
    if mismatch:
        found.append(Status.RATE_MISMATCH)
    if not in_reach:
        found.append(Status.DISCONNECTED)
    if not trusted or (not in_reach and not own):
        pairs = [a for a, ok in own if ok] or [a for a in answers if v in a.pair]
        found += [f for a in pairs for f in a.refined.flags] or [Status.INCONSISTENT]
    return in_order(found)
