"""The plot of :mod:`otsync.bench.chain.run`: frames against seconds, a panel for each situation, the front drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...files.arrays import atomic_write

MARKS = {"DTW": "s", "scan": "o", "scan + spline": "D", "scan + fit": "D"}
LEAST = 0.01
"""Frames at which the axis ends."""


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Mean |error| against CPU-seconds on logarithmic axes; filled: matched again; the paper's row is a star."""
    from matplotlib import color_sequences, rc_context
    from matplotlib.figure import Figure

    situations = list(dict.fromkeys(r["situation"] for r in rows))
    names = [n for n in dict.fromkeys(r["matcher"] for r in rows) if n != "paper"]
    colours = dict(zip(names, (*color_sequences["tab10"], *color_sequences["tab20b"]), strict=False))
    columns = min(4, len(situations))
    lines = -(-len(situations) // columns)
    with rc_context({"svg.hashsalt": "otsync", "svg.fonttype": "none", "font.size": 8}):
        figure = Figure(figsize=(3.1 * columns, 2.6 * lines + 1.0), layout="constrained")
        panels = figure.subplots(lines, columns, squeeze=False).ravel()
        for ax, situation in zip(panels, situations, strict=False):
            own = [r for r in rows if r["situation"] == situation]
            for r in own:
                paper = r["matcher"] == "paper"
                colour = "black" if paper else colours[r["matcher"]]
                ax.scatter(
                    r["cpu_s"],
                    max(r["mean"], LEAST),
                    marker="*" if paper else MARKS[r["way"]],
                    s=90 if paper else 22,
                    facecolors=colour if r["rematch"] or paper else "none",
                    edgecolors=colour,
                    linewidths=0.9,
                    zorder=4 if paper else 3,
                )
            front = sorted((r["cpu_s"], max(r["mean"], LEAST)) for r in own if r["front"])
            ax.plot(*zip(*front, strict=True), color="0.6", lw=1, zorder=1)
            ax.set(xscale="log", yscale="log", title=situation)
            ax.grid(alpha=0.2)
        for ax in panels[len(situations) :]:
            ax.set_axis_off()
        figure.supxlabel("CPU seconds a pair")
        figure.supylabel("mean |error|, frames (missing: the clip's length)")
        _legend(figure, colours)
        with atomic_write(path, "w") as stream:
            figure.savefig(stream, format="svg", metadata={"Date": None})


def _legend(figure: Any, colours: dict[str, Any]) -> None:
    from matplotlib.lines import Line2D

    def handle(label: str, marker: str, colour: Any, full: bool) -> Line2D:
        face = colour if full else "none"
        return Line2D([], [], ls="", marker=marker, color=colour, markerfacecolor=face, label=label)

    handles = [handle(name, "o", colour, True) for name, colour in colours.items()]
    handles += [handle(way, mark, "0.3", True) for way, mark in MARKS.items() if way != "scan + fit"]
    handles += [handle("not matched again", "o", "0.3", False), handle("the paper", "*", "black", True)]
    handles.append(Line2D([], [], color="0.6", label="nothing is both faster and better"))
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=7)
