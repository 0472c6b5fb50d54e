"""Compiled loops of curves."""

from __future__ import annotations

from ..compute.jit import kernel


@kernel(fastmath={"contract"})
def add_curves(by_track, first, weights, out):
    """out[m,s] += Σ_k weights[s,k] by_track[m,first[s]+k]: every track's curve at every moment.

    by_track (M,n,3); first (S,); weights (S,4); out (M,S,3).
    """
    for m in range(out.shape[0]):
        for s in range(out.shape[1]):
            k = first[s]
            for d in range(3):
                out[m, s, d] += (
                    weights[s, 0] * by_track[m, k, d]
                    + weights[s, 1] * by_track[m, k + 1, d]
                    + weights[s, 2] * by_track[m, k + 2, d]
                    + weights[s, 3] * by_track[m, k + 3, d]
                )
