"""Pairs of videos in detail, folded: the score, the map of costs, and matches drawn on frames and in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape

import numpy as np

from ..align.warping import geometric_cost
from ..clocks.common import common_clock, readable, strongest
from ..types import Alignment, Matches, Offsets, TrackSet, Video
from ..types.drawing import shared_moment
from . import figures
from .clock import inline_image, measured, thumbnail

DETAILED_PAIRS = 5
"""Pairs shown with their figures; the others stand in the table. Keeps the page below 400 KB."""

WIDTH = 300
"""Of a frame that matches are drawn on, in pixels."""

BEST, DRAWN = 200, 30
"""Matches that are considered, and that are drawn."""


def pair_section(
    offsets: Offsets,
    tracks: Sequence[TrackSet] | None,
    videos: Sequence[Video] | None,
    truth: Sequence[float] | None,
    *,
    costs: bool = True,
) -> str:
    """All pairs, as HTML; empty where there are none."""
    if not offsets.alignments:
        return ""

    def rank(item: tuple[tuple[int, int], Alignment]) -> tuple[bool, bool, tuple[int, int]]:
        pair, alignment = item
        return alignment.status.ok, offsets.reference not in pair, pair

    ranked = sorted(offsets.alignments.items(), key=rank)
    shown = ranked[:DETAILED_PAIRS]
    doubtful = "" if all(pair.status.ok for _, pair in ranked) else " The doubtful ones come first."
    parts = [
        f"<h2>Pairs</h2><p class=s>{len(ranked)} pairs of videos were compared.{doubtful} Unfold one to see its "
        "evidence. Frames are those of the reference; in the figures, of the slower video of the two.</p>"
    ]
    for key, pair in shown:
        parts.append(
            f"<details><summary>{_summary(offsets, key, pair, truth)}</summary><div class=inside>"
            f"{_detail(offsets, key, pair, tracks, videos, truth, costs)}</div></details>"
        )
    for key, pair in ranked[DETAILED_PAIRS:]:
        parts.append(f"<p class=s>{_summary(offsets, key, pair, truth)}</p>")
    if len(shown) < len(ranked):
        parts.append(f"<p class=s>{len(ranked) - len(shown)} further pairs have no pictures.</p>")
    return "".join(parts)


def _summary(offsets: Offsets, key: tuple[int, int], pair: Alignment, truth: Sequence[float] | None) -> str:
    i, j = key
    words = "<span class=ok>✓ trusted</span>" if pair.status.ok else f"<span class=no>⚠ {_codes(pair)}</span>"
    count = f"{len(offsets.matches[key])} matches" if key in offsets.matches else ""
    fps, error = float(offsets.fps[offsets.component[j]]), ""
    if truth is not None and np.isfinite(pair.offset):
        error = f"error {(pair.offset - (truth[j] - truth[i])) * fps:.3f}"
    tail = "".join(f"<span class=s>{text}</span> " for text in (count, error) if text)
    return (
        f"<b>{escape(offsets.names[i])} – {escape(offsets.names[j])}</b> "
        f"<span>{measured(pair.offset * fps, pair.sigma * fps)} frames</span> {tail}{words}"
    )


def _codes(pair: Alignment) -> str:
    return ", ".join(flag.code.replace("_", " ") for flag in pair.flags or (pair.status,))


def _detail(
    offsets: Offsets,
    key: tuple[int, int],
    pair: Alignment,
    tracks: Sequence[TrackSet] | None,
    videos: Sequence[Video] | None,
    truth: Sequence[float] | None,
    costs: bool,
) -> str:
    i, j = key
    cost, every, path, origin = _cost_map(pair, key, offsets.matches, tracks if costs else None)
    true = None if truth is None else float(truth[j] - truth[i])
    drawn = [figures.score_figure(pair, path, origin, true)]
    if cost is not None:
        drawn.append(figures.cost_figure(pair, cost, every, path, origin, true))
    seen = None if tracks is None else both_seen(offsets, key, tracks)
    pictures = ""
    if seen is not None and tracks is not None:
        if videos is not None:
            pictures = _on_frames(seen, tracks, videos)
        if tracks[i].xyz is not None and tracks[j].xyz is not None and pair.transform is None:
            drawn.append(figures.in_space(*seen.places(tracks), offsets.names[i], offsets.names[j]))
    return f"{pictures}<div class=figs>{''.join(f'<div>{figure}</div>' for figure in drawn if figure)}</div>"


@dataclass(frozen=True, eq=False)
class Seen:
    """The moment at which most of a pair's best matches are seen in both videos.

    Args:
        key: the two videos. frames: k of the first, m of the second. matches: (M,2) tracks seen in both then, the best
            first.
    """

    key: tuple[int, int]
    frames: tuple[int, int]
    matches: np.ndarray

    def places(self, tracks: Sequence[TrackSet]) -> tuple[np.ndarray, np.ndarray]:
        """(M,3) positions of the matched tracks then, in the first video and in the second."""
        (i, j), (k, m) = self.key, self.frames
        first, second = (
            tracks[v].positions(t, [at])[:, 0] for v, t, at in zip((i, j), self.matches.T, (k, m), strict=True)
        )
        return first, second


def both_seen(offsets: Offsets, key: tuple[int, int], tracks: Sequence[TrackSet]) -> Seen | None:
    """Where a pair's matches are best drawn; None where none is seen in both at one moment."""
    i, j = key
    between = offsets.between(i, j)
    if key not in offsets.matches or not len(offsets.matches[key]) or not np.isfinite(between):
        return None
    found = shared_moment(tracks[i], tracks[j], offsets.matches[key].best(BEST).pairs, between)
    return None if found is None else Seen(key, found[:2], found[2])


def _on_frames(seen: Seen, tracks: Sequence[TrackSet], videos: Sequence[Video]) -> str:
    """The two frames beside each other, with lines between matched tracks, as HTML."""
    from PIL import Image, ImageDraw

    (i, j), (k, m) = seen.key, seen.frames
    a, b = tracks[i].uv, tracks[j].uv
    if a is None or b is None:
        return ""
    sides = []
    for video, frame in ((videos[i], k), (videos[j], m)):
        height = max(1, round(WIDTH * video.camera.height / video.camera.width))
        sides.append(thumbnail(video.frames[frame], (WIDTH, height)))
    sheet = Image.new("RGB", (2 * WIDTH, max(len(side) for side in sides)), (128, 128, 128))
    for n, side in enumerate(sides):
        sheet.paste(Image.fromarray(side), (n * WIDTH, 0))
    draw = ImageDraw.Draw(sheet)
    chosen = seen.matches[:: max(1, len(seen.matches) // DRAWN)][:DRAWN]
    p = a[chosen[:, 0], k] * WIDTH / videos[i].camera.width
    q = b[chosen[:, 1], m] * WIDTH / videos[j].camera.width + [WIDTH, 0]
    # in the order of height, so that neighbouring lines differ and the eye can follow one
    for n, line in enumerate(np.argsort(p[:, 1])):
        colour = figures.MANY[n % len(figures.MANY)]
        ends = [tuple(float(x) for x in end[line]) for end in (p, q)]
        draw.line([*ends[0], *ends[1]], colour, 1)
        for x, y in ends:
            draw.ellipse((x - 2.5, y - 2.5, x + 2.5, y + 2.5), colour, (0, 0, 0))
    names = f"{tracks[i].name} frame {k} and {tracks[j].name} frame {m}"
    words = f"{escape(names)}: {len(seen.matches)} of the best matches are seen in both; {len(chosen)} are drawn"
    return f"<figure>{inline_image(np.asarray(sheet), f'matches on {names}')}<figcaption>{words}</figcaption></figure>"


def _cost_map(
    pair: Alignment, key: tuple[int, int], matches: Mapping[tuple[int, int], Matches], tracks: Sequence[TrackSet] | None
) -> tuple[np.ndarray | None, int, np.ndarray | None, float]:
    """The pair's own cost map and path, or D_geo made from tracks and matches, of every how many frames; and the offset
    of lag 0. D_geo is of the frames that are drawn: of an hour's all it would have 87 GB.

    No path is made where the pair has none: it did not tell the answer, and tslearn compiles for seconds.
    """
    if tracks is None or key not in matches or len(matches[key]) == 0:
        return pair.cost, 1, pair.path, 0.0
    if pair.transform is not None:  # positions are in two frames
        return None, 1, None, 0.0
    i, j = key
    origin = float(tracks[i].times[0] - tracks[j].times[0])
    if pair.cost is not None:
        return pair.cost, 1, pair.path, origin
    if tracks[i].xyz is None or tracks[j].xyz is None:  # D_geo is of positions
        return None, 1, None, origin
    a, b = tracks[i], tracks[j]
    both = common_clock(a, b, strongest(matches[key], readable(BEST, a, b)))
    every = figures.frames_a_pixel(max(both.a.shape[1], both.b.shape[1]))
    drawn = replace(both, a=both.a[:, ::every], b=both.b[:, ::every])
    return geometric_cost(drawn, "position"), every, None, origin
