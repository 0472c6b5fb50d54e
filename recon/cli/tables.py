"""Tables that commands print."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recon.evaluate.views import ViewScore
    from recon.pipeline.verb import Outcome


def offset_table(outcome: Outcome) -> str:
    """Offsets before and after, in frames of the reference."""
    import numpy as np

    offsets, coarse, true = outcome.found.offsets, outcome.coarse, outcome.truth
    fps, width = offsets.fps[offsets.reference], max(5, *map(len, offsets.names))
    head = f"{'video':{width}}  {'before':>9} {'after':>9} {'sigma':>8}"
    head += f" {'true':>9} {'error':>8}" if true is not None else ""
    lines = [head + "   (frames of the reference)"]
    for v, name in enumerate(offsets.names):
        values = [coarse.frames[v], offsets.frames[v], offsets.sigma[v] * fps]
        values += [true[v] * fps, offsets.frames[v] - true[v] * fps] if true is not None else []
        cells = [
            f"{x:{w}.3f}" if np.isfinite(x) else "–".rjust(w) for x, w in zip(values, (9, 9, 8, 9, 8), strict=False)
        ]
        lines.append(f"{name:{width}}  {' '.join(cells)}" + ("  reference" if v == offsets.reference else ""))
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
