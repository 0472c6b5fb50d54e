"""Rolling shutters undone: tracks as a global shutter would have seen them, where the camera's readout is known.

Row v of an image of H rows is read at ``t + readout (v/H - 1/2)``, v continuous from the top (pixel centres at +0.5),
``t`` the frame's time: the middle row is read at the frame's time, as in the simulator and in the reconstruction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from ..geometry import distort
from ..types import Camera, TrackSet

LONGEST = 1.1
"""Readout in frames beyond which it cannot be right: a sensor reads a frame before it begins the next."""

LEAST_SHARE = 0.5
"""Two samples closer in time than this share of their frames' distance tell no velocity: a track that leaps over half
the image within a frame is none."""


def at_frame_times(tracks: TrackSet) -> TrackSet:
    """The same tracks, every visible sample at its frame's own time; their camera's ``readout`` becomes None.

    Sample k was taken when its row was read. ``uv`` and ``xyz`` at the frame's time come from the quadratic through
    the sample and its two neighbours in the track, the nearest visible ones before and after, at their real times: a
    line where there is one neighbour only. A sample without any stays as it is, for a track seen once says nothing
    about time. ``visible`` and ``sigma`` stay, and what is not visible is neither read nor written.

    White noise of the samples is not amplified: by .85 to 1 between neighbours whose rows are alike, by 1.06 at most
    where a track crosses 5 % of the height in a frame; at the ends of what was seen in one piece, where half a readout
    is extrapolated, by up to 1.58, for a readout of a whole frame and the first or last row.

    Of a camera that moves, ``uv`` at the frame's time belongs to the frame's pose. Its ``xyz`` are taken to be what
    that pose makes of the pixels and depths of rows read earlier or later, and are interpolated in the camera's axes,
    which undoes that wobble too.

    Args:
        tracks: ``uv`` or ``xyz``, whose rows tell the times. Without a camera, a readout, or with one of 0, the very
            same object comes back: what is absent costs nothing, and twice is once.

    ValueError for a readout longer than a frame (milliseconds, perhaps).
    """
    camera = tracks.camera
    if camera is None or not camera.readout:
        return tracks
    done = replace(camera, readout=None)
    if tracks.n_frames < 2:
        return replace(tracks, camera=done)
    check_within_a_frame(camera.readout, tracks.times, f"camera.readout of {tracks.name or 'the tracks'!r}")
    shift = _Shift(tracks.times, camera.readout * rows(tracks, camera), tracks.seen)
    uv = None if tracks.uv is None else shift(tracks.uv)
    xyz = None
    if tracks.xyz is not None and camera.w2c.ndim == 2:
        xyz = shift(tracks.xyz)
    elif tracks.xyz is not None:
        moved = camera.to_world(shift(camera.to_camera(tracks.positions())))
        xyz = np.where(tracks.seen[..., None], moved, tracks.xyz).astype(tracks.xyz.dtype, copy=False)
    return replace(tracks, uv=uv, xyz=xyz, camera=done)


def check_within_a_frame(seconds: float | None, times: Float[np.ndarray, " T"], what: str) -> None:
    """ValueError, which begins with ``what``, for a readout or an exposure that is longer than a frame."""
    frame = float(np.median(np.diff(times))) if len(times) > 1 else np.inf
    if seconds is not None and not seconds <= LONGEST * frame:
        raise ValueError(
            f"{what}: expected seconds, no longer than a frame ({frame:.4g} s); found {seconds:g}. Give seconds, not "
            "milliseconds, or leave it out."
        )


def rows(tracks: TrackSet, camera: Camera) -> Float[np.ndarray, "N T"]:
    """Where in the image every visible sample lies, from -1/2 (top) to 1/2; 0 where not visible.

    The image's own rows: distortion counts. Beyond the image's borders the nearest row.
    """
    pixels = tracks.uv if tracks.uv is not None else camera.project(tracks.positions())
    known = np.where(tracks.seen[..., None], pixels, np.nan).astype(float)
    return np.nan_to_num(np.clip(distort(camera, known)[..., 1] / camera.height - 0.5, -0.5, 0.5))


class _Shift:
    """From the samples' real times to the frames': which neighbours, and how much each of them counts.

    Args:
        times: (T,) of the frames. late: (N,T) by how much later each sample was taken.
    """

    def __init__(self, times: Float[np.ndarray, " T"], late: Float[np.ndarray, "N T"], seen: Bool[np.ndarray, "N T"]):
        N, T = seen.shape
        k = np.arange(T)
        last = np.maximum.accumulate(np.where(seen, k, -1), axis=1)
        following = np.minimum.accumulate(np.where(seen, k, T)[:, ::-1], axis=1)[:, ::-1]
        before = np.concatenate([np.full((N, 1), -1), last[:, :-1]], 1)
        after = np.concatenate([following[:, 1:], np.full((N, 1), T)], 1)
        has_before, has_after = seen & (before >= 0), seen & (after < T)
        self.seen = seen
        self.before, self.after = np.maximum(before, 0), np.minimum(after, T - 1)
        # a, b: from the neighbours' real times to the sample's and on; u: from there to the frame's time
        taken, u = times + late, -late
        a = taken - np.take_along_axis(taken, self.before, 1)
        b = np.take_along_axis(taken, self.after, 1) - taken
        has_before &= a >= LEAST_SHARE * (times - times[self.before])
        has_after &= b >= LEAST_SHARE * (times[self.after] - times)
        a, b = np.where(has_before, a, 1.0), np.where(has_after, b, 1.0)
        both = has_before & has_after
        self.from_before = np.where(both, u * (u - b) / (a * (a + b)), np.where(has_before, -u / a, 0.0))
        self.from_after = np.where(both, u * (u + a) / (b * (a + b)), np.where(has_after, u / b, 0.0))

    def __call__(self, x: Float[np.ndarray, "N T d"]) -> Float[np.ndarray, "N T d"]:
        """``x`` at the frames' times where seen, in its own precision; as it is elsewhere."""
        known = np.where(self.seen[..., None], x, 0).astype(float)
        # differences: what stands still stays to the last bit
        moved = known.copy()
        for neighbour, weight in ((self.before, self.from_before), (self.after, self.from_after)):
            moved += weight[..., None] * (np.take_along_axis(known, neighbour[..., None], 1) - known)
        return np.where(self.seen[..., None], moved, x).astype(x.dtype, copy=False)
