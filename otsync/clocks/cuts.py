"""Cuts that a video shows by itself: between two frames everything is elsewhere at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from ..geometry import directions, seen_pixels
from ..types import Break, Camera, TrackSet

BESIDE = 5
"""Frames on either side of a step that a line is laid through: what moves goes on along it, noise averages out."""

NEAR = 30
"""Frames on either side, behind those, whose steps tell how far apart such lines usually are."""

SUDDEN = 1.5
"""Times the largest of these that the step of a cut is. What jumps in the scene looks so, too: in a recording of
basketball all players turn at once, and eleven of fifteen cameras have up to 1.8, and 3.6 in pixels."""

CLEAR = 2.2
"""The same where a cut alone speaks against an answer: above all that was seen of things that jump in recordings with
depth. A cut with less says where to look, and must prove itself there."""

CLEAR_PATH = 2.5
"""The same of a camera's own path. Twelve films of four phones in hands (seeds 3200 to 3211): without a cut 1.95 at
most, with four, seven or ten frames missing 3.3 at least, at 144 of 144."""

GAP = 1.5
"""Usual steps of a clock from which on frames are missing between two."""

CALM = 1.3
"""Up to which no step is a cut. Of videos without one (seeds 80100 to 80103, all classes) five have more, 1.53 at most,
where a freeze or a slow motion begins, and of few tracks; brutal noise has 1.46 once (80100 to 80107). Of 44 that are
cut 41 have more than 1.8; two that lack ten frames under hard noise, and one that lacks a stride, have 1.2."""

FEWEST = 5
"""Tracks that must be seen in all frames beside a step, and other steps that must be known."""

COUNTED = 0.6
"""Share of the tracks that count, those that jump least: what jumps alone is no cut."""

JUMP = 3.0
"""Times a track's median step that its largest one is, where it jumps by itself: a tracker that takes up another point,
or a thing that wraps round."""

RHYTHM = 30
"""Frames that a cut must be worth: where more steps are sudden, pictures repeat (6 a second in a file of 30)."""

ROUNDED = 1e-9
"""Of the size of a path: less is no motion."""

BLOCK = 4096
"""Frames at a time: all steps of an hour would take a gigabyte."""


@dataclass(frozen=True, eq=False)
class Steps:
    """What a video shows from each frame to the next.

    Args:
        times: (T,) s of the video's own clock.
        jolts: how far apart the lines are that the tracks follow before and behind each step, rms, in units of the
            largest such distance beside it; nan where that is not known.
    """

    times: Float[np.ndarray, " T"]
    jolts: Float[np.ndarray, " T-1"]

    @classmethod
    def of(cls, tracks: TrackSet) -> Steps:
        """Of tracks with positions; of others nothing is known."""
        if tracks.xyz is None:
            return cls._of(tracks, np.full(max(tracks.n_frames - 1, 0), np.nan))
        return cls._of(tracks, _apart(lambda frames: tracks.positions(frames=frames), tracks.n_frames))

    @classmethod
    def in_pixels(cls, tracks: TrackSet) -> Steps:
        """Of tracks with pixels; a camera that is jerked looks cut, too."""
        return cls._of(tracks, _apart(_some_of(seen_pixels(tracks)), tracks.n_frames))

    @classmethod
    def of_camera(cls, tracks: TrackSet) -> Steps:
        """Of the camera's own path, where it moves: the mean of where it is and in which direction it looks; of one
        that stands still nothing is known. A hand never stops, so frames that are missing show there whatever the scene
        does. Beside frames that are known to be missing, by the times, nothing is known either.
        """
        n, camera = tracks.n_frames, tracks.camera
        if camera is None or camera.w2c.ndim == 2:
            return cls(tracks.times, np.full(max(n - 1, 0), np.nan))
        paths = camera.center[None], _corners(camera)
        each = [cls._of(tracks, _apart(_some_of(x), n, fewest=1), ROUNDED * np.abs(x).max()).jolts for x in paths]
        known = np.isfinite(each).sum(0) * ~_beside_gaps(tracks.times)
        return cls(tracks.times, np.where(known > 0, np.nansum(each, 0) / np.maximum(known, 1), np.nan))

    @classmethod
    def _of(cls, tracks: TrackSet, apart: Float[np.ndarray, " T-1"], least: float = 0.0) -> Steps:
        """``least``: up to which a distance is nothing."""
        padded = np.pad(apart, NEAR, constant_values=np.nan)
        late = [k for k in range(-NEAR, NEAR + 1) if abs(k) >= BESIDE]
        beside = np.stack([padded[NEAR + k : NEAR + k + len(apart)] for k in late])
        known = np.isfinite(beside).sum(0) >= FEWEST
        largest = np.fmax.reduce(beside, 0)
        return cls(
            tracks.times, np.divide(apart, largest, out=np.full(len(apart), np.nan), where=known & (largest > least))
        )

    def cuts(self, above: float = SUDDEN) -> Int[np.ndarray, " K"]:
        """The frames behind the cuts, whose jolts are larger than ``above``.

        A recorder that was paused, frames that were lost, a picture that froze and then caught up: whatever happened to
        the clock, it happened here. A freeze and its end, where the file goes on with what came next, are no cuts. None
        is told where there is more than one in :data:`RHYTHM` frames.
        """
        padded = np.pad(np.nan_to_num(self.jolts), BESIDE - 1)
        beside = sliding_window_view(padded, 2 * BESIDE - 1).max(1) if len(self.jolts) else padded
        # lines beside a cut are laid across it
        sudden = np.flatnonzero((self.jolts > above) & (self.jolts == beside))
        return np.zeros(0, int) if len(sudden) * RHYTHM > len(self.times) else sudden + 1

    def cut_near(self, at: float, within: float) -> float | None:
        """The moment of the frame behind the sharpest cut within so many seconds of a moment; None where none is."""
        found = self.cuts()
        found = found[np.abs(self.times[found] - at) <= within]
        return float(self.times[found[np.argmax(self.jolts[found - 1])]]) if len(found) else None

    def sharpest(self) -> tuple[float, float]:
        """The moment of the frame behind the largest jolt, and the jolt; 0 where none is known."""
        if not np.isfinite(self.jolts).any():
            return 0.0, 0.0
        k = int(np.nanargmax(self.jolts))
        return float(self.times[k + 1]), float(self.jolts[k])


def _beside_gaps(times: Float[np.ndarray, " T"]) -> Bool[np.ndarray, " T-1"]:
    """The steps at which lines are laid across frames that are missing by their times."""
    step = np.diff(times)
    gap = np.pad(step > GAP * np.median(step) if len(step) else np.zeros(0, bool), BESIDE - 1)
    return np.asarray(sliding_window_view(gap, 2 * BESIDE - 1).any(1)) if len(step) else np.zeros(0, bool)


def _corners(camera: Camera) -> Float[np.ndarray, "4 T 3"]:
    """In which directions the corners of a camera's pictures look."""
    corners = np.array([(0, 0), (camera.width, 0), (0, camera.height), (camera.width, camera.height)], float)
    return directions(camera, np.repeat(corners[:, None], len(camera.w2c), 1))


def _some_of(x: Float[np.ndarray, "M T D"]) -> Callable[[slice], Float[np.ndarray, "M F D"]]:
    return lambda frames: x[:, frames]


def _apart(
    part_of: Callable[[slice], Float[np.ndarray, "M F D"]], n_frames: int, fewest: int = FEWEST
) -> Float[np.ndarray, " T-1"]:
    """The distances, in units of the coordinates; nan where few tracks are seen on both sides.

    Args:
        part_of: coordinates of the tracks in some frames, nan where not seen. fewest: of these, at least.
    """
    told = np.full(max(n_frames - 1, 0), np.nan)
    at = np.arange(BESIDE) + 0.5
    one_side = 1 / BESIDE - at.mean() * (at - at.mean()) / np.square(at - at.mean()).sum()  # the line's value at 0
    weight = np.concatenate([-one_side[::-1], one_side])
    for first in range(0, len(told) - len(weight) + 2, BLOCK):
        x = part_of(slice(first, first + BLOCK + len(weight) - 1))
        steps = x.shape[1] - len(weight) + 1
        away = sum(w * x[:, k : k + steps] for k, w in enumerate(weight))
        square = np.square(away).sum(2)
        square[_jumps_beside(x)] = np.nan
        square = np.sort(square, axis=0)  # nan comes last
        seen = np.isfinite(square).sum(0)
        count = np.maximum((COUNTED * seen).astype(int), 1)
        total = np.cumsum(np.nan_to_num(square), 0)[count - 1, np.arange(steps)]
        known = np.flatnonzero(seen >= fewest)
        told[first + BESIDE - 1 + known] = np.sqrt(total[known] / count[known])
    return told


def _jumps_beside(x: Float[np.ndarray, "M T D"]) -> Bool[np.ndarray, "M S"]:
    """Which tracks jump by themselves within the frames that lines are laid through, beside the step in question."""
    length = np.sqrt(np.square(np.diff(x, axis=1)).sum(2))
    around = sliding_window_view(length, 2 * BESIDE - 1, axis=1)
    largest = around.max(2)
    return (around[:, :, BESIDE - 1] < largest) & (largest > JUMP * np.median(around, axis=2))


EXPLAINED = 0.2
"""Seconds within which a break explains a cut: it is measured by motion, which is slow."""


def unexplained(steps: Steps, breaks: Sequence[Break]) -> Int[np.ndarray, " K"]:
    """The frames behind the clear cuts of a video that none of the breaks of its clock explains."""
    known = np.array([moment for b in breaks for moment in (b.at, b.at - b.still)])
    found = steps.cuts()
    found = found[steps.jolts[found - 1] > CLEAR]
    far = [not len(known) or bool(np.abs(known - steps.times[k]).min() > EXPLAINED) for k in found]
    return found[np.array(far, bool)]


def calm(steps: Steps) -> bool:
    """Whether nothing that a video shows may be a cut."""
    return steps.sharpest()[1] < CALM
