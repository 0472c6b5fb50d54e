"""What errors that many tracks have in common do to an offset: tracks that slide on a turning body all slide alike.

A jackknife over neighbourhoods sees what differs between them and one over blocks of time what differs between seconds;
an error that all tracks of a body share throughout a short clip is invisible to both, since the fit has made the sum of
its effects zero. Its size is not: the residuals of different tracks are correlated. So their covariance is estimated by
how much two tracks have to do with each other, and then propagated to the offset.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..clocks.splines import TrackSplines
from ..types import Clock
from .samples import Pieces, detrended, sample_weights

FITTED = 1.8
"""Factor on the error found. Partners are chosen by how well they agree at the answer, and the fit has moved to where
they agree best, so that residuals show less of a common error than there is. Of 78 offsets of twenty recordings that
`recon simulate` films (two smooth bodies that turn and walk; seeds 76000 to 76019) 65 and 96 % lie within one and two
sigmas; with 2.5, 81 and 100 %. Real people need 1.0."""


OF_MOTION = 2.0
"""Factor on the error of residuals that are as large as those found, and change as the motion does. What a short clip
tells of how a common error changes is little: of 300 pairs of films (`recon simulate`, seeds 80100 to 80147, on which
it was chosen) 69 and 88 % lay within one and two sigmas without this, 77 and 96 % with it (73 and 94 % with 1.5). Of 48
offsets of fresh films (80148 to 80159) 85 and 96 % lie within. Tracks with errors of their own have next to none: sigma
of mid, hard and brutal worlds grows by 1 % at most in the median (with 1.5; seeds 600 to 611)."""


def common_error(
    a: TrackSplines,
    b: TrackSplines,
    clock: Clock,
    weight: Float[np.ndarray, " M"],
    group: Int[np.ndarray, " M"],
    window: float,
) -> float:
    """One sigma, in seconds, of what errors in common to several tracks move the offset by.

    Residuals r and velocities v of matches m at times t, both without their mean over ± ``window``, make the offset off
    by ``Σ w v·r / Σ w v·v``. With Cov(r_mt, r_nu) = C(t - u) times one of three functions, for two tracks of different
    neighbourhoods, two of one neighbourhood, and a track with itself, isotropic in space, the variance is a sum over
    lags of each function times the autocorrelation of the weighted velocities, summed over just such pairs. The third
    is left to the jackknife. Each function is estimated by the same sums over the residuals. A short clip tells its
    size better than how it falls with the lag; so what residuals of this size would do that change as the motion does,
    which is what makes tracks slide, is added. Read at the frames of both videos, so that exchanging them changes
    nothing.

    Args:
        a, b: curves of the matched tracks, m-th to m-th. weight: of the matches. group: neighbourhood of each match.
    """
    found = [
        _variance(own, other, there, weight, group, window)
        for own, other, there in ((a, b, clock.own), (b, a, clock.world))
    ]
    return math.sqrt(sum(found) / len(found))


def _variance(
    own: TrackSplines,
    other: TrackSplines,
    there: Callable[[np.ndarray], np.ndarray],
    weight: Float[np.ndarray, " M"],
    group: Int[np.ndarray, " M"],
    window: float,
) -> float:
    """s², with the factors, from the frames of ``own``."""
    parts = Pieces.of(own, window)
    sums = Sums.empty(2 * parts.near)
    for frames, middle in parts:
        times = own.times[frames]
        seen = own.support(times) & other.support(there(times))
        x = own.joined(times)
        y, v = other.joined(there(times)), other.velocity(there(times))
        r, v = (detrended(values, seen, parts.near)[:, middle] for values in (x - y, v))
        sums = sums + Sums.of(r, v, sample_weights(r, seen[:, middle], weight), group, 2 * parts.near)
    return (FITTED**2 * sums.variance() + OF_MOTION**2 * sums.variance_of_motion()) * parts.share


@dataclass(frozen=True, eq=False)
class Sums:
    """Autocorrelations by lag, over pairs of different neighbourhoods (row 0) and different tracks of one (row 1).

    Args:
        residuals: of the weighted residuals, a coordinate. count: of the weights. speeds: of the weighted velocities.
        information: Σ w v·v.
    """

    residuals: Float[np.ndarray, "2 L"]
    count: Float[np.ndarray, "2 L"]
    speeds: Float[np.ndarray, "2 L"]
    information: float

    @classmethod
    def of(
        cls,
        r: Float[np.ndarray, "M T D"],
        v: Float[np.ndarray, "M T D"],
        w: Float[np.ndarray, "M T"],
        group: Int[np.ndarray, " M"],
        lags: int,
    ) -> Sums:
        """Of residuals ``r``, by how much they grow a second of offset ``v``, and weights ``w``."""
        found, member = [], (np.arange(int(group.max(initial=0)) + 1)[:, None] == group).astype(float)
        w = w[..., None]
        for values in (w * r, w * v, w):
            by_group = np.tensordot(member, values, 1)
            whole, within, alone = (autocorrelation(x, lags) for x in (by_group.sum(0)[None], by_group, values))
            found.append(np.stack([whole - within, within - alone]))
        residuals, speeds, count = found
        return cls(residuals / r.shape[2], count, speeds, float((w * v**2).sum()))

    @classmethod
    def empty(cls, lags: int) -> Sums:
        return cls(np.zeros((2, lags)), np.zeros((2, lags)), np.zeros((2, lags)), 0.0)

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.residuals + other.residuals,
            self.count + other.count,
            self.speeds + other.speeds,
            self.information + other.information,
        )

    def variance(self) -> float:
        """s², as :func:`common_error` explains; 0 where nothing moves."""
        return self._moved_by(np.maximum((self._twice * self._covariance * self.speeds).sum(1), 0))

    def variance_of_motion(self) -> float:
        """s² where covariances have the size that is found, and fall with the lag as those of the velocities."""
        largest = np.maximum(np.abs(self.speeds).max(1), 1e-300)[:, None]
        size = np.maximum(self._covariance[:, 0], 0)
        return self._moved_by(size * (self._twice * self.speeds * (self.speeds / largest)).sum(1))

    def _moved_by(self, errors: Float[np.ndarray, " 2"]) -> float:
        return float(errors.sum()) / self.information**2 if self.information > 0 else 0.0

    @property
    def _covariance(self) -> Float[np.ndarray, "2 L"]:
        known = self.count > 1e-6 * max(float(self.count.max(initial=0)), 1e-300)
        return np.where(known, self.residuals / np.where(known, self.count, 1), 0)

    @property
    def _twice(self) -> Float[np.ndarray, " L"]:
        """How often a lag counts: once for each sign."""
        return np.where(np.arange(self.speeds.shape[1]) == 0, 1.0, 2.0)


def autocorrelation(x: Float[np.ndarray, "N T D"], lags: int) -> Float[np.ndarray, " L"]:
    """Σ over rows, coordinates and times of x(t) x(t + lag), lags from 0."""
    T = x.shape[1]
    spectrum = np.fft.rfft(x, 2 * T, axis=1)
    power = (spectrum.real**2 + spectrum.imag**2).sum((0, 2))
    found = np.fft.irfft(power, 2 * T)[: min(T, lags)]
    return np.pad(found, (0, lags - len(found)))
