"""Errors of an answer, given the truth: of matches, and of offsets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from .types import Matches

if TYPE_CHECKING:
    from .simulate import Truth


#: a match is right within this share of the scene's size, on the same object
TOLERANCE = 0.06


def match_quality(
    matches: Matches, truth: Truth, a: int = 0, b: int = 1, tolerance: float = TOLERANCE
) -> dict[str, float]:
    """Precision, recall, flips and P50 of the matches between videos a and b of a simulated world.

    A match is right when both tracks lie on the same object within ``tolerance`` of the scene's size, measured on the
    body at rest. It is flipped when it is not right, but would be on the other side of the body.

    Args:
        truth: of the simulated world.

    Returns:
        ``precision``: right matches / matches (nan when there are none).
        ``recall``: tracks of a with a right match / tracks of a for which b has a right partner.
        ``flips``: flipped matches / matches (nan when there are none).
        ``p50``: right ones among the N/2 of best score / (N/2), where N is the number of tracks of the smaller set, so
        that few sure matches cannot shine.
    """
    reach = tolerance * truth.size
    n_a, n_b = len(truth.surfaces[a]), len(truth.surfaces[b])
    matches.check("matches", n_a, n_b)
    distance, mirror = truth.match_errors(matches, a, b)
    right = distance <= reach
    flipped = ~right & (mirror <= reach)
    matchable = int(truth.matchable(a, b, reach).sum())
    assert matches.score is not None
    half = max(min(n_a, n_b) // 2, 1)
    best = np.argsort(-matches.score, kind="stable")[:half]
    return {
        "precision": float(right.mean()) if len(right) else float("nan"),
        "recall": len(np.unique(matches.pairs[right, 0])) / matchable if matchable else float("nan"),
        "flips": float(flipped.mean()) if len(right) else float("nan"),
        "p50": float(right[best].sum()) / half,
    }


@dataclass(frozen=True, eq=False)
class OffsetError:
    """Errors of offsets in frames of the reference, once the gauge is fixed.

    Args:
        errors: (V,) signed, nan where there is no estimate; a positive one says that the video is placed too late.
        mean, max: of their absolute values, over the videos that have an estimate; of the gauge "reference" without the
            reference itself, whose error is zero by definition. nan when there are none.
    """

    errors: Float[np.ndarray, " V"]
    mean: float
    max: float


def offset_error(
    seconds: Sequence[float] | Float[np.ndarray, " V"],
    truth: Sequence[float] | Float[np.ndarray, " V"],
    fps: float,
    gauge: Literal["reference", "median"] = "reference",
    reference: int = 0,
) -> OffsetError:
    """Errors of estimated offsets, one a video, in frames of the reference.

    Offsets are known up to a common shift only, so the gauge is fixed first.

    Args:
        seconds: estimated offsets; nan where there is none.
        truth: true offsets, seconds.
        fps: of the reference.
        gauge: "reference": the ``reference`` video is right by definition (all nan when it has no estimate).
            "median": the median error of all videos is zero; for methods that let every offset move.
    """
    est, true = np.asarray(seconds, float), np.asarray(truth, float)
    if est.ndim != 1 or est.shape != true.shape:
        raise ValueError(f"seconds, truth: expected one number a video each; found shapes {est.shape}, {true.shape}.")
    if not np.isfinite(true).all():
        raise ValueError("truth: expected finite seconds; found nan or infinity.")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps: expected frames per second > 0; found {fps}.")
    error = (est - true) * fps
    if gauge == "reference":
        if not 0 <= reference < len(error):
            raise ValueError(f"reference: expected the index of one of {len(error)} videos; found {reference}.")
        error = error - error[reference]
        counted = np.isfinite(error) & (np.arange(len(error)) != reference)
    elif gauge == "median":
        known = error[np.isfinite(error)]
        error = error - (np.median(known) if len(known) else np.nan)
        counted = np.isfinite(error)
    else:
        raise ValueError(f"gauge: expected 'reference' or 'median'; found {gauge!r}.")
    size = np.abs(error[counted])
    mean, largest = (float(size.mean()), float(size.max())) if len(size) else (float("nan"), float("nan"))
    return OffsetError(error, mean, largest)
