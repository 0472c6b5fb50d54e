"""What the clocks that a fit began with and its pictures say together: two witnesses of each offset.

They are not independent. A short fit still has a share of its start's error, which no averaging of the two can remove.
Where clocks were bent before the fit (:mod:`recon.footage.bends`) that share is measured, and so are the fit's own
errors: both by what is left of bends that are known (:func:`told_by_bends`). Where none were, the share is what fits of
such a length usually keep (:func:`share_kept`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

CONTRADICTION = 3.0  # sigmas between two answers, from which one of them is wrong
IMAGES = 90  # of a video, after which a fit keeps 1/e of the error that its start had: filmed rigs, docs/trust.md
EPOCHS = 1.0  # times that it has then seen every frame; the motion, which carries the start's clocks, is local in time
CHANCE = 2.0  # sigmas between two answers, up to which chance explains it
VOTED = 0.7  # of the votes' sigma, that is the error of fits beside the share kept: films, docs/trust.md
VIDEOS = 4  # whose bends the votes' own sigma, or whose gaps the start's, weighs as much as


@dataclass(frozen=True)
class Told:
    """What bends tell of a fit.

    Args:
        share: 0..1 of the start's error that the fit still has. share_sigma: one standard deviation of that.
        scale: what the sigma of the votes is to be multiplied by.
    """

    share: float
    share_sigma: float
    scale: float

    @property
    def kept(self) -> float:
        """The share that the start's error is expected to be left with, rms."""
        return min(1.0, math.hypot(self.share, self.share_sigma))


def told_by_bends(bends: np.ndarray, left: np.ndarray, sigma: np.ndarray) -> Told | None:
    """What a fit kept of known errors, and how far it erred beside that.

    ``left`` is regressed on ``bends``: the slope is the share that was kept. What differs from the line are errors of
    the fit, as those of its offsets are, and are held against the votes' sigma; so that few videos do not tell too
    much, :data:`VOTED` of that itself counts as :data:`VIDEOS` of them. What all videos share is taken out: a scene can
    bend with them.

    Args:
        bends: [V] seconds by which each clock was bent. left: [V] seconds of that after the fit. sigma: [V] one
            standard deviation of each clock by the votes, seconds; nan where nothing moves, which tells nothing.

    Returns None where fewer than two videos tell.
    """
    shown = np.isfinite(sigma) & (sigma > 0)
    if shown.sum() < 2:
        return None
    known, after, variance = bends[shown], left[shown], np.square(sigma[shown])
    known, after = known - known.mean(), after - after.mean()
    if not known.any():
        return None
    share = float((known * after).sum() / np.square(known).sum())
    rest = float((np.square(after - share * known) / variance).sum())
    scale = math.sqrt((VIDEOS * VOTED**2 + rest) / (VIDEOS + max(0, len(known) - 2)))
    error = scale * math.sqrt(float(variance.mean() / np.square(known).sum()))
    return Told(min(max(share, 0.0), 1.0), error, scale)


def share_kept(*, images: float, epochs: float) -> float:
    """Share of its start's error that a fit still has, because it has seen too few pictures.

    The scene that a fit begins with was made with the start's clocks, of each video's own tracks and depth: so each
    video agrees with itself, however wrong its clock. Pictures undo that in time.

    Args:
        images: of a video that the fit has seen. epochs: times that it has seen every frame.
    """
    return math.exp(-min(images / IMAGES, epochs / EPOCHS))


def unseen(start_sigma: np.ndarray, moved: np.ndarray, reference: int, kept: float) -> np.ndarray:
    """[V] seconds of the start's error that a fit may still have.

    Of starts without a sigma it tells by how far the fit has gone from all of them, rms: what is kept is to that as the
    shares are.

    Args:
        start_sigma: one standard deviation of the clocks that it began with, seconds; nan or 0: no witness.
        moved: seconds from the start to the fit's answer. kept: see :func:`share_kept`.
    """
    known = np.isfinite(start_sigma) & (start_sigma > 0)
    others = ~known
    others[reference] = False
    gone = math.sqrt(float(np.square(moved[others]).mean())) if others.any() else 0.0
    left = kept * np.where(known, start_sigma, gone / max(1.0 - kept, 1e-9))
    left[reference] = 0.0
    return left


def relative_sigma(sigma: np.ndarray, reference: int) -> np.ndarray:
    """[V] sigma of offsets against the reference of a fit, which need not be the one that they were measured against.

    Where it is not, the reference's own error counts; errors are taken as independent.
    """
    relative = np.hypot(sigma, sigma[reference])
    relative[reference] = 0.0
    return relative


def scaled_start(
    start_sigma: np.ndarray, gap: np.ndarray, fitted_sigma: np.ndarray, reference: int, kept: float
) -> np.ndarray:
    """[V] sigma of the starts, larger or smaller by one factor, as how far all of them are from the fit's answers asks.

    The share that is kept must have been measured: a fit that stands still is no sign of a good start. A gap counts by
    as much as it is the start's rather than the fit's own error, and as two sigmas at the most; that itself counts as
    :data:`VIDEOS` gaps.

    Args:
        start_sigma: one standard deviation, seconds; nan or 0: no witness. gap: seconds from start to fit.
        fitted_sigma, kept: as of :func:`reconciled`.
    """
    known = np.isfinite(start_sigma) & (start_sigma > 0) & np.isfinite(fitted_sigma)
    known[reference] = False
    before, after = ((1.0 - kept) * start_sigma[known]) ** 2, fitted_sigma[known] ** 2
    share = before / np.maximum(before + after, 1e-30)
    found = np.minimum(np.square(gap[known]) / np.maximum(before + after, 1e-30), CHANCE**2)
    return start_sigma * math.sqrt((VIDEOS + float((share * found).sum())) / (VIDEOS + float(share.sum())))


def reconciled(
    start: np.ndarray,
    start_sigma: np.ndarray,
    fitted: np.ndarray,
    fitted_sigma: np.ndarray,
    reference: int,
    kept: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two witnesses of each offset, tracks and pictures: (offset, sigma, whether they contradict each other), [V] each.

    The start errs by s, the fit by ``kept`` s + e. The answer is that between the two of least variance (Gauss-Markov),
    so its sigma is ``kept`` times the start's at the least. Sigma grows by their discord (Birge's ratio) where it is
    more than chance explains. Beyond CONTRADICTION sigmas one of them is wrong, nobody can say which, and sigma covers
    both. A start without a sigma, or with none (0: it was declared, not measured), is no witness: the fit's answer
    stands.

    Args:
        start, fitted: seconds relative to the reference's, whose entries are returned as they are.
        start_sigma: one standard deviation of s, seconds. fitted_sigma: of e. kept: see :func:`share_kept`.
    """
    known = np.isfinite(start_sigma) & (start_sigma > 0) & np.isfinite(fitted_sigma)
    known[reference] = False
    before = np.where(known, start_sigma, 1.0) ** 2
    after = np.where(known, fitted_sigma, 1.0) ** 2
    gap, undone = fitted - start, 1.0 - kept
    expected = undone**2 * before + after
    discord = np.square(gap) / expected
    contradicted = known & (discord > CONTRADICTION**2)
    weight = np.minimum(undone * before / expected, 1.0)  # never past the fit's answer: the share is known too roughly
    variance = (1.0 - weight * undone) ** 2 * before + weight**2 * after
    variance *= np.maximum(1.0, discord / CHANCE**2)
    variance = np.where(contradicted, variance + np.square(gap), variance)
    offset = np.where(known, start + gap * weight, fitted)
    return offset, np.where(known, np.sqrt(variance), fitted_sigma), contradicted


def repeated(
    start: np.ndarray, start_sigma: np.ndarray, fitted: np.ndarray, fitted_sigma: np.ndarray, reference: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """:func:`reconciled` where the start is an earlier fit's: the same pictures are no second witness.

    The fit's answer stands, with the larger one of both sigmas.
    """
    _, _, contradicted = reconciled(start, start_sigma, fitted, fitted_sigma, reference)
    sigma = np.fmax(start_sigma, fitted_sigma)
    sigma[reference] = fitted_sigma[reference]
    return fitted, np.where(contradicted, np.hypot(sigma, fitted - start), sigma), contradicted
