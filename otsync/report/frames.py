"""Pictures in the report: all videos at the same moments before and after, and matches drawn on frames."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from ..types.drawing import clips_of
from .figures import effort
from .page import write_report

if TYPE_CHECKING:
    from ..io.scene import Scene
    from ..recordings.routes import Synchronized
    from ..types import Offsets


THUMB = 120
"""Width of a thumbnail; the sheet of eight videos at four moments stays below 60 KB."""

MOMENTS = 4
SHOWN_VIDEOS = 8
SHOWN_MATCHES = 25


def write_recording_report(
    path: str | os.PathLike[str], scene: Scene, answer: Synchronized, *, truth: Sequence[float] | None = None
) -> None:
    """The report page with what the run did and what it looks like; still one file without a script."""
    write_report(
        path,
        answer.offsets,
        answer.tracks if answer.route != "epipolar" else None,
        truth=truth,
        title="Synchronisation of a recording",
        extra=sections(scene, answer, truth),
        clips=clips_of(scene.videos, len(scene.videos)),
    )


def sections(scene: Scene, answer: Synchronized, truth: Sequence[float] | None = None) -> str:
    """HTML of the route, what accuracy cost, the contact sheets and the matches."""
    seconds = ", ".join(f"{k} {v:.1f} s" for k, v in answer.seconds.items())
    parts = [
        "<h2>How it was found</h2><p>" + "<br>".join(escape(line) for line in answer.why) + "</p>",
        f"<p class=s>{escape(seconds)}</p>",
        effort(answer.seconds, answers(answer), None if truth is None else np.asarray(truth, float)),
        "<h2>Before and after</h2><p class=s>One row a video, one column a moment. Before: frames of the same number. "
        "After: frames of the same world time. A blank has no frame then.</p>",
    ]
    zero = np.zeros(len(scene.videos))
    for title, offsets in (("before", zero), ("after", answer.offsets.seconds)):
        sheet = contact_sheet(scene, offsets)
        parts.append(f"<p>{title}</p>{inline_image(sheet, f'contact sheet {title}')}")
    matched = matches_drawn(scene, answer)
    if matched is not None:
        picture, text = matched
        parts.append(f"<h2>Matches</h2><p class=s>{escape(text)}</p>{inline_image(picture, 'matches on frames')}")
    return "".join(parts)


def answers(answer: Synchronized) -> dict[str, Offsets]:
    """The offsets that there were after a stage."""
    if answer.route == "epipolar":
        return {"epipolar": answer.offsets}
    last = {"synchronise": answer.offsets}
    return last if answer.first is None else {"epipolar": answer.first} | last


def contact_sheet(scene: Scene, offsets: np.ndarray) -> np.ndarray:
    """(rows, columns) of thumbnails: videos by moments of the world clock that most of them saw."""
    shown = [v for v in range(len(scene.videos)) if np.isfinite(offsets[v])][:SHOWN_VIDEOS]
    clocks = [scene.videos[v].times + offsets[v] for v in shown]
    start, stop = max(c[0] for c in clocks), min(c[-1] for c in clocks)
    if stop <= start:
        start, stop = min(c[0] for c in clocks), max(c[-1] for c in clocks)
    moments = start + (stop - start) * (np.arange(MOMENTS) + 0.5) / MOMENTS
    rows = []
    for v, clock in zip(shown, clocks, strict=True):
        video = scene.videos[v]
        height = max(1, round(THUMB * video.camera.height / video.camera.width))
        step = float(np.median(np.diff(clock))) if len(clock) > 1 else 1.0
        cells = []
        for t in moments:
            k = int(np.argmin(np.abs(clock - t)))
            blank = np.full((height, THUMB, 3), 235, np.uint8)
            cells.append(_thumb(video.frames[k], (THUMB, height)) if abs(clock[k] - t) <= step else blank)
        rows.append(np.concatenate(cells, 1))
    return np.concatenate(rows)


def matches_drawn(scene: Scene, answer: Synchronized) -> tuple[np.ndarray, str] | None:
    """The best matches of the reference's surest pair, drawn on the frames of one moment."""
    import cv2

    offsets, width = answer.offsets, 2 * THUMB
    pairs = [(p, a) for p, a in offsets.alignments.items() if offsets.reference in p and len(offsets.matches[p])]
    if not pairs:
        return None
    (i, j), _ = min(pairs, key=lambda item: (not item[1].status.ok, item[1].sigma, item[0]))
    a, b = answer.tracks[i], answer.tracks[j]
    if a.uv is None or b.uv is None or not np.isfinite(offsets.between(i, j)):
        return None
    pairs_ij = offsets.matches[i, j].best(200).pairs
    kb = np.clip(
        np.round(np.interp(a.times - offsets.between(i, j), b.times, np.arange(b.n_frames))), 0, b.n_frames - 1
    )
    inside = (a.times - offsets.between(i, j) >= b.times[0]) & (a.times - offsets.between(i, j) <= b.times[-1])
    both = a.seen[pairs_ij[:, 0]] & b.seen[pairs_ij[:, 1]][:, kb.astype(int)] & inside
    if not both.any():
        return None
    k = int(np.argmax(both.sum(0)))
    m = int(kb[k])
    sides = []
    for video, frame in ((scene.videos[i], k), (scene.videos[j], m)):
        height = round(width * video.camera.height / video.camera.width)
        sides.append(_thumb(video.frames[frame], (width, height)))
    rows = max(s.shape[0] for s in sides)
    canvas = np.concatenate([np.pad(s, ((0, rows - len(s)), (0, 0), (0, 0))) for s in sides], 1)
    rng = np.random.default_rng(0)
    for u, v in pairs_ij[both[:, k]][:SHOWN_MATCHES]:
        color = tuple(int(c) for c in rng.integers(60, 255, 3))
        p = a.uv[u, k] * width / scene.videos[i].camera.width
        q = b.uv[v, m] * width / scene.videos[j].camera.width + [width, 0]
        ends = [tuple(round(float(x)) for x in e) for e in (p, q)]
        cv2.line(canvas, ends[0], ends[1], color, 1, cv2.LINE_AA)
        for e in ends:
            cv2.circle(canvas, e, 2, color, -1, cv2.LINE_AA)
    count = int(both[:, k].sum())
    return canvas, f"{offsets.names[i]} frame {k} and {offsets.names[j]} frame {m}: {count} matches seen in both"


def _thumb(frame: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    return cv2.resize(np.asarray(frame), size, interpolation=cv2.INTER_AREA)


def inline_image(pixels: np.ndarray, label: str) -> str:
    """An inline WebP."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "WEBP", quality=60, method=4)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img alt="{escape(label)}" style="max-width:100%" src="data:image/webp;base64,{data}">'
