"""The slots of tracking, and what otsync and plugins ask of the objects that go into them.

A prior is a frozen dataclass (or any callable) with its parameters as fields. Its results are kept on disk under a key
of its input and of itself: all its fields count, unless it declares ``cache_key``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..types import Camera
from .depth_scale import Gives
from .working import WorkingFrames


class Masker(Protocol):
    """The ``masker`` slot: which pixels move."""

    def __call__(self, frames: WorkingFrames, camera: Camera) -> Bool[np.ndarray, "T h w"]:
        """Foreground at working resolution. ``camera``: of the frames at full resolution, its poses known."""
        ...


class Tracker(Protocol):
    """The ``points`` slot: points of the foreground followed through the frames of a video."""

    def __call__(self, frames: WorkingFrames, masks: Sequence[np.ndarray], fps: float) -> Float[np.ndarray, "N T 2"]:
        """Working pixel indices (centre of the first pixel at 0) of every track, nan where it is not followed.

        ``masks``: (h,w) foreground per frame. ``fps``: of the video; frame counts are given at 30.
        """
        ...


class Flow(Protocol):
    """The ``flow`` slot: optical flow between two frames, there and back.

    One that declares ``colour = True`` gets (H,W,3) instead of grey. One that has the two methods of
    :class:`OfWhatMoves` is asked by these instead.
    """

    def pair(
        self, before: np.ndarray, after: np.ndarray
    ) -> tuple[Float[np.ndarray, "H W 2"], Float[np.ndarray, "H W 2"]]:
        """Pixels that each point moves by, from ``before`` to ``after`` and from ``after`` back."""
        ...


@runtime_checkable
class OfWhatMoves(Protocol):
    """A :class:`Flow` that can leave out what nobody follows."""

    def prepare(self, image: np.ndarray, moves: Bool[np.ndarray, "H W"]) -> Any:
        """A frame as it is read, once for the flow to the next one and for that to the one before."""
        ...

    def between(self, before: Any, after: Any) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w 2"]]:
        """As of :meth:`Flow.pair`, from what ``prepare`` gave: right where something moves. Of any resolution, in
        pixels of the image."""
        ...


class Describer(Protocol):
    """The ``features`` slot: what tells a track from others, whichever camera sees it."""

    def __call__(
        self, frames: WorkingFrames, masks: Sequence[np.ndarray], uv: Float[np.ndarray, "N T 2"], fps: float
    ) -> Float[np.ndarray, "N D"]:
        """One vector a track, compared by its direction; none is all zeros. ``uv`` as a :class:`Tracker` gives it."""
        ...


class DepthEstimator(Protocol):
    """The ``depth`` slot: inverse depth of every pixel, up to what points of known depth tell afterwards.

    One that declares ``together`` is always given so many frames at once (the last ones fewer), since what it says of
    one depends on the others.
    """

    @property
    def gives(self) -> Gives:
        """What its values are: see :mod:`otsync.priors.depth_scale`."""
        ...

    def __call__(
        self, images: Sequence[UInt8[np.ndarray, "H W 3"]], cameras: Sequence[Camera]
    ) -> Float[np.ndarray, "B h w"]:
        """A map of any size an image, with the image's field of view; not finite where it tells nothing.

        ``cameras``: of the images at their size, each with one pose.
        """
        ...


def cache_key(prior: Any) -> Any:
    """What the cache tells a prior's results by: its ``cache_key`` where it declares one, else all it holds."""
    return getattr(prior, "cache_key", prior)
