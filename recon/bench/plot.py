"""The plot of ``recon bench``: what accuracy costs in time, one line a configuration, one point a length of the fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from otsync.bench.record import machine
from otsync.files.arrays import atomic_write

PANELS = (
    ("mean", "mean error of the offsets, frames"),
    ("psnr", "held-out PSNR, dB"),
    ("mask_psnr", "held-out PSNR where things move, dB"),
)


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Offset error and held-out PSNR against the time of the fit; the mean over seeds, of the smallest errors put in.

    Time is CPU seconds, which another process hardly changes; of fits on a GPU, where the CPU waits, it is wall
    seconds. Rows whose offsets are true or held have no error of the fit's, and stand in the panels of PSNR alone.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import color_sequences
    from matplotlib import pyplot as plt
    from matplotlib.ticker import LogLocator

    amplitude = min(r["amplitude"] for r in rows)
    rows = [r for r in rows if r["amplitude"] == amplitude]
    cost, xlabel = "cpu_seconds", "CPU seconds of the fit"
    if any("gpu_gb" in r for r in rows):
        cost, xlabel = "seconds", "wall seconds of the fit, on a GPU"
    names = list(dict.fromkeys(r["configuration"] for r in rows))
    colors = dict(zip(names, color_sequences["tab10"], strict=False))
    with plt.rc_context({"svg.hashsalt": "otsync", "svg.fonttype": "none", "font.size": 9}):
        figure, all_axes = plt.subplots(1, len(PANELS), figsize=(12, 4), layout="constrained")
        for axes, (key, label) in zip(all_axes, PANELS, strict=True):
            for name in names:
                points = curve([r for r in rows if r["configuration"] == name], key, cost)
                if key == "mean" and all(held(r) for r in rows if r["configuration"] == name):
                    continue
                axes.plot(points[:, 0], points[:, 1], ".-", color=colors.get(name, "0.5"), label=name)
            axes.set(xscale="log", xlabel=xlabel, ylabel=label)
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter("")
            axes.grid(alpha=0.25)
        all_axes[0].set_yscale("log")
        all_axes[0].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        all_axes[0].yaxis.set_major_formatter("{x:g}")
        all_axes[0].yaxis.set_minor_formatter("")
        handles, labels = all_axes[1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(names), fontsize=8)
        about = machine()
        figure.suptitle(
            f"errors of up to {amplitude:g} frames put in; {about['processor']}, {about['cores']} cores",
            fontsize=8,
            color="0.4",
        )
        with atomic_write(path, "wb") as stream:
            figure.savefig(stream, format="svg", metadata={"Date": None})
        plt.close(figure)


def held(row: dict[str, Any]) -> bool:
    """Whether the fit left the offsets where they began."""
    return bool(row["mean"] == row["start"])


def curve(rows: Sequence[dict[str, Any]], key: str, cost: str = "cpu_seconds") -> np.ndarray:
    """(lengths, 2): mean cost and mean figure of every length, by length; lengths without the figure left out."""
    points = []
    for steps in sorted({r["steps"] for r in rows}):
        alike = [r for r in rows if r["steps"] == steps]
        values = [float(r[key]) for r in alike if r.get(key) is not None]
        if values:
            points.append((math.fsum(r[cost] for r in alike) / len(alike), math.fsum(values) / len(values)))
    return np.array(points).reshape(-1, 2)
