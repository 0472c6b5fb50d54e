"""Where a camera that moves is between its frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from ..clocks.common import frames_on_clock
from ..geometry import fundamental_of
from ..types import Camera, TrackSet

FEWEST = 4
"""Poses that a curve needs; of fewer the nearest one holds."""


@dataclass(frozen=True, eq=False)
class Moves:
    """The pose of a camera at every moment.

    A hand that shakes moves a picture by 100 pixels a second: the nearest frame's pose is wrong by two pixels halfway
    to the next, which is more than most things move meanwhile.

    Args:
        camera: its ``w2c`` (4,4), or (T,4,4) of the frames at ``times`` (T,), s.
    """

    camera: Camera
    times: Float[np.ndarray, " T"]

    @classmethod
    def of(cls, tracks: TrackSet) -> Moves:
        assert tracks.camera is not None
        return cls(tracks.camera, tracks.times)

    def at(self, times: Float[np.ndarray, " N"]) -> Float[np.ndarray, "*N 4 4"]:
        """World to camera: (N,4,4), or (1,4,4) of one that stands still. Before the first frame and after the last one
        it is where it was then.
        """
        w2c = self.camera.w2c
        if w2c.ndim == 2:
            return w2c[None]
        t = np.clip(times, self.times[0], self.times[-1])
        if len(w2c) < FEWEST:
            return w2c[np.abs(t[:, None] - self.times).argmin(1)]
        turn, centre = self._curves
        out = np.broadcast_to(np.eye(4), (len(t), 4, 4)).copy()
        out[:, :3, :3] = turn(t).as_matrix()
        out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], centre(t))
        return out

    def turns(self, times: Float[np.ndarray, " N"]) -> Float[np.ndarray, "*N 4 3"]:
        """The homographies by which the pictures at ``times`` differ from that of the middle frame since the camera
        turned, and below each the last row of its inverse: what :func:`not_turned` reads.
        """
        if self.camera.w2c.ndim == 2:
            return np.eye(4)[None, [0, 1, 2, 2], :3]
        R, K = self.at(times)[:, :3, :3], self.camera.K
        H = K @ R @ self.camera.w2c[len(self.times) // 2, :3, :3].T @ np.linalg.inv(K)
        return np.concatenate([H, np.linalg.inv(H)[:, 2:]], 1)

    @cached_property
    def _curves(self) -> tuple[Any, Any]:
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        rotation = Rotation.from_matrix(self.camera.w2c[:, :3, :3])
        return RotationSpline(self.times, rotation), CubicSpline(self.times, self.camera.center)


@dataclass(frozen=True, eq=False)
class Lines:
    """The epipolar geometry of a's frames, each with any moment of b.

    Args:
        a: (T,4,4) poses of a's frames, or (1,4,4). Ka: of a. b: the other camera.
    """

    Ka: Float[np.ndarray, "3 3"]
    a: Float[np.ndarray, "*T 4 4"]
    b: Moves

    @classmethod
    def of(cls, a: TrackSet, b: TrackSet, fps: float) -> Lines:
        """Of a's frames on its even clock of ``fps``."""
        assert a.camera is not None
        return cls(a.camera.K, Moves.of(a).at(on_even_clock(a, fps)), Moves.of(b))

    @property
    def still(self) -> bool:
        """Whether neither camera moves."""
        return len(self.a) == 1 and self.b.camera.w2c.ndim == 2

    def at(self, times: Float[np.ndarray, " T"]) -> Float[np.ndarray, "*T 3 3"]:
        """F of each of a's frames with b at ``times`` of its clock; one where neither moves."""
        return fundamental_of(self.Ka, self.a, self.b.camera.K, self.b.at(times))


@dataclass(frozen=True, eq=False)
class Rays:
    """A camera in each of its frames, or in one where it stands still.

    Args:
        back: (T,3,3) from pixels (x, y, 1) to rays in the world. line: (T,3,3) from normals of planes through the
            centre to lines in the picture. centre: (T,3).
    """

    back: Float[np.ndarray, "T 3 3"]
    line: Float[np.ndarray, "T 3 3"]
    centre: Float[np.ndarray, "T 3"]

    @classmethod
    def of(cls, K: Float[np.ndarray, "3 3"], poses: Float[np.ndarray, "T 4 4"]) -> Rays:
        R, inverse = poses[:, :3, :3], np.linalg.inv(K)
        back = np.swapaxes(R, 1, 2) @ inverse
        return cls(back, inverse.T @ R, -np.einsum("tji,tj->ti", R, poses[:, :3, 3]))

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """In order, as compiled loops read them."""
        return np.ascontiguousarray(self.back), np.ascontiguousarray(self.line), np.ascontiguousarray(self.centre)

    def within(self, frames: slice) -> Rays:
        """Those of some frames."""
        return self if len(self.back) == 1 else Rays(self.back[frames], self.line[frames], self.centre[frames])


@dataclass(frozen=True, eq=False)
class Views:
    """The epipolar geometry of all frames of both videos' even clocks. No matrix for each pair of frames: those of two
    phones that were held for three minutes would take 2 GB.

    Args:
        turn: (Tb,4,3), of b: see :meth:`Moves.turns`.
    """

    a: Rays
    b: Rays
    turn: Float[np.ndarray, "Tb 4 3"]

    @classmethod
    def of(cls, a: TrackSet, b: TrackSet, fps: float) -> Views:
        moves, times = (Moves.of(a), Moves.of(b)), (on_even_clock(a, fps), on_even_clock(b, fps))
        one, two = (Rays.of(m.camera.K, m.at(t)) for m, t in zip(moves, times, strict=True))
        return cls(one, two, moves[1].turns(times[1]))

    def F(self, i: int, j: int) -> Float[np.ndarray, "3 3"]:
        """The fundamental matrix of a's frame i and b's frame j, 0 of cameras that stand still."""
        x, y, z = self.a.centre[i] - self.b.centre[j]
        return self.b.line[j] @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ self.a.back[i]

    def within(self, frames: slice) -> Views:
        """Those of some frames of a."""
        return replace(self, a=self.a.within(frames))


def not_turned(
    across: Float[np.ndarray, "M T 2"], x: Float[np.ndarray, "M T 2"], turn: Float[np.ndarray, "*T 4 3"]
) -> Float[np.ndarray, "M T 2"]:
    """How something changes with a step in the middle frame's picture that changes by ``across`` with one at ``x``."""
    H = turn[:, :3]
    size = np.einsum("tj,mtj->mt", turn[:, 3, :2], x) + turn[:, 3, 2]
    along = (across * x).sum(2)[..., None]
    return size[..., None] * (np.einsum("tij,mti->mtj", H[:, :2, :2], across) - along * H[:, 2, :2])


def on_even_clock(tracks: TrackSet, fps: float) -> Float[np.ndarray, " T"]:
    """Times of the frames of a set's even clock (:func:`otsync.clocks.common.on_clock`), s."""
    return tracks.times[0] + np.arange(frames_on_clock(tracks, fps)) / fps
