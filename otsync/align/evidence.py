"""The likelihood scan's score: what each whole-frame lag explains of the matched motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ..clocks.common import CommonClock
from ..compute.indices import blocks, evenly
from ..costs.linear import binary_scale, velocity
from .peaks import separate_peaks
from .signal import Signal, extent_of
from .spectra import lag_statistics

FAST, SLOW = 2 / 30, 5 / 30
"""Half windows, s, over which velocities are regressed: swift motion, and motion above the jitter of a tracker."""

BLOCK = 20 / 30
"""Half the length, s, of the windows in which positions are compared: drifts of depth are slower than that."""

MIN_FRAMES, MIN_WINDOW = 12 / 30, 10 / 30
"""Seconds that a match must be seen in both videos to say anything, altogether and within a window."""

APART = 4 / 30
"""Seconds between peaks that count as different hypotheses."""

DIRECT = 300_000_000
"""Matches times lags times common frames up to which sums are made one by one: about a second. Beyond, spectra tell
the velocities and whole positions, and windows are only looked at where they matter."""

CONTENDERS, BACKGROUND = 32, 64
"""Peaks of the velocities at which the windows of long clips are looked at, and lags spread evenly over all whose
median, by common frames, is what they have elsewhere."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Scores over K lags, nats a match (-inf where too little is in common), and what else they were made with.

    Args:
        total: what is maximised. slow: of ±5-frame velocities. windows: of windowed positions.
        observed: matches seen long enough at each lag. samples: common ones of a match there, on average by weight.
        motion: at each lag, the rms motion that both videos share, relative to the rms extent of the scene.
        floor: e² of the positions.
    """

    total: Float[np.ndarray, " K"]
    slow: Float[np.ndarray, " K"]
    windows: Float[np.ndarray, " K"]
    observed: Float[np.ndarray, " K"]
    samples: Float[np.ndarray, " K"]
    motion: Float[np.ndarray, " K"]
    floor: float = 0.0


def evidence(pair: CommonClock, lags: Int[np.ndarray, " K"], weight: Float[np.ndarray, " M"] | None = None) -> Curves:
    """The scan's score and its parts at ``lags``; ``weight``: of the matches, with mean 1."""
    weight = np.ones(len(pair.a)) if weight is None else weight

    def frames(seconds: float) -> int:
        return max(1, round(seconds * pair.fps))

    least = frames(MIN_FRAMES)
    count, power, residual = statistics_by_part(pair, lags, least)
    floor, extent = noise_floor(count, power, residual), 0.5 * (extent_of(pair.a) + extent_of(pair.b))
    observed = (count > 0).sum(0).astype(float)
    power -= residual
    power *= count
    samples = weight @ count / len(count)
    shared = 0.5 * power.sum(0) / np.maximum(count.sum(0), 1)
    del count, power, residual  # of long clips, hundreds of megabytes
    fast, slow = (velocity_score(pair, lags, frames(half), least, weight) for half in (FAST, SLOW))
    windows = np.where(observed > 0, window_score(pair, lags, fast + slow, floor, weight), -np.inf)
    return Curves(
        total=fast + slow + windows,
        slow=slow,
        windows=windows,
        observed=observed,
        samples=samples,
        motion=np.sqrt(np.maximum(shared, 0)) / extent if extent > 0 else np.zeros(len(lags)),
        floor=floor,
    )


def window_score(
    pair: CommonClock,
    lags: Int[np.ndarray, " K"],
    motion: Float[np.ndarray, " K"],
    floor: float,
    weight: Float[np.ndarray, " M"],
) -> Float[np.ndarray, " K"]:
    """Mean LLR of the positions in windows; of long clips that at the peaks of ``motion``, the score of velocities, and
    beside them what lags by chance have.
    """
    from . import kernels

    def frames(seconds: float) -> int:
        return max(1, round(seconds * pair.fps))

    def at(some: Int[np.ndarray, " L"]) -> Float[np.ndarray, " L"]:
        total, begin = np.zeros((1, len(some))), np.maximum(some, 0)  # treats a and b alike
        block, few = frames(BLOCK), frames(MIN_WINDOW)
        for part in blocks(len(pair.a), max(pair.a.shape[1], pair.b.shape[1])):  # of long clips few matches at a time
            a, b = Signal.of(pair.a[part]), Signal.of(pair.b[part])
            arrays = *a.for_kernels, *b.for_kernels, some, begin, block, few, floor, weight[part], total
            kernels.windowed_evidence(*arrays)
        return total[0] / len(pair.a)

    if direct(pair.a.shape[:2], pair.b.shape[1], lags):
        return at(lags)
    some, common = evenly(len(lags), BACKGROUND), pair.overlap(lags)
    score = common * float(np.median(at(lags[some]) / common[some]))
    tops = separate_peaks(motion, frames(APART), CONTENDERS)
    if not tops:  # no match is seen in both videos at any lag
        return score
    near = np.add.outer(tops, np.arange(-frames(APART), frames(APART) + 1)).ravel()
    some = np.unique(np.clip(near, 0, len(lags) - 1))
    score[some] = at(lags[some])
    return score


def velocity_score(
    pair: CommonClock,
    lags: Int[np.ndarray, " K"],
    half: int,
    least: int,
    weight: Float[np.ndarray, " M"] | None = None,
) -> Float[np.ndarray, " K"]:
    """Mean LLR of the velocities over ±``half`` frames, the matches counted by ``weight`` (mean 1)."""
    count, power, residual = statistics_by_part(pair, lags, least, half)
    floor = noise_floor(count, power, residual)
    # in place: of long clips these are the largest arrays
    power += floor
    residual += floor
    gain = np.divide(power, residual, out=power)
    np.log(gain, out=gain)
    gain *= count
    if weight is not None:
        gain *= weight[:, None]
    score = 0.5 * gain.sum(0) / len(pair.a)
    return np.where((count > 0).any(0), score, -np.inf)


def statistics_by_part(
    pair: CommonClock, lags: Int[np.ndarray, " K"], least: int, half: int | None = None
) -> tuple[Float[np.ndarray, "M K"], Float[np.ndarray, "M K"], Float[np.ndarray, "M K"]]:
    """:func:`statistics` of the positions, or of the velocities over ±``half`` frames; of long clips few matches at a
    time are brought into the form that it reads.
    """
    count, power, residual = (np.zeros((len(pair.a), len(lags))) for _ in range(3))
    for some in blocks(len(pair.a), max(pair.a.shape[1], pair.b.shape[1])):
        a, b = (Signal.of(x[some] if half is None else velocity(x[some], half)) for x in (pair.a, pair.b))
        count[some], power[some], residual[some] = statistics(a, b, lags, least)
    return count, power, residual


def statistics(
    a: Signal, b: Signal, lags: Int[np.ndarray, " K"], least: int
) -> tuple[Float[np.ndarray, "M K"], Float[np.ndarray, "M K"], Float[np.ndarray, "M K"]]:
    """Frames in common, Var a + Var b and Var(a - b) of every match at every lag."""
    from . import kernels

    if not direct(a.arrays[1].shape, b.arrays[1].shape[1], lags):
        return lag_statistics(a, b, lags, least)
    out = tuple(np.zeros((len(a.arrays[0]), len(lags))) for _ in range(3))
    kernels.lag_statistics(*a.for_kernels, *b.for_kernels, lags, least, *out)
    return out  # type: ignore[return-value]


def direct(a: tuple[int, ...], Tb: int, lags: Int[np.ndarray, " K"]) -> bool:
    """Whether sums over the common frames of every match and lag are made one by one: see :data:`DIRECT`.

    Args:
        a: matches, and frames of the first video. Tb: frames of the second.
    """
    M, Ta = a
    common = np.minimum(Ta, Tb + lags) - np.maximum(0, lags)
    return M * float(np.maximum(common, 0).sum()) <= DIRECT


def noise_floor(count: np.ndarray, power: np.ndarray, residual: np.ndarray) -> float:
    """e²: a quarter of the typical match's least residual variance; above rounding of the signal's own variance."""
    known = (count > 0).any(1)
    if not known.any():
        return 1.0
    least = np.where(count > 0, residual, np.inf).min(1)[known]
    largest = power.max(1)[known]
    floor = max(0.25 * float(np.median(least)), 1e-12 * float(np.median(largest)), 1e-24 * float(largest.max()))
    return floor or 1.0


def normalised(pair: CommonClock) -> tuple[CommonClock, float]:
    """The same in units of a power of two near its size, and that unit: squares neither overflow nor vanish."""
    scale = max(binary_scale(pair.a), binary_scale(pair.b))
    return replace(pair, a=pair.a / scale, b=pair.b / scale), scale
