"""Phones that film the small world: video files as phones write them, depth maps, cameras, and the truth.

No two phones agree: each has a rate of its own, one drops and delays frames, one begins late in its file, some hear the
footfalls. All of it stands in :data:`PHONES`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from otsync.export.encode import REPEATABLE, write_video
from otsync.io.document import write_document
from otsync.progress import counted
from otsync.simulate.observation import stream
from otsync.types import Camera, Offsets
from recon.rotations import look_at
from recon.simulate.camera import FilmingCamera
from recon.simulate.estimates import noisy_depth
from recon.simulate.recording import write_depth
from recon.simulate.world import DISTANCE, MIDDLE, World, draw_world

SOUND_SPEED = 343.0
"""m/s."""

RATE = 48_000
"""Samples of sound a second."""


BEGUN = 0.3
"""World second at which the first phone begins: the two who walk then meet in the middle of its clip."""


@dataclass(frozen=True)
class Phone:
    """How one phone writes its file.

    Args:
        fps: frames a second. wander: standard deviation of a frame's delay, as a share of a frame: above 0 the rate is
            variable. begins: seconds at which its file begins. channels: of sound; 0: none.
    """

    fps: float
    wander: float = 0.0
    begins: float = 0.0
    channels: int = 0

    def times(self, seconds: float, rng: np.random.Generator) -> Float[np.ndarray, " T"]:
        """Seconds of the frames of a clip on the phone's own clock."""
        even = np.arange(max(2, round(seconds * self.fps))) / self.fps
        late = np.clip(self.wander * rng.standard_normal(len(even)), -0.4, 0.4) / self.fps
        late[0] = 0
        return self.begins + even + late


PHONES = (
    Phone(30, channels=2),
    Phone(25, channels=1),
    Phone(30, wander=0.12),
    Phone(24, begins=0.5),
    Phone(30_000 / 1001, channels=2),
)


@dataclass(frozen=True, eq=False)
class PhoneFilms:
    """What nobody tells ``otsync run``.

    Args:
        world: what was filmed. offsets: when each phone began, against the first. cameras: of the phones.
        start: world second of the first phone's second 0; ``world`` at ``start + t`` is what a result shows at ``t``.
    """

    world: World
    offsets: Offsets
    cameras: tuple[Camera, ...]
    start: float


def film_phones(
    folder: str | os.PathLike[str],
    seed: int = 0,
    *,
    phones: Sequence[Phone] = PHONES,
    seconds: float = 2.0,
    size: tuple[int, int] = (320, 192),
    late: float = 0.35,
    gap: float = 72.0,
) -> PhoneFilms:
    """Film the world that ``seed`` draws: ``phone0.mp4``, ..., ``scene.json`` with their cameras, and ``truth.json``.

    The phones have a depth sensor, as erroneous as those are (:mod:`.estimates`); its maps stand in ``depth/``.

    Args:
        seconds: of every clip. late: the largest shift between the beginning of a phone and of the first, s.
        gap: degrees between neighbours, as seen from the middle of the scene.
    """
    if len(phones) < 2 or not seconds > 0 or not late >= 0:
        raise ValueError(
            f"phones, seconds, late: expected two phones and more, above 0, and 0 or more; found {len(phones)}, "
            f"{seconds:g} and {late:g}."
        )
    folder, world = Path(folder), draw_world(seed)
    began = np.array([0.0, *(late * stream(seed, v, "late").uniform(-1, 1) for v in range(1, len(phones)))])
    entries: list[dict[str, Any]] = []
    cameras, starts = [], []
    for v, phone in counted(list(enumerate(phones)), "filming", "phone", len(phones)):
        rng = stream(seed, v, "phone")
        camera = _camera((v - (len(phones) - 1) / 2) * np.radians(gap), size, rng)
        own = phone.times(seconds, rng)
        start = BEGUN + float(began[v]) - phone.begins  # world second of the phone's second 0
        film = FilmingCamera.of(world, camera, v, (), seed).film(own + start)
        sound = None if not phone.channels else heard(world, camera, start, float(own[-1]), phone.channels, rng)
        images = zip(own.tolist(), film.images, strict=True)
        write_video(folder / f"phone{v}.mp4", images, phone.fps, sound, RATE, x264=REPEATABLE)
        lens = {"K": camera.K.tolist(), "w2c": camera.w2c.tolist(), "width": camera.width, "height": camera.height}
        maps = noisy_depth(film, stream(seed, v, "depth"))
        depth = write_depth(folder / "depth" / f"phone{v}", maps, folder)
        entries.append({"name": f"phone{v}", "file": f"phone{v}.mp4", "camera": lens, "depth": depth})
        cameras.append(camera)
        starts.append(start)
    truth = Offsets.known([e["name"] for e in entries], np.array(starts) - starts[0], phones[0].fps)
    truth.save(folder / "truth.json")
    write_document(folder / "scene.json", entries)  # last: a folder that holds it is complete
    return PhoneFilms(world, truth, tuple(cameras), starts[0])


def _camera(azimuth: float, size: tuple[int, int], rng: np.random.Generator) -> Camera:
    """A phone on a tripod, in a lens of its own."""
    azimuth += 0.05 * rng.uniform(-1, 1)
    eye = np.array([DISTANCE * np.sin(azimuth), -DISTANCE * np.cos(azimuth), 1.5 + 0.3 * rng.uniform(-1, 1)])
    focal = size[0] * rng.uniform(0.9, 1.0)
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    return Camera(K, look_at(eye, np.array(MIDDLE), np.array([0.0, 0, 1])), *size)


def footfalls(world: World, first: float, last: float) -> list[tuple[float, Float[np.ndarray, " 3"]]]:
    """World seconds and places (m) at which a foot of a body meets the floor: where its trunk is lowest."""
    t = np.arange(first, last, 1e-3)
    trunks = np.flatnonzero(np.diff(world.scene.parts.object, prepend=-1))
    places = world.scene.pose(t)[1][trunks]
    steps = []
    for way in places:
        z = way[:, 2]
        low = 1 + np.flatnonzero((z[1:-1] < z[:-2]) & (z[1:-1] <= z[2:]))
        steps += [(float(t[k]), way[k] * [1, 1, 0]) for k in low]
    return sorted(steps, key=lambda step: step[0])


def heard(
    world: World, camera: Camera, start: float, seconds: float, channels: int, rng: np.random.Generator
) -> Float[np.ndarray, "C N"]:
    """What a phone hears from world second ``start`` on, -1..1: a hiss, and the footfalls, as late as sound is slow."""
    count = max(1, round(seconds * RATE))
    own = np.arange(count) / RATE
    sound = 0.004 * rng.standard_normal((channels, count))
    for t, place in footfalls(world, start - 0.5, start + seconds):
        since = own + start - t - np.linalg.norm(place - camera.center) / SOUND_SPEED
        after = np.maximum(since, 0)
        sound += (since >= 0) * 0.5 * np.exp(-after / 0.03) * np.sin(2 * np.pi * 140 * after)
    return sound.clip(-1, 1).astype(np.float32)
