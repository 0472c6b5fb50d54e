"""``synthetic()``: a world filmed by unsynchronised cameras, with the exact answers."""

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
from recon.rotations import look_at
from recon.simulate.camera import FilmingCamera
from recon.simulate.effects import Effect
from recon.simulate.estimates import noisy_depth, noisy_tracks
from recon.simulate.world import DISTANCE, FPS, MIDDLE, STATIC_NEAR, World, draw_world


@dataclass(frozen=True, eq=False, repr=False)
class Capture:
    """A world as V cameras filmed it, with the tracks and depth of estimators, and the answers.

    Args:
        footage: of the training cameras; the first is the reference.
        held_out: of cameras that no fit sees. They film at true world time.
        tracks: of every training camera, on its own clock, with ``camera`` and ``frame="world"``.
        depth: of every training camera, (T,h,w) z in m with errors, of moving and static things; 0 where unknown.
        offsets: (V,) s, the truth: frames of camera v show the world at ``footage[v].times + offsets[v]``.
        gains: (V + held out, 3) the cameras' true colour gains (1 without :class:`Exposure`).
        world: the truth at every time.
        near: m; static things nearer than this to a camera are not drawn.
        held_depth: as ``depth``, of the held-out cameras: for a synchronisation that sees them too.
    """

    footage: tuple[Footage, ...]
    held_out: tuple[Footage, ...]
    tracks: tuple[TrackSet, ...]
    depth: tuple[Float[np.ndarray, "T h w"], ...]
    offsets: Float[np.ndarray, " V"]
    gains: Float[np.ndarray, "C 3"]
    world: World
    near: float = STATIC_NEAR
    held_depth: tuple[Float[np.ndarray, "T h w"], ...] = ()

    def __repr__(self) -> str:
        frames = len(self.footage[0])
        return f"Capture({len(self.footage)} cameras, {len(self.held_out)} held out, {frames} frames, {self.world})"

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
    pace: float = 1.0,
) -> Capture:
    """Draw a world and film it; every seed has its own bodies, colours, cameras and offsets.

    Args:
        cameras, held_out: number of training cameras, and of those between them for evaluation.
        size: (width, height) of the images.
        offsets: in frames: a bound within which they are drawn, or one for each training camera. The reference's is 0
            when drawn.
        effects: what cameras do to the images beyond noise of 1 %; one that is absent changes no bit of the rest.
        pace: how many times as fast as usual all of it happens: a limb swings about once a second.
    """
    if cameras < 1 or held_out < 0 or frames < 1:
        raise ValueError(
            f"cameras, held_out, frames: expected at least 1, 0 and 1; found {cameras}, {held_out} and {frames}."
        )
    world = draw_world(seed, pace)
    shift = np.concatenate([_offsets(offsets, cameras, seed), np.zeros(held_out)]) / FPS
    times = np.arange(frames) / FPS
    lenses = [ring_camera(c, cameras, held_out, size, seed) for c in range(cameras + held_out)]
    filming = [FilmingCamera.of(world, lens, c, effects, seed) for c, lens in enumerate(lenses)]
    filmed = [f.film(times + shift[c]) for c, f in counted(enumerate(filming), "filming", "camera", len(filming))]
    footage = []
    for c, film in enumerate(filmed):
        name = f"cam{c}" if c < cameras else f"held{c - cameras}"
        video = Video(list(film.images), filming[c].camera, fps=FPS, name=name)
        footage.append(footage_of(video, list(film.masks), width=size[0]))
    tracks, depth = [], []
    for c in range(cameras):
        tracks.append(noisy_tracks(world, lenses[c], filmed[c].depth, times + shift[c], f"cam{c}", seed, c))
        depth.append(noisy_depth(filmed[c], stream(seed, c, "depth")))
    held_depth = [noisy_depth(filmed[c], stream(seed, c, "depth")) for c in range(cameras, cameras + held_out)]
    gains = np.stack([f.gain for f in filming])
    return Capture(
        tuple(footage[:cameras]),
        tuple(footage[cameras:]),
        tuple(tracks),
        tuple(depth),
        shift[:cameras],
        gains,
        world,
        held_depth=tuple(held_depth),
    )


def ring_camera(c: int, cameras: int, held_out: int, size: tuple[int, int], seed: int) -> Camera:
    """Camera c of a ring around the scene; held-out ones stand half-way in the gaps, which are narrower for it."""
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
    height = 1.3 + 0.15 * (c % 6) + 0.05 * rng.uniform(-1, 1)
    eye = np.array([DISTANCE * np.cos(azimuth), DISTANCE * np.sin(azimuth), height])
    w2c = look_at(eye, np.array(MIDDLE), np.array([0.0, 0, 1]))
    focal = 150 / 160 * size[0]
    return Camera(np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]]), w2c, *size)


def _offsets(offsets: float | Sequence[float], cameras: int, seed: int) -> Float[np.ndarray, " V"]:
    """Frames, one for each training camera."""
    if np.ndim(offsets):
        given = np.asarray(offsets, float)
        if given.shape != (cameras,) or not np.isfinite(given).all():
            raise ValueError(f"offsets: expected a bound or {cameras} finite frames; found {given.tolist()}.")
        return given
    bound: Any = offsets
    return np.array([0.0] + [float(bound * stream(seed, c, "offset").uniform(-1, 1)) for c in range(1, cameras)])
