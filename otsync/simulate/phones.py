"""Phones that film a textured room: on tripods, in hands, and one that is carried past all the others.

Nobody calibrated them and nobody pressed record at once: :func:`film` writes video files alone, and returns the truth.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from ..types import Camera
from .board import length, with_board
from .observation import stream
from .room import MIDDLE, Room, RoomCamera, draw_room, look_at

TARGET = MIDDLE + np.array([0.1, 0.05, 0.1])
"""Where phones on tripods look, m."""

ONE = "threads=1:lookahead-threads=1:sliced-threads=0:rc-lookahead=0:mbtree=0:bframes=0"
"""x264 on one thread, without a look ahead: the same images make the same bytes."""


class Held(Protocol):
    """How a phone is held: poses at the times of its frames."""

    def __call__(
        self, azimuth: float, times: Float[np.ndarray, " T"], rng: np.random.Generator
    ) -> Float[np.ndarray, "*T 4 4"]:
        """World to camera, one pose where the phone stands still. ``azimuth``: where around the middle (rad)."""
        ...


@dataclass(frozen=True)
class Tripod:
    """The phone stands still."""

    def __call__(
        self, azimuth: float, times: Float[np.ndarray, " T"], rng: np.random.Generator
    ) -> Float[np.ndarray, "4 4"]:
        return look_at(_stand(azimuth, -0.2 + 0.2 * rng.uniform(-1, 1)), TARGET + 0.1 * rng.normal(size=3))


@dataclass(frozen=True)
class Hand:
    """The phone sways.

    Args:
        sway: standard deviation of the place, m. turn: of the direction, degrees.
    """

    sway: float = 0.08
    turn: float = 1.8

    def __call__(
        self, azimuth: float, times: Float[np.ndarray, " T"], rng: np.random.Generator
    ) -> Float[np.ndarray, "T 4 4"]:
        place = _stand(azimuth, -0.15 + 0.15 * rng.uniform(-1, 1)) + self.sway * _shake(times, rng, 0.2, 1.2)
        turn = np.radians(self.turn) * _shake(times, rng, 0.2, 1.5)
        return np.stack([look_at(p, TARGET, r) for p, r in zip(place, turn, strict=True)])

    def shaken(
        self, w2c: Float[np.ndarray, "4 4"], times: Float[np.ndarray, " T"], rng: np.random.Generator
    ) -> Float[np.ndarray, "T 4 4"]:
        """A camera that stands still, as if it were held there."""
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(np.radians(self.turn) * _shake(times, rng, 0.2, 1.5)).as_matrix()
        out = np.repeat(np.asarray(w2c, float)[None], len(times), 0)
        centre = -w2c[:3, :3].T @ w2c[:3, 3] + self.sway * _shake(times, rng, 0.2, 1.2)
        out[:, :3, :3] = turn @ out[:, :3, :3]
        out[:, :3, 3] = -np.einsum("tij,tj->ti", out[:, :3, :3], centre)
        return out


@dataclass(frozen=True)
class Walk:
    """The phone is carried along the circle of the others, from one end to the other, and looks at the middle.

    Args:
        first, last: azimuths of the ends, rad. sway, turn: as of :class:`Hand`.
    """

    first: float
    last: float
    sway: float = 0.05
    turn: float = 2.0

    def __call__(
        self, azimuth: float, times: Float[np.ndarray, " T"], rng: np.random.Generator
    ) -> Float[np.ndarray, "T 4 4"]:
        way = self.first + (self.last - self.first) * np.linspace(0, 1, len(times))
        place = np.stack([_stand(a, -0.25) for a in way]) + self.sway * _shake(times, rng, 0.3, 1.5)
        turn = np.radians(self.turn) * _shake(times, rng, 0.3, 1.5)
        return np.stack([look_at(p, TARGET, r) for p, r in zip(place, turn, strict=True)])


@dataclass(frozen=True, eq=False)
class PhoneTruth:
    """What nobody tells ``otsync calibrate``.

    Args:
        names: of the videos, without the walk's. cameras: theirs; ``w2c`` (T,4,4) where they move.
        offsets: (V,) seconds: positive where a video started later than the first.
        fps: of all videos. walk: the camera of the clip that walks past the others, or None.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    offsets: Float[np.ndarray, " V"]
    fps: float
    walk: Camera | None


def film(
    folder: str | os.PathLike[str],
    seed: int,
    *,
    phones: int = 4,
    gap: float = 80.0,
    held: Held | None = None,
    walk: int = 600,
    frames: int = 150,
    fps: float = 30.0,
    size: tuple[int, int] = (640, 360),
    max_offset: float = 20.0,
    room: Room | None = None,
    board: int = 0,
    tell: Callable[[str], None] = lambda text: None,
) -> PhoneTruth:
    """Write ``phone0.mp4``, ``phone1.mp4``, ..., ``walk.mp4`` and the clips of a board into ``folder``; nothing else.

    Args:
        seed: decides everything.
        gap: degrees between neighbours. held: how phones are held; default :class:`Tripod`.
        walk: frames of the clip that walks past all phones; 0: there is none.
        frames: of every phone's video. max_offset: the largest offset, in frames.
        room: default: one drawn by ``seed``.
        board: places where a board is held still before the phones (see :mod:`otsync.simulate.board`), which each film
            it from their tripods: ``board phone0.mp4``, ...; 0: there is none.
        tell: receives a line for every clip that is written.
    """
    if phones < 2 or frames < 2 or walk < 0 or walk == 1:
        raise ValueError(
            f"phones, frames, walk: expected 2 and more, 2 and more, and 0 or at least 2; found {phones}, {frames}, "
            f"{walk}."
        )
    if board < 0 or (board and not isinstance(held or Tripod(), Tripod)):
        found = "phones in hands" if board > 0 else str(board)
        raise ValueError(f"board: expected 0 places and more, and phones on tripods; found {found}.")
    folder, room, held = Path(folder), room or draw_room(seed), held or Tripod()
    azimuths = np.radians(gap) * (np.arange(phones) - (phones - 1) / 2)
    shift = np.array([0.0, *(max_offset * stream(seed, v, "offset").uniform(-1, 1) for v in range(1, phones))]) / fps
    cameras, names = [], tuple(f"phone{v}" for v in range(phones))
    for v, name in enumerate(names):
        times = np.arange(frames) / fps
        w2c = held(float(azimuths[v]), times, stream(seed, v, "hand"))
        cameras.append(_clip(folder / f"{name}.mp4", room, w2c, times + shift[v], size, fps, stream(seed, v, "phone")))
        tell(f"filmed {name}.mp4, {frames} frames")
    if board:
        stands = np.stack([-camera.w2c[:3, :3].T @ camera.w2c[:3, 3] for camera in cameras])
        empty, times = with_board(room, seed, board, stands), np.arange(round(length(board) * fps)) / fps
        for v, (name, camera) in enumerate(zip(names, cameras, strict=True)):
            late = max_offset / fps * stream(seed, v, "board clip").uniform(-1, 1)
            _clip(folder / f"board {name}.mp4", empty, camera.w2c, times + late, size, fps, stream(seed, v, "phone"))
            tell(f"filmed board {name}.mp4, {len(times)} frames")
    carried = None
    if walk:
        times = np.arange(walk) / fps
        ends = (azimuths[0] - np.radians(5), azimuths[-1] + np.radians(5))
        w2c = Walk(*map(float, ends))(0.0, times, stream(seed, "walk"))
        carried = _clip(
            folder / "walk.mp4", room, w2c, times + frames / fps + 3, size, fps, stream(seed, "walk", "phone")
        )
        tell(f"filmed walk.mp4, {walk} frames")
    return PhoneTruth(names, tuple(cameras), shift, fps, carried)


def _clip(
    path: Path,
    room: Room,
    w2c: Float[np.ndarray, "*T 4 4"],
    times: Float[np.ndarray, " T"],
    size: tuple[int, int],
    fps: float,
    rng: np.random.Generator,
) -> Camera:
    """Film one clip; its camera, with a focal length of its own."""
    focal = size[0] * rng.uniform(0.7, 0.95)
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    eye = RoomCamera(room, K, size, rng)
    poses = np.broadcast_to(w2c, (len(times), 4, 4))
    write_video(path, (eye.film(np.ascontiguousarray(p), float(t))[0] for p, t in zip(poses, times, strict=True)), fps)
    return Camera(K, w2c, *size)


def write_video(path: str | os.PathLike[str], images: Iterable[np.ndarray], fps: float, *, crf: int = 16) -> None:
    """Write RGB images as H.264 in an MP4 file. ``crf``: x264's quality, 0 (lossless) to 51."""
    import av

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        video: Any = None
        for image in images:
            if video is None:
                video = container.add_stream("libx264", rate=round(fps), options={"crf": str(crf), "x264-params": ONE})
                video.height, video.width = image.shape[:2]
                video.pix_fmt = "yuv420p"
                video.codec_context.thread_count = 1
            container.mux(video.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        if video is not None:
            container.mux(video.encode())


def _stand(azimuth: float, height: float) -> Float[np.ndarray, " 3"]:
    """A place around the middle of the room, m."""
    return np.array([2.6 * np.sin(azimuth), height, 0.3 - 2.4 * np.cos(azimuth)])


def _shake(
    times: Float[np.ndarray, " T"], rng: np.random.Generator, low: float, high: float
) -> Float[np.ndarray, "T 3"]:
    """Smooth noise of about unit size: three waves between two frequencies (Hz) on each axis."""
    f, phase = rng.uniform(low, high, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
    return np.sin(2 * np.pi * f * times[:, None, None] + phase).sum(1) * np.sqrt(2 / 3)
