"""Joint fit of a pair's clock and similarity on the splines of its matched tracks, with an honest sigma.

The residual of a match has two parts. Its mean over a second or so is where the two tracked points sit on the body,
which differs by centimetres and says little of the clock; what is left is motion, the same for both points, and sharp.
Each part is weighted by its own noise: motion finds the clock, the rotation and the scale, places the translation.

Depth errs more than the rest. Where the cameras are known, residuals count by how far they lie along the two lines of
sight (:mod:`otsync.frames.noise`).

Everything is symmetric in the two videos: residuals are read at the frames of both, in the unit midway between the two
frames of reference, so that exchanging them inverts the answer and changes nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ..clocks.splines import TrackSplines
from ..refine.gauss_newton import CLUSTER, GROUPS, MIN_FRAMES, MOST_LEVERAGE, OUTLYING, ROBUST, neighbours
from ..types import Clock, Similarity
from ..types.similarity import cross_matrix, rotation_of
from .noise import Metric, Noise, Sight

LONGEST_STEP = 2.0 / 30
"""Seconds by which one iteration may move the offset."""

LONGEST_TURN = 0.2
"""Radians, and relative scale, by which one iteration may change the similarity."""

SHORTEST_CORRELATION = 4 / 30
"""Seconds over which the fast part of a residual is one error: the spline smooths a tracker's jitter."""

READ_EVERY = 2 / 30
"""Seconds between the moments at which residuals are read: half of what is one error, and as far apart as knots."""


@dataclass(frozen=True, eq=False)
class Joint:
    """Where the iteration ended.

    Args:
        clock: of b against a. transform: from b's frame to a's, with its covariance.
        offset_variance: s². weights: (M,) of the matches. iterations: done.
        blur: rms of the fast residual over rms speed, s. place: typical slow residual, in the unit between the frames.
        misfit: (M,) rms residual of each match in that unit; inf where it was not seen long enough.
    """

    clock: Clock
    transform: Similarity
    offset_variance: float
    weights: Float[np.ndarray, " M"]
    iterations: int
    blur: float
    place: float
    misfit: Float[np.ndarray, " M"]
    weakest: float

    @property
    def effective_matches(self) -> float:
        """(Σw)² / Σw²."""
        return float(self.weights.sum() ** 2 / max((self.weights**2).sum(), 1e-300))


def fit_jointly(
    a: TrackSplines,
    b: TrackSplines,
    clock: Clock,
    transform: Similarity,
    window: float,
    *,
    sight: Sight | None = None,
    iterations: int = 15,
    tolerance: float = 1e-5,
) -> Joint | None:
    """Minimise robustly the differences of matched curves over offset, rotation, scale and translation.

    Args:
        a, b: curves of the matched tracks, m-th to m-th, each in its own frame. clock, transform: where to begin; the
            rate of the clock stays. window: s, half the length of the moving mean that splits the residual.
        sight: along which depth errs; None: errors are taken to be alike in all directions.
        tolerance: frames, radians and relative scale; smaller steps end the iteration.

    Returns None when no match is seen long enough in both.
    """
    state = State.of(a, b, clock, transform)
    own = read(a), read(b)
    noise: Noise | None = None
    n = 0
    while True:
        n += 1
        system = linearise(a, b, own, state, window, sight, noise)
        if system is None:
            return None
        step, noise = system.step(), system.noise
        step[0] = np.clip(step[0], -LONGEST_STEP, LONGEST_STEP)
        step[1:5] *= min(1.0, LONGEST_TURN / max(float(np.abs(step[1:5]).max()), 1e-300))
        state = state.stepped(step)
        if n >= iterations or (abs(step[0]) / a.frame < tolerance and np.abs(step[1:5]).max() < tolerance):
            break
    final = linearise(a, b, own, state, window, sight, noise, clusters=True)
    if final is None:
        return None
    covariance = final.covariance()
    return Joint(
        state.clock,
        state.transform(covariance),
        float(covariance[0, 0]),
        final.match_weights,
        n,
        final.blur,
        final.place,
        final.misfit,
        final.weakest,
    )


@dataclass(frozen=True, eq=False)
class State:
    """Parameters of the fit: r = (x_a - c_a) / √s - √s R (x_b - c_b) - tau."""

    clock: Clock
    scale: float
    R: Float[np.ndarray, "3 3"]
    tau: Float[np.ndarray, " 3"]
    middle_a: Float[np.ndarray, " 3"]
    middle_b: Float[np.ndarray, " 3"]

    @classmethod
    def of(cls, a: TrackSplines, b: TrackSplines, clock: Clock, start: Similarity) -> State:
        middle_a, middle_b = a.mean.mean(0), b.mean.mean(0)
        away = (start(middle_b) - middle_a) / np.sqrt(start.scale)
        return cls(clock, start.scale, start.R, away, middle_a, middle_b)

    def stepped(self, step: Float[np.ndarray, " 8"]) -> State:
        return replace(
            self,
            clock=replace(self.clock, offset=self.clock.offset + float(step[0])),
            R=rotation_of(step[1:4]) @ self.R,
            scale=self.scale * float(np.exp(step[4])),
            tau=self.tau + step[5:],
        )

    def transform(self, covariance: Float[np.ndarray, "8 8"]) -> Similarity:
        """From b's frame to a's: x_a = c_a + √s tau + s R (x_b - c_b)."""
        root = np.sqrt(self.scale)
        centre = self.middle_a + root * self.tau
        found = Similarity(self.scale, self.R, centre - self.scale * self.R @ self.middle_b)
        # (w, log s, tau) about the tracks' middle, as an error in a's frame: u = √s dtau + s' tau √s / 2 - w x c - s' c
        J = np.zeros((7, 7))
        J[:3, :3], J[3, 3] = np.eye(3), 1.0
        J[4:, :3] = cross_matrix(centre)
        J[4:, 3] = 0.5 * root * self.tau - centre
        J[4:, 4:] = root * np.eye(3)
        return found.with_covariance(J @ covariance[1:, 1:] @ J.T)


@dataclass(frozen=True, eq=False)
class System:
    """Weighted normal equations, by match and by block of time; see :class:`Joint`. noise: that the residuals show."""

    H: Float[np.ndarray, "8 8"]
    g: Float[np.ndarray, " 8"]
    by_match: tuple[np.ndarray, np.ndarray]
    by_time: tuple[np.ndarray, np.ndarray]
    match_weights: Float[np.ndarray, " M"]
    blur: float
    place: float
    misfit: Float[np.ndarray, " M"]
    noise: Noise | None

    def step(self) -> Float[np.ndarray, " 8"]:
        return -np.linalg.solve(regular(self.H), self.g)

    @property
    def weakest(self) -> float:
        """Least curvature over the largest among the rotations: near 0 when tracks on a line leave a turn open."""
        spread = np.linalg.eigvalsh(schur(self.H, [1, 2, 3]))
        return float(max(spread[0], 0.0) / max(spread[-1], 1e-300))

    def covariance(self) -> Float[np.ndarray, "8 8"]:
        """The sum of two jackknives, over neighbourhoods of matches and over blocks of time (Bell and McCaffrey 2002).

        Errors of matches on one limb hang together, and so do errors of one moment: either alone is too sure.
        """
        total = np.zeros_like(self.H)
        inverse = np.linalg.inv(regular(self.H))
        for Hc, gc in (self.by_match, self.by_time):
            leverage = np.array([np.linalg.eigvals(inverse @ h).real.max() for h in Hc])
            shrink = np.minimum(1.0, MOST_LEVERAGE / np.maximum(leverage, 1e-12))
            for h, g, k in zip(Hc, gc, shrink, strict=True):
                moved = np.linalg.solve(regular(self.H - k * h), g)
                total += np.outer(moved, moved)
        return total


def regular(H: np.ndarray) -> np.ndarray:
    return H + np.diag(1e-10 * np.diag(H) + 1e-300)


def schur(H: np.ndarray, index: list[int]) -> np.ndarray:
    """The information on some parameters once the others are free."""
    rest = [i for i in range(len(H)) if i not in index]
    inner = np.linalg.solve(regular(H[np.ix_(rest, rest)]), H[np.ix_(rest, index)])
    return H[np.ix_(index, index)] - H[np.ix_(index, rest)] @ inner


Reading = tuple[Float[np.ndarray, " S"], Float[np.ndarray, "M S 3"], float]


def read(curves: TrackSplines) -> Reading:
    """The moments at which residuals are read in one video, its curves there, and the seconds from one to the next."""
    step = max(1, round(READ_EVERY / curves.frame))
    t = curves.times[::step]
    return t, curves.value(t), step * curves.frame


def linearise(
    a: TrackSplines,
    b: TrackSplines,
    own: tuple[Reading, Reading],
    state: State,
    window: float,
    sight: Sight | None = None,
    noise: Noise | None = None,
    *,
    clusters: bool = False,
) -> System | None:
    """Residuals, robust weights and normal equations.

    Args:
        own: both videos as they are read. noise: along the lines of ``sight``; None: alike in all directions.
        clusters: whether groups of matches are told apart.
    """
    from . import kernels_fit as kernels

    root, clock = np.sqrt(state.scale), state.clock
    turned = root * state.R.T
    M = len(a.mean)
    common = None if sight is None else (sight[0], sight[1] @ state.R.T)
    even = Metric.even(M)
    metric = even if common is None or noise is None else noise.metric(common)
    parts = []
    for (t, values, frame), forward in zip(own, (True, False), strict=True):
        there = clock.own(t) if forward else clock.world(t)
        t_a, t_b = (t, there) if forward else (there, t)
        ok = a.support(t_a) & b.support(t_b)
        x, v = (b if forward else a).value_and_velocity(there)
        u = ((values if forward else x) - state.middle_a) / root
        y = ((x if forward else values) - state.middle_b) @ turned
        # t_b = (t_a - offset) / rate at a's frames; t_a = rate t_b + offset at b's
        v = (v @ turned) / clock.rate if forward else v / root
        slack = 1e-6 * frame
        lo = np.searchsorted(t, t - window - slack)
        hi = np.searchsorted(t, t + window + slack, side="right")
        least = MIN_FRAMES / frame
        slow = np.zeros((*ok.shape, 9))
        u, y, v = (np.ascontiguousarray(x) for x in (u, y, v))
        kernels.split(u, y, v, ok, lo, hi, least - 1e-6, slow)
        used = ok & (ok.sum(1) >= least - 1e-6)[:, None]
        parts.append(Part(frame, t_a, u, y, v, slow, used))
    count = np.sum([p.used.sum(1) for p in parts], axis=0)
    seen = count > 0
    if seen.sum() < 3:
        return None
    sizes = Sizes.of(parts, state.tau, metric, count)
    weight = np.where(seen, _match_weight(sizes.quick, seen) * _match_weight(sizes.slow, seen), 0.0)
    H_match, g_match = np.zeros((M, 8, 8)), np.zeros((M, 8))
    start = max(a.times[0], float(clock.world(b.times[0])))
    blocks = [np.maximum(np.floor((p.t_a - start) / CLUSTER + 1e-9), 0).astype(np.int64) for p in parts]
    n = max(int(x.max(initial=0)) for x in blocks) + 1
    H_time, g_time = np.zeros((n, 8, 8)), np.zeros((n, 8))
    products, weights = np.zeros((M, 2, 3, 3)), np.zeros((M, 2))
    for p, rr, block in zip(parts, sizes.squares, blocks, strict=True):
        w_quick, w_slow = (
            weight[:, None] / (1 + r / (ROBUST * typical) ** 2) for r, typical in zip(rr, sizes.typical, strict=True)
        )
        if common is not None:
            kernels.scatter(p.u, p.y, p.slow, state.tau, p.used, w_quick, w_slow, products, weights)
        # a second of samples holds some seven independent errors of motion, and one of place
        w_quick *= min(1.0, p.frame / SHORTEST_CORRELATION) / sizes.typical[0] ** 2
        w_slow *= min(1.0, p.frame / (2 * window)) / sizes.typical[1] ** 2
        kernels.normal_equations(
            *(p.u, p.y, p.v, p.slow, state.tau, p.used, metric.inverse, metric.of_a, metric.of_b, w_quick, w_slow),
            *(block, H_match, g_match, H_time, g_time),
        )
    for H in (H_match, H_time):
        H += np.tril(H, -1).swapaxes(1, 2)
    H_group, g_group = np.zeros((GROUPS, 8, 8)), np.zeros((GROUPS, 8))
    if clusters:
        where = (a.mean - state.middle_a) / root + (b.mean - state.middle_b) @ turned
        group = neighbours(where, GROUPS)
        np.add.at(H_group, group, H_match)
        np.add.at(g_group, group, g_match)
        # what is told of the residuals is of their length
        sizes = sizes if metric is even else Sizes.of(parts, state.tau, even, count)
    power = sum(float(weight @ rr[0].sum(1)) for rr in sizes.squares)
    speed = sum(float(weight @ (((p.v - p.slow[..., 6:]) ** 2).sum(2) * p.used).sum(1)) for p in parts)
    return System(
        H_match.sum(0),
        g_match.sum(0),
        (H_group, g_group),
        (H_time, g_time),
        weight,
        float(np.sqrt(power / speed)) if speed > 0 else np.inf,
        sizes.typical[1],
        np.where(seen, np.hypot(sizes.quick, sizes.slow), np.inf),
        None if common is None else Noise.of(common, products, weights),
    )


@dataclass(frozen=True, eq=False)
class Part:
    """What one video's moments say: u, y, v (M,S,3) of either video and the speed; slow (M,S,9) their moving means."""

    frame: float
    t_a: Float[np.ndarray, " S"]
    u: Float[np.ndarray, "M S 3"]
    y: Float[np.ndarray, "M S 3"]
    v: Float[np.ndarray, "M S 3"]
    slow: Float[np.ndarray, "M S 9"]
    used: Bool[np.ndarray, "M S"]


@dataclass(frozen=True, eq=False)
class Sizes:
    """Sizes of the fast and the slow part of the residuals.

    Args:
        squares: of both parts, (M,S), for the moments of either video. typical: robust scale of both.
        quick, slow: rms of each match.
    """

    squares: list[tuple[np.ndarray, np.ndarray]]
    typical: tuple[float, float]
    quick: Float[np.ndarray, " M"]
    slow: Float[np.ndarray, " M"]

    @classmethod
    def of(cls, parts: list[Part], tau: np.ndarray, metric: Metric, count: np.ndarray) -> Sizes:
        from . import kernels_fit as kernels

        squares = []
        for p in parts:
            rr = np.zeros(p.used.shape), np.zeros(p.used.shape)
            kernels.residual_squares(p.u, p.y, p.slow, tau, p.used, metric.inverse, *rr)
            squares.append(rr)
        often = np.maximum(count, 1)
        quick, slow = (np.sqrt(np.sum([rr[k].sum(1) for rr in squares], axis=0) / often) for k in range(2))
        typical = [
            _scale(np.concatenate([np.sqrt(rr[k][p.used]) for rr, p in zip(squares, parts, strict=True)]))
            for k in range(2)
        ]
        return cls(squares, (typical[0], typical[1]), quick, slow)


def _scale(size: np.ndarray) -> float:
    """Robust scale of residuals with three coordinates, of their lengths."""
    return max(1.4826 / 1.5 * float(np.median(size)), 1e-12)


def _match_weight(rms: np.ndarray, seen: np.ndarray) -> np.ndarray:
    typical = float(np.median(rms[seen]))
    return 1 / (1 + (rms / max(OUTLYING * typical, 1e-300)) ** 2) ** 2
