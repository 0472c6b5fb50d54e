"""Figures of the report as inline SVG: deterministic, with real text, without a script."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float

from ..types import Alignment, Offsets
from ..types.drawing import (
    CHOSEN,
    CURVE,
    GREY,
    TRUTH,
    draw_choice,
    draw_matches_in_space,
    draw_score,
    plain,
)

MAP_PIXELS = 100
"""Longest side of an embedded cost map: five of them keep the page below 400 KB."""

WIDE, HIGH = 4.2, 2.4
"""Inches of a figure: at the width of a phone its letters can still be read, and two fit side by side elsewhere."""

LEFT, BELOW, BESIDE, ABOVE = 0.64, 0.46, 0.08, 0.24
"""Inches around the axes of a pair's figures: four digits of a tick and a label, a legend of one line above."""

IN_SPACE = 30
"""Matches that are drawn in space: each takes half a kilobyte."""

MANY = ("#56b4e9", "#e69f00", "#009e73", "#f0e442", "#cc79a7", "#d55e00", "#8fd3c8", "#b8a1e3")
"""Colours of lines that are to be told apart, on pictures (Okabe and Ito, without the dark ones)."""


def axes_of(width: float = WIDE, height: float = HIGH, columns: int = 1):
    """A figure outside pyplot's global state, and its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(1, columns)
    for ax in np.ravel(axes):
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes


def framed() -> Any:
    """A figure of a pair and its axes, with room around them: to measure what stands there takes as long as to draw."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDE, HIGH))
    ax = figure.add_axes((LEFT / WIDE, BELOW / HIGH, 1 - (LEFT + BESIDE) / WIDE, 1 - (BELOW + ABOVE) / HIGH))
    ax.spines[["top", "right"]].set_visible(False)
    return figure, ax


def svg(figure, label: str) -> str:
    """The figure as an <svg> element without a ground, in the page's own ink; the same input gives the same bytes."""
    import matplotlib

    plain(figure)
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "otsync", "font.size": 8}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    # a hundredth of a point is finer than any screen; six decimals make up half of the page
    text = re.sub(r'\bd="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path.group()), text)
    # nor does anybody read its comments, its names of groups, and the space between its tags
    text = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r">\s+<", "><", re.sub(r'<g id="[^"]*"', "<g", text))
    # black is the ink of the page, which is bright in the dark; words that black was not asked for have none
    text = re.sub(r'style="[^"]*"', lambda style: style.group().replace("#000000", "currentColor"), text)
    text = text.replace("<svg ", f'<svg role="img" aria-label="{escape(label, quote=True)}" fill="currentColor" ', 1)
    return text


def score_figure(pair: Alignment, path: np.ndarray | None, origin: float, truth: float | None) -> str:
    """The score over offsets, or how often a path takes each; empty where there is neither."""
    scored = pair.curve is not None and len(pair.curve)
    if not scored and (path is None or not len(path)):
        return ""
    figure, ax = framed()
    if scored:
        draw_score(ax, pair)
    elif path is not None:
        values, counts = np.unique(path[:, 0] - path[:, 1], return_counts=True)
        ax.bar(values + origin * pair.fps, counts, color=CURVE, width=1)
        ax.set(xlabel="offset in frames", ylabel="frames of the path")
    draw_choice(ax, pair, truth)
    return svg(figure, "score over offsets")


def frames_a_pixel(frames: int) -> int:
    """Every how many of so many frames a map of costs shows."""
    return max(1, -(-frames // MAP_PIXELS))


def cost_figure(
    pair: Alignment, cost: np.ndarray, every: int, path: np.ndarray | None, origin: float, truth: float | None
) -> str:
    """The frame-to-frame cost with the chosen offset, and the warping path where the pair has one.

    Args:
        cost: of every ``every``-th frame of a (rows) and of b.
    """
    figure, ax = framed()
    step = frames_a_pixel(max(cost.shape))
    high, wide = (every * n - 0.5 for n in cost.shape)
    extent = (-0.5, wide, high, -0.5)
    known = cost[np.isfinite(cost)]
    top = float(np.quantile(known, 0.95)) if known.size else 1.0
    ax.imshow(cost[::step, ::step], extent=extent, cmap="cividis", vmax=top, aspect="auto", interpolation="none")
    if path is not None:
        ax.plot(path[:, 1], path[:, 0], color="#3fb9f0", lw=1.2, label="DTW path")
    j = np.array([0, wide - 0.5])
    for offset, color, name in ((pair.offset, "#ff8c2b", "chosen"), (truth, "#e07be0", "true")):
        if offset is not None and np.isfinite(offset):
            i = j + (offset - origin) * pair.fps
            ax.plot(j, i, color=color, lw=1.4, ls="-" if name == "chosen" else ":", label=name)
    ax.set(xlim=(-0.5, wide), ylim=(high, -0.5), xlabel="frame of b", ylabel="frame of a")
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=6.5, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False, borderaxespad=0)
    return svg(figure, "cost of frames against each other")


def in_space(a: Float[np.ndarray, "M 3"], b: Float[np.ndarray, "M 3"], first: str, second: str) -> str:
    """Matched tracks of two videos at one moment in space, a line between the two of each match; empty without any."""
    known = np.isfinite(a).all(1) & np.isfinite(b).all(1)
    if not known.any():
        return ""
    from matplotlib.figure import Figure

    some = np.flatnonzero(known)
    some = some[:: -(-len(some) // IN_SPACE)]
    a, b = a[some], b[some]
    figure = Figure(figsize=(WIDE, HIGH + 0.5))
    ax: Any = figure.add_axes((0.02, 0.06, 0.9, 0.94), projection="3d")
    draw_matches_in_space(ax, a, b, first, second)
    return svg(figure, f"matches of {first} and {second} in space")


def residual_bars(labels: Sequence[str], frames: np.ndarray, trusted: Sequence[bool]) -> str:
    """How far each pair's own answer lies from the solution of the graph, in frames."""
    figure, ax = axes_of(WIDE, 0.8 + 0.15 * len(labels))
    ax.barh(range(len(labels)), frames, color=[CHOSEN if ok else GREY for ok in trusted], height=0.7)
    ax.axvline(0, color="black", lw=0.6)
    ax.set_yticks(range(len(labels)), [short(label) for label in labels], fontsize=6.5)
    ax.invert_yaxis()
    if np.abs(frames).max(initial=0.0) > 3:
        ax.set_xscale("symlog", linthresh=0.5)
        ax.xaxis.set_major_formatter("{x:g}")
    ax.set_xlabel("pair minus graph, frames (grey: flagged pair)")
    return svg(figure, "graph residuals")


LONGEST = 30
"""Letters of a label in a figure."""


def short(label: str) -> str:
    return label if len(label) <= LONGEST else label[: LONGEST - 1] + "…"


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
    from matplotlib.ticker import LogLocator, NullLocator

    names, at, sigma, error = zip(*points, strict=True)
    figure, ax = axes_of()
    ax.plot(at, sigma, "o-", color=CHOSEN, ms=4, lw=1, label="estimated: mean sigma")
    if np.isfinite(error).any():
        ax.plot(at, error, "x--", color=TRUTH, ms=5, lw=1, label="true: mean |error|")
    total = max(ends.values()) or 1.0
    for name, x, y in zip(names, at, sigma, strict=True):
        late = x > 0.55 * total  # words that would leave the figure stand on the other side
        ax.annotate(
            f"after {name.rpartition(': ')[2]}, {x:.3g} s" if name else "given",
            (x, y),
            xytext=(-6, -11) if late else (4, 6),
            textcoords="offset points",
            fontsize=7,
            ha="right" if late else "left",
        )
    for name, end in ends.items():
        if name and seconds[name] > 0.03 * total:
            ax.axvline(end, color=GREY, lw=0.5, zorder=0)
    ax.set(
        xlabel="wall seconds since the start (lines: a stage ends)",
        ylabel="frames",
        yscale="log",
        xlim=(-0.02 * total, 1.05 * total),
    )
    ax.margins(y=0.3)
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_locator(NullLocator())
    ax.legend(fontsize=7, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, borderaxespad=0)
    return svg(figure, "estimated error of the offsets against seconds")


def _errors(offsets: Offsets, truth: np.ndarray | None) -> tuple[float, float]:
    """Mean sigma and mean |error| of all but the reference, in its frames; nan where unknown."""
    others = np.arange(len(offsets)) != offsets.reference
    fps = float(offsets.fps[offsets.reference])

    def mean(x: np.ndarray) -> float:
        known = x[others & np.isfinite(x)]
        return float(known.mean()) * fps if known.size else float("nan")

    return mean(offsets.sigma), float("nan") if truth is None else mean(np.abs(offsets.seconds - truth))
