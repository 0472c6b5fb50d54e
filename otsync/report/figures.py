"""Figures of the report as inline SVG: deterministic, with real text, without a script."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ..types import Alignment, Offsets
from ..types.drawing import CHOSEN, CURVE, GREY, draw_choice, draw_clock_bars, draw_score, plain

MAP_PIXELS = 100
"""Longest side of an embedded cost map: eight of them keep the page below 400 KB."""


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

    plain(figure)
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "otsync", "font.size": 8}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    # a hundredth of a point is finer than any screen; six decimals make up half of the page
    text = re.sub(r'\bd="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path.group()), buffer.getvalue())
    return text[text.index("<svg") :].replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)


def clock_bars(offsets: Offsets, clips: Sequence[tuple[float, float]]) -> str:
    """Every video as a bar on the common clock: see :func:`otsync.types.drawing.draw_clock_bars`."""
    figure, ax = axes_of(7.2, 0.9 + 0.24 * len(offsets))
    draw_clock_bars(ax, offsets, clips)
    return svg(figure, "videos on the common clock")


def pair_figure(
    pair: Alignment, cost: np.ndarray | None, path: np.ndarray | None, origin: float, truth: float | None
) -> str:
    """Left: the frame-to-frame cost with the warping path and the chosen offset; nothing where there is no cost.
    Right: the score over offsets."""
    if cost is None:
        figure, right = axes_of(7.2, 2.2)
    else:
        figure, (left, right) = axes_of(7.2, 2.5, 2)
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
        left.legend(
            fontsize=6, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, facecolor="#31363f", labelcolor="white"
        )
    if pair.curve is not None and len(pair.curve):
        draw_score(right, pair)
        draw_choice(right, pair, truth)
    elif path is not None and len(path):
        values, counts = np.unique(path[:, 0] - path[:, 1], return_counts=True)
        right.bar(values + origin * pair.fps, counts, color=CURVE, width=1)
        right.set(xlabel="offset in frames", ylabel="frames of the path")
        draw_choice(right, pair, truth)
    else:
        right.set_axis_off()
    return svg(figure, "cost map and score")


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


def effort(
    seconds: Mapping[str, float], known: Mapping[str, Offsets], truth: Float[np.ndarray, " V"] | None = None
) -> str:
    """What accuracy cost in this run: estimated error of the offsets against wall time, a point for each answer.

    Args:
        seconds: wall time of every stage, in order. known: the answer that there was after a stage; "" is before all.
        truth: (V,) true offsets in seconds relative to the reference of each answer, where they are known.

    Empty where no answer says how sure it is.
    """
    ends = {"": 0.0} | dict(zip(seconds, np.cumsum(list(seconds.values())).tolist(), strict=True))
    points = [(name, ends[name], *_errors(known[name], truth)) for name in ends if name in known]
    points = [p for p in points if p[2] > 0 and np.isfinite(p[2])]
    if not points:
        return ""
    names, at, sigma, error = zip(*points, strict=True)
    figure, ax = axes_of(7.2, 2.3)
    ax.plot(at, sigma, "o-", color=CHOSEN, ms=4, lw=1, label="estimated: mean sigma")
    if np.isfinite(error).any():
        ax.plot(at, error, "x--", color=CURVE, ms=5, lw=1, label="true: mean |error|")
    for name, x, y in zip(names, at, sigma, strict=True):
        ax.annotate(f"{name or 'given'}, {x:.3g} s", (x, y), xytext=(4, 5), textcoords="offset points", fontsize=7)
    total = max(ends.values()) or 1.0
    for name, end in ends.items():
        if name and seconds[name] > 0.03 * total:
            ax.axvline(end, color=GREY, lw=0.5, zorder=0)
    ax.set(xlabel="wall seconds since the start", ylabel="frames", yscale="log", xlim=(-0.02 * total, 1.15 * total))
    ax.legend(fontsize=7, loc="upper right")
    return svg(figure, "estimated error of the offsets against seconds")


def _errors(offsets: Offsets, truth: np.ndarray | None) -> tuple[float, float]:
    """Mean sigma and mean |error| of all but the reference, in its frames; nan where unknown."""
    others = np.arange(len(offsets)) != offsets.reference
    fps = float(offsets.fps[offsets.reference])

    def mean(x: np.ndarray) -> float:
        known = x[others & np.isfinite(x)]
        return float(known.mean()) * fps if known.size else float("nan")

    return mean(offsets.sigma), float("nan") if truth is None else mean(np.abs(offsets.seconds - truth))
