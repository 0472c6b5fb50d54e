"""The page: tables in words, a figure per pair, what to do about each flag. No script, nothing loaded from outside."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from ..files.arrays import atomic_write
from ..types import Alignment, Matches, Offsets, Status, TrackSet
from ..types.drawing import clips_of, judged
from ..types.similarity import IDENTITY
from . import figures

DETAILED_PAIRS = 8
"""Pairs shown with their figure; the others stand in the table. Keeps the page below 400 KB."""

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:0 auto;max-width:62rem;padding:1rem;color:#1b1e23;background:#fff}
h1{font-size:1.5rem;margin:.2rem 0}h2{font-size:1.15rem;margin:1.6rem 0 .4rem}h3{font-size:1rem;margin:1.1rem 0 .2rem}
table{border-collapse:collapse;font-size:.86rem}\
td,th{padding:.22rem .6rem;text-align:right;border-bottom:1px solid #dfe3e8}
td:first-child,th:first-child,td.t,th.t{text-align:left}.scroll{overflow-x:auto}.ok{color:#0a7d33}.no{color:#b3261e}
svg{max-width:100%;height:auto}p.s{color:#555b66;font-size:.86rem}dt{font-weight:600}dd{margin:0 0 .5rem 1rem}
"""


def write_report(
    path: str | os.PathLike[str],
    offsets: Offsets,
    tracks: Sequence[TrackSet] | None = None,
    *,
    truth: Sequence[float] | None = None,
    title: str = "Synchronisation report",
    extra: str = "",
    clips: Sequence[tuple[float, float]] | None = None,
) -> None:
    """Write the report page, atomically.

    Args:
        offsets: from :func:`otsync.synchronize`.
        tracks: what they were made from; with it the page shows cost maps and DTW paths.
        truth: true offsets in seconds on the reference's clock, for simulated worlds.
        extra: further sections as HTML, after the graph (a recording's pictures).
        clips: first second and duration of every video on its own clock; default: those of the tracks.
    """
    page = [
        f"<h1>{escape(title)}</h1>",
        f"<p>{_verdict(offsets)}</p>",
        "<h2>Offsets</h2>",
        _offset_table(offsets, truth),
        _frames_table(offsets),
        "<p class=s>A positive offset means that the video started later than its reference. "
        "t<sub>world</sub> = rate · t<sub>video</sub> + offset.</p>",
        "<h2>On the common clock</h2>",
        figures.clock_bars(offsets, clips_of(tracks, len(offsets)) if clips is None else clips),
        _remedies(offsets),
        _graph(offsets),
        extra,
        "<h2>Pairs</h2>",
        _pair_table(offsets, truth),
        *_pair_details(offsets, tracks, truth),
        _footer(offsets),
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


def _verdict(offsets: Offsets) -> str:
    trusted, count = judged(offsets)
    missing = int((~np.isfinite(offsets.seconds)).sum())
    text = f"<b>{trusted} of {count} offsets {'is' if count == 1 else 'are'} to be trusted"
    if trusted < count:
        text += f"; {count - missing - trusted} doubtful, {missing} missing"
    return text + f".</b> The clock is that of <b>{escape(offsets.names[offsets.reference])}</b>."


def _offset_table(offsets: Offsets, truth: Sequence[float] | None) -> str:
    head = ["<th>video", "<th class=t>status", "<th>offset, frames", "<th>± sigma", "<th>offset, s", "<th>rate"]
    head += ["<th>true, frames", "<th>error"] if truth is not None else []
    rows = []
    for v, name in enumerate(offsets.names):
        fps = offsets.fps[offsets.component[v]]
        status = "reference" if v == offsets.reference else status_words(offsets.status[v], offsets.flags[v])
        cells = [
            f"<td>{escape(name)}",
            f"<td class=t>{status}",
            f"<td>{number(offsets.frames[v], 3)}",
            f"<td>{number(offsets.sigma[v] * fps, 3)}",
            f"<td>{number(offsets.seconds[v], 5)}",
            f"<td>{number(offsets.rates[v], 6).rstrip('0').rstrip('.')}",
        ]
        if truth is not None:
            cells += [f"<td>{number(truth[v] * fps, 3)}", f"<td>{number((offsets.seconds[v] - truth[v]) * fps, 3)}"]
        rows.append("<tr>" + "".join(cells))
    notes = "".join(f"<li>{escape(note)}" for note in offsets.clock_notes())
    told = f"<ul>{notes}</ul>" if notes else ""
    return f"<div class=scroll><table><tr>{''.join(head)}{''.join(rows)}</table></div>{told}"


def _frames_table(offsets: Offsets) -> str:
    """Where each video's frame of reference lies, for videos that have one of their own."""
    if not offsets.transforms:
        return ""
    rows = []
    for name, S in zip(offsets.names, offsets.transforms, strict=True):
        cells = ["–"] * 5
        if S is not None:
            cells = [
                f"{S.scale:.4f}",
                f"{100 * S.scale_sigma:.2f} %",
                f"{S.degrees_from(IDENTITY):.1f}°",
                f"{S.rotation_sigma:.2f}°",
                " ".join(f"{x:.3g}" for x in S.t),
            ]
        rows.append(f"<tr><td>{escape(name)}" + "".join(f"<td>{c}" for c in cells))
    head = "<th>video<th>scale<th>± sigma<th>turned by<th>± sigma<th>origin, in the reference's frame"
    return f"<h2>Frames of reference</h2><div class=scroll><table><tr>{head}{''.join(rows)}</table></div>"


def status_words(status: Status, flags: Sequence[Status]) -> str:
    if status.ok:
        return "<span class=ok>trusted</span>"
    return f"<span class=no>{', '.join(f.code.replace('_', ' ') for f in flags or (status,))}</span>"


def _remedies(offsets: Offsets) -> str:
    """What each flag that occurs means and what to do about it."""
    everywhere = [*offsets.flags, *(p.flags for p in offsets.alignments.values())]
    seen = [s for s in Status if any(s in flags for flags in everywhere)]
    if not seen:
        return ""
    items = "".join(f"<dt>{s.code.replace('_', ' ')}<dd>{escape(str(s))}" for s in reversed(seen))
    return f"<h2>What the flags mean, and what to do</h2><dl>{items}</dl>"


def _graph(offsets: Offsets) -> str:
    """Residuals of the pairs against the graph, where there are more pairs than a tree needs."""
    rows = [
        (f"{offsets.names[i]} – {offsets.names[j]}", (p.offset - offsets.between(i, j)) * p.fps, p.status.ok)
        for (i, j), p in sorted(offsets.alignments.items())
        if np.isfinite(p.offset - offsets.between(i, j))
    ]
    if len(rows) < len(offsets):
        return ""
    values = np.array([r[1] for r in rows])
    shown = sorted(rows, key=lambda r: -abs(r[1]))[:30]
    text = (
        f"<p>{len(rows)} pairs; median |residual| {np.median(np.abs(values)):.3f} frames, "
        f"largest {np.abs(values).max():.3f}. {'The 30 largest:' if len(rows) > 30 else ''}</p>"
    )
    figure = figures.residual_bars([r[0] for r in shown], np.array([r[1] for r in shown]), [r[2] for r in shown])
    return f"<h2>Do the pairs agree?</h2>{text}{figure}"


def _pair_table(offsets: Offsets, truth: Sequence[float] | None) -> str:
    head = "<th>a<th class=t>b<th>offset, frames<th>± sigma<th>matches" + ("<th>error" if truth is not None else "")
    rows = []
    for (i, j), p in sorted(offsets.alignments.items()):
        error = "" if truth is None else f"<td>{number((p.offset - (truth[j] - truth[i])) * p.fps, 3)}"
        count = len(offsets.matches[i, j]) if (i, j) in offsets.matches else "–"
        rows.append(
            f"<tr><td>{escape(offsets.names[i])}<td class=t>{escape(offsets.names[j])}<td>{number(p.frames, 3)}"
            f"<td>{number(p.sigma * p.fps, 3)}<td>{count}{error}<td class=t>{status_words(p.status, p.flags)}"
        )
    return f"<div class=scroll><table><tr>{head}<th class=t>status{''.join(rows)}</table></div>"


def _pair_details(offsets: Offsets, tracks: Sequence[TrackSet] | None, truth: Sequence[float] | None) -> list[str]:
    """The figure of the pairs that matter most: the flagged first, then those with the reference."""

    def rank(item: tuple[tuple[int, int], Alignment]) -> tuple[bool, bool, tuple[int, int]]:
        pair, alignment = item
        return alignment.status.ok, offsets.reference not in pair, pair

    shown = sorted(offsets.alignments.items(), key=rank)[:DETAILED_PAIRS]
    parts = []
    for (i, j), p in shown:
        cost, path, origin = _cost_map(p, (i, j), offsets.matches, tracks)
        true = None if truth is None else float(truth[j] - truth[i])
        parts.append(
            f"<h3>{escape(offsets.names[i])} – {escape(offsets.names[j])}: {status_words(p.status, p.flags)}</h3>"
        )
        parts.append(figures.pair_figure(p, cost, path, origin, true))
    if len(shown) < len(offsets.alignments):
        parts.append(f"<p class=s>{len(offsets.alignments) - len(shown)} further pairs stand in the table only.</p>")
    return parts


def _cost_map(
    pair: Alignment, key: tuple[int, int], matches: Mapping[tuple[int, int], Matches], tracks: Sequence[TrackSet] | None
) -> tuple[np.ndarray | None, np.ndarray | None, float]:
    """The pair's own cost map and path, or the paper's made from tracks and matches; and the offset of lag 0."""
    if tracks is None or key not in matches or len(matches[key]) == 0:
        return pair.cost, pair.path, 0.0
    if pair.transform is not None:  # positions are in two frames
        return None, None, 0.0
    i, j = key
    origin = float(tracks[i].times[0] - tracks[j].times[0])
    if pair.cost is not None:
        return pair.cost, pair.path, origin
    if tracks[i].xyz is None or tracks[j].xyz is None:  # D_geo is of positions
        return None, None, origin
    from ..align.warping import DTW

    paper = DTW()(tracks[i], tracks[j], matches[key])
    return paper.cost, paper.path, origin


def _footer(offsets: Offsets) -> str:
    from .. import __version__

    stats = ", ".join(f"{k} {v:.4g}" for k, v in offsets.stats.items())
    where = f"otsync {__version__}, Python {platform.python_version()}, {platform.machine()}"
    return f"<p class=s>{where}. {escape(stats)}</p>"


def number(x: float, digits: int) -> str:
    return f"{x:.{digits}f}" if np.isfinite(x) else "–"
