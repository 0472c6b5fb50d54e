"""From the answers of pairs to the clocks of videos: a robust solution, its contradictions, and whom to trust."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from ..types import Alignment, Matches, Stats, Status, in_order
from ..types.trust import Trust
from .graph import CurveSum, Edge, Graph, Pair, agreeing, components, cycle_errors, solve, spanning_trees

FRAME = 1 / 30
"""The frame, s, that tolerances of this module are multiples of."""

MOVED = 1.5 * FRAME
"""A video that the summed curves put further than this from the robust solution has moved."""

ASTRAY = 1.0 * FRAME
"""A pair further than this from the solution, and than four sigmas or CAPTURED, is fitted anew from there."""

CONFIRMED = 1.5 * FRAME
"""Doubtful pairs this close to the solution by themselves confirm it."""

STANDING_MARGIN = 0.1
"""Lead of the summed curves' peak, as a share of it, that keeps a flagged estimate: sums are steadier."""

CAPTURED = 3.0 * FRAME
"""The new fit counts when it ends this close to where it began."""

SHARED = 0.35
"""Share of a pair's variance that its two videos have in all their pairs. Of the answers to worlds of four and eight
videos, mid and hard (37 worlds each, seeds 620-644), 69 to 73 % lie within one sigma with .2, 71 to 75 % with .3, 73 to
79 % with .4, 75 to 82 % with .5. Recordings share more than simulated tracks: 80 % with .25 (basketball with depth)."""

SAME_RATE = 1e-12
"""By which the rate of a pair's fit may differ from the one that it is to have."""

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


MAYBE_RATE = 1.5
"""Sigmas of a video's rate, as all its pairs measure it, from which on it may be another than is declared; from
:attr:`otsync.Trust.rate_sigmas` on it is (:func:`off_rates`). Twelve films of four phones in hands, 3 s (seeds 3200 to
3211): sound videos have 1.8 at most, but for two of which a pair was wrong altogether; with a rate of 4.2 % 18 of 24
have 3.1 to 14, the others 2.1 to 2.8 or no pair that vouches."""

LEAST_DRIFT = 0.25 / 30
"""Seconds by which a rate must move the ends of an overlap to be told."""

MOST_RATE = 0.1
"""Beyond it a fit has lost its way."""


@dataclass(frozen=True, eq=False)
class Answer:
    """The outcome of one pair: its matches, the aligner's answer, and the refiner's."""

    pair: Pair
    matches: Matches
    scanned: Alignment
    refined: Alignment

    @property
    def finite(self) -> bool:
        """Whether there is an offset at all."""
        return math.isfinite(self.refined.offset)

    @property
    def sound(self) -> bool:
        """Whether the fit shows a common motion at all, whatever else is flagged."""
        return not NOTHING_COMMON & set(self.refined.flags)

    def flagged(self, flag: Status) -> Answer:
        """The answer with one more flag."""
        return replace(self, refined=replace(self.refined, flags=in_order((*self.refined.flags, flag))))

    def doubted(self) -> Answer:
        """The answer with the flag of a clock that breaks otherwise than it was mended."""
        return self.flagged(Status.BROKEN_CLOCK)

    def that_may_be_another_time(self) -> Answer:
        """The answer with the scan's doubt whether it is of another time, also where it is fitted anew."""

        def told(alignment: Alignment) -> Alignment:
            flags = in_order((*alignment.flags, Status.AMBIGUOUS))
            return replace(alignment, flags=flags, stats=alignment.stats | {"another_time": 1.0})

        return replace(self, scanned=told(self.scanned), refined=told(self.refined))


Refit = Callable[[list[tuple[Answer, float, float]]], list[Alignment]]
"""Fit answers anew, each from an offset (s of a's clock) and at a rate."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """The clocks: fields as of :class:`otsync.Offsets`; ``answers`` with the residual that the solution left each."""

    x: Float[np.ndarray, " V"]
    rates: Float[np.ndarray, " V"]
    sigma: Float[np.ndarray, " V"]
    reference: int
    component: Int[np.ndarray, " V"]
    flags: tuple[tuple[Status, ...], ...]
    answers: tuple[Answer, ...]
    stats: Stats


@dataclass(frozen=True, eq=False)
class Network:
    """Videos and the pairs that link them.

    Args:
        n: number of videos. links: the pairs with an offset. rates: (n,) of the videos' clocks.
        anchor: the video that the search holds at 0; the reference unless one is to be chosen.
        graph: how pairs are combined. trust: the thresholds behind flags.
    """

    n: int
    links: tuple[Answer, ...]
    rates: Float[np.ndarray, " V"]
    anchor: int
    graph: Graph
    trust: Trust

    @cached_property
    def edges(self) -> list[Edge]:
        """The links in world seconds; the sigma of a pair that does not vouch for its answer counts three times."""
        edges = []
        for link in self.links:
            (a, b), pair = link.pair, link.refined
            edges.append(Edge.of(a, b, float(self.rates[a] * pair.offset), pair, link.scanned.curve))
        return edges

    @cached_property
    def vouches(self) -> Bool[np.ndarray, " E"]:
        """The links that vouch for themselves."""
        return np.array([e.trusted for e in self.edges], bool)

    def residual(self, x: Float[np.ndarray, " V"]) -> Float[np.ndarray, " E"]:
        """Seconds by which the solution contradicts each link."""
        return np.array([x[e.b] - x[e.a] - e.offset for e in self.edges])

    def of(self, links: Iterable[Answer]) -> Network:
        """The same videos linked by other pairs."""
        return replace(self, links=tuple(links))


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution in which every component of the network has an anchor of its own: x, sigma, and the anchors, (V,)."""

    x: Float[np.ndarray, " V"]
    sigma: Float[np.ndarray, " V"]
    component: Int[np.ndarray, " V"]


def judge(
    n: int, answers: Sequence[Answer], reference: int | None, centre: int, graph: Graph, trust: Trust, refit: Refit
) -> Verdict:
    """Offsets of ``n`` videos from the answers of pairs.

    Args:
        reference: the video that has offset 0, or None to choose the one that the others are best tied to.
        centre: the middle of the star, where the search begins.
        refit: how contradicting pairs are fitted anew.
    """
    anchor = centre if reference is None else reference
    answers, rates = _rates(n, list(answers), anchor, trust, refit)
    network = Network(n, tuple(a for a in answers if a.finite), rates, anchor, graph, trust)
    x = _first_guess(network)
    for _ in range(ROUNDS):
        network = _relocated(network, x, refit)
        x = solve_components(network, anchor, x).x
    by_pair = {a.pair: a for a in answers} | {a.pair: a for a in network.links}
    if n > 2:  # two videos have no third to say whether a flagged pair agrees
        network = _linked(network, x)
    chosen = _best_tied(network) if reference is None else reference
    # rates were fitted relative to the anchor; the reference's clock is the world's
    network = replace(network, rates=rates / rates[chosen])
    solved = solve_components(network, chosen, None if chosen != anchor else x)
    return _verdict(network, tuple(by_pair[a.pair] for a in answers), solved, chosen)


def _linked(network: Network, x: np.ndarray) -> Network:
    """Only the pairs that link videos: those that vouch for themselves, and flagged ones between videos that stand out.

    A flagged pair must agree with the solution. A video stands out when the sum of all its pairs' curves peaks at its
    place as an undoubted pair's curve would. That keeps an estimate for videos that no pair vouches for, on the clock
    of the anchor's group. Groups of three and more held together by pairs that vouch are never joined by flagged ones:
    the curves of strangers with the views of one scene add up too.
    """
    n, edges, vouches = network.n, network.edges, network.vouches
    curves = CurveSum(n, edges, FRAME)
    stands = np.array([undoubted(curves, v, x, network.trust, STANDING_MARGIN) for v in range(n)])
    group = components(n, [a.pair for a, ok in zip(network.links, vouches, strict=True) if ok])
    size = np.bincount(group, minlength=n)[group]
    main = group[network.anchor] if size[network.anchor] > 1 else group[int(np.argmax(size))]
    welcome = stands & ((size == 1) | (group == main))
    agrees = agreeing(edges, network.residual(x), CONFIRMED)
    kept = zip(network.links, edges, vouches, agrees, strict=True)
    return network.of(a for a, e, good, ok in kept if good or (ok and welcome[e.a] and welcome[e.b]))


def undoubted(curves: CurveSum, v: int, x: np.ndarray, trust: Trust, margin: float) -> bool:
    """Whether the summed curves of v's pairs peak at x[v], high enough and without a rival."""
    if not curves.around[v]:
        return True  # aligners without curves: nothing to doubt by
    here, rival = curves.standing(v, x)
    return here >= trust.evidence and (here - rival) >= margin * here


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
    solution = solve(n, edges, anchor)
    significant = np.abs(solution.x) > trust.rate_sigmas * solution.sigma
    rates[significant] = np.exp(solution.x[significant])
    wanted = [(a, a.refined.offset, rates[a.pair[1]] / rates[a.pair[0]]) for a in answers if a.finite]
    # most were fitted at this rate: many pairs cost much, and are judged several times
    tasks = [(a, offset, rate) for a, offset, rate in wanted if abs(a.refined.rate - rate) > SAME_RATE]
    fresh = {t[0].pair: refitted for t, refitted in zip(tasks, refit(tasks), strict=True)}
    return [replace(a, refined=fresh.get(a.pair, a.refined)) for a in answers], rates


@dataclass(frozen=True)
class OffRate:
    """A clock that runs, or may run, otherwise than most.

    Args:
        video: whose clock it is. sigmas: between its rate and the declared one. drift: seconds by which that moves the
            ends of the longest overlap. limit: sigmas from which on it is certain.
    """

    video: int
    sigmas: float
    drift: float
    limit: float

    def told(self, answer: Answer) -> Answer:
        """A pair of this video: flagged where the rate is certain, else with a sigma that covers what may be."""
        if self.video not in answer.pair:
            return answer
        if self.sigmas >= self.limit:
            return answer.flagged(Status.RATE_MISMATCH)
        found, more = answer.refined, self.drift * (self.sigmas - MAYBE_RATE) / (self.limit - MAYBE_RATE)
        common = math.hypot(found.stats.get("common_error", 0.0), more)  # all pairs of a video err alike
        return replace(
            answer,
            refined=replace(found, sigma=math.hypot(found.sigma, more), stats=found.stats | {"common_error": common}),
        )


def off_rates(answers: Sequence[Answer], reference: int, trust: Trust) -> list[OffRate]:
    """Clocks that run, or may run, otherwise than most; the surest first.

    Read from all pairs that fitted a rate beside the offset and kept the declared one. One pair of a few seconds hardly
    tells a rate, but a clock that runs otherwise does so in all of a video's pairs. The surest is set aside, and the
    rest is asked again. In the end each is measured by its pairs with those that were not set aside: two that run alike
    do not contradict each other. Where as many run one way as the other, the reference is right: offsets are on its
    clock.
    """
    least = min(MAYBE_RATE, trust.rate_sigmas)
    every = {a.pair: a.refined.stats for a in answers if _tells_rate(a)}
    videos = {v for pair in every for v in pair}
    told, aside = every, set[int]()
    while told:
        asked = (_off_rate(v, told, trust) for v in {v for pair in told for v in pair})
        surest = max(asked, key=lambda r: (r.sigmas, r.video != reference, r.video))
        if surest.sigmas <= least:
            break
        aside.add(surest.video)
        told = {pair: stats for pair, stats in told.items() if surest.video not in pair}
    if reference in aside and 2 * len(aside) == len(videos) > 2:
        aside = videos - aside
    found = []
    for v in aside:
        with_most = {pair: stats for pair, stats in every.items() if v in pair and not (aside - {v}) & set(pair)}
        found.append(_off_rate(v, with_most or {p: s for p, s in every.items() if v in p}, trust))
    return sorted((r for r in found if r.sigmas > least), key=lambda r: -r.sigmas)


def _off_rate(v: int, told: Mapping[Pair, Mapping[str, float]], trust: Trust) -> OffRate:
    """As all pairs of a video measure it; no sigmas where it hardly moves the ends."""
    own = [(pair, stats) for pair, stats in told.items() if v in pair]
    rate = np.array([math.log(stats["fitted_rate"]) * (1 if v == pair[1] else -1) for pair, stats in own])
    weight = np.array([stats["rate_sigma"] ** -2 for _, stats in own])
    mean = float(weight @ rate / weight.sum())
    # pairs that differ by more than they say do not know it better together
    misfit = float(weight @ (rate - mean) ** 2) / max(1, len(own) - 1)
    drift = abs(mean) * max(stats.get("overlap", 0.0) for _, stats in own) / 2
    # rounded: of two videos, which are off against each other alike, neither is surer
    sigmas = round(abs(mean) * math.sqrt(weight.sum() / max(1.0, misfit)), 6) if drift > LEAST_DRIFT else 0.0
    return OffRate(v, sigmas, drift, trust.rate_sigmas)


def _tells_rate(answer: Answer) -> bool:
    """Whether a pair fitted a rate that can be one and did not keep it, and vouches for its offset but that it may not
    hold throughout.
    """
    rate = answer.refined.stats.get("fitted_rate", math.nan)
    vouches = set(answer.refined.flags) <= {Status.BROKEN_CLOCK}
    return vouches and answer.refined.rate == 1.0 and abs(rate - 1) <= MOST_RATE


def _first_guess(network: Network) -> Float[np.ndarray, " V"]:
    """Robust solution; by the summed curves where pairs are flagged or contradict it, and cycles can tell."""
    n, graph = network.n, network.graph
    solved = solve_components(network, network.anchor, None)
    x, component = solved.x, solved.component
    if not graph.curves:
        return x
    for root in np.unique(component):
        inside = network.of(a for a, e in zip(network.links, network.edges, strict=True) if component[e.a] == root)
        edges, members = inside.edges, int((component == root).sum())
        agrees = agreeing(edges, inside.residual(x), ASTRAY) & inside.vouches
        if len(edges) < members or agrees.all():
            continue
        weight = [a.refined.stats.get("evidence", 1.0) * a.refined.stats.get("margin", 1.0) for a in inside.links]
        fps = max(a.refined.fps for a in inside.links)
        y = np.where(component == root, x, 0.0)
        star = y.copy()
        for e in edges:
            if root in (e.a, e.b):
                star[e.b if e.a == root else e.a] = e.offset if e.a == root else -e.offset
        trees = spanning_trees(n, edges, weight, int(root), graph.starts, graph.seed)
        best = CurveSum(n, edges, 1 / fps).search([y, star, *trees], int(root))
        moved = (component == root) & (np.abs(best - y) > MOVED)
        x = np.where(moved, best, x)
    return x


def _relocated(network: Network, x: np.ndarray, refit: Refit) -> Network:
    """Pairs astray are fitted anew from the solution's prediction; those that do not stay near it are left out."""
    tasks, kept, rates = [], [], network.rates
    for link, e in zip(network.links, network.edges, strict=True):
        predicted = x[e.b] - x[e.a]
        if abs(predicted - e.offset) <= max(ASTRAY, min(4 * e.sigma, CAPTURED)):
            kept.append(link)
        else:
            tasks.append((link, predicted / rates[e.a], rates[e.b] / rates[e.a]))
    for (link, start, _), again in zip(tasks, refit(tasks), strict=True):
        if abs(again.offset - start) <= CAPTURED:
            moved = {"relocated": again.offset - link.scanned.offset}
            if link.refined.status.ok:
                moved["vouched"] = link.refined.sigma
            kept.append(replace(link, refined=replace(again, stats=again.stats | moved)))
    return network.of(sorted(kept, key=lambda a: a.pair))


def solve_components(network: Network, reference: int, start: np.ndarray | None) -> Solved:
    """Every component solved on its own: around ``reference`` in its component, the best tied video in others."""
    n, edges = network.n, network.edges
    near = components(n, edges)
    x, sigma, anchor = np.full(n, np.nan), np.full(n, np.nan), np.arange(n)
    for root in np.unique(near):
        inside = near == root
        own = [e for e in edges if near[e.a] == root]
        middle = reference if inside[reference] else _most_tied(np.flatnonzero(inside), own)
        began = None if start is None or not np.isfinite(start[inside]).all() else start
        solution = solve(n, own, middle, began, SHARED)
        x[inside], sigma[inside], anchor[inside] = solution.x[inside], solution.sigma[inside], middle
    return Solved(x, sigma, anchor)


def _best_tied(network: Network) -> int:
    """The video with the surest pairs within the largest component."""
    near = components(network.n, network.edges)
    roots, counts = np.unique(near, return_counts=True)
    inside = np.flatnonzero(near == roots[np.argmax(counts)])
    return _most_tied(inside, [e for e in network.edges if near[e.a] == near[inside[0]]])


def _most_tied(videos: np.ndarray, edges: list[Edge]) -> int:
    """Largest sum of 1/sigma over its pairs; the first on ties."""
    tie = {int(v): 0.0 for v in videos}
    for e in edges:
        tie[e.a] += 1 / e.sigma
        tie[e.b] += 1 / e.sigma
    return max(sorted(tie), key=tie.__getitem__)


def _verdict(network: Network, answers: tuple[Answer, ...], solved: Solved, reference: int) -> Verdict:
    """Flags of every video, residuals of every pair."""
    n, edges, component = network.n, network.edges, solved.component
    residual = network.residual(solved.x)
    agrees = agreeing(edges, residual, ASTRAY) if edges else np.zeros(0, bool)
    trusted = _trusted(network, solved, agrees)
    x, sigma = solved.x.copy(), solved.sigma.copy()
    alone = (np.bincount(component, minlength=n)[component] == 1) & (np.arange(n) != reference)
    x[alone] = sigma[alone] = np.nan
    own = [[(a, bool(ok)) for a, ok in zip(network.links, agrees, strict=True) if v in a.pair] for v in range(n)]
    flags = tuple(
        () if v == reference else _flags(v, answers, own[v], bool(trusted[v]), component[v] == reference)
        for v in range(n)
    )
    used = {a.pair: float(r) for a, r in zip(network.links, residual, strict=True)}
    answers = tuple(_with_residual(a, used.get(a.pair)) for a in answers)
    stats = _stats(network, answers, residual, component)
    return Verdict(x, network.rates, sigma, reference, component, flags, answers, stats)


def _stats(network: Network, answers: tuple[Answer, ...], residual: np.ndarray, component: np.ndarray) -> Stats:
    """What the report says of the whole network."""
    stats: Stats = {
        "pairs": float(len(answers)),
        "pairs_used": float(len(network.links)),
        "pairs_relocated": float(sum("relocated" in a.refined.stats for a in network.links)),
        "components": float(len(np.unique(component))),
    }
    if len(residual):
        stats["residual_median"] = float(np.median(np.abs(residual)))
        stats["residual_max"] = float(np.abs(residual).max())
    cycles = cycle_errors(network.edges)
    if len(cycles):
        stats["cycle_median"], stats["cycle_max"] = float(np.median(cycles)), float(cycles.max())
    return stats


def _with_residual(answer: Answer, residual: float | None) -> Answer:
    """The answer with what the solution made of it among its statistics; residual: None where it was not used."""
    stats = answer.refined.stats | ({} if residual is None else {"residual": residual})
    stats["used"] = float(residual is not None)
    return replace(answer, refined=replace(answer.refined, stats=stats))


def _trusted(network: Network, solved: Solved, agrees: np.ndarray) -> Bool[np.ndarray, " V"]:
    """Videos that hang on their reference by pairs that vouch, or by summed curves that leave no doubt.

    Trust grows from the reference: a video joins by one agreeing pair that vouches for itself, or by two sound agreeing
    pairs, at least half of all its pairs, with trusted videos, whose summed curves pass the limits for evidence and
    ambiguity. Pairs whose rival lies where their curves do not reach add nothing to that.
    """
    n, edges, trust = network.n, network.edges, network.trust
    agrees = agrees & np.array([a.sound for a in network.links], bool)
    degree = np.zeros(n, int)
    for e in edges:
        degree[[e.a, e.b]] += 1
    trusted = solved.component == np.arange(n)
    growing = True
    while growing:
        growing = False
        for v in np.flatnonzero(~trusted):
            near = [
                (e, bool(a.scanned.stats.get("another_time")))
                for e, a, ok in zip(edges, network.links, agrees, strict=True)
                if ok and ((e.a == v and trusted[e.b]) or (e.b == v and trusted[e.a]))
            ]
            joined = any(e.trusted for e, _ in near)
            within_reach = [e for e, another_time in near if not another_time]
            if not joined and network.graph.curves and len(within_reach) >= max(2, degree[v] / 2):
                joined = undoubted(CurveSum(n, within_reach, FRAME), int(v), solved.x, trust, trust.margin)
            if joined:
                trusted[v] = growing = True
    return trusted


def _flags(
    v: int, answers: tuple[Answer, ...], own: list[tuple[Answer, bool]], trusted: bool, in_reach: bool
) -> tuple[Status, ...]:
    """What the user should know about video v.

    Args:
        own: its links, and whether each agrees with the solution. in_reach: whether it is on the reference's clock.
    """
    vouching = [ok for a, ok in own if a.refined.status.ok]
    contradicted = len(vouching) > 0 and sum(vouching) <= len(vouching) / 2
    # a pair that vouched for another time, surer than those that vouch for this one: fitted anew it says little
    moved = [a.refined.stats["vouched"] ** -2 for a, _ in own if "vouched" in a.refined.stats]
    agreeing = [a.refined.sigma**-2 for a, ok in own if ok and a.refined.status.ok and "vouched" not in a.refined.stats]
    contradicted |= len(moved) >= max(len(agreeing), 1) and sum(moved) > sum(agreeing)
    mismatch = sum(Status.RATE_MISMATCH in a.refined.flags for a, _ in own) > len(own) / 2
    # where others settle which of two returns is right, a lost one may still hide in what an ambiguous pair sees
    hidden = [trusted and a.scanned.stats.get("returns", 0.0) > 0 for a, _ in own]
    doubts = [Status.BROKEN_CLOCK in a.refined.flags or more for (a, _), more in zip(own, hidden, strict=True)]
    broken = sum(doubts) >= max(len(own) / 2, 1)
    # however well pairs agree: what is wrong with the tracks of a video is in all of them
    lagging = len(own) > 0 and all(Status.LAGGING in a.refined.flags for a, _ in own)
    flags: list[Status] = []
    if broken:
        flags.append(Status.BROKEN_CLOCK)
    if lagging:
        flags.append(Status.LAGGING)
    if contradicted:
        flags.append(Status.INCONSISTENT)
    if mismatch:
        flags.append(Status.RATE_MISMATCH)
    if not in_reach:
        flags.append(Status.DISCONNECTED)
    if not trusted or (not in_reach and not own):
        pairs = [a for a, ok in own if ok] or [a for a in answers if v in a.pair]
        flags += [f for a in pairs for f in a.refined.flags] or [Status.INCONSISTENT]
    return in_order(flags)
