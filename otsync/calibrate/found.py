"""What a calibration found: one value a camera, with how sure it is, and what to film where it is not."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

WALK = (
    "Walk past all cameras with one of the phones for 20 seconds, keep the scene in view, and put the clip beside the "
    "others as walk.mp4."
)
"""What makes a calibration possible where cameras see no common background."""


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """The camera of one video.

    Args:
        name: of the video. width, height: of its images, in pixels.
        K: (3,3) intrinsics in pixels. distortion: OpenCV's coefficients, or None.
        lens: where K comes from: "given", "board", "file" (its metadata), "found" (by the mapping) or "guessed".
        w2c: world to camera, OpenCV axes; (4,4), or (T,4,4) where the camera moves; None where no pose was found.
        sigma_degrees, sigma_position: standard deviations of the pose: degrees, and units of the world; nan: not known.
        inliers: matches that obey one two-view geometry with the nearest picture of another video; by a board: corners.
        points: points of the model that it sees; by a board: its places.
        bridged: share of a moving camera's frames whose pose was put between those of their neighbours.
        doubt: why the camera is not to be trusted; empty where it is. remedy: what to do or to film about it.
    """

    name: str
    width: int
    height: int
    K: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, " D"] | None
    lens: str
    w2c: Float[np.ndarray, "*T 4 4"] | None = None
    sigma_degrees: float = float("nan")
    sigma_position: float = float("nan")
    inliers: int = 0
    points: int = 0
    bridged: float = 0.0
    doubt: str = ""
    remedy: str = ""

    @property
    def ok(self) -> bool:
        """Whether the camera is to be trusted."""
        return self.w2c is not None and not self.doubt

    @property
    def places(self) -> Float[np.ndarray, "T 3"]:
        """Where the camera stands, one place where it does not move. ValueError where no pose was found."""
        if self.w2c is None:
            raise ValueError(f"{self.name}: expected a pose; none was found.")
        poses = self.w2c.reshape(-1, 4, 4)
        return -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])

    def doubted(self, doubt: str, remedy: str) -> FoundCamera:
        """The same camera with a reason to doubt it; the first reason stays."""
        return self if self.doubt else replace(self, doubt=doubt, remedy=remedy)


@dataclass(frozen=True, eq=False)
class Calibration:
    """The cameras of a folder of videos.

    Args:
        cameras: one a video, in the videos' order.
        method: how they were found: "incremental" or "global": whose model it is; "board": by a board that is
            carried about; "motion": by what moves, with depth.
        unit: "metres", or "arbitrary": then the median distance from a camera to where all look is 3, or, by motion,
            lengths are in the unit of the first video's depth.
        helpers: cameras of clips that only helped (walk.mp4), which belong to no scene.
        points: (M,3) of the background, in the world (z up); none by motion.
        seconds: wall time per stage.
    """

    cameras: tuple[FoundCamera, ...]
    method: str
    unit: str = "arbitrary"
    helpers: tuple[FoundCamera, ...] = ()
    points: Float[np.ndarray, "M 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    seconds: dict[str, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, name: str) -> FoundCamera:
        """The camera of the named video. ValueError lists the names."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise ValueError(f"name: expected one of {', '.join(c.name for c in self.cameras)}; found {name!r}.")

    @property
    def found(self) -> tuple[FoundCamera, ...]:
        """The cameras with a pose."""
        return tuple(c for c in self.cameras if c.w2c is not None)

    @property
    def ok(self) -> bool:
        """Whether every camera was found and is to be trusted."""
        return all(c.ok for c in self.cameras)
