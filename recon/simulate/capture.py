"""``synthetic()``: a filmed world, its unsynchronised cameras, and the exact answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from otsync.progress import counted
from otsync.simulate.observation import stream
from otsync.types import Camera, TrackSet, Video
from recon.footage.footage import Footage, footage_of
from recon.simulate.effects import Effect
from recon.simulate.film import Film, Shots
from recon.simulate.world import (
    DEPTH_NOISE,
    DEPTH_SCALE,
    DRIFT,
    DRIFTING,
    FPS,
    NEAR,
    SHORTEST,
    TRACK_NOISE,
    World,
    _world,
)


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
