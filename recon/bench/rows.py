"""Rows of ``recon bench`` on disk: continued where they were measured alike; tables of all rows, and the paper's."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from otsync.files.arrays import read_json
from recon.bench.paper_table import Style, ablation_table, layout, number, offset_table, view_table, with_spread

Row = dict[str, Any]

KEY = ("configuration", "amplitude", "seed", "steps")
"""What tells the rows of one protocol apart."""

SETTINGS = {"true time": "true time", "ours": "unsynchronised"}
"""Configurations that stand in the paper's table of novel views, and its names for their settings."""

ABLATIONS = {"true time": "full", "w/o spline, true time": "w/o spline", "w/o scaffold, true time": "w/o scaffold"}
"""Configurations that stand in the paper's table of ablations, and its names for them: its full row is the one that it
reports at true time."""

FIGURES = (
    *("start", "mean", "psnr", "ssim", "lpips", "mask_psnr", "mask_ssim"),
    *("neighbour_change", "follow_20", "images", "cpu_seconds"),
)
"""Figures of a row that are averaged over draws."""


def measured_before(out: Path, about: Mapping[str, Any]) -> list[Row]:
    """The rows of an earlier run into ``out``; none when there was none.

    ValueError when they were measured otherwise than ``about`` says: hours of work are not overwritten, and figures of
    two protocols do not belong in one table.
    """
    path = out / "recon.json"
    if not path.exists():
        return []
    document = read_json(path)
    rows = document.get("rows") if isinstance(document, dict) else None
    if not isinstance(rows, list) or not all(isinstance(r, dict) and all(k in r for k in KEY) for r in rows):
        raise ValueError(f"{path}: expected rows of recon bench; found something else. Choose another --out.")
    now = json.loads(json.dumps(about))
    other = [k for k in now if _fixed(k, document.get(k)) != _fixed(k, now[k])]
    if other:
        was, wanted = (_fixed(other[0], d.get(other[0])) for d in (document, now))
        raise ValueError(
            f"{path}: expected rows measured alike; {', '.join(other)} differs: {_apart(was, wanted)}. "
            "Choose another --out, or move the file away."
        )
    return rows


def _fixed(key: str, value: Any) -> Any:
    """What must agree: of a protocol all but the errors put in and the lengths, since every row names its own."""
    if key == "protocol" and isinstance(value, dict):
        return {k: v for k, v in value.items() if k not in ("amplitudes", "seeds", "steps", "lengths")}
    return value


def _apart(was: Any, wanted: Any) -> str:
    if isinstance(was, dict) and isinstance(wanted, dict):
        names = [k for k in {**was, **wanted} if was.get(k) != wanted.get(k)]
        return ", ".join(f"{k} {was.get(k)!r}, now {wanted.get(k)!r}" for k in names)
    return f"{was!r}, now {wanted!r}"


def find(rows: Sequence[Row], which: tuple[str, float, int, int], lpips: bool) -> Row | None:
    """The row of this KEY; not one without LPIPS where there is a network for it now."""
    for row in rows:
        if tuple(row[k] for k in KEY) == which and not (lpips and row.get("lpips") is None):
            return row
    return None


def paper_tables(rows: Sequence[Row], scene: str, lpips_reason: str = "", style: Style = "text") -> str:
    """All rows, then novel views, offsets and ablations in the paper's layout: longest fits, tables per amplitude.

    Figures are means over seeds, with their standard deviation where several seeds were measured; the largest error of
    an offset is that of all.

    Args:
        scene: name of the recording; one of the paper's stands beside its figures.
        lpips_reason: why the LPIPS column is empty, said below.
    """
    parts = []
    for amplitude in dict.fromkeys(r["amplitude"] for r in rows):
        chosen = longest([r for r in rows if r["amplitude"] == amplitude])
        means = {name: summary([r for r in chosen if r["configuration"] == name]) for name in _names(chosen)}
        parts.append(f"errors of up to {amplitude:g} frames, {len({r['seed'] for r in chosen})} seeds, {scene}")
        parts.append(row_table(means, style))
        views = [{**means[n], "scene": scene, "setting": s} for n, s in SETTINGS.items() if n in means]
        if views:
            parts.append(view_table(views, style, lpips_reason))
        if "ours" in means:
            own = means["ours"]
            row = {"scene": scene, **_renamed(own, initial="start", refined="mean"), "refined_max": own["max"]}
            parts.append(offset_table([row], style))
        variants = [_variant(name, means[n]) for n, name in ABLATIONS.items() if n in means]
        if len(variants) > 1:
            parts.append(ablation_table(variants, style))
            parts.append("The paper's ablations are of tennis, at true time.")
    return "\n\n".join(parts)


def longest(rows: Sequence[Row]) -> list[Row]:
    """Of every configuration the rows of its longest fits."""
    most = {name: max(r["steps"] for r in rows if r["configuration"] == name) for name in _names(rows)}
    return [r for r in rows if r["steps"] == most[r["configuration"]]]


def _names(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(r["configuration"] for r in rows))


def summary(rows: Sequence[Row]) -> dict[str, float | None]:
    """Of every figure the mean over the rows that have it, and under its name with ``_spread`` the standard deviation.

    None where no row has it, and for the spread of one. ``max`` is the largest; ``seeds``: how many rows there are.
    """
    out: dict[str, float | None] = {"seeds": float(len(rows))}
    largest = [float(r["max"]) for r in rows if r.get("max") is not None]
    out["max"] = max(largest, default=None)
    for key in FIGURES:
        known = [float(r[key]) for r in rows if r.get(key) is not None]
        mean = math.fsum(known) / len(known) if known else None
        out[key] = mean
        spread = None
        if mean is not None and len(known) > 1:
            spread = math.sqrt(math.fsum((x - mean) ** 2 for x in known) / (len(known) - 1))
        out[f"{key}_spread"] = spread
    return out


def row_table(means: Mapping[str, Mapping[str, float | None]], style: Style = "text") -> str:
    """A line a configuration: what it was measured on, its offsets, its views and its motion.

    means: of :func:`summary`, by name.
    """
    columns = (("mean", 3), ("max", 3), ("psnr", 2), ("mask_psnr", 2), ("neighbour_change", 2), ("follow_20", 2))
    lines = []
    for name, row in means.items():
        figures = [with_spread(row, key, digits) for key, digits in columns]
        counts = [number(row["seeds"], 0), number(row["images"], 0), number(row["cpu_seconds"], 0)]
        lines.append([name, *counts, number(row["start"], 2), *figures])
    header = ["row", "seeds", "images", "CPU s", "errors put in", "offset error, frames", "largest", "PSNR"]
    header += ["PSNR in the mask", "neighbour distance change", "following error"]
    return layout(header, lines, style, "Mean ± standard deviation over seeds. Lengths in footprints (working pixels).")


def _renamed(mean: Mapping[str, float | None], **names: str) -> dict[str, float | None]:
    """Figures with their spreads under other names: new=old."""
    return {f"{new}{end}": mean[f"{old}{end}"] for new, old in names.items() for end in ("", "_spread")}


def _variant(name: str, mean: Mapping[str, float | None]) -> dict[str, Any]:
    moved = _renamed(mean, offset="mean", coherence="neighbour_change", following="follow_20")
    return {"variant": name, **mean, **moved}
