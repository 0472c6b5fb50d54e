"""``recon bench --gate``: some rows on a small recording that is filmed here, against the committed baseline.

The recording, the errors of its clocks and every draw of the fits are decided by seeds: on one kind of machine the
figures are the same each time. On another one they differ by roundings that a fit enlarges; the tolerance is for these.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from otsync.bench import record
from otsync.io import open_scene
from otsync.progress import tell
from otsync.types import Offsets
from recon.bench.fits import Protocol, Row
from recon.bench.fits import run as measure
from recon.fit.options import FitOptions
from recon.pipeline.plan import Plan
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture

SIZE, CAMERAS, FRAMES, SEED = (96, 64), 5, 16, 3
"""Of the recording."""

ROWS = ("ours", "fixed", "w/o scaffold", "scaffold per video")
"""What is measured on it."""

PLAN = Plan(width=SIZE[0], views=8, backdrop_steps=300, fit=FitOptions(steps=300))

WATCHED = {
    "mean": "offset error, frames",
    "psnr": "PSNR",
    "mask_psnr": "PSNR in the mask",
    "neighbour_change": "neighbour distance change",
}
"""Figures of a row that the gate watches, and what the baseline calls them."""

DECIBELS = 0.3
"""By which a PSNR may fall."""

SHARE, FRAME, PIXEL = 0.25, 0.01, 0.02
"""By which an offset error and a change of distances may grow: a share of the baseline's, and frames or pixels."""


def run(out: Path, *, gate: bool = False, rebase: bool = False) -> int:
    """Film, measure, write ``recon_gate.csv`` and ``.json`` to ``out``; 1 where the gate finds something worse, else 0.

    gate: compare with the baseline. rebase: make this run the baseline, before it is compared.
    """
    rows = measured()
    record.write_rows(out, "recon_gate", rows, {"unit": "frames, dB, footprints"})
    print(record.table(rows))
    figures = figures_of(rows)
    if rebase:
        record.save_baseline("recon", figures)
    return record.gate("recon", figures, worse) if gate else 0


def measured() -> list[Row]:
    """The rows, measured anew: none is kept from an earlier run."""
    capture = synthetic(SEED, cameras=CAMERAS, held_out=1, frames=FRAMES, size=SIZE, offsets=[0.0] * CAMERAS)
    protocol = Protocol(PLAN, held_out=tuple(f.name for f in capture.held_out))
    with tempfile.TemporaryDirectory() as name:
        world = Path(name) / "world"
        write_capture(capture, world)
        truth = Offsets.load(world / "truth.json")
        return measure(open_scene(world), truth, Path(name) / "rows", protocol=protocol, rows=ROWS, tell=tell)


def figures_of(rows: list[Row]) -> dict[str, float]:
    """The figures that the gate watches, by row and name; the offsets of a row that holds them are none of its own."""
    return {
        f"{row['configuration']}: {name}": float(row[key])
        for row in rows
        for key, name in WATCHED.items()
        if key != "mean" or row["configuration"] != "fixed"
    }


def worse(key: str, found: float, baseline: float) -> bool:
    """Whether a figure of :func:`figures_of` is worse than the baseline's by more than the tolerance."""
    if "PSNR" in key:
        return found < baseline - DECIBELS
    return found > (1 + SHARE) * baseline + (FRAME if "frames" in key else PIXEL)
