"""Tables that commands print, and their rows as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from recon.evaluate.views import ViewScore
    from recon.pipeline.verb import Outcome


def offset_rows(outcome: Outcome) -> list[dict[str, Any]]:
    """Offsets before and after in frames of the reference, their sigma and status, and error where truth is known."""
    offsets, true = outcome.fitted.offsets, outcome.truth
    fps = float(offsets.fps[offsets.reference])
    rows = []
    for v, name in enumerate(offsets.names):
        row: dict[str, Any] = {"video": name, "reference": v == offsets.reference}
        row |= {"before": float(outcome.coarse.frames[v]), "after": float(offsets.frames[v])}
        row["sigma"] = float(offsets.sigma[v]) * fps
        row["status"] = offsets.status[v].code
        if true is not None:
            row |= {"true": float(true[v]) * fps, "error": float(offsets.frames[v]) - float(true[v]) * fps}
        rows.append(row)
    return rows


def offset_table(outcome: Outcome) -> str:
    """Offsets before and after, in frames of the reference."""
    import numpy as np

    rows = offset_rows(outcome)
    columns = [
        (k, w) for k, w in (("before", 9), ("after", 9), ("sigma", 8), ("true", 9), ("error", 8)) if k in rows[0]
    ]
    width = max(5, *(len(row["video"]) for row in rows))
    lines = [f"{'video':{width}} " + "".join(f" {k:>{w}}" for k, w in columns) + "  status   (frames of the reference)"]
    for row in rows:
        cells = [f"{row[k]:{w}.3f}" if np.isfinite(row[k]) else "–".rjust(w) for k, w in columns]
        status = "reference" if row["reference"] else row["status"]
        lines.append(f"{row['video']:{width}}  {' '.join(cells)}  {status}")
    return "\n".join(lines)


def view_table(views: tuple[ViewScore, ...], lpips_reason: str = "") -> str:
    """Figures of every camera that was compared."""
    import numpy as np

    keys = [("psnr", 2), ("ssim", 4), ("lpips", 4), ("mask_psnr", 2), ("mask_ssim", 4)]
    if lpips_reason:
        keys = [k for k in keys if k[0] != "lpips"]
    width = max(6, *(len(v.name) for v in views)) if views else 6
    lines = [f"{'camera':{width}}  {'role':9}" + "".join(f" {key:>10}" for key, _ in keys) + "  clock"]
    for v in views:
        cells = "".join(f" {v.mean[k]:10.{d}f}" if np.isfinite(v.mean[k]) else f" {'–':>10}" for k, d in keys)
        lines.append(f"{v.name:{width}}  {'held out' if v.held_out else 'training':9}{cells}  {v.clock.how}")
    return "\n".join(lines + ([f"LPIPS is left out: {lpips_reason}"] if lpips_reason else []))
