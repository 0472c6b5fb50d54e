"""The page: a sentence and a picture, how sure it is, what it cost, pairs on demand. No script, nothing loaded."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from ..files.arrays import atomic_write
from ..types import Offsets, Status, TrackSet, Video
from ..types.drawing import HEARD, judged, span
from ..types.similarity import IDENTITY
from . import figures
from .clock import began, measured, stills, timeline
from .pairs import pair_section
from .style import STYLE

NEARLY_ZERO = 0.0005
"""Seconds."""

SECOND = np.array([0.0, 1.0])
"""Of a video whose length nobody told: its bar is a second long."""


TRUSTED = (
    "Trusted means that no check raised a flag: the evidence is strong, no other time suits as well, every second and "
    "the other videos agree. About seven of ten such offsets are within one ± of the truth."
)


def write_report(
    path: str | os.PathLike[str],
    offsets: Offsets,
    tracks: Sequence[TrackSet] | None = None,
    *,
    truth: Sequence[float] | None = None,
    title: str = "Synchronisation",
    videos: Sequence[Video] | None = None,
    why: Sequence[str] = (),
    cost: str = "",
    costs: bool = True,
) -> None:
    """Write the report page, atomically.

    Args:
        offsets: from :func:`otsync.synchronize`.
        tracks: what they were made from, in the order of the names; with them the page shows pairs in detail.
        truth: true offsets in seconds on the reference's clock, for simulated worlds.
        videos: what was filmed, in the order of the names; with them the page has pictures.
        why: in words, how the answer was found. cost: what accuracy cost in time, as HTML.
        costs: draw every pair's map of costs: of positions, where tracks are in one world frame.
    """
    sources: Sequence[Video | TrackSet] | None = tracks if videos is None else videos
    own = [SECOND] * len(offsets) if sources is None else [frames_of(source) for source in sources]
    told = "".join(f"<li>{escape(line)}" for line in why)
    page = [
        f"<p class=kind>{escape(title)}</p>",
        f"<h1>{verdict(offsets)}</h1>",
        f"<p class=lead>{extent(offsets, own)}</p>" if sources is not None else "",
        "" if videos is None else stills(offsets, videos),
        "<h2>On the common clock</h2>",
        timeline(offsets, own, videos),
        "<h2>How sure</h2>",
        _offset_table(offsets, truth),
        "<p class=s>A positive offset means that the video's clock started later than the reference's: "
        f"t<sub>world</sub> = rate · t<sub>video</sub> + offset. ± is one standard deviation. {TRUSTED}"
        f"{told_truth(truth)}</p>",
        late_starts(offsets, own),
        remedies(offsets),
        _frames_table(offsets),
        _graph(offsets),
        f"<h2>What accuracy cost</h2>{cost}" if cost else "",
        f"<h2>How it was found</h2><ul>{told}</ul>" if told else "",
        pair_section(offsets, tracks, videos, truth, costs=costs),
        footer(offsets.stats),
    ]
    write_page(path, title, page)


def write_page(path: str | os.PathLike[str], title: str, parts: Sequence[str]) -> None:
    """Write ``parts`` of HTML as one self-contained page without a script, atomically."""
    html = (
        "<!doctype html><html lang=en><head><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width,initial-scale=1'>"
        "<meta http-equiv=Content-Security-Policy "
        "content=\"default-src 'none';style-src 'unsafe-inline';img-src data:\">"
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )
    with atomic_write(path, "w") as stream:
        stream.write(html)


def frames_of(source: Video | TrackSet) -> np.ndarray:
    """(T,) seconds of the frames of a video or a track set on its own clock."""
    return np.asarray(source.times, float)


def verdict(offsets: Offsets) -> str:
    """The answer in a sentence, as HTML."""
    trusted, count = judged(offsets)
    missing = int((~np.isfinite(offsets.seconds)).sum())
    if count > 1 and trusted == count:
        return f"{len(offsets)} videos on one clock: all {count} offsets are to be trusted"
    text = f"{trusted} of {count} offsets {'is' if count == 1 else 'are'} to be trusted"
    return text if trusted == count else text + f"; {count - missing - trusted} doubtful, {missing} missing"


def extent(offsets: Offsets, own: Sequence[np.ndarray]) -> str:
    """Who began first and last, and by how much, as HTML."""
    first = began(offsets, own)
    if np.isfinite(first).sum() < 2:
        return ""
    early, late = int(np.nanargmin(first)), int(np.nanargmax(first))
    sigma = float(np.hypot(offsets.sigma[early], offsets.sigma[late]))
    fps = float(offsets.fps[offsets.reference])
    apart = float(first[late] - first[early])
    return (
        f"<b>{escape(offsets.names[late])}</b> began last, {measured(apart, sigma)} s "
        f"({apart * fps:.1f} frames of the reference) after <b>{escape(offsets.names[early])}</b>. "
        f"The clock is that of <b>{escape(offsets.names[offsets.reference])}</b>."
    )


def late_starts(offsets: Offsets, own: Sequence[np.ndarray]) -> str:
    """Which files' own clocks do not begin at 0, so that when they began is not their offset; as HTML, often empty."""
    told = [
        f"{escape(name)}'s first frame is at {t[0]:.3f} s of its file's own clock"
        for name, t in zip(offsets.names, own, strict=True)
        if len(t) and abs(t[0]) > NEARLY_ZERO
    ]
    if not told:
        return ""
    return f"<p class=s>Offsets are between clocks, bars show when videos began: {'; '.join(told)}.</p>"


def cards(head: Sequence[tuple[str, bool]], rows: Sequence[Sequence[str]]) -> str:
    """A table that becomes a card a row where the screen is narrow. Cells are HTML.

    head: title of every column, and whether it holds text.
    """
    line = "".join(f"<th{' class=t' if text else ''}>{title}" for title, text in head)
    body = []
    for row in rows:
        body.append("<tr>")
        for n, ((title, text), cell) in enumerate(zip(head, row, strict=True)):
            label = f' data-l="{escape(title, quote=True)}"' if n else ""
            body.append(f"<td{' class=t' if text else ''}{label}>{cell}")
    return f"<table class=cards><tr>{line}{''.join(body)}</table>"


def _offset_table(offsets: Offsets, truth: Sequence[float] | None) -> str:
    head = [("video", False), ("status", True), ("offset, frames", False), ("offset, s", False), ("rate", False)]
    heard = [span(*ends) for ends in offsets.steps_heard.tolist()]
    told = any(h != "–" for h in heard)
    head += [("steps heard", False)] if told else []
    head += [("true, frames", False), ("error, frames", False)] if truth is not None else []
    rows = []
    for v, name in enumerate(offsets.names):
        fps = float(offsets.fps[offsets.component[v]])
        status = "reference" if v == offsets.reference else status_words(offsets.status[v], offsets.flags[v])
        sigma = float(offsets.sigma[v])
        cells = [
            escape(name),
            status,
            measured(float(offsets.frames[v]), sigma * fps),
            measured(float(offsets.seconds[v]), sigma),
            number(float(offsets.rates[v]), 6).rstrip("0").rstrip("."),
            *([heard[v]] if told else []),
        ]
        if truth is not None:
            error = (float(offsets.seconds[v]) - float(truth[v])) * fps
            cells += [number(float(truth[v]) * fps, 3), number(error, 3)]
        rows.append(cells)
    notes = "".join(f"<li>{escape(note)}" for note in [*offsets.clock_notes(), *([HEARD] if told else [])])
    return cards(head, rows) + (f"<ul>{notes}</ul>" if notes else "")


def _frames_table(offsets: Offsets) -> str:
    """Where each video's frame of reference lies, for videos that have one of their own."""
    if not offsets.transforms:
        return ""
    rows = []
    for name, S in zip(offsets.names, offsets.transforms, strict=True):
        cells = ["–"] * 3
        if S is not None:
            cells = [
                f"{S.scale:.4f} ± {100 * S.scale_sigma:.2f} %",
                f"{S.degrees_from(IDENTITY):.1f}° ± {S.rotation_sigma:.2f}°",
                " ".join(f"{x:.3g}" for x in S.t),
            ]
        rows.append([escape(name), *cells])
    head = [("video", False), ("scale", False), ("turned by", False), ("origin, in the reference's frame", False)]
    return f"<h3>Frames of reference</h3>{cards(head, rows)}"


def told_truth(truth: Sequence[float] | np.ndarray | None) -> str:
    """Where the columns of the truth come from; empty where there are none."""
    return "" if truth is None else " True offsets came with the recording; they are used for these columns alone."


def status_words(status: Status, flags: Sequence[Status]) -> str:
    if status.ok:
        return "<span class=ok>✓ trusted</span>"
    return f"<span class=no>⚠ {', '.join(f.code.replace('_', ' ') for f in flags or (status,))}</span>"


def remedies(offsets: Offsets) -> str:
    """What each flag that occurs means and what to do about it; of videos first, of pairs folded."""
    own = _told({s for flags in offsets.flags for s in flags})
    pairs = {s for p in offsets.alignments.values() for s in p.flags} - {s for flags in offsets.flags for s in flags}
    parts = [f"<h3>What the flags mean, and what to do</h3>{own}"] if own else []
    if pairs:
        words = "Flags of single pairs, which the others outvoted" if not own else "Further flags, of single pairs"
        parts.append(f"<details><summary>{words}</summary><div class=inside>{_told(pairs)}</div></details>")
    return "".join(parts)


def _told(flags: set[Status]) -> str:
    items = "".join(
        f"<dt class=no>⚠ {s.code.replace('_', ' ')}<dd>{escape(str(s))}" for s in reversed(Status) if s in flags
    )
    return f"<dl>{items}</dl>" if items else ""


def _graph(offsets: Offsets) -> str:
    """Residuals of the pairs against the graph, where there are more pairs than a tree needs."""
    fps = float(offsets.fps[offsets.reference])
    rows = [
        (f"{offsets.names[i]} – {offsets.names[j]}", (p.offset - offsets.between(i, j)) * fps, p.status.ok)
        for (i, j), p in sorted(offsets.alignments.items())
        if np.isfinite(p.offset - offsets.between(i, j))
    ]
    if len(rows) < len(offsets):
        return ""
    values = np.array([r[1] for r in rows])
    shown = sorted(rows, key=lambda r: -abs(r[1]))[:30]
    text = (
        f"<p>{len(rows)} pairs, each measured by itself; median |residual| {np.median(np.abs(values)):.3f} frames, "
        f"largest {np.abs(values).max():.3f}. {'The 30 largest:' if len(rows) > 30 else ''}</p>"
    )
    figure = figures.residual_bars([r[0] for r in shown], np.array([r[1] for r in shown]), [r[2] for r in shown])
    return f"<h3>Do the pairs agree?</h3>{text}<div class=figs>{figure}</div>"


def stage_bars(seconds: Mapping[str, float]) -> str:
    """Wall time of every stage, as HTML."""
    longest = max(seconds.values(), default=0.0) or 1.0
    words = [stage.replace("synchronise: synchronise", "synchronise: offsets") for stage in seconds]
    rows = "".join(
        f'<li><span>{escape(stage)}</span><i style="width:{100 * s / longest:.1f}%"></i><span>{s:.1f} s</span>'
        for stage, s in zip(words, seconds.values(), strict=True)
    )
    return f"<ul class=steps>{rows}</ul>" if rows else ""


def footer(stats: Mapping[str, float]) -> str:
    """With what and where the page was made."""
    from .. import __version__

    told = f"Solved in {stats['seconds']:.1f} s." if "seconds" in stats else ""
    where = f"otsync {__version__}, Python {platform.python_version()}, {platform.machine()}"
    return f"<footer>{where}. {told}</footer>"


def number(x: float, digits: int) -> str:
    return f"{x:.{digits}f}" if np.isfinite(x) else "–"
