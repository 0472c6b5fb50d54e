"""Colours of cameras, told from points of the background that several of them show: gains, and the lens's falloff."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from recon.backdrop.stills import Still
from recon.backdrop.surroundings import Lookup
from recon.observe.effects import Lens
from recon.observe.vignetting import NO_FALLOFF, STRONGEST, Falloff

POINTS, ROUNDS = 4000, 20
"""Surface points that are compared at most, and rounds of medians in which gains settle."""

LEAST_FALLOFF, SURE = 0.02, 3.0
"""Vignetting is modelled where corners differ from the middle by this share at least, and by this many sigmas."""

OUTLYING = 3.0
"""Colours further from the falloff than this many robust deviations are of points that are hidden or misplaced."""

ALIKE = 0.4
"""A falloff is told by points whose colours differ between pictures by less than this share of how much colours differ
overall: .1 to .26 of points on the true floor and shell (the Panoptic dome, simulated rooms), .6 to 1 on a wrong one,
where the middles of images are compared with other images' margins, whatever they show."""

LEAST_STILLS = 3
"""Pictures from which a falloff is told: with fewer none can be left out to see how much it depends on each."""


@dataclass(frozen=True, eq=False)
class Compared:
    """The same surface points as S pictures show them.

    Args:
        colors: [S,N,3] log RGB, nan where a picture does not show a point, or no other does. radii: [S,N] squared
            distances from the principal point, in half diagonals. video: [S] index of each picture's video.
    """

    colors: Float[np.ndarray, "S N 3"]
    radii: Float[np.ndarray, "S N"]
    video: np.ndarray

    @classmethod
    def of(cls, stills: Sequence[Still], points: Float[np.ndarray, "N 3"]) -> Compared:
        points = points[:: max(1, len(points) // POINTS)]
        colors, radii = [], []
        for still in stills:
            lookup, lens = Lookup.of(still), Lens.of(still.K, still.size)
            seen, inside = lookup.look(points)
            colors.append(np.where(inside[:, None], seen, np.nan))
            u, v, _ = lookup.project(points)
            radii.append(((u - lens.x) ** 2 + (v - lens.y) ** 2) / lens.reach**2)
        together = np.stack(colors)
        twice = np.isfinite(together[..., 0]).sum(0) >= 2
        return cls(together[:, twice], np.stack(radii)[:, twice], np.array([s.video for s in stills]))

    def without(self, falloff: Falloff) -> Compared:
        """The same with the falloff taken out of the colours."""
        log_v = falloff.second * self.radii + falloff.fourth * self.radii**2
        return Compared(self.colors - log_v[..., None], self.radii, self.video)

    def leaving_out(self, still: int) -> Compared:
        """The same without one picture."""
        keep = np.arange(len(self.video)) != still
        return Compared(self.colors[keep], self.radii[keep], self.video[keep])


def first_colours(
    stills: Sequence[Still], points: Float[np.ndarray, "N 3"], videos: int
) -> tuple[Float[np.ndarray, "V 3"], Falloff]:
    """Gains of the videos, of geometric mean 1, and the falloff that they share, from points that several show.

    The falloff is (0, 0) where it is too small to matter or too unsure to be believed.
    """
    compared = Compared.of(stills, points)
    falloff = first_falloff(compared, videos)
    return first_gains(compared.without(falloff), videos), falloff


def first_gains(compared: Compared, videos: int) -> Float[np.ndarray, "V 3"]:
    """Gains of the videos, of geometric mean 1; 1 for videos that have no picture.

    Occlusion and misplaced points change colours too, but not all in one direction: medians are taken.
    """
    shift = _shifts(compared, videos)
    taking_part = np.isin(np.arange(videos), compared.video)
    return np.where(taking_part[:, None], np.exp(shift - shift[taking_part].mean(0)), 1.0)


def first_falloff(compared: Compared, videos: int) -> Falloff:
    """The falloff that makes points look alike wherever in an image they are seen; (0, 0) where none is sure.

    It is sure when it is the same, but for a fraction of itself, whichever picture is left out (jackknife): that a room
    is bright where all cameras look, or that points are misplaced, is not the same to all of them.
    """
    n = len(compared.video)
    if n < LEAST_STILLS or not compared.colors.shape[1]:
        return NO_FALLOFF
    found = _fitted(compared, videos)
    others = np.array([sum(_fitted(compared.leaving_out(s), videos)) for s in range(n)])
    sigma = np.sqrt((n - 1) / n * ((others - others.mean()) ** 2).sum())
    size = abs(np.expm1(sum(found)))
    sound = all(abs(x) <= STRONGEST for x in found) and _unlike(compared.without(found), videos) < ALIKE
    return found if sound and size >= LEAST_FALLOFF and abs(sum(found)) > SURE * sigma else NO_FALLOFF


def _shifts(compared: Compared, videos: int) -> Float[np.ndarray, "V 3"]:
    """Log gains of the videos, up to one that all share."""
    shift = np.zeros((videos, 3))
    if not compared.colors.shape[1]:
        return shift
    for _ in range(ROUNDS):
        apart = _apart(compared.colors - shift[compared.video][:, None])
        for v in np.unique(compared.video):
            own = apart[compared.video == v].reshape(-1, 3)
            own = own[np.isfinite(own[:, 0])]
            shift[v] += np.median(own, 0) if len(own) else 0.0
    return shift


def _fitted(compared: Compared, videos: int) -> Falloff:
    """Least squares over the colours' departures from their points' means without outliers; gains in turns with it."""
    falloff = NO_FALLOFF
    seen = np.isfinite(compared.colors[..., 0])
    powers = np.stack([compared.radii, compared.radii**2], -1)
    powers = _apart(np.where(seen[..., None], powers, np.nan))[seen]
    for _ in range(3):
        shift = _shifts(compared.without(falloff), videos)
        apart = _apart((compared.colors - shift[compared.video][:, None]).mean(-1, keepdims=True))[seen][:, 0]
        good = np.ones(len(apart), bool)
        for _ in range(4):
            if good.sum() < 2:
                return NO_FALLOFF
            solved = np.linalg.lstsq(powers[good], apart[good], rcond=None)[0]
            left = np.abs(apart - powers @ solved)
            good = left <= OUTLYING * 1.4826 * np.median(left)
        falloff = Falloff(float(solved[0]), float(solved[1]))
    return falloff


def _unlike(compared: Compared, videos: int) -> float:
    """How much the same points differ in colour between pictures, as a share of how much colours differ overall."""
    colors = compared.colors - _shifts(compared, videos)[compared.video][:, None]
    count = np.isfinite(colors[..., 0]).sum(0)
    # n samples lie nearer to their own mean than to the truth
    within = np.nansum(np.abs(_apart(colors)) * np.sqrt(count / (count - 1))[None, :, None])
    overall = np.nansum(np.abs(colors - np.nanmedian(colors, (0, 1))))
    return float(within / max(overall, 1e-12))


def _apart(values: np.ndarray) -> np.ndarray:
    """Departures [S,N,...] from the mean over the pictures that show a point."""
    seen = np.isfinite(values)
    mean = np.where(seen, values, 0).sum(0) / np.maximum(seen.sum(0), 1)
    return values - mean
