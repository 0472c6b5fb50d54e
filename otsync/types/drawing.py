"""Results as a notebook shows them: a line of words, a small table, curves and bars on matplotlib axes.

Names are a stranger's: they are escaped in HTML, and a dollar sign in one begins no formula.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

CHOSEN, PEAK, TRUTH, CURVE, GREY = "#2a83c6", "#d9690f", "#a06cc4", "#74849b", "#8a8f98"
"""Colours that all eyes tell apart, and that show on white and on black."""

SHOWN = 3
"""Videos that an ``Offsets`` names in its line."""

LONGEST_NAME = 16
"""Characters of a name in a line."""


def short(text: str) -> str:
    """A name in a line, quoted; long ones are cut."""
    return repr(text if len(text) <= LONGEST_NAME else text[: LONGEST_NAME - 1] + "…")


def codes(flags: Iterable[Any]) -> str:
    """The codes of flags; ok without any."""
    return ", ".join(flag.code for flag in flags) or "ok"


def measured(value: float, sigma: float, unit: str, digits: int) -> str:
    """``12.30 ± 0.06 frames``; without the error where it is not known."""
    error = f" ± {sigma:.{digits}f}" if math.isfinite(sigma) else ""
    return f"{value:.{digits}f}{error} {unit}"


def matches_line(m: Any) -> str:
    """:class:`otsync.Matches` in a line."""
    scores = f", scores {m.score.min():.3g} to {m.score.max():.3g}" if len(m) else ""
    plan = "" if m.plan is None else f", plan {m.plan.shape[0]} x {m.plan.shape[1]}"
    return f"Matches({len(m)} pairs{scores}{plan}; {codes(m.flags)})"


def alignment_line(a: Any) -> str:
    """:class:`otsync.Alignment` in a line."""
    if not math.isfinite(a.offset):
        return f"Alignment(no offset; {codes(a.flags)})"
    frames = f"{measured(a.frames, a.sigma * a.fps, 'frames', 2)} = " if math.isfinite(a.fps) else ""
    rate = "" if a.rate == 1 else f", rate {a.rate:.6f}"
    return f"Alignment({frames}{measured(a.offset, a.sigma, 's', 4)}{rate}; {codes(a.flags)})"


def offsets_line(o: Any) -> str:
    """:class:`otsync.Offsets` in a line: the first few videos, in frames, and how many are to be trusted."""
    shown = [
        f"{short(name)} {f'{frames:+.2f}' if math.isfinite(frames) else 'none'}"
        for name, frames in zip(o.names[:SHOWN], o.frames, strict=False)
    ]
    more = [f"{len(o) - SHOWN} more"] if len(o) > SHOWN else []
    trusted, count = judged(o)
    return f"Offsets(frames: {', '.join([*shown, *more])}; {trusted} of {count} to be trusted)"


def judged(o: Any) -> tuple[int, int]:
    """How many offsets are to be trusted, and of how many: the reference's own is none."""
    others = [status.ok for v, status in enumerate(o.status) if v != o.reference]
    return sum(others), len(others)


HEARD = "steps heard: when, on the clock of its reference, a clock that steps by two frames or more would be heard"


def span(begin: float, end: float) -> str:
    """From when to when, s; a dash where it is not known."""
    return f"{begin:.1f} to {end:.1f} s" if math.isfinite(begin) and math.isfinite(end) else "–"


def table(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A small HTML table; everything in it is escaped."""

    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f"<table><caption>{html.escape(caption)}</caption>{line(head, 'th')}{body}</table>"


def matches_table(m: Any, rows: int = 5) -> str:
    """:class:`otsync.Matches` as HTML: the best few."""
    best = m.best(rows)
    lines = [(str(i), str(j), f"{score:.4g}") for (i, j), score in zip(best.pairs, best.score, strict=True)]
    return table(matches_line(m), ("track of a", "track of b", "score"), lines)


def alignment_table(a: Any) -> str:
    """:class:`otsync.Alignment` as HTML: its competing offsets."""
    lines = [(f"{seconds * a.fps:.2f}", f"{seconds:.4f}", f"{score:.4g}") for seconds, score in a.hypotheses]
    return table(alignment_line(a), ("offset, frames", "offset, s", "score"), lines)


def offsets_table(o: Any) -> str:
    """:class:`otsync.Offsets` as HTML: a row a video."""
    lines = [
        (
            name,
            "–" if not math.isfinite(o.seconds[v]) else f"{o.frames[v]:.2f}",
            "–" if not math.isfinite(o.seconds[v]) else f"{o.seconds[v]:.4f}",
            "–" if not math.isfinite(o.sigma[v]) else f"{o.sigma[v]:.4f}",
            f"{o.rates[v]:g}",
            o.names[o.component[v]],
            span(*heard),
            codes(o.flags[v]),
        )
        for (v, name), heard in zip(enumerate(o.names), o.steps_heard.tolist(), strict=True)
    ]
    head = ("video", "offset, frames", "offset, s", "± sigma, s", "rate", "on the clock of", "steps heard", "flags")
    return table(f"Offsets of {len(o)} videos", head, lines)


def new_axes(width: float, height: float, solid: bool = False) -> Any:
    """Axes of a figure of pyplot's, which a notebook shows at the end of its cell. solid: three-dimensional ones."""
    from matplotlib import pyplot

    how = {"projection": "3d"} if solid else {}
    return pyplot.subplots(figsize=(width, height), layout="constrained", subplot_kw=how)[1]


def plain(artist: Any) -> None:
    """Take every text of a figure or its axes as it is: names are data, a dollar sign in one is no formula."""
    for text in artist.findobj(lambda each: hasattr(each, "set_parse_math")):
        text.set_parse_math(False)


def draw_score(ax: Any, pair: Any) -> None:
    """The score over offsets, with its peaks and the offset that was chosen; all in frames."""
    if pair.curve is not None:
        known = pair.curve[np.isfinite(pair.curve[:, 1])]
        ax.plot(known[:, 0] * pair.fps, known[:, 1], color=CURVE, lw=1)
    ax.plot(pair.hypotheses[:, 0] * pair.fps, pair.hypotheses[:, 1], "v", ms=4, color=PEAK, label="peaks")
    ax.set(xlabel="offset in frames", ylabel="score")


def draw_choice(ax: Any, pair: Any, truth: float | None = None) -> None:
    """Lines at the chosen and, where known, at the true offset (seconds), and what all colours mean."""
    if np.isfinite(pair.offset):
        ax.axvline(pair.frames, color=CHOSEN, lw=1.4, label="chosen")
    if truth is not None:
        ax.axvline(truth * pair.fps, color=TRUTH, lw=1, ls=":", label="true")
    if ax.get_legend_handles_labels()[0]:  # above, where it covers nothing
        ax.legend(fontsize=6.5, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False, borderaxespad=0)


def draw_clock_bars(ax: Any, offsets: Any, clips: Sequence[tuple[float, float]]) -> None:
    """Every video as a bar on the common clock; a whisker of two sigma at its start.

    ``clips``: first second and duration of every video on its own clock.
    """
    for v, name in enumerate(offsets.names):
        first, duration = clips[v]
        start, sigma = offsets.seconds[v] + offsets.rates[v] * first, offsets.sigma[v]
        if not np.isfinite(start) or offsets.component[v] != offsets.reference:
            why = "no answer" if not np.isfinite(start) else "on a clock of its own group"
            ax.text(0, v, f"{name}: {why}", va="center", fontsize=8, color=PEAK)
            continue
        color = CHOSEN if offsets.status[v].ok else GREY
        ax.barh(v, offsets.rates[v] * duration, left=start, height=0.62, color=color, alpha=0.85)
        if np.isfinite(sigma) and sigma > 0:
            ax.errorbar(start, v, xerr=2 * sigma, color="black", capsize=2, lw=1)
    ax.set_yticks(range(len(offsets)), list(offsets.names))
    ax.invert_yaxis()
    ax.set_xlabel(f"seconds on the clock of {offsets.names[offsets.reference]} (grey: not to be trusted)")


def clips_of(sources: Sequence[Any] | None, count: int) -> list[tuple[float, float]]:
    """First second and duration of videos or track sets on their own clocks; a second each where there are none."""
    if sources is None:
        return [(0.0, 1.0)] * count
    return [(float(s.times[0]), float(s.times[-1] - s.times[0] + 1 / (s.fps or 1))) for s in sources]


def draw_matches_in_space(ax: Any, a: Any, b: Any, first: str, second: str) -> None:
    """Matched points of two videos, (M,3) each, on three-dimensional axes, a line between the two of each match."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]

    ax.add_collection3d(Line3DCollection(np.stack([a, b], 1), colors=GREY, linewidths=0.7))
    ax.scatter(*a.T, s=7, color=CHOSEN, label=short(first)[1:-1], depthshade=False)
    ax.scatter(*b.T, s=7, color=PEAK, marker="x", lw=0.9, label=short(second)[1:-1], depthshade=False)
    look_in_space(ax, np.concatenate([a, b]))


def look_in_space(ax: Any, points: Any) -> None:
    """Three-dimensional axes about points (M,3), nan left out: one unit in all directions, thin walls, a legend."""
    from matplotlib.ticker import MaxNLocator

    points = points[np.isfinite(points).all(-1)]
    low, high = (np.percentile(points, q, axis=0) for q in (1, 99)) if len(points) else (-np.ones(3), np.ones(3))
    size = np.maximum(high - low, 1e-3 * max(float((high - low).max()), 1e-9))
    for name, middle, half in zip("xyz", (low + high) / 2, 0.6 * size, strict=True):
        getattr(ax, f"set_{name}lim")(middle - half, middle + half)
        axis = getattr(ax, f"{name}axis")
        axis.set_pane_color((0.5, 0.5, 0.5, 0.06))
        axis.set_tick_params(labelsize=6, pad=0)
        axis.set_major_locator(MaxNLocator(4))
    ax.set_box_aspect(size)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=6.5, loc="upper left", frameon=False, ncols=2)


def shared_moment(a: Any, b: Any, pairs: Any, offset: float) -> tuple[int, int, Any] | None:
    """The frame k of ``a`` and m of ``b`` at which most pairs of tracks (M,2) are seen in both, and those pairs.

    offset: of b against a, s. None where no pair is seen in both at one moment.
    """
    there = a.times - offset
    nearest = np.clip(np.round(np.interp(there, b.times, np.arange(b.n_frames))), 0, b.n_frames - 1).astype(int)
    inside = (there >= b.times[0]) & (there <= b.times[-1])
    both = a.seen[pairs[:, 0]] & b.seen[pairs[:, 1]][:, nearest] & inside
    if not both.any():
        return None
    k = int(np.argmax(both.sum(0)))
    return k, int(nearest[k]), pairs[both[:, k]]


def draw_matches_in_pixels(ax: Any, p: Any, q: Any, a: Any, b: Any) -> None:
    """Matched pixels (M,2) of two videos, the second's picture beside the first's; pixels as wide as a's."""
    width = float(a.camera.width if a.camera is not None else np.nanmax(a.uv[..., 0]))
    shifted = q + np.array([1.05 * width, 0.0])
    for start, end in zip(p, shifted, strict=True):
        ax.plot(*np.stack([start, end]).T, color=GREY, lw=0.6)
    ax.plot(*p.T, ".", ms=4, color=CHOSEN, label=short(a.name or "a")[1:-1])
    ax.plot(*shifted.T, "x", ms=4, color=PEAK, label=f"{short(b.name or 'b')[1:-1]}, beside it")
    _like_a_picture(ax)
    ax.legend(fontsize=6.5, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, borderaxespad=0)


def draw_paths_in_space(ax: Any, paths: Any) -> None:
    """Paths (N,T,3), nan where not seen, in the colours of where they begin, with a dot at the end."""
    for path, colour in zip(paths, _colours(len(paths)), strict=True):
        ax.plot(*path.T, color=colour, lw=0.7)
    ends = last_seen(paths)
    ax.scatter(*ends.T, s=5, color=_colours(len(paths)), depthshade=False)
    look_in_space(ax, paths.reshape(-1, 3))
    ax.set(xlabel="x", ylabel="y", zlabel="z")


def draw_paths_in_pixels(ax: Any, paths: Any) -> None:
    """Paths (N,T,2), nan where not seen, with a dot at the end."""
    for path, colour in zip(paths, _colours(len(paths)), strict=True):
        ax.plot(*path.T, color=colour, lw=0.7)
    ends = last_seen(paths)
    ax.scatter(*ends.T, s=5, color=_colours(len(paths)))
    _like_a_picture(ax)


def last_seen(paths: Any) -> Any:
    """(N,D) where each path (N,T,D) was last seen; nan where never."""
    seen = np.isfinite(paths).all(-1)
    last = seen.shape[1] - 1 - np.argmax(seen[:, ::-1], 1)
    return paths[np.arange(len(paths)), last]


def _colours(count: int) -> Any:
    import matplotlib

    return matplotlib.colormaps["cividis"](np.linspace(0, 1, max(count, 1)))[:count]


def _like_a_picture(ax: Any) -> None:
    ax.set_aspect("equal")
    if not ax.yaxis_inverted():
        ax.invert_yaxis()
    ax.set(xlabel="pixels", ylabel="pixels")
