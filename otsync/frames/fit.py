"""Joint fit of a pair's clock and similarity on the splines of its matched tracks, with an honest sigma.

The residual of a match has two parts. Its mean over a second or so is where the two tracked points sit on the body,
which differs by centimetres and says little of the clock; what is left is motion, the same for both points, and sharp.
Each part is weighted by its own noise: motion finds the clock, the rotation and the scale, places the translation.

Everything is symmetric in the two videos: residuals are read at the frames of both, in the unit midway between the two
frames of reference, so that exchanging them inverts the answer and changes nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ..clocks.splines import TrackSplines
from ..refine.gauss_newton import CLUSTER, GROUPS, MIN_FRAMES, MOST_LEVERAGE, OUTLYING, ROBUST, neighbours
from ..types import Clock, Similarity
from ..types.similarity import cross_matrix, rotation_of

LONGEST_STEP = 2.0 / 30
"""Seconds by which one iteration may move the offset."""

LONGEST_TURN = 0.2
"""Radians, and relative scale, by which one iteration may change the similarity."""

SHORTEST_CORRELATION = 4 / 30
"""Seconds over which the fast part of a residual is one error: the spline smooths a tracker's jitter."""


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
    iterations: int = 15,
    tolerance: float = 1e-5,
) -> Joint | None:
    """Minimise robustly the differences of matched curves over offset, rotation, scale and translation.

    Args:
        a, b: curves of the matched tracks, m-th to m-th, each in its own frame. clock, transform: where to begin; the
            rate of the clock stays. window: s, half the length of the moving mean that splits the residual.
        tolerance: frames, radians and relative scale; smaller steps end the iteration.

    Returns None when no match is seen long enough in both.
    """
    state = State.of(a, b, clock, transform)
    own = a.value(a.times), b.value(b.times)
    n = 0
    while True:
        n += 1
        system = linearise(a, b, own, state, window)
        if system is None:
            return None
        step = system.step()
        step[0] = np.clip(step[0], -LONGEST_STEP, LONGEST_STEP)
        step[1:5] *= min(1.0, LONGEST_TURN / max(float(np.abs(step[1:5]).max()), 1e-300))
        state = state.stepped(step)
        if n >= iterations or (abs(step[0]) / a.frame < tolerance and np.abs(step[1:5]).max() < tolerance):
            break
    final = linearise(a, b, own, state, window, clusters=True)
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
    """Weighted normal equations, by match and by block of time; see :class:`Joint`."""

    H: Float[np.ndarray, "8 8"]
    g: Float[np.ndarray, " 8"]
    by_match: tuple[np.ndarray, np.ndarray]
    by_time: tuple[np.ndarray, np.ndarray]
    match_weights: Float[np.ndarray, " M"]
    blur: float
    place: float
    misfit: Float[np.ndarray, " M"]

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


def linearise(
    a: TrackSplines,
    b: TrackSplines,
    own: tuple[np.ndarray, np.ndarray],
    state: State,
    window: float,
    *,
    clusters: bool = False,
) -> System | None:
    """Residuals, robust weights and normal equations.

    Args:
        own: the curves of a at a's frames, and of b at b's. clusters: whether groups of matches are told apart.
    """
    from . import kernels_fit as kernels

    root, clock = np.sqrt(state.scale), state.clock
    turned = root * state.R.T
    parts = []
    for curves, forward in ((a, True), (b, False)):
        t = curves.times
        there = clock.own(t) if forward else clock.world(t)
        t_a, t_b = (t, there) if forward else (there, t)
        ok = a.support(t_a) & b.support(t_b)
        u = ((own[0] if forward else a.value(t_a)) - state.middle_a) / root
        y = ((b.value(t_b) if forward else own[1]) - state.middle_b) @ turned
        # t_b = (t_a - offset) / rate at a's frames; t_a = rate t_b + offset at b's
        v = (b.velocity(t_b) @ turned) / clock.rate if forward else a.velocity(t_a) / root
        slack = 1e-6 * curves.frame
        lo = np.searchsorted(t, t - window - slack)
        hi = np.searchsorted(t, t + window + slack, side="right")
        least = MIN_FRAMES / curves.frame
        slow = np.zeros((*ok.shape, 9))
        u, y, v = (np.ascontiguousarray(x) for x in (u, y, v))
        kernels.split(u, y, v, ok, lo, hi, least - 1e-6, slow)
        used = ok & (ok.sum(1) >= least - 1e-6)[:, None]
        squares = np.zeros(ok.shape), np.zeros(ok.shape)
        kernels.residual_squares(u, y, slow, state.tau, used, *squares)
        parts.append((curves.frame, t_a, u, y, v, slow, used, *squares))
    count = np.sum([np.sum(p[6], axis=1) for p in parts], axis=0)
    seen = count > 0
    if seen.sum() < 3:
        return None
    quick, place = (_noise(parts, k) for k in (7, 8))
    often = np.maximum(count, 1)
    rms_quick, rms_slow = (np.sqrt(np.sum([np.sum(p[k], axis=1) for p in parts], axis=0) / often) for k in (7, 8))
    weight = np.where(seen, _match_weight(rms_quick, seen) * _match_weight(rms_slow, seen), 0.0)
    M = len(weight)
    H_match, g_match = np.zeros((M, 8, 8)), np.zeros((M, 8))
    start = max(a.times[0], float(clock.world(b.times[0])))
    blocks = [np.maximum(np.floor((p[1] - start) / CLUSTER + 1e-9), 0).astype(np.int64) for p in parts]
    n = max(int(x.max(initial=0)) for x in blocks) + 1
    H_time, g_time = np.zeros((n, 8, 8)), np.zeros((n, 8))
    for (frame, _, u, y, v, slow, used, rr_quick, rr_slow), block in zip(parts, blocks, strict=True):
        # a second of samples holds some seven independent errors of motion, and one of place
        share_quick = min(1.0, frame / SHORTEST_CORRELATION)
        share_slow = min(1.0, frame / (2 * window))
        w_quick = weight[:, None] * share_quick / quick**2 / (1 + rr_quick / (ROBUST * quick) ** 2)
        w_slow = weight[:, None] * share_slow / place**2 / (1 + rr_slow / (ROBUST * place) ** 2)
        kernels.normal_equations(
            u, y, v, slow, state.tau, used, w_quick, w_slow, block, H_match, g_match, H_time, g_time
        )
    for H in (H_match, H_time):
        H += np.tril(H, -1).swapaxes(1, 2)
    H_group, g_group = np.zeros((GROUPS, 8, 8)), np.zeros((GROUPS, 8))
    if clusters:
        where = (a.mean - state.middle_a) / root + (b.mean - state.middle_b) @ turned
        group = neighbours(where, GROUPS)
        np.add.at(H_group, group, H_match)
        np.add.at(g_group, group, g_match)
    power = sum(float(weight @ p[7].sum(1)) for p in parts)
    speed = sum(float(weight @ (((p[4] - p[5][..., 6:]) ** 2).sum(2) * p[6]).sum(1)) for p in parts)
    return System(
        H_match.sum(0),
        g_match.sum(0),
        (H_group, g_group),
        (H_time, g_time),
        weight,
        float(np.sqrt(power / speed)) if speed > 0 else np.inf,
        place,
        np.where(seen, np.hypot(rms_quick, rms_slow), np.inf),
    )


def _noise(parts: list[tuple], k: int) -> float:
    """Robust scale of one part of the residual, of a vector of three."""
    size = np.concatenate([np.sqrt(p[k][p[6]]) for p in parts])
    return max(1.4826 / 1.5 * float(np.median(size)), 1e-12)


def _match_weight(rms: np.ndarray, seen: np.ndarray) -> np.ndarray:
    typical = float(np.median(rms[seen]))
    return 1 / (1 + (rms / max(OUTLYING * typical, 1e-300)) ** 2) ** 2
