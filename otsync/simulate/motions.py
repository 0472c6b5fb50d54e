"""Motions of figures as functions of real time: band-limited wandering, a gait, gestures at events and cycles."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.special import erf

from .body import CHEST, FOREARM, HAND, LEFT, PELVIS_HEIGHT, SHIN, THIGH, UPPER_ARM, forward_kinematics

TAU = 2 * np.pi


class Wander:
    """C smooth random functions of time: sums of sinusoids of random frequency, phase and amplitude.

    Args:
        scale: standard deviation over time of every function; a number or (C,).
        low, high: band in Hz. Amplitudes fall with frequency, as those of bodies do.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        channels: int,
        scale: float | np.ndarray,
        low: float,
        high: float,
        terms: int = 6,
    ) -> None:
        edges = np.geomspace(low, high, terms + 1)
        self.omega = TAU * edges[:-1] * (edges[1:] / edges[:-1]) ** rng.random(terms)
        weights = rng.standard_normal((2, terms, channels)) / np.sqrt(self.omega)[:, None]
        power = 0.5 * (weights**2).sum((0, 1))
        self.weights = weights * (scale / np.sqrt(power))

    def __call__(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T C"]:
        angle = t[:, None] * self.omega
        return np.cos(angle) @ self.weights[0] + np.sin(angle) @ self.weights[1]

    def speed(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T C"]:
        """The derivative with respect to time."""
        angle = t[:, None] * self.omega
        w = self.omega[:, None]
        return np.cos(angle) @ (w * self.weights[1]) - np.sin(angle) @ (w * self.weights[0])


def bump(s: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * s**2)


def step(s: np.ndarray) -> np.ndarray:
    return 0.5 * (1 + erf(s / np.sqrt(2)))


def event_times(
    rng: np.random.Generator, first: tuple[float, float], pause: tuple[float, float], count: int = 24
) -> Float[np.ndarray, " E"]:
    """Instants of recurring events: one in ``first`` (s), others before and after it with random pauses (s)."""
    gaps = rng.uniform(*pause, 2 * count)
    start = rng.uniform(*first)
    return np.concatenate([start - np.cumsum(gaps[:count])[::-1], [start], start + np.cumsum(gaps[count:])])


@dataclass(frozen=True, eq=False)
class Gesture:
    """At each event, joint angle ``axis`` of ``limb`` is moved by ``size`` rad: there and back, or (``lasting``) on.

    ``delay`` and ``width`` are seconds; a lasting gesture is a smooth step, for whole turns.
    """

    limb: int
    axis: int
    size: float
    delay: float
    width: float
    lasting: bool = False


@dataclass(frozen=True, eq=False)
class Cycle:
    """A sinusoid on one joint angle, ``harmonic`` times the figure's cycle, ``phase`` rad ahead."""

    limb: int
    axis: int
    size: float
    harmonic: int
    phase: float


@dataclass(frozen=True, eq=False)
class Actor:
    """A moving figure.

    Args:
        posture: (15,3) mean anatomical angles.
        sway: band-limited motion of all 45 angles.
        place, walk: mean (2,) and band-limited motion of the pelvis on the floor, m.
        heading, turning: mean yaw and band-limited motion of it, rad.
        stride: (thigh amplitude at full speed in rad, cadence in Hz, phase); grows with the walking speed.
        events, gestures: what is done when.
        cycle_rate, cycle_wobble, cycles: periodic motion; the rate in Hz, the wobble shifts its phase.
        squat: m that the pelvis sinks at each event (negative: jumps), and over what seconds.
    """

    posture: Float[np.ndarray, "15 3"]
    sway: Wander
    walk: Wander
    turning: Wander
    place: tuple[float, float] = (0.0, 0.0)
    heading: float = 0.0
    stride: tuple[float, float, float] = (0.0, 1.0, 0.0)
    events: Float[np.ndarray, " E"] = field(default_factory=lambda: np.empty(0))
    gestures: tuple[Gesture, ...] = ()
    cycle_rate: float = 1.0
    cycle_wobble: Wander | None = None
    cycles: tuple[Cycle, ...] = ()
    squat: tuple[float, float] = (0.0, 0.3)
    size: float = 1.0

    def phase(self, t: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
        """Of the cycle, rad."""
        wobble = 0.0 if self.cycle_wobble is None else self.cycle_wobble(t)[:, 0]
        return TAU * self.cycle_rate * t + wobble

    def __call__(self, t: Float[np.ndarray, " T"]) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (15,T,3,3) and positions (15,T,3) of the limbs at world times ``t`` (s)."""
        angles = self.posture + self.sway(t).reshape(-1, 15, 3)
        root = np.empty((len(t), 3))
        root[:, :2] = self.place + self.walk(t)
        root[:, 2] = PELVIS_HEIGHT * self.size
        if self.stride[0]:
            self._stride(t, angles, root)
        if self.cycles:
            phase = self.phase(t)
            for c in self.cycles:
                angles[:, c.limb, c.axis] += c.size * np.sin(c.harmonic * phase + c.phase)
        if len(self.events) and len(t):
            # far events have no effect on there-and-back gestures, and a whole one on lasting ones
            early, late = t.min() - 6, t.max() + 6
            since = t[:, None] - self.events[(self.events > early) & (self.events < late)]
            passed = float((self.events <= early).sum())
            for g in self.gestures:
                s = (since - g.delay) / g.width
                moved = step(s).sum(1) + passed if g.lasting else bump(s).sum(1)
                angles[:, g.limb, g.axis] += g.size * moved
            root[:, 2] -= self.squat[0] * bump(since / self.squat[1]).sum(1)
        yaw = self.heading + self.turning(t)[:, 0]
        return forward_kinematics(angles, root, yaw, self.size)

    def _stride(self, t: np.ndarray, angles: np.ndarray, root: np.ndarray) -> None:
        size, cadence, start = self.stride
        pace = np.sqrt((self.walk.speed(t) ** 2).sum(1) + 0.01)
        swing = size * np.tanh(pace / 1.2)
        phase = TAU * cadence * t + start
        for side, sign in ((0, 1.0), (LEFT, -1.0)):
            angles[:, THIGH + side, 0] += sign * swing * np.sin(phase)
            angles[:, SHIN + side, 0] += 0.7 * swing * (1 + sign * np.cos(phase))
            angles[:, UPPER_ARM + side, 0] -= 0.6 * sign * swing * np.sin(phase)
        root[:, 2] += 0.04 * swing * np.cos(2 * phase)


def posture(
    elbows: float = 0.4, arms_out: float = 0.15, arms_forward: float = 0.15, knees: float = 0.15, lean: float = 0.05
) -> Float[np.ndarray, "15 3"]:
    """A relaxed stand, in anatomical angles (rad)."""
    angles = np.zeros((15, 3))
    for side in (0, LEFT):
        angles[UPPER_ARM + side, 0], angles[UPPER_ARM + side, 1] = arms_forward, arms_out
        angles[FOREARM + side, 0] = elbows
        angles[THIGH + side, 0], angles[SHIN + side, 0] = 0.5 * knees, knees
        angles[THIGH + side, 1] = 0.08
    angles[CHEST, 0] = lean
    return angles


def sway_scale(size: float, arms: float = 1.0, legs: float = 1.0) -> Float[np.ndarray, " 45"]:
    """How much every angle sways: ``size`` rad, trunk a third of it, hands and head more; arms and legs weighted."""
    scale = np.full((15, 3), size)
    scale[:2] *= 0.3
    scale[2] *= 0.6
    for side in (0, LEFT):
        scale[[UPPER_ARM + side, FOREARM + side, HAND + side]] *= arms
        scale[FOREARM + side, 1] *= 0.1  # elbows hinge
        scale[THIGH + side : THIGH + side + 3] *= 0.5 * legs
        scale[SHIN + side, 1:] *= 0.1  # so do knees
    return scale.ravel()
