"""The plot of :mod:`otsync.bench.match`: accuracy against seconds, a line for each matcher, the front marked."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from . import record


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """P50 against CPU seconds on a logarithmic axis; points are labelled with N, ringed on the Pareto front."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import color_sequences
    from matplotlib import pyplot as plt

    done = [r for r in rows if r["status"] == "ok"]
    names = list(dict.fromkeys(r["matcher"] for r in done))
    with plt.rc_context({"svg.hashsalt": "otsync", "svg.fonttype": "none", "font.size": 9}):
        figure, axes = plt.subplots(figsize=(8, 4.6))
        colors = itertools.cycle((*color_sequences["tab10"], *color_sequences["tab20b"]))
        for name, color in zip(names, colors, strict=False):
            own = sorted((r for r in done if r["matcher"] == name), key=lambda r: r["n"])
            x, y = [r["cpu_seconds"] for r in own], [r["p50"] for r in own]
            axes.plot(x, y, "-", color=color, lw=1.2, alpha=0.7)
            axes.scatter(x, y, s=14, color=color, label=name, zorder=3)
            for r in own:
                axes.annotate(
                    _short(r["n"]),
                    (r["cpu_seconds"], r["p50"]),
                    xytext=(3, 3),
                    textcoords="offset points",
                    fontsize=7,
                    color=color,
                )
                if r["front"]:
                    axes.scatter(r["cpu_seconds"], r["p50"], s=70, facecolors="none", edgecolors=color, zorder=4)
        axes.set_xscale("log")
        axes.set_ylim(0, 1.03)
        axes.set_xlabel(
            "CPU seconds (numbers: tracks a video; rings: no matcher at that size is faster and as accurate)"
        )
        axes.set_ylabel("right among the best N/2 matches (P50)")
        axes.grid(alpha=0.25)
        axes.legend(fontsize=7.5, loc="lower right")
        about = record.machine()
        versions = ", ".join(f"{k} {v}" for k in ("otsync", "POT", "numpy", "numba") if (v := about["versions"][k]))
        axes.set_title(f"{about['processor']}, {about['cores']} cores; {versions}", fontsize=7.5, color="0.4")
        figure.tight_layout()
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
        plt.close(figure)


def _short(n: int) -> str:
    return f"{n // 1000}k" if n >= 1000 else str(n)
