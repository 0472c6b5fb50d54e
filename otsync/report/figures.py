"""Figures of the report as inline SVG: deterministic, with real text, without a script."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence

import numpy as np

from ..types import Alignment, Offsets

MAP_PIXELS = 100
"""Longest side of an embedded cost map: eight of them keep the page below 400 KB."""

CHOSEN, PATH, TRUTH, GREY = "#0a7d33", "#c22f2f", "#6b3fa0", "#8a8f98"


def axes_of(width: float, height: float, columns: int = 1):
    """A figure outside pyplot's global state, and its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(1, columns)
    for ax in np.ravel(axes):
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes


def svg(figure, label: str) -> str:
    """The figure as an <svg> element; the same input gives the same bytes."""
    import matplotlib

    for text in figure.findobj(lambda artist: hasattr(artist, "set_parse_math")):
        text.set_parse_math(False)  # names are data: a dollar sign in one is no formula
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "otsync", "font.size": 8}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    # a hundredth of a point is finer than any screen; six decimals make up half of the page
    text = re.sub(r'\bd="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path.group()), buffer.getvalue())
    return text[text.index("<svg") :].replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)


def clock_bars(offsets: Offsets, clips: Sequence[tuple[float, float]]) -> str:
    """Every video as a bar on the common clock; a whisker of two sigma at its start.

    ``clips``: first second and duration of every video on its own clock.
    """
    figure, ax = axes_of(7.2, 0.9 + 0.24 * len(offsets))
    for v, name in enumerate(offsets.names):
        first, duration = clips[v]
        start, sigma = offsets.seconds[v] + offsets.rates[v] * first, offsets.sigma[v]
        if not np.isfinite(start) or offsets.component[v] != offsets.reference:
            why = "no answer" if not np.isfinite(start) else "on a clock of its own group"
            ax.text(0, v, f"{name}: {why}", va="center", fontsize=8, color=PATH)
            continue
        color = CHOSEN if offsets.status[v].ok else GREY
        ax.barh(v, offsets.rates[v] * duration, left=start, height=0.62, color=color, alpha=0.85)
        if np.isfinite(sigma) and sigma > 0:
            ax.errorbar(start, v, xerr=2 * sigma, color="black", capsize=2, lw=1)
    ax.set_yticks(range(len(offsets)), list(offsets.names))
    ax.invert_yaxis()
    ax.set_xlabel(f"seconds on the clock of {offsets.names[offsets.reference]} (grey: not to be trusted)")
    return svg(figure, "videos on the common clock")


def pair_figure(
    pair: Alignment, cost: np.ndarray | None, path: np.ndarray | None, origin: float, truth: float | None
) -> str:
    """Left: the frame-to-frame cost with the warping path and the chosen offset. Right: the score over offsets."""
    figure, (left, right) = axes_of(7.2, 2.5, 2)
    if cost is not None:
        step = max(1, -(-max(cost.shape) // MAP_PIXELS))
        extent = (-0.5, cost.shape[1] - 0.5, cost.shape[0] - 0.5, -0.5)
        known = cost[np.isfinite(cost)]
        top = float(np.quantile(known, 0.95)) if known.size else 1.0
        left.imshow(cost[::step, ::step], extent=extent, cmap="magma", vmax=top, aspect="auto", interpolation="none")
        if path is not None:
            left.plot(path[:, 1], path[:, 0], color="#39c0ff", lw=1.2, label="DTW path")
        j = np.array([0, cost.shape[1] - 1])
        for offset, color, name in ((pair.offset, "#35e06a", "chosen"), (truth, "#ffffff", "true")):
            if offset is not None and np.isfinite(offset):
                i = j + (offset - origin) * pair.fps
                left.plot(j, i, color=color, lw=1.2, ls="-" if name == "chosen" else ":", label=name)
        left.set(
            xlim=(-0.5, cost.shape[1] - 0.5), ylim=(cost.shape[0] - 0.5, -0.5), xlabel="frame of b", ylabel="frame of a"
        )
        left.legend(fontsize=6, loc="lower right")
    else:
        left.set_axis_off()
    if pair.curve is not None and len(pair.curve):
        known_rows = pair.curve[np.isfinite(pair.curve[:, 1])]
        right.plot(known_rows[:, 0] * pair.fps, known_rows[:, 1], color="#31507d", lw=1)
        right.plot(pair.hypotheses[:, 0] * pair.fps, pair.hypotheses[:, 1], "v", ms=4, color=PATH, label="peaks")
        right.set(xlabel="offset in frames", ylabel="score")
        _mark(right, pair, truth)
    elif path is not None and len(path):
        values, counts = np.unique(path[:, 0] - path[:, 1], return_counts=True)
        right.bar(values + origin * pair.fps, counts, color="#31507d", width=1)
        right.set(xlabel="offset in frames", ylabel="frames of the path")
        _mark(right, pair, truth)
    else:
        right.set_axis_off()
    return svg(figure, "cost map and score")


def _mark(ax, pair: Alignment, truth: float | None) -> None:
    if np.isfinite(pair.offset):
        ax.axvline(pair.frames, color=CHOSEN, lw=1, label="chosen")
    if truth is not None:
        ax.axvline(truth * pair.fps, color=TRUTH, lw=1, ls=":", label="true")
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=6)


def residual_bars(labels: Sequence[str], frames: np.ndarray, trusted: Sequence[bool]) -> str:
    """How far each pair's own answer lies from the solution of the graph, in frames."""
    figure, ax = axes_of(7.2, 0.8 + 0.15 * len(labels))
    ax.barh(range(len(labels)), frames, color=[CHOSEN if ok else GREY for ok in trusted], height=0.7)
    ax.axvline(0, color="black", lw=0.6)
    ax.set_yticks(range(len(labels)), labels, fontsize=6)
    ax.invert_yaxis()
    if np.abs(frames).max(initial=0.0) > 3:
        ax.set_xscale("symlog", linthresh=0.5)
    ax.set_xlabel("pair minus graph, frames (grey: flagged pair)")
    return svg(figure, "graph residuals")
