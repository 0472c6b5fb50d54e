"""A small filmed world with exact answers: what the fit's tests, examples and ablations run on.

Two articulated bodies of six rigid parts walk between a floor and a wall; every surface point is a Gaussian that moves
at every real time. Cameras around them film it, each with a clock that is off by a known part of a frame: camera v's
frame at its own time t shows the world at ``t + offset_v``, and so do its tracks, its depth and its masks. A method is
given all but the offsets. Metres, seconds, z up.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from otsync.progress import counted
from otsync.simulate import Scene
from otsync.simulate.body import Parts, euler, sample_surface, thing
from otsync.simulate.observation import stream
from otsync.types import Camera, TrackSet, Video
from recon.footage import Footage, footage_of
from recon.gaussians import Gaussians
from recon.raster import render, sh

FPS = 30.0
NOISE = 0.01
"""Standard deviation of the images' noise, in 0..1."""

RADIUS, HEIGHT = 3.2, 3.0
"""Of the wall around the scene, m. Cameras stand inside of it, so splats of the wall come close to them."""

NEAR = 0.6
"""m; what is static and nearer than this to a camera is not drawn."""

TRACK_NOISE, DRIFTING, DRIFT, SHORTEST = 0.006, 0.05, 0.01, 8
"""Tracks: m of white noise; share that drifts and its random walk, m per frame; frames that a track must be seen."""

DEPTH_SCALE, DEPTH_NOISE = 0.004, 0.006
"""Depth maps: relative error of a whole frame, and m of noise of every pixel."""


@dataclass(frozen=True, eq=False)
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

    @property
    def body(self) -> Int[np.ndarray, " N"]:
        """Which body every moving Gaussian belongs to."""
        return self.scene.parts.object[self.part]

    def positions(self, times: Sequence[float] | np.ndarray) -> Float[np.ndarray, "N T 3"]:
        """Of the moving Gaussians at world ``times`` (s)."""
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
        return Gaussians.from_colors(means, upright, torch.full((n, 3), 0.03), torch.full((n,), 0.9), colors)


@dataclass(frozen=True, eq=False)
class Capture:
    """What V cameras filmed of a world, what trackers and depth estimators made of it, and the answers.

    Args:
        footage: of the training cameras; the first is the reference.
        held_out: of cameras that no fit sees. They film at true world time.
        tracks: per training camera, on its own clock, with ``camera`` and ``frame="world"``.
        depth: per training camera (T,h,w) z in m, noisy, of what moves and of what is static; 0 where unknown.
        offsets: (V,) s, the truth: frames of camera v show the world at ``footage[v].times + offsets[v]``.
        gains: (V + held out, 3) the cameras' true colour gains (1 without :class:`Exposure`).
        world: the truth at every time.
    """

    footage: tuple[Footage, ...]
    held_out: tuple[Footage, ...]
    tracks: tuple[TrackSet, ...]
    depth: tuple[Float[np.ndarray, "T h w"], ...]
    offsets: Float[np.ndarray, " V"]
    gains: Float[np.ndarray, "C 3"]
    world: World
    near: float = NEAR

    @property
    def frame_step(self) -> float:
        """Seconds of a frame."""
        return 1 / FPS


def synthetic(
    seed: int = 0,
    *,
    cameras: int = 5,
    held_out: int = 1,
    frames: int = 24,
    size: tuple[int, int] = (160, 96),
    offsets: float | Sequence[float] = 1.0,
    effects: tuple[Effect, ...] = (),
) -> Capture:
    """Draw a world and film it; every seed has bodies, colours, cameras and offsets of its own.

    Args:
        cameras, held_out: how many train, and how many stand between them for evaluation.
        size: (width, height) of the images.
        offsets: frames; a bound that they are drawn within, or one a training camera. The reference's is 0 when drawn.
        effects: what cameras do to the images beyond noise of 1 %; what is absent changes no bit of the rest.
    """
    if cameras < 1 or held_out < 0 or frames < 1:
        raise ValueError(
            f"cameras, held_out, frames: expected 1, 0 and 1 or more; found {cameras}, {held_out}, {frames}."
        )
    world = _world(seed)
    shift = np.concatenate([_offsets(offsets, cameras, seed), np.zeros(held_out)]) / FPS
    times = np.arange(frames) / FPS
    lenses = [_camera(c, cameras, held_out, size, seed) for c in range(cameras + held_out)]
    films = [Film.of(world, lens, c, effects, seed) for c, lens in enumerate(lenses)]
    shots = [film.shoot(times + shift[c]) for c, film in counted(enumerate(films), "filming", "camera", len(films))]
    footage = []
    for c, (film, shot) in enumerate(zip(films, shots, strict=True)):
        name = f"cam{c}" if c < cameras else f"held{c - cameras}"
        video = Video(list(shot.images), film.camera, fps=FPS, name=name)
        footage.append(footage_of(video, list(shot.masks), width=size[0]))
    tracks, depth = [], []
    for c in range(cameras):
        tracks.append(_tracks(world, lenses[c], shots[c].depth, times + shift[c], f"cam{c}", seed, c))
        depth.append(_measured(shots[c], stream(seed, c, "depth")))
    gains = np.stack([film.gain for film in films])
    return Capture(
        tuple(footage[:cameras]), tuple(footage[cameras:]), tuple(tracks), tuple(depth), shift[:cameras], gains, world
    )


@dataclass(frozen=True, eq=False)
class Instant:
    """What a camera sees at one instant: rgb [h,w,3] and alpha [h,w,1] of what moves.

    z [h,w,1]: its depth, and solid [h,w,1]: its alpha, both as they are without blur, which a depth estimator looks through.
    """

    rgb: Tensor
    alpha: Tensor
    z: Tensor
    solid: Tensor


See = Callable[[float], Instant]


@dataclass(frozen=True)
class Exposure:
    """Every camera has a gain of its own per channel, log-normal with this standard deviation."""

    size: float = 0.08

    def draw(self, rng: np.random.Generator) -> Float[np.ndarray, " 3"]:
        """Factors of R, G and B."""
        return np.exp(self.size * rng.standard_normal(3))


@dataclass(frozen=True)
class MoreNoise:
    """White noise beyond the usual, standard deviation in 0..1."""

    size: float = 0.03


@dataclass(frozen=True)
class Blur:
    """The shutter is open for ``exposure`` s around a frame's time: mean over ``samples`` instants."""

    exposure: float = 0.02
    samples: int = 7

    def __call__(self, see: See, camera: Camera) -> See:
        def blurred(t: float) -> Instant:
            steps = ((np.arange(self.samples) + 0.5) / self.samples - 0.5) * self.exposure
            seen = [see(t + step) for step in steps]
            middle, rgb, alpha = see(t), [s.rgb for s in seen], [s.alpha for s in seen]
            return Instant(torch.stack(rgb).mean(0), torch.stack(alpha).mean(0), middle.z, middle.solid)

        return blurred


@dataclass(frozen=True)
class Rolling:
    """Rows are read over ``readout`` s, the middle one at the frame's time; rendered in ``bands`` bands of rows."""

    readout: float = 0.02
    bands: int = 16

    def __call__(self, see: See, camera: Camera) -> See:
        rows = (np.arange(camera.height) + 0.5) / camera.height
        band = np.minimum((rows * self.bands).astype(int), self.bands - 1)

        def rolled(t: float) -> Instant:
            parts = []
            for b in np.unique(band):
                own = torch.as_tensor(np.flatnonzero(band == b))
                seen = see(t + self.readout * float(rows[band == b].mean() - 0.5))
                parts.append([x[own] for x in (seen.rgb, seen.alpha, seen.z, seen.solid)])
            return Instant(*(torch.cat(column) for column in zip(*parts, strict=True)))

        return rolled


@dataclass(frozen=True)
class Sheen:
    """A lamp that what moves reflects: ``size * max(0, n . h) ** sharpness`` on every channel (Blinn 1977).

    h: half-way between the directions of the lamp, which is far away, and of the camera.
    """

    size: float = 0.3
    sharpness: float = 6.0
    lamp: tuple[float, float, float] = (0.3, -0.4, 0.87)

    def light(self, means: np.ndarray, normals: np.ndarray, eye: np.ndarray) -> Float[np.ndarray, "N 1"]:
        """What it adds to the colours that the camera at ``eye`` sees."""
        to_eye = eye - means
        half = to_eye / np.linalg.norm(to_eye, axis=1, keepdims=True) + np.asarray(self.lamp) / np.linalg.norm(
            self.lamp
        )
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        return self.size * np.maximum((normals * half).sum(1, keepdims=True), 0) ** self.sharpness


Effect = Exposure | MoreNoise | Blur | Rolling | Sheen


@dataclass(frozen=True, eq=False)
class Shots:
    """The frames of one camera: uint8 images, bool masks, and depths [T,h,w] without error, 0 at silhouettes."""

    images: np.ndarray
    masks: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True, eq=False)
class Film:
    """One camera with its effects, loaded with a world."""

    world: World
    camera: Camera
    effects: tuple[Effect, ...]
    gain: Float[np.ndarray, " 3"]
    noise: tuple[tuple[float, np.random.Generator], ...]

    @classmethod
    def of(cls, world: World, camera: Camera, c: int, effects: tuple[Effect, ...], seed: int) -> Film:
        gain, noise = np.ones(3), [(NOISE, stream(seed, c, "noise"))]
        seen: Counter[str] = Counter()
        for effect in effects:
            name = type(effect).__name__
            rng = stream(seed, c, "effect", name, seen[name])
            seen[name] += 1
            if isinstance(effect, Exposure):
                gain = gain * effect.draw(rng)
            elif isinstance(effect, MoreNoise):
                noise.append((effect.size, rng))
            elif isinstance(effect, Rolling):
                camera = replace(camera, readout=effect.readout)
        return cls(world, camera, effects, gain, tuple(noise))

    def shoot(self, times: Float[np.ndarray, " T"]) -> Shots:
        """Frames at world ``times``. Depth is that of the rows' instants, without blur."""
        with torch.no_grad():
            backdrop = self._render(self.world.static, NEAR)
            wall = backdrop.z[..., 0].numpy()
            see = self._see()
            images, masks, depths = [], [], []
            for t in times:
                seen = see(float(t))
                image = (seen.rgb + (1 - seen.alpha) * backdrop.rgb).numpy() * self.gain
                for size, rng in self.noise:
                    image = image + size * rng.standard_normal(image.shape)
                images.append(np.rint(255 * image.clip(0, 1)).astype(np.uint8))
                masks.append(seen.alpha[..., 0].numpy() > 0.5)
                alpha, z = seen.solid[..., 0].numpy(), seen.z[..., 0].numpy()
                depths.append(np.where(alpha > 0.6, z, np.where(alpha < 0.05, wall, 0)).astype(np.float32))
        return Shots(np.stack(images), np.stack(masks), np.stack(depths))

    def _see(self) -> See:
        """The camera through its effects."""
        see: See = lambda t: self._render(self._moving(t), 0.01)  # noqa: E731
        for effect in self.effects:
            if isinstance(effect, Blur | Rolling):
                see = effect(see, self.camera)
        return see

    def _moving(self, t: float) -> Gaussians:
        """What moves, in the colours that this camera sees."""
        moving = self.world.moving(t)
        for lamp in (e for e in self.effects if isinstance(e, Sheen)):
            R, shift = self.camera.w2c[:3, :3], self.camera.w2c[:3, 3]
            light = lamp.light(moving.means.numpy(), self.world.facing(t), -R.T @ shift)
            moving = replace(moving, sh=moving.sh + torch.as_tensor(light / sh.C0, dtype=torch.float32)[:, None])
        return moving

    def _render(self, gaussians: Gaussians, near: float) -> Instant:
        """What the camera sees of them; depth 0 where there is nothing."""
        colors = (sh.C0 * gaussians.sh[:, 0] + 0.5).clamp(0, 1)
        w2c = torch.as_tensor(self.camera.w2c, dtype=torch.float32)[None]
        K = torch.as_tensor(self.camera.K, dtype=torch.float32)[None]
        out = render(
            gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors, w2c, K,
            self.camera.width, self.camera.height, near_plane=near,
        )  # fmt: skip
        assert out.depths is not None
        return Instant(out.colors[0], out.alphas[0], out.depths[0], out.alphas[0])


def _world(seed: int) -> World:
    bodies = [_body(b, stream(seed, "body", b)) for b in range(2)]
    parts = Parts.join([parts for parts, _ in bodies])

    def pose(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        poses = [place(t) for _, place in bodies]
        return np.concatenate([R for R, _ in poses]), np.concatenate([p for _, p in poses])

    rng = stream(seed, "surface")
    part, local, normals = sample_surface(parts, 2200, rng)
    base = rng.uniform(0.1, 0.9, (len(parts), 3))
    wave = rng.normal(0, 18, (len(parts), 3, 3))
    texture = 0.18 * np.sin(np.einsum("ni,nij->nj", local, wave[part])) + 0.05 * rng.standard_normal((len(part), 3))
    return World(
        Scene(parts, pose, distance=2.6, center=(0, 0, 0.7)), part, local, normals, np.clip(base[part] + texture, 0, 1),
        _room(stream(seed, "room")),
    )  # fmt: skip


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

    Splats are sorted by their middles, so that a floor of large ones would seem to stand higher, and differently so from
    every side.
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


def _camera(c: int, cameras: int, held_out: int, size: tuple[int, int], seed: int) -> Camera:
    """Camera c of a ring around the scene; those held out stand half-way in the gaps, which are kept narrower."""
    gaps = np.ones(cameras)
    gaps[: min(held_out, cameras)] = 0.75
    edges = np.concatenate([[0], np.cumsum(gaps)]) * 2 * np.pi / gaps.sum()
    if c < cameras:
        azimuth = edges[c]
    else:
        gap, turn = (c - cameras) % cameras, (c - cameras) // cameras
        azimuth = edges[gap] + (edges[gap + 1] - edges[gap]) * 0.5 ** (turn + 1)
    rng = stream(seed, c, "camera")
    azimuth = azimuth + stream(seed, "rig").uniform(0, 2 * np.pi) + 0.05 * rng.uniform(-1, 1)
    eye = np.array([2.6 * np.cos(azimuth), 2.6 * np.sin(azimuth), 1.3 + 0.15 * (c % 6) + 0.05 * rng.uniform(-1, 1)])
    z = np.array([0, 0, 0.7]) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0, 1])
    x /= np.linalg.norm(x)
    w2c = np.eye(4)
    w2c[:3, :3] = np.stack([x, np.cross(z, x), z])
    w2c[:3, 3] = -w2c[:3, :3] @ eye
    focal = 150 / 160 * size[0]
    return Camera(np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]]), w2c, *size)


def _offsets(offsets: float | Sequence[float], cameras: int, seed: int) -> Float[np.ndarray, " V"]:
    """Frames, one a training camera."""
    if np.ndim(offsets):
        given = np.asarray(offsets, float)
        if given.shape != (cameras,) or not np.isfinite(given).all():
            raise ValueError(f"offsets: expected a bound or {cameras} finite frames; found {given.tolist()}.")
        return given
    bound: Any = offsets
    return np.array([0.0] + [float(bound * stream(seed, c, "offset").uniform(-1, 1)) for c in range(1, cameras)])


def _measured(shots: Shots, rng: np.random.Generator) -> Float[np.ndarray, "T h w"]:
    """The depth maps with errors."""
    scale = 1 + DEPTH_SCALE * rng.standard_normal((len(shots.depth), 1, 1))
    noisy = shots.depth * scale + DEPTH_NOISE * rng.standard_normal(shots.depth.shape)
    return np.where(shots.depth > 0, noisy, 0).astype(np.float32)


def _tracks(
    world: World, camera: Camera, depth: np.ndarray, times: np.ndarray, name: str, seed: int, c: int
) -> TrackSet:
    """Tracks of the surface points that this camera sees, with the errors of a tracker."""
    rng = stream(seed, c, "tracks")
    true = world.positions(times)
    z, uv = camera.to_camera(true)[..., 2], camera.project(true)
    inside = (z > 0.05) & (uv >= 0).all(-1) & (uv < (camera.width, camera.height)).all(-1)
    column, row = np.where(inside[..., None], uv, 0).astype(int).transpose(2, 0, 1)
    surface = depth[np.arange(len(times)), row, column]
    visible = inside & (surface > 0) & (z < surface + 0.03)
    xyz = true + TRACK_NOISE * rng.standard_normal(true.shape)
    walk = np.cumsum(DRIFT * rng.standard_normal(true.shape), 1)
    xyz += np.where(rng.random(len(true)) < DRIFTING, 1.0, 0.0)[:, None, None] * walk
    keep = visible.sum(1) >= min(SHORTEST, len(times))
    xyz = np.where(visible[..., None], xyz, np.nan)[keep]
    return TrackSet(xyz, visible[keep], fps=FPS, name=name, uv=camera.project(xyz), camera=camera, frame="world")
