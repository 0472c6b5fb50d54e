"""Claimed against found: sigma against the error that it stands for, over all trusted answers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...files.arrays import atomic_write
from ..record import Row

BINS = 8

LEAST = 1e-4
"""Frames; answers that are off by less are drawn there."""


def at_both_ends(rows: Sequence[Row]) -> tuple[np.ndarray, np.ndarray]:
    """(N,2) errors of answers at the beginning and at the end of what two videos share, and the sigmas that they say
    for these, frames. Each end is a claim of its own: the larger error of two is more often beyond one sigma.
    """
    error, sigma = (
        np.array([[r[a], r[b]] for r in rows], float).reshape(-1, 2)
        for a, b in (("begin", "end"), ("sigma_begin", "sigma_end"))
    )
    return error, sigma


def in_sigmas(rows: Sequence[Row]) -> np.ndarray:
    """(N,2) errors at both ends in units of the sigma that is said for each."""
    error, sigma = at_both_ends(rows)
    return error / sigma


def reliability(rows: Sequence[Row]) -> list[Row]:
    """Trusted answers with a true answer, in bins of as many by sigma: claimed and found rms, and coverage, of both
    ends.
    """
    ok = [r for r in rows if r["trusted"] and np.isfinite(r["error"]) and np.isfinite(r["sigma"])]
    if len(ok) < BINS:
        return []
    error, sigma = at_both_ends(ok)
    out: list[Row] = []
    for part in np.array_split(np.argsort([r["sigma"] for r in ok]), BINS):
        e, s = error[part], sigma[part]
        out.append(
            {
                "sigma from": float(s.min()),
                "to": float(s.max()),
                "answers": len(part),
                "claimed rms": float(np.sqrt((s**2).mean())),
                "found rms": float(np.sqrt((e**2).mean())),
                "within 1 sigma": float((e <= s).mean()),
                "within 2 sigmas": float((e <= 2 * s).mean()),
            }
        )
    return out


def draw(rows: Sequence[Row], path: Path) -> None:
    """Left: claimed against found. Right: share of trusted and of wrong answers by class."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    ours = [r for r in rows if r["method"] == "default"]
    names = list(dict.fromkeys(r["class"] for r in ours))[::-1]
    size = 11, max(6.5, 1.5 + 0.13 * len(names))  # a line for every name
    figure, (left, right) = plt.subplots(1, 2, figsize=size, layout="constrained", width_ratios=(1, 1.1))
    told = reliability(ours)
    if told:
        claimed, found = (np.array([r[k] for r in told]) for k in ("claimed rms", "found rms"))
        ok = [r for r in ours if r["trusted"] and np.isfinite(r["error"])]
        error, sigma = at_both_ends(ok)
        left.scatter(
            sigma.ravel(), np.maximum(error.ravel(), LEAST), s=6, color="#9db7c9", label="answers, at either end"
        )
        left.plot(claimed, found, "o-", color="#00527a", label="rms in eighths")
        ends = np.array([0.5 * min(claimed), 2 * max(claimed)])
        left.plot(ends, ends, color="#777", lw=0.8, ls="--", label="claimed = found")
        left.set(xscale="log", yscale="log", xlabel="sigma that is claimed, frames", ylabel="error, frames")
        left.set_ylim(bottom=0.8 * LEAST)
        left.legend(fontsize=8)
    trusted = [float(np.mean([r["trusted"] for r in ours if r["class"] == n])) for n in names]
    bad = [float(np.mean([r["trusted"] and not r["error"] <= 1 for r in ours if r["class"] == n])) for n in names]
    right.barh(names, trusted, color="#7fb58a", label="trusted")
    right.barh(names, bad, color="#b3261e", label="trusted and wrong by over a frame")
    right.set(xlim=(0, 1), ylim=(-0.8, len(names) - 0.2), xlabel="share of answers")
    right.tick_params(axis="y", labelsize=7)
    right.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    with atomic_write(path, "wb") as stream:
        figure.savefig(stream, format="png", dpi=130)
    plt.close(figure)
