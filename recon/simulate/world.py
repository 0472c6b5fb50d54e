"""A small world with exact answers, for tests, examples and ablations.

Two articulated bodies of six rigid parts walk between a floor and a wall; every surface point is a Gaussian that moves
at every real time. Cameras around them film it, each with a clock that is off by a known part of a frame: camera v's
frame at its own time t shows the world at ``t + offset_v``, and so do its tracks, its depth and its masks. Methods are
given everything but the offsets. Metres, seconds, z up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from otsync.simulate import Scene
from otsync.simulate.body import Parts, euler, sample_surface, thing
from otsync.simulate.observation import stream
from recon.scene.gaussians import Gaussians

FPS = 30.0
NOISE = 0.01
"""Standard deviation of the images' noise, in 0..1."""

RADIUS, HEIGHT = 3.2, 3.0
"""Of the wall around the scene, m. Cameras stand inside it, so splats of the wall come close to them."""

DISTANCE, MIDDLE = 2.6, (0, 0, 0.7)
"""From the cameras to the axis of the scene, m, and the point that they look at."""

STATIC_NEAR = 0.6
"""m; static things nearer than this to a camera are not drawn."""

SPLAT = 0.03
"""Standard deviation of the moving Gaussians, m."""

POINTS = 2200
"""Moving Gaussians of both bodies."""


@dataclass(frozen=True, eq=False, repr=False)
class World:
    """The truth: N moving Gaussians at every real time, and S static ones.

    Args:
        scene: the rigid parts and their poses.
        part: (N,) part of every moving Gaussian; six parts a body.
        local: (N,3) its position in the part's frame, m. normals: (N,3) which way the surface faces there, unit.
        colors: (N,3) RGB in 0..1.
        static: floor and wall.
    """

    scene: Scene
    part: Int[np.ndarray, " N"]
    local: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    colors: Float[np.ndarray, "N 3"]
    static: Gaussians

    def __repr__(self) -> str:
        return f"World({len(self.part)} moving Gaussians on {len(self.scene.parts)} parts, {len(self.static)} static)"

    @property
    def body(self) -> Int[np.ndarray, " N"]:
        """Which body every moving Gaussian belongs to."""
        return self.scene.parts.object[self.part]

    def positions(self, times: Sequence[float] | np.ndarray) -> Float[np.ndarray, "N T 3"]:
        """Positions of the moving Gaussians at world ``times`` (s)."""
        R, p = self.scene.pose(np.asarray(times, float))
        return np.einsum("ntij,nj->nti", R[self.part], self.local) + p[self.part]

    def facing(self, t: float) -> Float[np.ndarray, "N 3"]:
        """Normals of the surfaces that the moving Gaussians lie on, at world time ``t`` (s)."""
        return np.einsum("nij,nj->ni", self.scene.pose(np.array([t]))[0][self.part, 0], self.normals)

    def moving(self, t: float) -> Gaussians:
        """The moving Gaussians at world time ``t`` (s)."""
        means = torch.as_tensor(self.positions([t])[:, 0], dtype=torch.float32)
        n = len(means)
        upright = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
        colors = torch.as_tensor(self.colors, dtype=torch.float32)
        return Gaussians.from_colors(means, upright, torch.full((n, 3), SPLAT), torch.full((n,), 0.9), colors)


def draw_world(seed: int, pace: float = 1.0) -> World:
    """Two bodies in a room; ``seed`` decides everything but the ``pace``: how many times as fast all of it happens."""
    if not (math.isfinite(pace) and pace > 0):
        raise ValueError(f"pace: expected a number > 0; found {pace:g}.")
    bodies = [_body(b, stream(seed, "body", b)) for b in range(2)]
    parts = Parts.join([parts for parts, _ in bodies])

    def pose(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        poses = [place(pace * t) for _, place in bodies]
        return np.concatenate([R for R, _ in poses]), np.concatenate([p for _, p in poses])

    rng = stream(seed, "surface")
    part, local, normals = sample_surface(parts, POINTS, rng)
    base = rng.uniform(0.1, 0.9, (len(parts), 3))
    wave = rng.normal(0, 18, (len(parts), 3, 3))
    texture = 0.18 * np.sin(np.einsum("ni,nij->nj", local, wave[part])) + 0.05 * rng.standard_normal((len(part), 3))
    return World(
        Scene(parts, pose, distance=DISTANCE, center=MIDDLE),
        part,
        local,
        normals,
        np.clip(base[part] + texture, 0, 1),
        _room(stream(seed, "room")),
    )


def _body(b: int, rng: np.random.Generator) -> tuple[Parts, Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]]:
    """Trunk, head, two arms and two legs, which swing about their joints while the body turns and walks."""
    #        middle,             half axes,          joint,           swing rad
    layout = [
        ((0, 0, 0.75), (0.14, 0.10, 0.32), (0, 0, 0.75), 0.0),
        ((0, 0, 1.25), (0.11, 0.11, 0.13), (0, 0, 1.10), 0.25),
        ((0.20, 0, 0.80), (0.05, 0.05, 0.26), (0.18, 0, 1.02), 0.9),
        ((-0.20, 0, 0.80), (0.05, 0.05, 0.26), (-0.18, 0, 1.02), 0.9),
        ((0.09, 0, 0.22), (0.065, 0.065, 0.26), (0.09, 0, 0.45), 0.5),
        ((-0.09, 0, 0.22), (0.065, 0.065, 0.26), (-0.09, 0, 0.45), 0.5),
    ]
    parts = Parts.join([thing(b, k, axes, center=middle) for k, (middle, axes, _, _) in enumerate(layout)])
    joint = np.array([j for _, _, j, _ in layout])
    swing = np.array([s for *_, s in layout]) * rng.uniform(0.9, 1.1, 6)
    # arms and legs alternate, each a little ahead or behind
    phase = rng.uniform(0, 2 * np.pi) + np.array([0, 0.5, 0, 2.5, 1.0, 1.0 + np.pi]) + rng.normal(0, 0.2, 6)
    rate = 2 * np.pi * FPS / (16 + 3 * b) * rng.uniform(0.95, 1.05)
    heading, turning, drifting, bouncing = rng.uniform(0, 2 * np.pi, 4)
    side = 1 - 2 * b
    start = np.array([-0.55 * side, 0.3 * side]) + rng.uniform(-0.05, 0.05, 2)

    def pose(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angles = np.zeros((6, len(t), 3))
        angles[..., 0] = swing[:, None] * np.sin(rate * t + phase[:, None])
        yaw = np.zeros((len(t), 3))
        yaw[:, 2] = heading + 0.9 * np.sin(2 * np.pi * FPS / 40 * t + turning)
        turn, bend = euler(yaw), euler(angles)
        at = np.empty((len(t), 3))
        at[:, 0] = start[0] + 0.66 * side * (t - 0.4)
        at[:, 1] = start[1] + 0.25 * np.sin(2 * np.pi * FPS / 35 * t + drifting)
        at[:, 2] = 0.05 + 0.03 * np.abs(np.sin(2 * np.pi * FPS / 16 * t / 2 + bouncing))
        R = turn[None] @ bend
        fixed = joint[:, None] - np.einsum("ptij,pj->pti", bend, joint)
        return R, np.einsum("tij,ptj->pti", turn, fixed) + at

    return parts, pose


def _room(rng: np.random.Generator) -> Gaussians:
    """A floor and a round wall of small, flat, overlapping discs, blotchy.

    Splats are sorted by their middles: a floor of large ones would seem to stand higher, and differently so from every
    side.
    """
    on_floor, on_wall, width = 4000, 7000, 0.08
    angle = rng.uniform(0, 2 * np.pi, on_wall)
    floor = np.stack([*rng.uniform(-RADIUS, RADIUS, (2, on_floor)), np.zeros(on_floor)], 1)
    wall = np.stack([RADIUS * np.sin(angle), RADIUS * np.cos(angle), rng.uniform(0, HEIGHT, on_wall)], 1)
    at = np.concatenate([floor, wall])
    colors = 0.5 + 0.15 * np.sin(2.3 * at) @ rng.standard_normal((3, 3)) + 0.03 * rng.standard_normal(at.shape)
    quats = np.zeros((len(at), 4))
    quats[:on_floor, 0] = 1
    quats[on_floor:, 0], quats[on_floor:, 3] = np.cos(angle / 2), -np.sin(angle / 2)  # y turned outwards
    scales = np.concatenate([np.tile([1, 1, 0.1], (on_floor, 1)), np.tile([1, 0.1, 1], (on_wall, 1))]) * width
    arrays = (at, quats, scales, np.full(len(at), 0.95), colors.clip(0, 1))
    return Gaussians.from_colors(*(torch.as_tensor(a, dtype=torch.float32) for a in arrays))
