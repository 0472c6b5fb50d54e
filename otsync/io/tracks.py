"""Point tracks as trackers write them: CoTracker, SpatialTracker, TAPIR and TAPVid-3D, as arrays without pickles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..files.arrays import read_npz
from ..files.strict import shown
from .frames import file_digest

Kind = Literal["cotracker", "spatialtracker", "tapir", "tapvid3d"]

NAMES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "tapvid3d": (("tracks_XYZ",), ("visibility",)),
    "tapir": (("tracks",), ("visibles", "visible")),
    "cotracker": (("pred_tracks", "tracks"), ("pred_visibility", "visibility")),
    "spatialtracker": (("pred_tracks", "tracks", "coords"), ("pred_visibility", "visibility", "visibs")),
}
"""Of each kind the names of positions and of what was seen, in the order in which kinds are tried.

TAPIR writes (N,T,...), the others (T,N,...); a batch of one may stand before it.
"""

INDEX = ("cotracker", "spatialtracker")
"""Trackers whose pixels are indices (centre of the first pixel at 0); the others' begin at its edge, as ours."""

SEEN = 0.5
"""Confidence from which a sample counts as seen, where a file holds confidences."""

BEYOND = 1.05
"""Sizes of the image within which seen samples must lie: beyond them they are of another resolution."""


@dataclass(frozen=True)
class TrackFile:
    """Tracks of a file: pixels of images of ``size`` (width, height)."""

    path: Path
    kind: Kind | None = None
    size: tuple[int, int] | None = None
    picks: tuple[int, ...] | None = None
    """The frames of the file that are left of a video, in their order; None: all."""

    def digest(self) -> str:
        """A hash of the content, for caches."""
        return f"{file_digest(self.path)} {self.kind} {self.size} {self.picks}"

    def take(self, picks: Sequence[int]) -> TrackFile:
        """Of some of the frames."""
        own = self.picks
        return replace(self, picks=tuple(int(k) if own is None else own[int(k)] for k in picks))

    def read(self, frames: int, size: tuple[int, int]) -> Float[np.ndarray, "N T 2"]:
        """Pixels of images of ``size``, the centre of the first at (0.5, 0.5); nan where a point was not seen.

        Args:
            frames: of the video. ValueError for another number, and for pixels outside the images.
        """
        arrays = read_npz(self.path)
        kinds = [self.kind] if self.kind else list(NAMES)
        kind = next((k for k in kinds if all(set(names) & set(arrays) for names in NAMES[k])), None)
        if kind is None:
            wanted = "; ".join(f"{k}: {' and '.join('|'.join(names) for names in NAMES[k])}" for k in kinds)
            raise ValueError(
                f"{self.path}: expected tracks ({wanted}); found {shown(', '.join(arrays))}. Save them under "
                "these names."
            )
        places, seen = (next(arrays[n] for n in names if n in arrays) for names in NAMES[kind])
        places, seen = _plain(places, 3, self.path), _plain(seen, 2, self.path)
        if kind == "tapir":
            places, seen = places.swapaxes(0, 1), seen.swapaxes(0, 1)
        if self.picks is not None and max(self.picks, default=0) < min(len(places), len(seen)):
            places, seen = places[list(self.picks)], seen[list(self.picks)]
        T, N = places.shape[:2]
        if seen.shape != (T, N) or frames != T:
            order = "N,T" if kind == "tapir" else "T,N"
            raise ValueError(
                f"{self.path}: expected ({order}) as {kind} writes them, of {frames} frames; found {T} frames, {N} "
                f"tracks and visibility {seen.shape}. Give kind, or cut both to the same frames."
            )
        if kind == "tapvid3d":
            places = _projected(places, arrays, self.path)
        visible = seen > (SEEN if seen.dtype.kind == "f" else 0)
        uv = places[..., :2].astype(float) + (0.5 if kind in INDEX else 0.0)
        own = self.size or size
        visible &= np.isfinite(uv).all(-1)
        if visible.any():
            furthest = np.abs(uv[visible]).max(0)
            if (furthest > BEYOND * np.array(own)).any():
                raise ValueError(
                    f"{self.path}: expected pixels of {own[0]} x {own[1]} images; found up to {furthest[0]:.0f} and "
                    f"{furthest[1]:.0f}. Give size, of the images that were tracked in."
                )
        inside = (uv >= 0).all(-1) & (uv < np.array(own)).all(-1)
        uv = np.where((visible & inside)[..., None], uv * np.array(size) / np.array(own), np.nan)
        return uv.swapaxes(0, 1)


def _plain(array: np.ndarray, ndim: int, path: Path) -> np.ndarray:
    if array.ndim == ndim + 1 and len(array) == 1:
        array = array[0]
    if array.ndim != ndim or array.dtype.kind not in "biuf" or (ndim == 3 and array.shape[2] not in (2, 3)):
        raise ValueError(
            f"{path}: expected positions (T,N,2|3) and visibility (T,N); found {array.dtype} of {array.shape}. Save "
            "one video a file."
        )
    return array


def _projected(xyz: np.ndarray, arrays: dict[str, np.ndarray], path: Path) -> np.ndarray:
    """Pixels of points in the camera's axes, as TAPVid-3D holds them."""
    lens = arrays.get("fx_fy_cx_cy")
    if lens is None or lens.shape != (4,) or lens.dtype.kind not in "iuf" or xyz.shape[2] != 3:
        raise ValueError(f"{path}: expected tracks_XYZ (T,N,3) and fx_fy_cx_cy (4); found others. Export it again.")
    z = np.where(xyz[..., 2:] > 1e-9, xyz[..., 2:], np.nan)
    return xyz[..., :2] / z * lens[:2] + lens[2:]
