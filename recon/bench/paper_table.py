"""The tables of SyncTrack4D with its published figures and, beside them, the ones that were measured here.

Figures of the paper are for 31 cameras (Panoptic Studio, one held out) at its own image size and protocol; a figure
measured on another selection of cameras, frames or pixels stands beside them for orientation, not as a comparison.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

Style = Literal["text", "markdown"]
Row = Mapping[str, Any]

VIEWS: Mapping[str, Mapping[str, tuple[float, float, float, float]]] = {
    "boxes": {
        "PSNR": (25.61, 28.27, 24.26, 27.31),
        "SSIM": (0.885, 0.892, 0.882, 0.881),
        "LPIPS": (0.197, 0.116, 0.178, 0.129),
    },
    "juggle": {
        "PSNR": (26.27, 28.07, 22.91, 26.01),
        "SSIM": (0.894, 0.889, 0.878, 0.871),
        "LPIPS": (0.176, 0.125, 0.176, 0.155),
    },
    "softball": {
        "PSNR": (26.40, 27.31, 21.93, 26.67),
        "SSIM": (0.901, 0.879, 0.873, 0.873),
        "LPIPS": (0.161, 0.141, 0.174, 0.166),
    },
    "tennis": {
        "PSNR": (26.41, 27.30, 23.14, 26.32),
        "SSIM": (0.894, 0.880, 0.882, 0.871),
        "LPIPS": (0.173, 0.142, 0.161, 0.163),
    },
    "basketball": {
        "PSNR": (26.33, 26.28, 20.28, 25.23),
        "SSIM": (0.886, 0.857, 0.842, 0.843),
        "LPIPS": (0.194, 0.156, 0.238, 0.198),
    },
    "football": {
        "PSNR": (26.24, 27.30, 22.60, 26.13),
        "SSIM": (0.884, 0.875, 0.867, 0.863),
        "LPIPS": (0.193, 0.140, 0.187, 0.164),
    },
    "box": {
        "PSNR": (39.87, 25.33, 21.38, 25.01),
        "SSIM": (0.994, 0.925, 0.923, 0.911),
        "LPIPS": (0.010, 0.058, 0.098, 0.063),
    },
    "fox": {
        "PSNR": (41.74, 25.52, 22.85, 25.44),
        "SSIM": (0.996, 0.935, 0.902, 0.935),
        "LPIPS": (0.008, 0.094, 0.105, 0.044),
    },
    "deer": {
        "PSNR": (35.49, 25.23, 23.54, 24.89),
        "SSIM": (0.977, 0.937, 0.925, 0.902),
        "LPIPS": (0.013, 0.047, 0.087, 0.073),
    },
}
"""Novel views, table "Novel View Synthesis": (SyncNeRF, SyncTrack4D) at true time, then unsynchronised."""

OFFSETS: Mapping[str, tuple[float, float, float, float]] = {
    "boxes": (13.355, 13.387, 2.379, 0.205),
    "juggle": (13.355, 13.414, 6.414, 0.624),
    "softball": (13.355, 13.443, 1.379, 0.146),
    "tennis": (13.355, 13.375, 3.724, 0.187),
    "basketball": (13.355, 13.416, 9.689, 0.260),
    "football": (13.355, 13.405, 9.960, 0.138),
    "average": (13.355, 13.405, 5.590, 0.260),
}
"""Mean absolute offset error in frames, table "Video synchronization error": initial, SyncNeRF, DTW, refined."""

ABLATION: Mapping[str, tuple[float, float, float]] = {
    "full": (27.30, 0.880, 0.142),
    "w/o spline": (27.57, 0.889, 0.139),
    "w/o scaffold": (23.21, 0.724, 0.198),
}
"""PSNR, SSIM and LPIPS, table "Ablation study of multi-video 4DGS" (tennis)."""


def view_table(rows: Sequence[Row], style: Style = "text", lpips_reason: str = "") -> str:
    """Novel views in the paper's layout: a line per scene and figure, columns by setting and method.

    rows: ``{"scene", "setting": "true time" | "unsynchronised", "psnr", "ssim", "lpips", "mask_psnr", "mask_ssim"}``;
    what is missing or nan is a dash; the spread of a figure, where there is one, is named like it with ``_spread``.
    lpips_reason: why there is no LPIPS, said below the table.
    """
    lines = []
    for scene in _scenes(rows):
        for figure in ("PSNR", "SSIM", "LPIPS", "PSNR in the mask", "SSIM in the mask"):
            nerf, paper, nerf_unsync, paper_unsync = VIEWS.get(scene, {}).get(figure, (None,) * 4)
            key = ("mask_" if "mask" in figure else "") + figure.split()[0].lower()
            digits = 2 if "PSNR" in figure else 3
            settings = ("true time", "unsynchronised")
            own = [_found(rows, key, digits, scene=scene, setting=setting) for setting in settings]
            if "mask" in figure and own == [NOTHING, NOTHING]:
                continue
            theirs = [number(v, digits) for v in (nerf, paper, nerf_unsync, paper_unsync)]
            lines.append([scene, figure, *theirs[:2], own[0], *theirs[2:], own[1]])
    header = ["scene", "figure", "SyncNeRF, true time", "SyncTrack4D, true time", "otsync, true time"]
    header += ["SyncNeRF, unsync.", "SyncTrack4D, unsync.", "otsync, unsync."]
    below = "SyncNeRF and SyncTrack4D: figures of the paper, by its protocol."
    return layout(header, lines, style, below + (f" LPIPS: {lpips_reason}." if lpips_reason else ""))


def offset_table(rows: Sequence[Row], style: Style = "text") -> str:
    """Offset errors in the paper's layout: mean absolute errors in frames.

    rows: ``{"scene", "initial", "coarse", "refined", "refined_max"}`` in frames, with spreads as of :func:`view_table`;
    what is missing or nan is a dash.
    """
    lines = []
    for scene in _scenes(rows):
        own = [_found(rows, key, 3, scene=scene) for key in ("initial", "coarse", "refined", "refined_max")]
        lines.append([scene, *(number(v, 3) for v in OFFSETS.get(scene, (None,) * 4)), *own])
    header = ["scene", "initial (paper)", "SyncNeRF (paper)", "DTW (paper)", "refined (paper)"]
    header += ["initial", "coarse", "refined", "refined, worst"]
    return layout(header, lines, style, "Mean absolute error in frames of the reference; last column: the largest.")


def ablation_table(rows: Sequence[Row], style: Style = "text") -> str:
    """Ablations, a line each: held-out figures, offset error and the coherence of tracks.

    rows: ``{"variant", "psnr", "ssim", "lpips", "mask_psnr", "offset", "coherence", "following"}``, with spreads as of
    :func:`view_table`; variants named as in :data:`ABLATION` stand beside the paper's figures.
    """
    lines = []
    for row in rows:
        paper = ABLATION.get(str(row["variant"]), (None,) * 3)
        cells = [number(v, d) for v, d in zip(paper, (2, 3, 3), strict=True)]
        keys = (
            ("psnr", 2),
            ("ssim", 3),
            ("lpips", 3),
            ("mask_psnr", 2),
            ("offset", 3),
            ("coherence", 3),
            ("following", 2),
        )
        lines.append([str(row["variant"]), *cells, *(with_spread(row, key, digits) for key, digits in keys)])
    header = ["variant", "PSNR (paper)", "SSIM (paper)", "LPIPS (paper)", "PSNR", "SSIM", "LPIPS", "PSNR in the mask"]
    header += ["offset error, frames", "neighbour distance change", "following error"]
    return layout(header, lines, style)


def layout(header: Sequence[str], lines: Sequence[Sequence[str]], style: Style = "text", below: str = "") -> str:
    """Cells as aligned text or as a markdown table; the first column to the left, the others to the right."""
    if style not in ("text", "markdown"):
        raise ValueError(f"style: expected 'text' or 'markdown'; found {style!r}.")
    widths = [max(len(line[i]) for line in (header, *lines)) for i in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        padded = [c.rjust(w) if i else c.ljust(w) for i, (c, w) in enumerate(zip(cells, widths, strict=True))]
        return f"| {' | '.join(padded)} |" if style == "markdown" else "  ".join(padded).rstrip()

    rule = ["-" * (w - 1) + (":" if i else "-") for i, w in enumerate(widths)]
    out = [line(header), *([line(rule)] if style == "markdown" else []), *(line(cells) for cells in lines)]
    return "\n".join([*out, *(["", below] if below else [])])


def _scenes(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(str(row["scene"]) for row in rows))


def _found(rows: Sequence[Row], key: str, digits: int, **where: str) -> str:
    """The figure of the first row that fits and has one; a dash when there is none."""
    for row in rows:
        if all(row.get(name) == wanted for name, wanted in where.items()) and row.get(key) is not None:
            return with_spread(row, key, digits)
    return NOTHING


def with_spread(row: Row, key: str, digits: int) -> str:
    """A figure of a row, and its spread where the row has one."""
    return number(row.get(key), digits, row.get(f"{key}_spread"))


def number(value: float | None, digits: int, spread: float | None = None) -> str:
    """A figure with so many digits, "± spread" behind it where there is one; a dash where there is no figure."""
    if value is None or math.isnan(value):
        return NOTHING
    return f"{value:.{digits}f}" + ("" if spread is None else f" ± {spread:.{digits}f}")


NOTHING = "–"
"""Stands where there is no figure."""
