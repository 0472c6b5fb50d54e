"""The motion classes: scripted scenes after those of the paper, each drawn anew by every seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .body import CHEST, FOREARM, HAND, LEFT, N_KINDS, SHIN, THIGH, UPPER_ARM, Parts, euler, human, thing
from .motions import TAU, Actor, Cycle, Gesture, Wander, event_times, posture, step, sway_scale

Poses = tuple[np.ndarray, np.ndarray]
BALL, BOX, RACKET = N_KINDS, N_KINDS + 1, N_KINDS + 2


@dataclass(frozen=True, eq=False)
class Scene:
    """Rigid parts that move: the one thing a world has to provide.

    Args:
        parts: the surfaces.
        pose: world times (T,) in seconds, any real numbers -> rotations (P,T,3,3) and positions (P,T,3).
        distance: m from the middle of the scene at which its cameras stand.
        center: the middle of the scene, where cameras look.
    """

    parts: Parts
    pose: Callable[[Float[np.ndarray, " T"]], Poses]
    distance: float = 3.2
    center: tuple[float, float, float] = (0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Thing:
    """A rigid thing: its surface, and its pose from the times and the limbs' poses of all actors."""

    parts: Parts
    pose: Callable[[np.ndarray, list[Poses]], Poses]


def stage(actors: list[Actor], things: list[Thing], **view: float) -> Scene:
    """The scene of these actors and things; objects are numbered in this order."""

    def pose(t: np.ndarray) -> Poses:
        bodies = [actor(t) for actor in actors]
        moved = [x.pose(t, bodies) for x in things]
        R = [b[0] for b in bodies] + [m[0][None] for m in moved]
        p = [b[1] for b in bodies] + [m[1][None] for m in moved]
        return np.concatenate(R), np.concatenate(p)

    parts = Parts.join([human(i, a.size) for i, a in enumerate(actors)] + [x.parts for x in things])
    return Scene(parts, pose, **view)  # type: ignore[arg-type]


def still(rng: np.random.Generator) -> Wander:
    return Wander(rng, 1, 0.05, 0.1, 0.4)


def grip(body: Poses, side: int) -> Float[np.ndarray, "T 3"]:
    """The middle of a hand in the world."""
    R, p = body[0][HAND + side], body[1][HAND + side]
    return p - 0.09 * R[:, :, 2]


def spinning(rng: np.random.Generator, rate: float) -> Callable[[np.ndarray], np.ndarray]:
    """Rotation of a thing that turns about ``rate`` rad/s."""
    spin, start = rng.normal(0, rate, 3), rng.uniform(0, TAU, 3)
    return lambda t: euler(start + spin * t[:, None])


def boxes(rng: np.random.Generator) -> Scene:
    """One person walks about slowly, carries a box in both hands, lowers and lifts it."""
    carry = rng.uniform(0.9, 1.1)
    actor = Actor(
        posture=posture(elbows=0.5, arms_out=0.05, arms_forward=carry),
        sway=Wander(rng, 45, sway_scale(0.10, arms=0.5), 0.2, 1.2),
        walk=Wander(rng, 2, 0.40, 0.12, 0.35),
        turning=Wander(rng, 1, 0.5, 0.1, 0.3),
        heading=rng.uniform(0, TAU),
        stride=(0.5, rng.uniform(0.75, 0.95), rng.uniform(0, TAU)),
        events=event_times(rng, (1.5, 3.5), (3.5, 6.0)),
        gestures=(
            Gesture(CHEST, 0, rng.uniform(0.5, 0.9), 0.0, 0.45),
            *(Gesture(UPPER_ARM + s, 0, -rng.uniform(0.2, 0.4), 0.0, 0.45) for s in (0, LEFT)),
            *(Gesture(THIGH + s, 0, 0.6, 0.0, 0.45) for s in (0, LEFT)),
            *(Gesture(SHIN + s, 0, 1.1, 0.0, 0.45) for s in (0, LEFT)),
        ),
        squat=(0.18, 0.45),
        size=rng.uniform(0.95, 1.05),
    )
    wobble = Wander(rng, 3, 0.08, 0.2, 0.8)

    def held(t: np.ndarray, bodies: list[Poses]) -> Poses:
        R = bodies[0][0][CHEST] @ euler(wobble(t))
        return R, 0.5 * (grip(bodies[0], 0) + grip(bodies[0], LEFT))

    half = rng.uniform((0.15, 0.12, 0.10), (0.22, 0.18, 0.18)).tolist()
    return stage([actor], [Thing(thing(1, BOX, half, box=True), held)])


def juggle(rng: np.random.Generator) -> Scene:
    """One person stands and juggles three balls: hands at 1.2-1.6 Hz, balls in a cascade of three times that period."""
    rate = rng.uniform(1.2, 1.6)
    elbow, lift = rng.uniform(0.28, 0.4), rng.uniform(0.10, 0.2)
    ahead = rng.uniform(1.0, 1.8)
    cycles = []
    for side, start in ((0, 0.0), (LEFT, np.pi)):
        cycles += [
            Cycle(FOREARM + side, 0, elbow, 1, start),
            Cycle(UPPER_ARM + side, 0, lift, 1, start + 0.4),
            Cycle(UPPER_ARM + side, 2, 0.22, 1, start + ahead),
            Cycle(HAND + side, 0, 0.35, 1, start + 0.9),
        ]
    cycles.append(Cycle(CHEST, 2, 0.05, 1, rng.uniform(0, TAU)))
    actor = Actor(
        posture=posture(elbows=1.45, arms_forward=0.1),
        sway=Wander(rng, 45, sway_scale(0.07), 0.15, 0.9),
        walk=Wander(rng, 2, 0.06, 0.1, 0.4),
        turning=Wander(rng, 1, 0.12, 0.1, 0.4),
        heading=rng.uniform(0, TAU),
        cycle_rate=rate,
        cycle_wobble=Wander(rng, 1, 0.30, 0.1, 0.4),
        cycles=tuple(cycles),
        size=rng.uniform(0.95, 1.05),
    )
    height = rng.uniform(0.45, 0.75)
    width = 0.2

    def ball(i: int) -> Callable[[np.ndarray, list[Poses]], Poses]:
        turn = spinning(rng, 4.0)

        def pose(t: np.ndarray, bodies: list[Poses]) -> Poses:
            # a figure of eight: in a hand (x = +-width) when low, crossing the middle at the top of its flight
            angle = (actor.phase(t) + TAU * i) / 3 + np.pi / 6
            R, p = bodies[0][0][CHEST], bodies[0][1][CHEST]
            spot = np.stack([width * np.sin(angle), np.full(len(t), 0.38), 0.02 + height * np.cos(angle) ** 2], -1)
            return turn(t), p + np.einsum("tij,tj->ti", R, spot)

        return pose

    return stage([actor], [Thing(thing(1 + i, BALL + 4, (0.04,) * 3), ball(i)) for i in range(3)])


def softball(rng: np.random.Generator) -> Scene:
    """One pitcher: a few steps, then a windmill pitch (a whole turn of the right arm), and the ball flies off."""
    events = event_times(rng, (1.9, 3.1), (3.2, 4.8))
    turn = rng.uniform(0.18, 0.24)
    actor = Actor(
        posture=posture(elbows=0.25),
        sway=Wander(rng, 45, sway_scale(0.13), 0.2, 1.2),
        walk=Wander(rng, 2, 0.22, 0.12, 0.5),
        turning=Wander(rng, 1, 0.25, 0.1, 0.4),
        heading=rng.uniform(0, TAU),
        stride=(0.5, rng.uniform(0.8, 1.1), rng.uniform(0, TAU)),
        events=events,
        gestures=(
            Gesture(UPPER_ARM, 0, TAU, 0.0, turn, lasting=True),
            Gesture(UPPER_ARM + LEFT, 0, rng.uniform(0.8, 1.3), -0.1, 0.3),
            Gesture(CHEST, 2, rng.uniform(0.4, 0.7), -0.05, 0.25),
            Gesture(CHEST, 0, rng.uniform(0.2, 0.5), 0.2, 0.3),
            Gesture(THIGH + LEFT, 0, rng.uniform(0.6, 0.9), -0.15, 0.2),
            Gesture(SHIN + LEFT, 0, rng.uniform(0.4, 0.8), -0.2, 0.2),
            Gesture(THIGH, 0, -0.4, 0.15, 0.25),
        ),
        squat=(rng.uniform(0.06, 0.14), 0.3),
        size=rng.uniform(0.95, 1.05),
    )
    spin, reach = spinning(rng, 6.0), rng.uniform(1.6, 2.2)

    def ball(t: np.ndarray, bodies: list[Poses]) -> Poses:
        # in the hand, thrown out along the heading at each event, back from the catcher before the next
        out = step((t[:, None] - events - turn - 0.12) / 0.10) - step((t[:, None] - events - 1.6) / 0.2)
        yaw = actor.heading
        there = np.array([-reach * np.sin(yaw), reach * np.cos(yaw), 0.6])
        return spin(t), grip(bodies[0], 0) * (1 - out.sum(1))[:, None] + there * out.sum(1)[:, None]

    return stage([actor], [Thing(thing(1, BALL, (0.05,) * 3), ball)])


def tennis(rng: np.random.Generator) -> Scene:
    """One player shuffles about and makes one or two big forehand swings with a racket at a passing ball."""
    events = event_times(rng, (1.9, 3.1), (2.4, 4.0))
    swing = rng.uniform(0.16, 0.22)
    actor = Actor(
        posture=posture(elbows=0.6, arms_forward=0.5, knees=0.4, lean=0.2),
        sway=Wander(rng, 45, sway_scale(0.13), 0.2, 1.3),
        walk=Wander(rng, 2, 0.35, 0.15, 0.6),
        turning=Wander(rng, 1, 0.2, 0.1, 0.4),
        heading=rng.uniform(0, TAU),
        stride=(0.45, rng.uniform(1.1, 1.5), rng.uniform(0, TAU)),
        events=events,
        gestures=(
            # wind up to the right, then through to the left
            Gesture(CHEST, 2, -rng.uniform(0.5, 0.8), -0.35, 0.2),
            Gesture(CHEST, 2, rng.uniform(0.5, 0.9), 0.15, swing),
            Gesture(UPPER_ARM, 1, rng.uniform(0.8, 1.2), -0.3, 0.22),
            Gesture(UPPER_ARM, 0, rng.uniform(1.0, 1.5), 0.18, swing),
            Gesture(UPPER_ARM, 2, -rng.uniform(0.4, 0.9), 0.15, swing),
            Gesture(FOREARM, 0, rng.uniform(0.4, 0.8), 0.25, swing),
            Gesture(UPPER_ARM + LEFT, 0, rng.uniform(0.4, 0.8), -0.2, 0.3),
            Gesture(THIGH + LEFT, 0, rng.uniform(0.3, 0.5), -0.1, 0.25),
        ),
        squat=(0.08, 0.3),
        size=rng.uniform(0.95, 1.05),
    )
    speed, bounce, turn = rng.uniform(5, 8), rng.uniform(-2, 2), spinning(rng, 8.0)

    def racket(t: np.ndarray, bodies: list[Poses]) -> Poses:
        return bodies[0][0][HAND], grip(bodies[0], 0)

    def ball(t: np.ndarray, bodies: list[Poses]) -> Poses:
        # comes from 2.4 m ahead to the player's side at each event and goes back
        since = (t[:, None] - events)[np.arange(len(t)), np.abs(t[:, None] - events).argmin(1)]
        ahead = 0.6 + 1.8 * np.tanh(np.sqrt(since**2 + 0.0004) * speed / 1.8)
        c, s = np.cos(actor.heading), np.sin(actor.heading)
        side = 0.6 + bounce * since * np.exp(-3 * since**2)
        xy = np.stack([c * side - s * ahead, s * side + c * ahead], -1)
        return turn(t), np.concatenate([xy, (0.9 + 0.25 * np.tanh(2 * np.abs(since)))[:, None]], 1)

    head = thing(1, RACKET, (0.13, 0.02, 0.17), center=(0.0, 0.0, -0.45))
    return stage([actor], [Thing(head, racket), Thing(thing(2, BALL, (0.035,) * 3), ball)])


def _player(
    rng: np.random.Generator, place: tuple[float, float], reach: float, events: np.ndarray, kick: bool
) -> Actor:
    side = LEFT if rng.random() < 0.3 else 0
    throw = (
        Gesture(UPPER_ARM + side, 0, rng.uniform(0.9, 1.5), -0.1, 0.2),
        Gesture(UPPER_ARM + LEFT - side, 0, rng.uniform(0.6, 1.2), -0.1, 0.22),
        Gesture(FOREARM + side, 0, rng.uniform(0.3, 0.9), -0.3, 0.2),
        Gesture(CHEST, 2, rng.uniform(-0.4, 0.4), -0.1, 0.3),
    )
    shot = (
        Gesture(THIGH + side, 0, -rng.uniform(0.4, 0.7), -0.25, 0.12),
        Gesture(SHIN + side, 0, rng.uniform(0.8, 1.3), -0.22, 0.12),
        Gesture(THIGH + side, 0, rng.uniform(0.8, 1.2), 0.05, 0.14),
        Gesture(UPPER_ARM + LEFT - side, 0, rng.uniform(0.5, 0.9), 0.0, 0.2),
        Gesture(CHEST, 2, rng.uniform(-0.4, 0.4), 0.0, 0.25),
    )
    return Actor(
        posture=posture(elbows=0.9 if kick else 0.7, arms_forward=0.3, knees=0.35, lean=0.15),
        sway=Wander(rng, 45, sway_scale(0.16), 0.2, 1.4),
        walk=Wander(rng, 2, reach, 0.12, 0.45),
        turning=Wander(rng, 1, 0.5, 0.1, 0.4),
        place=place,
        heading=rng.uniform(0, TAU),
        stride=(0.7, rng.uniform(1.1, 1.5), rng.uniform(0, TAU)),
        events=events,
        gestures=shot if kick else throw,
        squat=(0.04, 0.25) if kick else (-rng.uniform(0.0, 0.15), 0.2),
        size=rng.uniform(0.93, 1.08),
    )


def _team(
    rng: np.random.Generator, people: int, reach: float, kick: bool
) -> tuple[list[Actor], np.ndarray, np.ndarray]:
    """Players around a circle, the instants at which the ball leaves one of them, and who that is."""
    passes = event_times(rng, (0.6, 1.4), (0.8, 1.5), 64)
    holder = np.cumsum(rng.integers(1, people, len(passes))) % people
    around = rng.uniform(0, TAU) + TAU * np.arange(people) / people
    ring = rng.uniform(0.7, 1.1, people)
    return (
        [
            _player(rng, (ring[i] * np.cos(around[i]), ring[i] * np.sin(around[i])), reach, passes[holder == i], kick)
            for i in range(people)
        ],
        passes,
        holder,
    )


def basketball(rng: np.random.Generator) -> Scene:
    """Four players move about, jump and pass a fast ball from hand to hand (6-10 m/s)."""
    actors, passes, holder = _team(rng, 4, rng.uniform(0.25, 0.35), kick=False)
    flight, arc, turn = rng.uniform(0.07, 0.10), rng.uniform(0.1, 0.35), spinning(rng, 6.0)

    def ball(t: np.ndarray, bodies: list[Poses]) -> Poses:
        return turn(t), _passed(t, passes, holder, [grip(b, 0) for b in bodies], flight, arc)

    return stage(actors, [Thing(thing(4, BALL, (0.12,) * 3), ball)], distance=4.2)


def football(rng: np.random.Generator) -> Scene:
    """Three players run about and kick a ball along the floor from one to the other."""
    actors, passes, holder = _team(rng, 3, rng.uniform(0.4, 0.5), kick=True)
    flight, turn = rng.uniform(0.07, 0.11), spinning(rng, 9.0)

    def feet(actor: Actor, t: np.ndarray) -> np.ndarray:
        yaw = actor.heading
        xy = actor.place + actor.walk(t) + 0.4 * np.array([-np.sin(yaw), np.cos(yaw)])
        return np.concatenate([xy, np.full((len(t), 1), 0.11)], 1)

    def ball(t: np.ndarray, bodies: list[Poses]) -> Poses:
        return turn(t), _passed(t, passes, holder, [feet(a, t) for a in actors], flight, 0.0)

    return stage(actors, [Thing(thing(3, BALL, (0.11,) * 3), ball)], distance=4.2)


def _passed(
    t: np.ndarray, passes: np.ndarray, holder: np.ndarray, spots: list[np.ndarray], flight: float, arc: float
) -> Float[np.ndarray, "T 3"]:
    """Where a ball is that goes from ``holder[e]`` to ``holder[e+1]`` around instant ``passes[e]``."""
    gone = step((t[:, None] - passes[:-1]) / flight)  # (T,E): pass e is over
    at = np.stack(spots)
    before = int((gone == 1).all(0).sum())
    where = at[holder[before]].copy()
    for e in range(before, int((gone > 0).any(0).sum())):
        where += gone[:, e, None] * (at[holder[e + 1]] - at[holder[e]])
    where[:, 2] += arc * (4 * gone * (1 - gone)).sum(1)
    return where


def static(rng: np.random.Generator) -> Scene:
    """One person stands as still as one can: millimetres of sway, below the noise of any tracker."""
    actor = Actor(
        posture=posture() + rng.normal(0, 0.1, (15, 3)) * (np.arange(3) == 0),
        sway=Wander(rng, 45, sway_scale(0.002), 0.1, 0.5),
        walk=Wander(rng, 2, 0.001, 0.1, 0.4),
        turning=Wander(rng, 1, 0.001, 0.1, 0.4),
        heading=rng.uniform(0, TAU),
        size=rng.uniform(0.95, 1.05),
    )
    R, p = np.eye(3), np.array([*rng.uniform(-0.6, 0.6, 2), 0.15])

    def lies(t: np.ndarray, bodies: list[Poses]) -> Poses:
        return np.broadcast_to(R, (len(t), 3, 3)), np.broadcast_to(p, (len(t), 3))

    return stage([actor], [Thing(thing(1, BOX, (0.2, 0.15, 0.15), box=True), lies)])


def articulated(rng: np.random.Generator) -> Scene:
    """The figure, ball and box of the matching study: everything moves, nothing is scripted."""
    actor = Actor(
        posture=posture(arms_out=0.5),
        sway=Wander(rng, 45, sway_scale(0.35), 0.15, 0.8),
        walk=Wander(rng, 2, 0.25, 0.12, 0.4),
        turning=Wander(rng, 1, 0.4, 0.1, 0.3),
        heading=rng.uniform(0, TAU),
        stride=(0.5, rng.uniform(0.8, 1.2), rng.uniform(0, TAU)),
    )
    floats = [Wander(rng, 3, 0.3, 0.12, 0.6) for _ in range(2)]
    turns = [Wander(rng, 3, 0.8, 0.1, 0.4) for _ in range(2)]
    middle = [np.array([*rng.uniform(-0.6, 0.6, 2), z]) for z in (1.4, 0.5)]

    def drift(i: int) -> Callable[[np.ndarray, list[Poses]], Poses]:
        return lambda t, bodies: (euler(turns[i](t)), middle[i] + floats[i](t))

    return stage(
        [actor],
        [
            Thing(thing(1, BALL, (0.12,) * 3), drift(0)),
            Thing(thing(2, BOX, (0.15, 0.12, 0.12), box=True), drift(1)),
        ],
    )


#: motion classes by name
MOTIONS: dict[str, Callable[[np.random.Generator], Scene]] = {
    "boxes": boxes,
    "juggle": juggle,
    "softball": softball,
    "tennis": tennis,
    "basketball": basketball,
    "football": football,
    "static": static,
    "articulated": articulated,
}
