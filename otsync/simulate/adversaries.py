"""Motions that mislead: somebody else who does the same, periods, alike things. Each drawn anew by every seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from .body import FOREARM, LEFT, N_KINDS, SHIN, THIGH, UPPER_ARM, Parts, euler, thing
from .motions import TAU, Actor, Cycle, Wander, posture, sway_scale
from .scenes import Poses, Scene, stage, tennis

HORSE, PARCEL = N_KINDS + 8, N_KINDS + 9


def copies(scene: Scene, of: Sequence[tuple[float, tuple[float, float]]]) -> Scene:
    """The scene several times at once, each copy (seconds later, metres aside in x and y).

    Objects are numbered copy by copy; ``len(scene)`` objects each.
    """
    objects = int(scene.parts.object.max()) + 1
    parts = Parts.join([replace(scene.parts, object=scene.parts.object + k * objects) for k in range(len(of))])

    def pose(t: np.ndarray) -> Poses:
        R, p = zip(*(scene.pose(t - later) for later, _ in of), strict=True)
        moved = [x + np.array([*aside, 0.0]) for x, (_, aside) in zip(p, of, strict=True)]
        return np.concatenate(R), np.concatenate(moved)

    middle = np.mean([aside for _, aside in of], 0)
    x, y, z = scene.center
    center = (float(x + middle[0]), float(y + middle[1]), z)
    return Scene(parts, pose, scene.distance + 1.0, center)


def canon(rng: np.random.Generator) -> Scene:
    """Two players do the same, the second 10 to 40 frames later and two metres aside."""
    return copies(tennis(rng), ((0.0, (0.0, 0.0)), (rng.uniform(10, 40) / 30, (2.0, 0.0))))


def unison(rng: np.random.Generator) -> Scene:
    """Two players do the same at the same time, two metres apart."""
    return copies(tennis(rng), ((0.0, (0.0, 0.0)), (0.0, (2.0, 0.0))))


def looped(scene: Scene, seconds: float) -> Scene:
    """The scene's motion of half of ``seconds`` to and fro, without end: exactly periodic."""

    def pose(t: np.ndarray) -> Poses:
        return scene.pose(seconds / 4 * (1 - np.cos(TAU * t / seconds)))

    return replace(scene, pose=pose)


def loop(rng: np.random.Generator) -> Scene:
    """One player whose motion repeats exactly every 1 to 2 seconds."""
    return looped(tennis(rng), rng.uniform(1.0, 2.0))


def strides(rng: np.random.Generator) -> Scene:
    """Two people on treadmills, each a stride a second: every stride is nearly the one before."""

    def walker(aside: float) -> Actor:
        cycles = []
        for side, ahead in ((0, 0.0), (LEFT, np.pi)):
            swing = rng.uniform(0.4, 0.6)
            cycles += [
                Cycle(THIGH + side, 0, swing, 1, ahead),
                Cycle(SHIN + side, 0, 0.7 * swing, 1, ahead + np.pi / 2),
                Cycle(UPPER_ARM + side, 0, -rng.uniform(0.3, 0.5), 1, ahead),
                Cycle(FOREARM + side, 0, rng.uniform(0.1, 0.3), 1, ahead + 0.6),
            ]
        return Actor(
            posture=posture(elbows=0.7, knees=0.5),
            sway=Wander(rng, 45, sway_scale(0.04), 0.15, 0.9),
            walk=Wander(rng, 2, 0.04, 0.1, 0.4),
            turning=Wander(rng, 1, 0.05, 0.1, 0.4),
            place=(aside, rng.uniform(-0.3, 0.3)),
            heading=rng.uniform(0, TAU),
            cycle_rate=rng.uniform(0.97, 1.03),
            cycle_wobble=Wander(rng, 1, 0.06, 0.1, 0.4),
            cycles=tuple(cycles),
            size=rng.uniform(0.93, 1.08),
        )

    return stage([walker(-0.6), walker(0.6)], [])


def carousel(rng: np.random.Generator) -> Scene:
    """Eight like horses go round and bob up and down; an eighth of a turn later each is where the next one was."""
    count, turn, start = 8, rng.uniform(0.4, 0.9), rng.uniform(0, TAU)

    def pose(t: np.ndarray) -> Poses:
        angle = start + turn * t[None] + TAU / count * np.arange(count)[:, None]
        spot = np.stack([np.cos(angle), np.sin(angle), 1.0 + 0.15 * np.sin(2 * angle)], -1)
        R = euler(np.stack([np.zeros_like(angle), np.zeros_like(angle), angle], -1).reshape(-1, 3))
        return R.reshape(count, len(t), 3, 3), spot

    return Scene(Parts.join([thing(i, HORSE, (0.15, 0.3, 0.2)) for i in range(count)]), pose)


def belt(rng: np.random.Generator) -> Scene:
    """Like parcels on a belt, all at one speed: each is soon where the next one was."""
    count, gap, speed = 24, rng.uniform(0.3, 0.6), rng.uniform(0.3, 0.6)

    def pose(t: np.ndarray) -> Poses:
        x = gap * (np.arange(count)[:, None] - count / 2) + speed * (t[None] - 3.0)
        spot = np.stack([x, np.zeros_like(x), np.ones_like(x)], -1)
        return np.broadcast_to(np.eye(3), (count, len(t), 3, 3)), spot

    return Scene(Parts.join([thing(i, PARCEL, (0.1, 0.08, 0.06), box=True) for i in range(count)]), pose)


def flock(rng: np.random.Generator) -> Scene:
    """Twelve like things that wander together, and hardly apart."""
    count = 12
    together, apart = Wander(rng, 3, 0.4, 0.15, 0.6), Wander(rng, 3 * count, 0.05, 0.3, 1.0)
    place = rng.uniform(-0.8, 0.8, (count, 3)) + np.array([0, 0, 1.0])

    def pose(t: np.ndarray) -> Poses:
        own = apart(t).reshape(len(t), count, 3).transpose(1, 0, 2)
        return np.broadcast_to(np.eye(3), (count, len(t), 3, 3)), place[:, None] + together(t)[None] + own

    return Scene(Parts.join([thing(i, HORSE, (0.06,) * 3) for i in range(count)]), pose)


def rain(rng: np.random.Generator) -> Scene:
    """Forty different things fall, each at its own speed, and come again on top the moment they reach the floor."""
    count, high = 40, 2.4
    spot = rng.uniform(-1.5, 1.5, (count, 2))
    speed, start = rng.uniform(0.6, 1.8, count), rng.uniform(0, high, count)

    def pose(t: np.ndarray) -> Poses:
        z = (start[:, None] - speed[:, None] * t[None]) % high
        x = np.broadcast_to(spot[:, None], (count, len(t), 2))
        return np.broadcast_to(np.eye(3), (count, len(t), 3, 3)), np.concatenate([x, z[..., None]], 2)

    return Scene(Parts.join([thing(i, N_KINDS + i, (0.06,) * 3) for i in range(count)]), pose)


def portals(rng: np.random.Generator) -> Scene:
    """Twenty-four different things wander, and each is elsewhere all at once every second or two."""
    count = 24
    wander = Wander(rng, 3 * count, 0.3, 0.3, 1.0)
    when = np.cumsum(rng.uniform(1.0, 2.0, (count, 40)), 1) - 15.0
    place = rng.uniform(-1.0, 1.0, (count, 41, 3)) + np.array([0, 0, 1.2])

    def pose(t: np.ndarray) -> Poses:
        own = wander(t).reshape(len(t), count, 3).transpose(1, 0, 2)
        now = np.stack([np.searchsorted(w, t) for w in when])
        return np.broadcast_to(np.eye(3), (count, len(t), 3, 3)), place[np.arange(count)[:, None], now] + own

    return Scene(Parts.join([thing(i, N_KINDS + i, (0.06,) * 3) for i in range(count)]), pose)


ADVERSARIES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "canon": canon,
    "unison": unison,
    "loop": loop,
    "strides": strides,
    "carousel": carousel,
    "belt": belt,
    "flock": flock,
    "rain": rain,
    "portals": portals,
}
"""Motions that mislead, by name."""
