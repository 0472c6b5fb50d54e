"""Rows of ``recon bench`` on disk: continued where they were measured alike, and laid out as the paper's tables."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from otsync.files.arrays import read_json
from recon.bench.paper_table import Style, ablation_table, offset_table, view_table

Row = dict[str, Any]

KEY = ("configuration", "amplitude", "seed", "steps")
"""What tells the rows of one protocol apart."""

SETTINGS = {"true time": "true time", "ours": "unsynchronised"}
"""Configurations that stand in the paper's table of novel views, and its names for their settings."""

ABLATIONS = {"ours": "full", "w/o spline": "w/o spline", "w/o scaffold": "w/o scaffold"}
"""Configurations that stand in the paper's table of ablations, and its names for them."""


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
    """Novel views, offsets and ablations in the paper's layout: longest fits, mean over seeds, tables per amplitude.

    Args:
        scene: name of the recording; one of the paper's stands beside its figures.
        lpips_reason: why the LPIPS column is empty, said below.
    """
    parts = []
    for amplitude in dict.fromkeys(r["amplitude"] for r in rows):
        chosen = longest([r for r in rows if r["amplitude"] == amplitude])
        means = {name: _mean([r for r in chosen if r["configuration"] == name]) for name in _names(chosen)}
        parts.append(f"errors of up to {amplitude:g} frames, {len({r['seed'] for r in chosen})} seeds, {scene}")
        views = [{**means[n], "scene": scene, "setting": s} for n, s in SETTINGS.items() if n in means]
        if views:
            parts.append(view_table(views, style, lpips_reason))
        if "ours" in means:
            own = means["ours"]
            row = {"scene": scene, "initial": own["start"], "refined": own["mean"], "refined_max": own["max"]}
            parts.append(offset_table([row], style))
        if any(n in means for n in ABLATIONS if n != "ours"):
            parts.append(ablation_table([_variant(ABLATIONS.get(n, n), m) for n, m in means.items()], style))
            parts.append("The paper's ablations are of tennis.")
    return "\n\n".join(parts)


def longest(rows: Sequence[Row]) -> list[Row]:
    """Of every configuration the rows of its longest fits."""
    most = {name: max(r["steps"] for r in rows if r["configuration"] == name) for name in _names(rows)}
    return [r for r in rows if r["steps"] == most[r["configuration"]]]


def _names(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(r["configuration"] for r in rows))


def _mean(rows: Sequence[Row]) -> dict[str, float | None]:
    """Of every figure over the rows that have it; of the largest error the largest."""
    out: dict[str, float | None] = {}
    for key in (
        "start",
        "mean",
        "max",
        "psnr",
        "ssim",
        "lpips",
        "mask_psnr",
        "mask_ssim",
        "neighbour_change",
        "follow_20",
    ):
        known = [float(r[key]) for r in rows if r.get(key) is not None]
        out[key] = None if not known else max(known) if key == "max" else math.fsum(known) / len(known)
    return out


def _variant(name: str, mean: Mapping[str, float | None]) -> dict[str, Any]:
    moved = {"offset": mean["mean"], "coherence": mean["neighbour_change"], "following": mean["follow_20"]}
    return {"variant": name, **mean, **moved}
