"""A cost for tracks without depth, once their clocks are known: how far from each other's epipolar lines they stay."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import in_space
from ..clocks.splines import TrackSplines
from ..geometry import fundamental_of, seen_pixels
from ..types import Camera, Clock, TrackSet
from .positions import all_pairs


@dataclass(frozen=True)
class EpipolarDistance:
    """Sampson residuals of pixel tracks at equal times: of their motion (the mean removed) and of their place.

    ``½ [log(1 + V/s_m²) + log(1 + Q/s_p²)]``, V the residuals' variance within windows, Q their mean square; the terms
    of :class:`otsync.EpipolarScan`, which finds the clock. While no clock is known every pair costs 0: residuals at
    wrong times tell nothing. :meth:`at` gives the cost at a clock, by which a pair is matched once more.

    Args:
        weight: factor of this term. clock: of b against a; None: not known yet.
        motion_scale, position_scale: s in pixels at 640 of width. cap: largest value of the cost.
        window, min_overlap: seconds; that two tracks must share.
    """

    weight: float = 1.0
    clock: Clock | None = None
    motion_scale: float = 2.0
    position_scale: float = 6.0
    cap: float = 3.0
    window: float = 50 / 30
    min_overlap: float = 12 / 30

    def at(self, clock: Clock) -> EpipolarDistance:
        """The cost once ``t_a = rate * t_b + offset`` is known."""
        return replace(self, clock=clock)

    def matrix(self, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
        return all_pairs(self, a, b)

    def pairs(
        self, a: TrackSet, b: TrackSet, i: Int[np.ndarray, " P"], j: Int[np.ndarray, " P"]
    ) -> Float[np.ndarray, " P"]:
        if self.clock is None:
            return np.zeros(len(i))
        from .kernels import paired_epipolar_residuals

        for name, tracks in (("a", a), ("b", b)):
            if tracks.uv is None or tracks.camera is None:
                raise ValueError(
                    f"{name}: expected pixels (uv) and a camera for epipolar distances; one is missing. Use "
                    "SynchronousDistance for tracks in space."
                )
        assert a.camera is not None and b.camera is not None
        xa = seen_pixels(a)
        at_b = self.clock.own(a.times)
        xb = TrackSplines(b.times, in_space(seen_pixels(b))).sample(at_b)[..., :2]
        frame_b = np.round(np.interp(at_b, b.times, np.arange(len(b.times)))).astype(int)
        F = fundamental_of(a.camera.K, a.camera.w2c, b.camera.K, _at(b.camera, frame_b)).reshape(-1, 3, 3)
        fps = (len(a.times) - 1) / max(float(a.times[-1] - a.times[0]), 1e-9) if len(a.times) > 1 else 30.0
        motion, place = paired_epipolar_residuals(
            np.ascontiguousarray(xa),
            np.ascontiguousarray(xb),
            F,
            i,
            j,
            max(4, round(self.window * fps)),
            max(2, round(self.min_overlap * fps)),
        )
        unit = 0.5 * (a.camera.width + b.camera.width) / 640
        cost = 0.5 * (
            np.log1p(motion / (self.motion_scale * unit) ** 2) + np.log1p(place / (self.position_scale * unit) ** 2)
        )
        return np.where(np.isfinite(cost), np.minimum(cost, self.cap), self.cap)


def _at(camera: Camera, frames: Int[np.ndarray, " T"]) -> Float[np.ndarray, "*T 4 4"]:
    """Its poses in these frames, or the one of a camera that stands still."""
    return camera.w2c if camera.w2c.ndim == 2 else camera.w2c[frames]
