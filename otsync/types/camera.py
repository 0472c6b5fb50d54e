"""Cameras and videos: what filmed, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from .drawing import short

FPS_FACTOR = 3.0
"""Timestamps may disagree with the nominal rate by this factor; beyond it their unit is wrong."""

LONGEST_GAPS = 1000.0
"""A clip may span so many times its frames; beyond it one wrong timestamp would ask for gigabytes of empty clock."""

_DISTORTION_LENGTHS = (4, 5, 8, 12, 14)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes (x right, y down, z forward).

    Args:
        K: intrinsics in pixels; pixel centres lie at +0.5.
        w2c: world to camera, ``x_cam = R x_world + t``; (4,4) when static, (T,4,4) when it moves.
        width, height: of the image, in pixels.
        distortion: OpenCV's coefficients (k1, k2, p1, p2, k3, ...), or None.
        readout: seconds from the first to the last row of a rolling shutter, or None for a global one (or an unknown
            one). Rows are read from the top of the image as it is, the middle one at the frame's time.
    """

    K: Float[np.ndarray, "3 3"]
    w2c: Float[np.ndarray, "*T 4 4"]
    width: int
    height: int
    distortion: Float[np.ndarray, " D"] | None = None
    readout: float | None = None

    def __post_init__(self) -> None:
        K = np.asarray(self.K, float)
        w2c = np.asarray(self.w2c, float)
        if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
            raise ValueError(f"Camera.K: expected a finite 3x3 matrix with positive focal lengths; found {K.tolist()}.")
        if w2c.shape[-2:] != (4, 4) or w2c.ndim not in (2, 3) or not np.isfinite(w2c).all():
            raise ValueError(f"Camera.w2c: expected finite values of shape (4,4) or (T,4,4); found shape {w2c.shape}.")
        R = w2c[..., :3, :3]
        with np.errstate(over="ignore", invalid="ignore"):  # a stranger's 1e308 is no rotation, and no more
            turns = np.allclose(R @ np.swapaxes(R, -1, -2), np.eye(3), atol=1e-3)
        if not turns:
            raise ValueError(
                "Camera.w2c: expected a rotation in the upper 3x3; its rows are not orthonormal. Take scale out of it."
            )
        if (np.linalg.det(R) < 0).any():
            raise ValueError(
                "Camera.w2c: expected det(R) = +1; found -1, a mirrored frame: one axis points the wrong way. Negate "
                "that axis; otsync check tries which readings of the matrices fit."
            )
        if int(self.width) < 1 or int(self.height) < 1:
            raise ValueError(f"Camera.width, height: expected positive pixels; found {self.width} x {self.height}.")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "w2c", w2c)
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))
        if self.distortion is not None:
            d = np.asarray(self.distortion, float).reshape(-1)
            if len(d) not in _DISTORTION_LENGTHS or not np.isfinite(d).all():
                raise ValueError(
                    f"Camera.distortion: expected {_DISTORTION_LENGTHS} finite values; found {d.tolist()}."
                )
            object.__setattr__(self, "distortion", d)
        if self.readout is not None and not (np.isfinite(self.readout) and self.readout >= 0):
            raise ValueError(f"Camera.readout: expected seconds >= 0; found {self.readout}.")

    def __repr__(self) -> str:
        pose = "static" if self.w2c.ndim == 2 else f"{len(self.w2c)} poses"
        lens = "" if self.distortion is None else ", distortion"
        readout = "" if self.readout is None else f", readout {self.readout:g} s"
        return f"Camera({self.width} x {self.height}, focal {self.K[0, 0]:.4g} px, {pose}{lens}{readout})"

    @property
    def center(self) -> Float[np.ndarray, "*T 3"]:
        """Camera centre in the world, ``-Rᵀ t``."""
        R, t = self.w2c[..., :3, :3], self.w2c[..., :3, 3]
        return -np.einsum("...ji,...j->...i", R, t)

    def to_camera(self, xyz: Float[np.ndarray, "N T 3"]) -> Float[np.ndarray, "N T 3"]:
        """World points to camera axes. A moving camera needs one w2c per frame of ``xyz``'s second axis."""
        R, t = self.w2c[..., :3, :3], self.w2c[..., :3, 3]
        if self.w2c.ndim == 2:
            return xyz @ R.T + t
        return np.einsum("tij,ntj->nti", R, xyz) + t

    def to_world(self, local: Float[np.ndarray, "N T 3"]) -> Float[np.ndarray, "N T 3"]:
        """Points in camera axes to the world: the inverse of :meth:`to_camera`."""
        R, t = self.w2c[..., :3, :3], self.w2c[..., :3, 3]
        return (local - t) @ R if self.w2c.ndim == 2 else np.einsum("ntj,tji->nti", local - t, R)

    def project(self, xyz: Float[np.ndarray, "N T 3"]) -> Float[np.ndarray, "N T 2"]:
        """World points to pixels, without distortion; nan at and behind the camera plane."""
        cam = self.to_camera(xyz)
        z = np.where(cam[..., 2:] > 1e-9, cam[..., 2:], np.nan)
        return (cam[..., :2] / z) @ self.K[:2, :2].T + self.K[:2, 2]


@dataclass(frozen=True, eq=False)
class Video:
    """Frames with a clock and a camera.

    Args:
        frames: any sequence of (H,W,3) uint8 images; readers decode lazily.
        camera: who filmed; its ``w2c`` has one entry per frame when it moves.
        fps: frames per second, or None when ``timestamps`` (T,) in seconds tell the time.
        depth: optional sequence of (H,W) depths along z in world units, 0 where unknown; None for a frame without one.
    """

    frames: Sequence[Any]
    camera: Camera
    fps: float | None = None
    timestamps: Float[np.ndarray, " T"] | None = None
    name: str = ""
    depth: Sequence[Any] | None = None

    def __post_init__(self) -> None:
        fps, timestamps = clock(self.fps, self.timestamps, len(self.frames), "Video")
        object.__setattr__(self, "fps", fps)
        object.__setattr__(self, "timestamps", timestamps)
        if self.camera.w2c.ndim == 3 and len(self.camera.w2c) != len(self.frames):
            raise ValueError(f"Video.camera.w2c: expected {len(self.frames)} poses; found {len(self.camera.w2c)}.")
        if self.depth is not None and len(self.depth) != len(self.frames):
            raise ValueError(f"Video.depth: expected {len(self.frames)} maps; found {len(self.depth)}.")

    def __repr__(self) -> str:
        rate = "" if self.fps is None else f", {self.fps:.5g} fps"
        size = f"{self.camera.width} x {self.camera.height}"
        depth = "" if self.depth is None else ", depth"
        moves = "" if self.camera.w2c.ndim == 2 else ", moving camera"
        return f"Video({short(self.name)}, {len(self.frames)} frames of {size}{rate}{depth}{moves})"

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        """Seconds of every frame on the video's own clock."""
        return frame_times(self.fps, self.timestamps, len(self.frames))


def matrix_of(value: Any, name: str, shape: str) -> np.ndarray:
    """Rows of numbers as an array; its shape is the camera's affair. ValueError for rows of several lengths."""
    try:
        return np.asarray(value, float)
    except (ValueError, TypeError, OverflowError):
        raise ValueError(
            f"{name}: expected numbers of shape {shape}; found rows of several lengths. Write all rows whole."
        ) from None


def clock(
    fps: float | None, timestamps: Any, n_frames: int, owner: str
) -> tuple[float | None, Float[np.ndarray, " T"] | None]:
    """Validated (fps, timestamps). With timestamps alone, fps becomes the inverse of their median step."""
    if fps is None and timestamps is None:
        raise ValueError(f"{owner}.fps: expected frames per second, or timestamps in seconds; found neither.")
    if timestamps is not None:
        timestamps = np.asarray(timestamps, float)
        if timestamps.shape != (n_frames,) or not np.isfinite(timestamps).all():
            raise ValueError(
                f"{owner}.timestamps: expected {n_frames} finite seconds, one a frame; found shape {timestamps.shape}."
            )
        if (np.diff(timestamps) <= 0).any():
            k = int(np.argmax(np.diff(timestamps) <= 0))
            raise ValueError(
                f"{owner}.timestamps: expected strictly increasing seconds; frames {k} and {k + 1} are at "
                f"{timestamps[k]:g} and {timestamps[k + 1]:g}. Drop repeated frames, or sort them by PTS."
            )
        if fps is None and n_frames > 1:
            fps = float(1.0 / np.median(np.diff(timestamps)))
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"{owner}.fps: expected a positive number of frames per second; found {fps}.")
    if fps is not None and timestamps is not None and n_frames > 1:
        step = float(np.median(np.diff(timestamps)))
        if not 1 / FPS_FACTOR <= fps * step <= FPS_FACTOR:
            raise ValueError(
                f"{owner}.timestamps: expected seconds about 1/fps = {1 / fps:.4g} apart; found a median step of "
                f"{step:.4g}. Give seconds, not milliseconds or ticks, or leave fps out."
            )
        if timestamps[-1] - timestamps[0] > LONGEST_GAPS * n_frames * step:
            raise ValueError(
                f"{owner}.timestamps: expected a clip without pauses of hours; {n_frames} frames span "
                f"{timestamps[-1] - timestamps[0]:.4g} s. Cut it where recording stopped, or mend the odd timestamp."
            )
    return (None if fps is None else float(fps)), timestamps


def frame_times(fps: float | None, timestamps: np.ndarray | None, n_frames: int) -> Float[np.ndarray, " T"]:
    """Seconds of every frame: the timestamps where given, else ``k / fps``."""
    if timestamps is not None:
        return timestamps
    assert fps is not None  # clock() saw to it
    return np.arange(n_frames) / fps
