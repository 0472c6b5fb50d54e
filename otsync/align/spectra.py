"""Statistics of matched tracks at every lag by fast Fourier transforms: for recordings of minutes and hours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy import fft

from ..compute.threads import for_each
from .signal import Signal


def lag_statistics(
    a: Signal, b: Signal, lags: Int[np.ndarray, " K"], least: int
) -> tuple[Float[np.ndarray, "M K"], Float[np.ndarray, "M K"], Float[np.ndarray, "M K"]]:
    """What :func:`otsync.align.kernels.lag_statistics` fills, in T log T for all lags together; matches are spread over
    threads.
    """
    count, power, residual = (np.zeros((len(a.arrays[0]), len(lags))) for _ in range(3))
    length = fft.next_fast_len(a.arrays[0].shape[2] + b.arrays[0].shape[2], real=True)
    index = lags % length

    def at_lags(spectrum: np.ndarray) -> np.ndarray:
        return fft.irfft(spectrum, length)[..., index]

    def work(m: int) -> None:
        (x, wa, qa), (y, wb, qb) = ([fft.rfft(array[m], length) for array in side.arrays] for side in (a, b))
        wb, qb, y = np.conj(wb), np.conj(qb), np.conj(y)
        n = np.rint(at_lags(wa * wb))
        enough = n >= max(least, 1)
        c = np.where(enough, n, 1.0)
        own = apart = 0.0
        for d in range(3):
            mean_a, mean_b = at_lags(x[d] * wb), at_lags(wa * y[d])
            own = own + mean_a**2 + mean_b**2
            apart = apart + (mean_a - mean_b) ** 2
        both = at_lags(qa * wb + wa * qb)
        rest = both - 2 * at_lags((x * y).sum(0))
        count[m] = np.where(enough, n, 0.0)
        power[m] = np.where(enough, np.maximum((both - own / c) / c, 0.0), 0.0)
        residual[m] = np.where(enough, np.maximum((rest - apart / c) / c, 0.0), 0.0)

    for_each(work, [(m,) for m in range(len(count))])
    return count, power, residual
