"""Robust Gauss-Newton on the clock of a pair: two sets of spline curves, one offset, optionally one rate.

Everything is symmetric in the two videos: residuals are read at the frames of both, so that exchanging them flips the
sign of the offset and changes nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import stdtrit

from ..clocks.splines import TrackSplines
from ..compute.indices import blocks
from ..compute.threads import for_each
from ..types import Clock

ROBUST = 2.0
"""Samples beyond this many noise scales count for less (Cauchy)."""

OUTLYING = 1.5
"""Matches whose rms residual is beyond this many typical ones count for less, with the fourth power."""

MIN_FRAMES = 20 / 30
"""Seconds that a match must be seen in both videos."""

LONGEST_STEP = 1.5 / 30
"""Seconds by which one iteration may move the offset."""

LONGEST_RATE_STEP = 0.01

CONVERGED = 1e-4 / 30
"""Seconds; a smaller step ends the iteration."""

MOST_STEPS = 60
"""Iterations at most. Where a fifth of the motion is common to both videos, a step goes a fifth of the way."""

CLUSTER = 1.0
"""Seconds of the blocks within which errors are taken as dependent."""

GROUPS = 10
"""Neighbourhoods into which matches are put: the errors of tracks on one limb are not independent."""

ONE_SIGMA = 0.8413
"""Share of a normal distribution below one standard deviation."""

MOST_LEVERAGE = 0.9
"""Share of the information that one cluster may be said to hold."""

WHOLE = -math.inf, math.inf
"""All frames of a video."""


@dataclass(frozen=True, eq=False)
class Side:
    """One video's frames against the other's curves.

    Args:
        own: curves of the video whose frames are looked at. times: (T,) of these frames, on its clock; at: the curves'
            values there, (M,T,3).
        other: curves of the other video.
        lo, hi: (T,) the frames within the detrending window of each frame, lo inclusive, hi exclusive.
        forward: whether these are a's frames. seen: where the curves are known at these frames.
    """

    own: TrackSplines
    times: Float[np.ndarray, " T"]
    at: Float[np.ndarray, "M T 3"]
    other: TrackSplines
    lo: Int[np.ndarray, " T"]
    hi: Int[np.ndarray, " T"]
    forward: bool
    seen: Bool[np.ndarray, "M T"]

    @classmethod
    def of(
        cls, own: TrackSplines, other: TrackSplines, window: float, forward: bool, span: tuple[float, float] = WHOLE
    ) -> Side:
        """All frames, or those from ``span[0]`` to ``span[1]`` s of their own clock."""
        slack = 1e-6 * own.frame
        first, last = np.searchsorted(own.times, [span[0] - slack, span[1] + slack])
        t = own.times[first:last]
        lo = np.searchsorted(t, t - window - slack)
        hi = np.searchsorted(t, t + window + slack, side="right")
        return cls(own, t, own.joined(t), other, lo, hi, forward, own.support(t))

    def there(self, clock: Clock) -> Float[np.ndarray, " T"]:
        """The moments of the other video that this one's frames show."""
        return clock.own(self.times) if self.forward else clock.world(self.times)

    def time_b(self, clock: Clock) -> Float[np.ndarray, " T"]:
        """Seconds of b's clock at these frames."""
        return self.there(clock) if self.forward else self.times


@dataclass(frozen=True, eq=False)
class Fit:
    """Where the iteration ended.

    Args:
        clock: the answer. covariance: (P,P) of offset (and rate), jackknifed over matches or over time, the larger: too
            large rather than too small, for tests. unbiased: (P,P) of the same, the jackknife's excess taken out, for
            sigma.
        weights: (M,) of the matches. iterations: done. settled: whether the last step was next to nothing. Where noise
            is as large as the motion, each step goes but a small part of the way, and the answer is where it stopped.
        blur: rms residual over rms speed, s: how far off a single sample of a typical match tells the time.
        wander: rms over blocks of a second, by their information, of what each says the offset is off by, s.
        information: Σ w v·v of the weighted samples: how much moves there.
        witnesses: neighbourhoods of matches that hold the information, of equal shares of it.
        seconds: blocks of a second that hold it, of equal shares.
    """

    clock: Clock
    covariance: Float[np.ndarray, "P P"]
    unbiased: Float[np.ndarray, "P P"]
    weights: Float[np.ndarray, " M"]
    iterations: int
    blur: float
    wander: float = 0.0
    settled: bool = True
    information: float = 0.0
    witnesses: float = 1.0
    seconds: float = 1.0

    def off_by(self, information: float) -> float:
        """One sigma, s, of a second that holds so much information, by what the seconds of this fit differ by; 0 where
        there are too few of them to tell.
        """
        if self.seconds < 2 or not information > 0:
            return 0.0
        return float(self.wander * np.sqrt(self.information / ((self.seconds - 1) * information)))

    @property
    def effective_matches(self) -> float:
        """(Σw)² / Σw²."""
        return float(self.weights.sum() ** 2 / max((self.weights**2).sum(), 1e-300))


def fit_clock(
    a: TrackSplines,
    b: TrackSplines,
    start: Clock,
    window: float,
    *,
    weight: Float[np.ndarray, " M"] | None = None,
    fit_rate: bool = False,
    iterations: int = MOST_STEPS,
    span: tuple[float, float] | None = None,
) -> Fit | None:
    """Minimise robustly the detrended differences of matched curves over the offset (and rate).

    Args:
        a, b: curves of the matched tracks, m-th to m-th. start: where to begin; its rate stays unless ``fit_rate``.
        window: s; the mean residual within ± this much of time is removed, as drifts of depth are slower.
        weight: of the matches, mean 1; robust weights multiply it. None: all alike.
        span: seconds of a's clock, from and to; only frames that ``start`` puts there count. None: all frames.

    Returns None when no match is seen long enough in both.
    """
    begin, end = WHOLE if span is None else span
    sides = (
        Side.of(a, b, window, True, (begin, end)),
        Side.of(b, a, window, False, (start.own(begin), start.own(end))),
    )
    if not all(len(side.times) for side in sides):
        return None
    clock = start
    centre = _centre(a, b, start)
    n = 0
    while True:
        n += 1
        system = _linearise(sides, clock, centre, fit_rate, weight)
        if system is None:
            return None
        step = system.step()
        shift = float(np.clip(step[0], -LONGEST_STEP, LONGEST_STEP))
        turn = float(np.clip(step[1], -LONGEST_RATE_STEP, LONGEST_RATE_STEP)) if fit_rate else 0.0
        rate = clock.rate + turn
        clock = Clock(clock.offset + shift - turn * centre, rate)
        settled = abs(shift) < CONVERGED and abs(turn) < CONVERGED / 30
        if n >= iterations or (settled and n > 3):
            break
    covariances = system.covariance(jackknife), system.covariance(bias_reduced)
    if fit_rate:
        # from the offset at the centre of the overlap to that at b's time zero
        move = np.array([[1.0, -centre], [0.0, 1.0]])
        covariances = tuple(move @ c @ move.T for c in covariances)
    moving = float(system.H[0, 0])
    shares = [equal_shares(by[0][:, 0, 0]) for by in (system.by_match, system.by_time)]
    return Fit(clock, *covariances, system.match_weights, n, system.blur, system.wander(), settled, moving, *shares)


def _centre(a: TrackSplines, b: TrackSplines, clock: Clock) -> float:
    """Middle of the common time on b's clock."""
    ends = clock.own(a.times[[0, -1]])
    return 0.5 * float(max(ends[0], b.times[0]) + min(ends[1], b.times[-1]))


@dataclass(frozen=True, eq=False)
class System:
    """Weighted normal equations, by match and by block of time.

    Args:
        H, g: (P,P), (P,) the whole. by_match: (G,P,P), (G,P) and by_time: (B,P,P), (B,P) its parts.
        match_weights: (M,). blur: see :class:`Fit`.
    """

    H: Float[np.ndarray, "P P"]
    g: Float[np.ndarray, " P"]
    by_match: tuple[np.ndarray, np.ndarray]
    by_time: tuple[np.ndarray, np.ndarray]
    match_weights: Float[np.ndarray, " M"]
    blur: float

    def step(self) -> Float[np.ndarray, " P"]:
        return -np.linalg.solve(_regular(self.H), self.g)

    def covariance(self, scatter: Scatter) -> Float[np.ndarray, "P P"]:
        """The larger of the scatter between groups of matches and that between blocks of time."""
        found = [scatter(*by) for by in (self.by_match, self.by_time)]
        return max(found, key=lambda c: float(c[0, 0]))

    def wander(self) -> float:
        """See :class:`Fit`."""
        H, g = self.by_time[0][:, 0, 0], self.by_time[1][:, 0]
        told = 1e-9 * max(float(H.sum()), 1e-300) < H
        return float(np.sqrt((g[told] ** 2 / H[told]).sum() / max(float(H[told].sum()), 1e-300)))


def equal_shares(information: Float[np.ndarray, " C"]) -> float:
    """Of how many clusters with equal shares the sum of squared shares would be the same."""
    return float(information.sum() ** 2 / max(float((information**2).sum()), 1e-300))


Scatter = Callable[[Float[np.ndarray, "C P P"], Float[np.ndarray, "C P"]], Float[np.ndarray, "P P"]]
"""Covariance of an answer from the normal equations of its clusters."""


def jackknife(H: Float[np.ndarray, "C P P"], g: Float[np.ndarray, "C P"]) -> Float[np.ndarray, "P P"]:
    """Covariance of the answer by leaving out one cluster after another (Bell and McCaffrey 2002).

    Leaving a cluster out moves the answer by (H - H_c)⁻¹ g_c: a block that holds most of the motion, a single swing,
    cannot pass for many independent ones. Of C alike clusters the variance is C / (C - 1) times too large. The scatter
    of few clusters says little: the answer is taken to follow Student's distribution, see :func:`wider`.

    Args:
        H, g: normal equations of every cluster.
    """
    whole = H.sum(0)
    leverage = np.einsum("pq,cqp->c", np.linalg.inv(_regular(whole)), H) / len(whole)
    shrink = np.minimum(1.0, MOST_LEVERAGE / np.maximum(leverage, 1e-12))
    rest = whole - shrink[:, None, None] * H
    rest = rest + (1e-12 * np.trace(whole) + 1e-300) * np.eye(len(whole))
    moved = np.linalg.solve(rest, g[..., None])[..., 0]
    return moved.T @ moved * wider(H[:, 0, 0]) ** 2


def bias_reduced(H: Float[np.ndarray, "C P P"], g: Float[np.ndarray, "C P"]) -> Float[np.ndarray, "P P"]:
    """As :func:`jackknife`, without its bias where the errors of samples are alike and clusters independent.

    The fit has taken its part of every cluster's error out, the larger the more the cluster holds. This puts back just
    that: "CR2" of Bell and McCaffrey (2002), (I - H⁻¹ᐟ² H_c H⁻¹ᐟ²)⁻¹ᐟ² on each cluster's whitened score. No cluster is
    said to hold more than :data:`MOST_LEVERAGE`.
    """
    root = np.linalg.inv(np.linalg.cholesky(_regular(H.sum(0))))
    share, turn = np.linalg.eigh(root @ H @ root.T)
    score = np.einsum("cqp,qr,cr->cp", turn, root, g) / np.sqrt(1 - np.clip(share, 0.0, MOST_LEVERAGE))
    moved = np.einsum("qp,cqr,cr->cp", root, turn, score)
    return moved.T @ moved * wider(H[:, 0, 0]) ** 2


def wider(information: Float[np.ndarray, " C"]) -> float:
    """One sigma of Student's distribution, what holds 68 % of it, over that of a normal one, for clusters that hold so
    much information.
    """
    return float(stdtrit(max(1.0, equal_shares(information) - 1), ONE_SIGMA))


def _regular(H: np.ndarray) -> np.ndarray:
    return H + np.diag(1e-12 * np.diag(H) + 1e-300)


def _linearise(
    sides: tuple[Side, Side], clock: Clock, centre: float, fit_rate: bool, prior: np.ndarray | None = None
) -> System | None:
    """Residuals, robust weights and normal equations at ``clock``."""
    P, M = 2 if fit_rate else 1, len(sides[0].at)
    reads = [Read.of(side, clock, centre) for side in sides]
    # of long clips few matches at a time: once for the size of residuals, which weights depend on, once for the sums
    parts = list(blocks(M, 2 * max(len(side.times) for side in sides)))
    kept: list[Any] = [None, None]
    sizes, known = ([np.empty((M, len(side.times)), kind) for side in sides] for kind in (float, bool))

    def measure(n: int) -> None:
        for part in parts:
            found = reads[n].residuals(part, P)
            np.sqrt(found[0], out=sizes[n][part])
            known[n][part] = found[3]
            kept[n] = found if len(parts) == 1 else None

    of_both(measure, threads=len(parts) > 1)
    seen = np.sum([ok.sum(1) for ok in known], axis=0)
    if not seen.any():
        return None
    noise = 1.4826 / 1.5 * float(np.median(np.concatenate([s[ok] for s, ok in zip(sizes, known, strict=True)])))
    squares = np.sum([np.einsum("mt,mt->m", s, s) for s in sizes], axis=0)
    rms = np.sqrt(squares / np.maximum(seen, 1))
    typical = float(np.median(rms[seen > 0]))
    weight = np.where(seen > 0, 1 / (1 + (rms / max(OUTLYING * typical, 1e-300)) ** 2) ** 2, 0.0)
    if prior is not None:
        weight *= prior
    start = max(sides[0].times[0], float(clock.world(sides[1].times[0])))
    block = [read.blocks_from(start, clock) for read in reads]
    H_match, g_match = np.zeros((2, M, P, P)), np.zeros((2, M, P))
    H_frame, g_frame = ([np.zeros((len(side.times), *shape)) for side in sides] for shape in ((P, P), (P,)))
    speed = np.zeros((len(parts), 2))

    def gather(n: int) -> None:
        for k, part in enumerate(parts):
            _, g, h, _ = kept[n] or reads[n].residuals(part, P)
            at_most = max(ROBUST * noise, 1e-300)
            w = np.where(known[n][part], weight[part, None] / (1 + (sizes[n][part] / at_most) ** 2), 0.0)
            H_match[n, part] = np.einsum("pqmt,mt->mpq", h, w)
            g_match[n, part] = np.einsum("pmt,mt->mp", g, w)
            H_frame[n] += np.einsum("pqmt,mt->tpq", h, w)
            g_frame[n] += np.einsum("pmt,mt->tp", g, w)
            speed[k, n] = weight[part] @ h[0, 0].sum(1)

    of_both(gather, threads=len(parts) > 1)
    H_match, g_match, moving = H_match.sum(0), g_match.sum(0), sum(speed.ravel().tolist())
    H_time, g_time = (added(np.concatenate(block), np.concatenate(x)) for x in (H_frame, g_frame))
    H_group, g_group = np.zeros((GROUPS, P, P)), np.zeros((GROUPS, P))
    group = neighbours(sides[0].own.mean + sides[1].own.mean, GROUPS)
    np.add.at(H_group, group, H_match)
    np.add.at(g_group, group, g_match)
    blur = np.sqrt(float(weight @ squares) / moving) if moving > 0 else np.inf
    return System(H_match.sum(0), g_match.sum(0), (H_group, g_group), (H_time, g_time), weight, float(blur))


def of_both(work: Callable[[int], None], *, threads: bool) -> None:
    """Do ``work`` for both sides, each on a thread of its own where that is worth it."""
    if threads:
        for_each(work, [(0,), (1,)])
    else:
        work(0)
        work(1)


def added(index: Int[np.ndarray, " S"], values: np.ndarray) -> np.ndarray:
    """The sums of the rows of ``values`` (S,...) with the same index, in their order."""
    count = int(index.max(initial=0)) + 1
    flat = values.reshape(len(values), -1)
    sums = np.stack([np.bincount(index, column, count) for column in flat.T], 1)
    return sums.reshape(count, *values.shape[1:])


@dataclass(frozen=True, eq=False)
class Read:
    """One side at a clock: where its frames fall on the other's curves."""

    side: Side
    there: Float[np.ndarray, " T"]
    from_centre: Float[np.ndarray, " T"]
    basis: tuple[np.ndarray, np.ndarray, np.ndarray]
    ok: Bool[np.ndarray, "M T"]

    @classmethod
    def of(cls, side: Side, clock: Clock, centre: float) -> Read:
        there = side.there(clock)
        first, value, slope = side.other.basis(there)
        # d(other curve's argument)/d offset: t_b = (t_a - offset) / rate from a's frames, t_a = rate t_b + offset from
        # b's
        sign = 1 / clock.rate if side.forward else -1.0
        ok = side.seen & side.other.support(there)
        return cls(side, there, side.time_b(clock) - centre, (first, value, sign * slope), ok)

    def residuals(self, part: slice, P: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """|R|² (m,T), J·R (P,m,T), J·J (P,P,m,T) of some matches, and where they count."""
        from .kernels import shift_residuals

        side = self.side
        ok = np.ascontiguousarray(self.ok[part])
        rr, g, h = (np.empty((*leading, *ok.shape)) for leading in ((), (P,), (P, P)))
        least = MIN_FRAMES / side.own.frame
        shift_residuals(
            side.at[part],
            side.other.by_track[part],
            side.other.mean[part],
            *self.basis,
            self.from_centre,
            ok,
            side.lo,
            side.hi,
            least - 1e-6,
            rr,
            g,
            h,
        )
        return rr, g, h, ok & (ok.sum(1) >= least - 1e-6)[:, None]

    def blocks_from(self, start: float, clock: Clock) -> Int[np.ndarray, " T"]:
        """Which block of time every frame lies in."""
        own = self.side.times
        t_a = own if self.side.forward else clock.world(own)
        return np.maximum(np.floor((t_a - start) / CLUSTER + 1e-9), 0).astype(np.int64)


def neighbours(x: Float[np.ndarray, "M 3"], groups: int) -> Int[np.ndarray, " M"]:
    """Group of each point: nearest of ``groups`` points far from each other (farthest-point sampling).

    The first one is nearest to the mean, which depends on no axes.
    """
    distance = np.linalg.norm(x - x.mean(0), axis=1)
    nearest = np.zeros(len(x), np.int64)
    closest = np.full(len(x), np.inf)
    for k in range(min(groups, len(x))):
        seed = int(np.argmin(distance) if k == 0 else np.argmax(closest))
        d = np.linalg.norm(x - x[seed], axis=1)
        nearest[d < closest] = k
        closest = np.minimum(closest, d)
    return nearest


def velocity_correlation(a: TrackSplines, b: TrackSplines, fit: Fit, window: float) -> float:
    """Correlation of matched velocities, differences over ± ``window`` s, pooled with the fit's weights."""
    clock = fit.clock
    t = a.times[a.support(a.times).any(0)]
    early, late = t - window, t + window
    u, v = a.joined(late) - a.joined(early), b.joined(clock.own(late)) - b.joined(clock.own(early))
    known = a.support(early) & a.support(late) & b.support(clock.own(early)) & b.support(clock.own(late))
    u, v = np.where(known[..., None], u, 0), np.where(known[..., None], v, 0)
    uv, uu, vv = (float(fit.weights @ (x * y).sum((1, 2))) for x, y in ((u, v), (u, u), (v, v)))
    return uv / np.sqrt(uu * vv) if uu > 0 and vv > 0 else 0.0


def common_span(a: TrackSplines, b: TrackSplines, clock: Clock) -> tuple[float, float]:
    """Seconds of b's clock between which both videos see something."""
    own = clock.own(a.times[[0, -1]])
    return max(float(own[0]), float(b.times[0])), min(float(own[1]), float(b.times[-1]))


def overlap_seconds(a: TrackSplines, b: TrackSplines, clock: Clock) -> float:
    """Seconds of a's clock that both videos cover, one frame included."""
    ends = clock.world(b.times[[0, -1]])
    return max(0.0, float(min(a.times[-1], ends[1]) - max(a.times[0], ends[0])) + max(a.frame, b.frame))
