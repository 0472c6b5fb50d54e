"""Phones that film a room in which balls fly: video files as phones write them, their cameras, and the truth.

No two phones agree: each has a rate of its own, one of them a variable one, one begins late in its file, some hear how
the balls tick. All of it stands in :data:`PHONES`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from otsync.export.encode import REPEATABLE, write_video
from otsync.io.document import write_document
from otsync.progress import counted
from otsync.simulate.observation import stream
from otsync.simulate.room import MIDDLE, Room, RoomCamera, draw_room, look_at
from otsync.types import Camera, Offsets

SOUND_SPEED = 343.0
"""m/s."""

RATE = 48_000
"""Samples of sound a second."""


THINGS, PACE, CONTRAST = 6, 0.6, 0.25
"""Balls that fly, how fast, and the contrast of the walls: a room that five phones can make a scene of."""

TICKS = 3.0
"""Ticks of a ball in a second."""

DISTANCE = 2.1
"""m from the phones to the middle of the room."""


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
        room: what was filmed; at its second ``t`` it is what a result shows at ``t`` on the first phone's clock.
        offsets: when each phone began, against the first. cameras: of the phones.
    """

    room: Room
    offsets: Offsets
    cameras: tuple[Camera, ...]

    def seen(
        self, camera: Camera, times: Float[np.ndarray, " T"]
    ) -> tuple[UInt8[np.ndarray, "T h w 3"], Bool[np.ndarray, "T h w"]]:
        """What ``camera`` would have filmed at ``times``, without noise, and which pixels show what moves."""
        eye = RoomCamera(self.room, camera.K, (camera.width, camera.height), np.random.default_rng(0), 0.0)
        images, masks = zip(*(eye.film(camera.w2c, float(t)) for t in times), strict=True)
        return np.stack(images), np.stack(masks)


def film_phones(
    folder: str | os.PathLike[str],
    seed: int = 0,
    *,
    phones: Sequence[Phone] = PHONES,
    seconds: float = 3.0,
    size: tuple[int, int] = (480, 270),
    late: float = 0.4,
    gap: float = 24.0,
) -> PhoneFilms:
    """Film a room that ``seed`` draws: ``phone0.mp4``, ..., ``scene.json`` with their cameras, and ``truth.json``.

    Args:
        seconds: of every clip. late: the largest shift between the beginning of a phone and of the first, s.
        gap: degrees between neighbours, as seen from the middle of the room.
    """
    if len(phones) < 2 or not seconds > 0 or not late >= 0:
        raise ValueError(
            f"phones, seconds, late: expected two phones and more, above 0, and 0 or more; found {len(phones)}, "
            f"{seconds:g} and {late:g}."
        )
    folder, room = Path(folder), draw_room(seed, things=THINGS, contrast=CONTRAST, pace=PACE, painted=True)
    began = np.array([0.0, *(late * stream(seed, v, "late").uniform(-1, 1) for v in range(1, len(phones)))])
    entries: list[dict[str, Any]] = []
    cameras, starts = [], []
    for v, phone in counted(list(enumerate(phones)), "filming", "phone", len(phones)):
        rng = stream(seed, v, "phone")
        camera = _camera((v - (len(phones) - 1) / 2) * np.radians(gap), size, rng)
        own = phone.times(seconds, rng)
        start = float(began[v]) - phone.begins  # second of the room at which the phone's clock shows 0
        eye = RoomCamera(room, camera.K, size, rng)
        sound = None if not phone.channels else heard(room, camera, start, float(own[-1]), phone.channels, seed, rng)
        write_video(folder / f"phone{v}.mp4", _frames(eye, camera, own, start), phone.fps, sound, RATE, x264=REPEATABLE)
        lens = {"K": camera.K.tolist(), "w2c": camera.w2c.tolist(), "width": camera.width, "height": camera.height}
        entries.append({"name": f"phone{v}", "file": f"phone{v}.mp4", "camera": lens})
        cameras.append(camera)
        starts.append(start)
    truth = Offsets.known([e["name"] for e in entries], np.array(starts), phones[0].fps)
    truth.save(folder / "truth.json")
    write_document(folder / "scene.json", entries)  # last: a folder that holds it is complete
    return PhoneFilms(room, truth, tuple(cameras))


def _frames(
    eye: RoomCamera, camera: Camera, own: Float[np.ndarray, " T"], start: float
) -> Iterator[tuple[float, UInt8[np.ndarray, "h w 3"]]]:
    for t in own.tolist():
        yield t, eye.film(camera.w2c, t + start)[0]


def _camera(azimuth: float, size: tuple[int, int], rng: np.random.Generator) -> Camera:
    """A phone on a tripod, in a lens of its own."""
    azimuth += 0.03 * rng.uniform(-1, 1)
    eye = MIDDLE + DISTANCE * np.array([np.sin(azimuth), 0, -np.cos(azimuth)]) + [0, rng.uniform(-0.6, 0), 0]
    focal = size[0] * rng.uniform(0.75, 0.85)
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    return Camera(K, look_at(eye, MIDDLE), *size)


def ticks(room: Room, first: float, last: float, seed: int) -> list[tuple[float, Float[np.ndarray, " 3"]]]:
    """Seconds of the room and places (m) at which its balls tick, each at times of its own."""
    found = []
    for ball in range(len(room.radii)):
        beat = stream(seed, ball, "tick").uniform(0, 1) / TICKS
        at = np.arange(np.ceil((first - beat) * TICKS), (last - beat) * TICKS) / TICKS + beat
        found += [(float(t), room.places(np.array([t]))[ball, 0]) for t in at]
    return sorted(found, key=lambda tick: tick[0])


def heard(
    room: Room, camera: Camera, start: float, seconds: float, channels: int, seed: int, rng: np.random.Generator
) -> Float[np.ndarray, "C N"]:
    """What a phone hears from its second 0 on, -1..1: a hiss, and the ticks, as late as sound is slow."""
    count = max(1, round(seconds * RATE))
    own = np.arange(count) / RATE
    sound = 0.004 * rng.standard_normal((channels, count))
    for t, place in ticks(room, start - 0.5, start + seconds, seed):
        since = own + start - t - np.linalg.norm(place - camera.center) / SOUND_SPEED
        after = np.maximum(since, 0)
        sound += (since >= 0) * 0.3 * np.exp(-after / 0.004) * np.sin(2 * np.pi * 1800 * after)
    return sound.clip(-1, 1).astype(np.float32)
