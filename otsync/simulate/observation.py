"""One video's observation of a world, which effects turn into a worse one; and their random streams."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ..types import Camera
from ..types.similarity import IDENTITY, Similarity

__all__ = ["IDENTITY", "Observation", "Similarity", "Surface", "stream"]


@dataclass(frozen=True, eq=False)
class Surface:
    """N canonical surface points: who a track is, the same in every video.

    Args:
        part: (N,) rigid part, -1 for an outlier.
        object: (N,) figure or thing, -1 for an outlier.
        local: (N,3) in the part's own frame; what moves with it.
        position: (N,3) body coordinate: the point on its object in the rest pose, m.
        mirrored: (N,3) the point on the other side of the body; of things, the point itself.
    """

    part: Int[np.ndarray, " N"]
    object: Int[np.ndarray, " N"]
    local: Float[np.ndarray, "N 3"]
    position: Float[np.ndarray, "N 3"]
    mirrored: Float[np.ndarray, "N 3"]

    def __len__(self) -> int:
        return len(self.part)


@dataclass(frozen=True, eq=False)
class Observation:
    """The tracks of one video while they are being made.

    Args:
        xyz: (N,T,3) positions in the video's frame, m. Finite everywhere; ``visible`` says what counts.
        visible: (N,T).
        features: (N,D) before normalisation, or None.
        surface: who the tracks are.
        times: (T,) frame times on the video's own clock, s.
        regular: whether these are ``k / fps``.
        fps: of the video.
        rate, offset: of its clock; world time is ``rate * times + offset``.
        camera: that sees ``xyz``.
        frame: how ``xyz`` follows from world coordinates.
        size: of the scene, m.
        at: world times (T,) -> true world positions (N,T,3).
        facing: world times (T,) -> cosine (N,T) between the surface normals and the directions to the camera.
        late: (T,) seconds of world time by which every frame shows something else than the clock says (a freeze, a
            cut); None: nothing of the kind.
        video: index of the video.
    """

    xyz: Float[np.ndarray, "N T 3"]
    visible: Bool[np.ndarray, "N T"]
    features: Float[np.ndarray, "N D"] | None
    surface: Surface
    times: Float[np.ndarray, " T"]
    regular: bool
    fps: float
    rate: float
    offset: float
    camera: Camera
    frame: Similarity
    size: float
    at: Callable[[Float[np.ndarray, " T"]], Float[np.ndarray, "N T 3"]]
    facing: Callable[[Float[np.ndarray, " T"]], Float[np.ndarray, "N T"]]
    late: Float[np.ndarray, " T"] | None = None
    video: int = 0

    @property
    def world_times(self) -> Float[np.ndarray, " T"]:
        """What every frame shows, in seconds of the world."""
        told = self.rate * self.times + self.offset
        return told if self.late is None else told + self.late

    def rays(self) -> Float[np.ndarray, "N T 3"]:
        """From the camera centre to every sample: its length is the depth that depth errors are relative to."""
        return self.xyz - self.camera.center.astype(self.xyz.dtype)

    def moved(self, later: float | Float[np.ndarray, " T"]) -> Float[np.ndarray, "N T 3"]:
        """How far the tracks' points move in ``later`` s of world time, in the video's frame; outliers do not."""
        now = self.world_times
        step = (self.at(now + later) - self.at(now)) @ (self.frame.scale * self.frame.R.T).astype(self.xyz.dtype)
        return np.where((self.surface.part >= 0)[:, None, None], step, 0).astype(self.xyz.dtype, copy=False)


def stream(seed: int, *key: int | str) -> np.random.Generator:
    """An independent random stream for every key: adding or removing one leaves the bits of all others alone."""
    words = [zlib.crc32(k.encode()) if isinstance(k, str) else int(k) for k in key]
    return np.random.default_rng(np.random.SeedSequence(int(seed), spawn_key=tuple(words)))
