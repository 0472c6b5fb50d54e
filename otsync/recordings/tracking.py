"""Tracking one video: masks, point tracks and descriptors, each kept on disk; and which tracks are worth keeping."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ..files.cache import Cache
from ..files.digest import content_key, sequence_key
from ..io.tracks import TrackFile
from ..priors.blobs import BySize
from ..priors.features import LabHistogram
from ..priors.masks import FlowResidual, GivenMasks, MedianBackground
from ..priors.slots import Describer, Masker, Tracker, cache_key
from ..priors.working import WIDTH, WorkingFrames
from ..types import Camera, TrackSet, Video
from ..types.checks import positive

TOGETHER = 5 / 30
"""Seconds that two tracks must share to be told apart, or not."""

KEPT = 2**26
"""Bytes of grey images that are kept from masks to flow: 290 frames of 640 x 360."""

SHORT_CLIP = 3
"""A track that lives this part of a clip is kept too, or of short clips none would be."""


@dataclass(frozen=True)
class Selection:
    """Which 2-D tracks to keep: the longest-lived, unless they move too little or follow a kept one.

    Where that keeps fewer than ``enough``, what moves is small or fast: then tracks may be nearer together (down to a
    quarter of ``apart``), live half as long and move half as much.

    Args:
        count: tracks (100 measured worse, 400 no better). min_life: frames at 30 fps.
        extent: pixels at 640 of width that a track must move in x or in y; a static false foreground does not.
        apart: pixels; a track that stays within it of a kept one tells nothing new. 10 let a person close to the
            camera take all places: 12 % of such depth-free pairs failed by more than 2 frames, 4 % with 16.
        enough: tracks; 0: the limits are never lowered.
    """

    count: int = 200
    min_life: float = 24
    extent: float = 6.0
    apart: float = 16.0
    enough: int = 60

    def __post_init__(self) -> None:
        positive("Selection.count", self.count)
        for name in ("min_life", "extent", "apart", "enough"):
            positive(f"Selection.{name}", getattr(self, name), zero=True)

    def __call__(self, uv: Float[np.ndarray, "N T 2"], width: int, fps: float) -> Int[np.ndarray, " K"]:
        """Indices into ``uv`` (pixels, nan unseen), by life."""
        kept = self._kept(uv, width, fps)
        for apart, least in LOWERED:
            if len(kept) >= self.enough:
                break
            lower = replace(self, apart=apart * self.apart, min_life=least * self.min_life, extent=least * self.extent)
            kept = lower._kept(uv, width, fps)
        return kept

    def _kept(self, uv: Float[np.ndarray, "N T 2"], width: int, fps: float) -> Int[np.ndarray, " K"]:
        from .kernels import apart_from_others

        life, least, moves = self._judged(uv, width, fps)
        good = (life >= least) & moves
        order = np.flatnonzero(good)[np.argsort(-life[good], kind="stable")]
        together = max(1, round(TOGETHER * fps))
        rows = np.ascontiguousarray(uv[order], np.float64)
        return order[apart_from_others(rows, self.apart * width / WIDTH, together, self.count)]

    def _judged(
        self, uv: Float[np.ndarray, "N T 2"], width: int, fps: float
    ) -> tuple[Int[np.ndarray, " N"], float, Bool[np.ndarray, " N"]]:
        """Life (frames) of every track, the least one, and which tracks move enough."""
        seen = np.isfinite(uv[..., 0])
        least = min(self.min_life * fps / 30, uv.shape[1] / SHORT_CLIP)
        low = np.where(seen[..., None], uv, np.inf).min(1, initial=np.inf)
        high = np.where(seen[..., None], uv, -np.inf).max(1, initial=-np.inf)
        return seen.sum(1), least, (high - low).max(1) > self.extent * width / WIDTH

    def told(self, uv: Float[np.ndarray, "N T 2"], width: int, fps: float) -> str:
        """How many tracks there were, and how many of them each limit drops where it is lowest, in words."""
        if len(uv) == 0:
            return "no track at all"
        apart, least = LOWERED[-1] if self.enough else (1.0, 1.0)
        lowest = replace(self, apart=apart * self.apart, min_life=least * self.min_life, extent=least * self.extent)
        life, needed, moves = lowest._judged(uv, width, fps)
        return (
            f"{len(uv)} tracks, of which {int((life < needed).sum())} live for less than {needed / fps:.2f} s "
            f"(min_life) and {int((~moves).sum())} move by less than {lowest.extent * width / WIDTH:.3g} px (extent)"
        )


LOWERED = ((0.5, 1.0), (0.25, 1.0), (0.25, 0.5))
"""Shares of ``apart``, and of life and extent, that are tried in turn where too few tracks are kept. Half of the life
is what the epipolar scan asks of a pair of tracks."""


def pixel_tracks(
    uv: Float[np.ndarray, "N T 2"],
    features: Float[np.ndarray, "N D"] | None,
    camera: Camera,
    *,
    fps: float | None,
    timestamps: Float[np.ndarray, " T"] | None = None,
    name: str = "",
    frame: str | None = None,
) -> TrackSet:
    """A track set of undistorted pixels, without positions in space."""
    from ..geometry import undistort

    seen = np.isfinite(uv[..., 0])
    return TrackSet(
        None, seen, features, fps, timestamps, name, undistort(camera, uv.astype(float)), camera=camera, frame=frame
    )


def track_labels(
    images: Sequence[np.ndarray], uv: Float[np.ndarray, "N T 2"], size: tuple[int, int]
) -> Int[np.ndarray, " N"]:
    """The label that most of a track's samples lie on; -1 where fewer than half of them lie on one and the same.

    Args:
        images: per frame (H,W) whole numbers, 0 none; of any resolution with the camera's field of view.
        uv: pixels of the images as they are, with distortion, nan unseen. size: width and height of those images.
    """
    seen = np.isfinite(uv[..., 0])
    under = np.zeros(seen.shape, np.int64)
    for k in range(uv.shape[1]):
        at = np.flatnonzero(seen[:, k])
        if len(at):
            image = np.asarray(images[k])
            h, w = image.shape
            x, y = np.floor(uv[at, k] * np.array([w, h]) / np.array(size)).astype(int).T
            under[at, k] = image[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)]
    names, index = np.unique(under, return_inverse=True)
    votes = np.zeros((len(uv), len(names)), int)
    np.add.at(votes, (np.nonzero(seen)[0], index.reshape(under.shape)[seen]), 1)
    votes[:, names == 0] = 0
    winner = votes.argmax(1)
    sure = votes.max(1) * 2 > seen.sum(1)
    return np.where(sure, names[winner], -1)


def on_foreground(
    uv: Float[np.ndarray, "N T 2"], masks: Sequence[np.ndarray], most: float = 0.5
) -> Float[np.ndarray, "N T 2"]:
    """The tracks of which at least ``most`` of the samples lie on the foreground: trackers follow walls as well.

    Args:
        uv: working pixel indices, nan unseen. masks: (h,w) per frame.
    """
    seen = np.isfinite(uv[..., 0])
    inside = np.zeros(seen.shape, bool)
    for k in range(uv.shape[1]):
        at = np.flatnonzero(seen[:, k])
        if len(at):
            mask = masks[k]
            x, y = np.round(uv[at, k]).astype(int).T
            inside[at, k] = mask[np.clip(y, 0, mask.shape[0] - 1), np.clip(x, 0, mask.shape[1] - 1)]
    return uv[inside.sum(1) >= np.maximum(most * seen.sum(1), 1)]


class PackedMasks(Sequence[np.ndarray]):
    """Masks of one bit a pixel, unpacked when a frame is asked for: 29 kB for 640 x 360."""

    def __init__(self, bits: np.ndarray, width: int):
        self.bits, self.width = bits, width

    def __len__(self) -> int:
        return len(self.bits)

    def __getitem__(self, k: int) -> Bool[np.ndarray, "h w"]:  # type: ignore[override]
        return np.unpackbits(self.bits[k], axis=-1, count=self.width).astype(bool)


@dataclass(frozen=True)
class Tracking:
    """Masks, point tracks and descriptors of one video: the stage that reads its pixels.

    Args:
        masker: default: given masks where there are any, else the median background of a static camera, else the
            flow residual of a moving one. One that is named is used even where masks are given.
        points: by the size of what moves optical flow that is chained, or blobs. features: colours, or
            :class:`otsync.priors.Daisy`. Any object with the call of its slot (:mod:`otsync.priors.slots`) will do.
        width: working resolution; larger frames are reduced to it.
        given: use point tracks that came with the recording, where there are any.
    """

    masker: Masker | None = None
    points: Tracker = field(default_factory=BySize)
    features: Describer = field(default_factory=LabHistogram)
    width: int = WIDTH
    given: bool = True

    def __call__(
        self,
        video: Video,
        masks: Sequence[np.ndarray] | None = None,
        cache: Cache | None = None,
        tracks: TrackFile | None = None,
    ) -> dict[str, np.ndarray]:
        """``uv`` (N,T,2), the camera's pixels with its distortion, nan unseen; ``features`` (N,D); ``seconds``.

        ``tracks``: a file of tracks that takes the tracker's place, unless ``given`` is off.

        Each of masks and tracks is kept on its own, so that a run that was killed continues between them.
        """
        cache = cache or Cache()
        frames = self._frames(video, keep=KEPT)
        fps = video.fps or 30.0
        brought = tracks if self.given else None
        follower = self.points if brought is None else brought.digest()
        priors = [cache_key(prior) for prior in (self.masker, follower, self.features)]

        def track() -> dict[str, np.ndarray]:
            started = time.perf_counter()
            mask = self._masks(frames, video, masks, cache)
            masked = time.perf_counter()
            if brought is None:
                uv = self.points(frames, mask, fps)
            else:
                size = (video.camera.width, video.camera.height)
                uv = on_foreground(frames.from_full(brought.read(len(video.frames), size)), mask)
            tracked = time.perf_counter()
            features = self.features(frames, mask, uv, fps).astype(np.float32)
            spent = np.diff([started, masked, tracked, time.perf_counter()])
            return {"uv": frames.to_full(uv).astype(np.float32), "features": features, "seconds": spent}

        return cache.arrays("tracks", (self.key(video, masks), *priors, self.width, fps), track)

    def masks(
        self, video: Video, given: Sequence[np.ndarray] | None = None, cache: Cache | None = None
    ) -> Sequence[np.ndarray]:
        """Foreground at working resolution, (h,w) bool per frame."""
        return self._masks(self._frames(video), video, given, cache or Cache())

    def _frames(self, video: Video, keep: int = 0) -> WorkingFrames:
        return WorkingFrames(video.frames, (video.camera.width, video.camera.height), self.width, keep)

    def _masks(
        self, frames: WorkingFrames, video: Video, given: Sequence[np.ndarray] | None, cache: Cache
    ) -> PackedMasks:
        masker = self.masker
        if masker is None:
            moves = video.camera.w2c.ndim == 3
            masker = GivenMasks(given) if given is not None else FlowResidual() if moves else MedianBackground()

        def compute() -> dict[str, np.ndarray]:
            foreground = masker(frames, video.camera)
            return {"bits": np.packbits(foreground, axis=2), "width": np.array(foreground.shape[2])}

        packed = cache.arrays("masks", (self.key(video, given), cache_key(masker), self.width), compute)
        return PackedMasks(packed["bits"], int(packed["width"]))

    def key(self, video: Video, masks: Sequence[np.ndarray] | None) -> str:
        """What the pixels and poses of a video are, for the cache."""
        poses = video.camera.w2c if video.camera.w2c.ndim == 3 else None
        given = None if masks is None else sequence_key(masks)
        return content_key(sequence_key(video.frames), given, video.camera.K, poses)
