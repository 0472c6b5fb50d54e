"""The common clock to look at: every video as a bar with its pictures, and one moment before and after."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float, UInt8

from ..types import Offsets, Video

THUMB, THUMBS = 96, 8
"""Width of a thumbnail on a bar in pixels, and how many a bar has."""

STILL, SHOWN = 208, 9
"""Width of a picture of the stills, and videos that they show."""

TICKS = 6
"""About how many ticks the axis has."""


def world_times(offsets: Offsets, v: int, own: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"] | None:
    """World seconds of a video's frames, nan where a frame tells no time; None where it is not on the common clock."""
    if not np.isfinite(offsets.seconds[v]) or offsets.component[v] != offsets.reference:
        return None
    times = np.asarray(offsets.times(v, np.asarray(own, float)), float)
    return times if np.isfinite(times).any() else None


def began(offsets: Offsets, own: Sequence[Float[np.ndarray, " T"]]) -> Float[np.ndarray, " V"]:
    """World seconds of the first frame of every video; nan for one that is not on the common clock.

    own: (T,) seconds of every video's frames on its own clock.
    """
    worlds = [world_times(offsets, v, times) for v, times in enumerate(own)]
    return np.array([np.nan if w is None else float(np.nanmin(w)) for w in worlds])


def timeline(offsets: Offsets, own: Sequence[Float[np.ndarray, " T"]], videos: Sequence[Video] | None = None) -> str:
    """Every video as a bar on the common clock, with its thumbnails where there are videos, as HTML.

    own: (T,) seconds of every video's frames on its own clock, in the order of the offsets' names.
    """
    worlds = [world_times(offsets, v, times) for v, times in enumerate(own)]
    steps = [float(np.median(np.diff(t))) if len(t) > 1 else 1 / 30 for t in own]
    ends = [
        None if world is None else (float(np.nanmin(world)), float(np.nanmax(world)) + step)
        for world, step in zip(worlds, steps, strict=True)
    ]
    known = [e for e in ends if e is not None]
    if not known:
        return "<p>No video is on the common clock.</p>"
    low, high = min(e[0] for e in known), max(e[1] for e in known)
    width = max(high - low, 1e-9)
    zero = ends[offsets.reference]
    rows = []
    for v, name in enumerate(offsets.names):
        span = ends[v]
        if span is None:
            why = "on a clock of its own group" if np.isfinite(offsets.seconds[v]) else "no answer"
            rows.append(_row(name, "<span class=no>⚠</span>", f"<div class=none>{why}</div>"))
            continue
        left, share = 100 * (span[0] - low) / width, 100 * (span[1] - span[0]) / width
        sure = v == offsets.reference or offsets.status[v].ok
        picture = "" if videos is None else _strip(videos[v])
        mark = "" if zero is None else f'<div class=mark style="left:{100 * (zero[0] - low) / width:.3f}%"></div>'
        bar = (
            f'<div class="bar{"" if sure else " unsure"}" style="margin-left:{left:.3f}%;width:{share:.3f}%">'
            f"{picture}</div>{mark}"
        )
        rows.append(_row(name, _late(offsets, v, span[0], zero), bar))
    axis = "".join(f'<span style="left:{100 * (t - low) / width:.2f}%">{t:g} s</span>' for t in _ticks(low, high))
    reference = escape(offsets.names[offsets.reference])
    return (
        f"<div class=clock>{''.join(rows)}<div class=row><div class=who></div><div class=axis>{axis}</div></div></div>"
        f"<p class=s>Seconds on the clock of {reference}, which began at the dashed line. Blue: to be trusted; "
        "hatched and orange: not. ± is one standard deviation.</p>"
    )


def _row(name: str, words: str, lane: str) -> str:
    who = f"<div class=who><b>{escape(name)}</b> <span class=s>{words}</span></div>"
    return f"<div class=row>{who}<div class=lane>{lane}</div></div>"


def _late(offsets: Offsets, v: int, first: float, zero: tuple[float, float] | None) -> str:
    """By how much a video began later than the reference, and how sure that is."""
    if v == offsets.reference:
        return "the reference"
    sign = "<span class=ok>✓</span>" if offsets.status[v].ok else "<span class=no>⚠</span>"
    if zero is None:
        return sign
    late = first - zero[0]
    return f"{sign} {measured(abs(late), float(offsets.sigma[v]))} s {'later' if late >= 0 else 'earlier'}"


def measured(value: float, sigma: float) -> str:
    """``0.6130 ± 0.0004``: two digits of the standard deviation; three of the value where there is none."""
    if not math.isfinite(value):
        return "–"
    if not math.isfinite(sigma) or sigma <= 0:
        return f"{value:.3f}"
    digits = min(6, max(1, 1 - math.floor(math.log10(sigma))))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers in a span."""
    step = 10.0 ** math.floor(math.log10((high - low) / TICKS))
    step *= next(m for m in (1, 2, 5, 10) if (high - low) / (step * m) <= TICKS)
    return [round(k * step, 9) + 0.0 for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _strip(video: Video) -> str:
    """Thumbnails over the whole of a video as one image, each the middle of its part."""
    count = min(THUMBS, len(video.frames))
    frames = ((np.arange(count) + 0.5) * len(video.frames) / count).astype(int)
    height = max(1, round(THUMB * video.camera.height / video.camera.width))
    sheet = np.concatenate([thumbnail(video.frames[int(k)], (THUMB, height)) for k in frames], 1)
    return inline_image(sheet, f"{video.name} over time", quality=50)


def stills(offsets: Offsets, videos: Sequence[Video]) -> str:
    """All videos at one moment: as filmed, when all are started together, beside synchronised; as HTML."""
    shown = [v for v in range(len(videos)) if world_times(offsets, v, videos[v].times) is not None][:SHOWN]
    if len(shown) < 2 or offsets.reference not in shown:
        return ""
    worlds = {v: np.asarray(world_times(offsets, v, videos[v].times)) for v in shown}
    zero = float(np.nanmin(worlds[offsets.reference]))
    start, stop = max(np.nanmin(w) for w in worlds.values()), min(np.nanmax(w) for w in worlds.values())
    if start > stop:  # a chain of videos without a moment that all show
        return ""
    moment = 0.5 * (start + stop)
    filmed = {v: zero + videos[v].times - videos[v].times[0] for v in shown}
    parts = []
    for title, clocks, words in (
        ("Before", filmed, "if all videos are started together"),
        ("After", worlds, "on the common clock"),
    ):
        cells = "".join(_cell(videos[v], clocks[v], moment) for v in shown)
        columns = f"grid-template-columns:repeat({math.ceil(math.sqrt(len(shown)))},minmax(0,1fr))"
        what = f"<b>{title}</b>: {moment - zero:.2f} s in, {words}"
        parts.append(
            f'<figure><div class=mosaic style="{columns}">{cells}</div><figcaption>{what}</figcaption></figure>'
        )
    more = f"<p class=s>The first {SHOWN} of {len(videos)} videos.</p>" if len(videos) > SHOWN else ""
    return f"<div class=stills>{''.join(parts)}</div>{more}"


def _cell(video: Video, clock: Float[np.ndarray, " T"], moment: float) -> str:
    """The frame of a video that is nearest to a moment on a clock, under its name; empty where it has none then."""
    away = np.abs(clock - moment)
    k = int(np.nanargmin(away))
    step = float(np.nanmedian(np.diff(clock))) if len(clock) > 1 else 1.0
    picture = ""
    if away[k] <= step:
        height = max(1, round(STILL * video.camera.height / video.camera.width))
        picture = inline_image(thumbnail(video.frames[k], (STILL, height)), f"{video.name} at {moment:.2f} s")
    return f"<div>{picture}<span>{escape(video.name)}</span></div>"


def thumbnail(frame: np.ndarray, size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    from PIL import Image

    return np.asarray(Image.fromarray(np.asarray(frame)).resize(size, Image.Resampling.BOX))


def inline_image(pixels: np.ndarray, label: str, quality: int = 60) -> str:
    """An inline WebP."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "WEBP", quality=quality, method=4)
    data = base64.b64encode(buffer.getvalue()).decode()
    height, width = pixels.shape[:2]
    return f'<img alt="{escape(label)}" width={width} height={height} src="data:image/webp;base64,{data}">'
