"""Colours of cameras, told from points of the background that several of them show: gains, and the lens's falloff."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

from otsync.compute.indices import evenly
from recon.backdrop.stills import Still
from recon.backdrop.surroundings import Lookup
from recon.observe.effects import ImageCircle
from recon.observe.vignetting import NO_FALLOFF, STRONGEST, Falloff

POINTS, ROUNDS, AGAIN = 4000, 20, 6
"""Surface points that are compared at most; rounds of medians in which gains settle, and in which they do again where
little has changed."""

LEAST_FALLOFF, CHANCE = 0.02, 0.0027
"""Vignetting is modelled where corners lose this share of their light at least, and where none would seem as sure with
this chance at most: three sigmas, if there were many videos (of three videos 19, of fourteen 3.6)."""

LEAST_VIDEOS = 3
"""Videos from which a falloff is told: with fewer none can be left out to see how much it depends on each."""

LEAST_REACH = 0.7
"""Distance from the principal point, in half diagonals, up to which points must be seen: beyond it is guessed."""

OUTLYING = 3.0
"""Colours further from the falloff than this many robust deviations are of points that are hidden or misplaced."""

ALIKE = 0.4
"""A falloff is told by points whose colours differ between pictures by less than this share of how much colours differ
overall: .1 to .26 of points on the true floor and shell (the Panoptic dome, simulated rooms), .6 to 1 on a wrong one,
where the middles of images are compared with other images' margins, whatever they show."""


@dataclass(frozen=True, eq=False)
class Compared:
    """The same surface points as S pictures show them; each is shown by two and more.

    Args:
        colors: [S,N,3] log RGB, nan where a picture does not show a point. radii: [S,N] squared distances from the
            principal point, in half diagonals. video: [S] index of each picture's video.
    """

    colors: Float[np.ndarray, "S N 3"]
    radii: Float[np.ndarray, "S N"]
    video: np.ndarray

    @classmethod
    def of(cls, stills: Sequence[Still], points: Float[np.ndarray, "N 3"]) -> Compared:
        points = points[evenly(len(points), POINTS)]
        colors, radii = [], []
        for still in stills:
            lookup, circle = Lookup.of(still), ImageCircle.of(still.K, still.size)
            seen, inside = lookup.look(points)
            colors.append(np.where(inside[:, None], seen, np.nan))
            u, v, _ = lookup.project(points)
            radii.append(circle.squared(u, v))
        return cls(np.stack(colors), np.stack(radii), np.array([s.video for s in stills])).shared()

    def shared(self) -> Compared:
        """The same without points that fewer than two pictures show: they are their own mean, and tell nothing."""
        twice = np.isfinite(self.colors[..., 0]).sum(0) >= 2
        return Compared(self.colors[:, twice], self.radii[:, twice], self.video)

    def without(self, falloff: Falloff) -> Compared:
        """The same with the falloff taken out of the colours."""
        log_v = falloff.second * self.radii + falloff.fourth * self.radii**2
        return Compared(self.colors - log_v[..., None], self.radii, self.video)

    def leaving_out(self, video: int) -> Compared:
        """The same without the pictures of one video."""
        keep = self.video != video
        return Compared(self.colors[keep], self.radii[keep], self.video[keep]).shared()

    @property
    def reach(self) -> float:
        """How far from the principal point colours are seen, but for a twentieth of them, in half diagonals; nan where
        there are none."""
        seen = self.radii[np.isfinite(self.colors[..., 0])]
        return float(np.sqrt(np.percentile(seen, 95))) if len(seen) else float("nan")


def first_colours(
    stills: Sequence[Still], points: Float[np.ndarray, "N 3"], videos: int, falloff: Falloff | None = None
) -> tuple[Float[np.ndarray, "V 3"], Falloff]:
    """Gains of the videos, of geometric mean 1, and the falloff that they share, from points that several show.

    Args:
        falloff: where it is known; None: told here, zeros where it is too small to matter or too unsure to be believed.
    """
    compared = Compared.of(stills, points)
    known = first_falloff(compared, videos) if falloff is None else falloff
    return first_gains(compared.without(known), videos), known


def first_gains(compared: Compared, videos: int) -> Float[np.ndarray, "V 3"]:
    """Gains of the videos, of geometric mean 1; 1 for videos that have no picture.

    Occlusion and misplaced points change colours too, but not all in one direction: medians are taken.
    """
    shift = _settled(compared, np.zeros((videos, 3)), ROUNDS, even=True)[0]
    taking_part = np.isin(np.arange(videos), compared.video)
    return np.where(taking_part[:, None], np.exp(shift - shift[taking_part].mean(0)), 1.0)


def first_falloff(compared: Compared, videos: int) -> Falloff:
    """The falloff (its part of r^2) by which points look alike wherever in an image they are seen; zeros where none is
    sure.

    Lenses darken: what brightens towards the corners is the scene's light. The darkening must be the same, but for a
    fraction of itself, whichever video is left out (jackknife over videos: pictures of one video are no witnesses of
    their own, as a lamp shines in all of them alike), and of the same points (see :data:`ALIKE`).
    """
    taking_part = np.unique(compared.video)
    if len(taking_part) < LEAST_VIDEOS or not compared.reach >= LEAST_REACH:
        return NO_FALLOFF
    shift, second = _settled(compared, np.zeros((videos, 3)), ROUNDS)
    found = Falloff(second, 0.0)
    if not (-STRONGEST <= second < 0 and 1 - found.corner >= LEAST_FALLOFF):
        return NO_FALLOFF
    if not _unlike(compared.without(found), shift) < ALIKE:
        return NO_FALLOFF
    parts = [compared.leaving_out(int(v)) for v in taking_part]
    if not all(part.reach >= LEAST_REACH for part in parts):  # what hangs on one video has no second witness
        return NO_FALLOFF
    others = np.array([_settled(part, shift, AGAIN, second)[1] for part in parts])
    n = len(others)
    sigma = np.sqrt((n - 1) / n * ((others - others.mean()) ** 2).sum())
    return found if -second > float(student.isf(CHANCE / 2, n - 1)) * sigma else NO_FALLOFF


def _settled(
    compared: Compared, shift: Float[np.ndarray, "V 3"], rounds: int, second: float = 0.0, even: bool = False
) -> tuple[Float[np.ndarray, "V 3"], float]:
    """Log gains of the videos, up to one that all share, and the falloff's part of r^2, in turns.

    Args:
        shift, second: to begin with. even: there is no falloff.
    """
    shift = shift.copy()
    if not compared.colors.shape[1]:
        return shift, second
    seen = np.isfinite(compared.colors[..., 0])
    power = _apart(np.where(seen, compared.radii, np.nan))
    mine = [(v, compared.video == v) for v in np.unique(compared.video)]
    colors = _apart(compared.colors)
    for _ in range(rounds):
        apart = (
            colors
            - second * power[..., None]
            - _apart(np.where(seen[..., None], shift[compared.video][:, None], np.nan))
        )
        for v, own in mine:
            left = apart[own][seen[own]]
            shift[v] += np.median(left, 0) if len(left) else 0.0
        if not even:
            apart = colors - _apart(np.where(seen[..., None], shift[compared.video][:, None], np.nan))
            second = _slope(power[seen], apart[seen].mean(-1), second)
    return shift, second


def _slope(x: np.ndarray, y: np.ndarray, before: float) -> float:
    """The factor from x to y by least squares, without the values that are far from the line ``before``."""
    left = np.abs(y - before * x)
    good = left <= OUTLYING * 1.4826 * np.median(left)
    square = float((x[good] ** 2).sum())
    return float((x[good] * y[good]).sum()) / square if square > 0 else before


def _unlike(compared: Compared, shift: Float[np.ndarray, "V 3"]) -> float:
    """How much the same points differ in colour between pictures, as a share of how much colours differ overall."""
    colors = compared.colors - shift[compared.video][:, None]
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
