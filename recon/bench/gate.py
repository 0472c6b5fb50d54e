"""``recon bench --gate``: small recordings that are filmed here, against the committed baseline.

Some rows of the benchmark on one, and on another the whole run, from images alone to the scene: offsets, pictures, and
time beside plain solvers. Recordings, errors of clocks and every draw of the fits are decided by seeds: on one kind of
machine the figures are the same each time, but for that of time. On another one they differ by roundings that a fit
enlarges; the tolerance is for these.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from otsync.bench import record
from otsync.bench.match import YARD, yardstick
from otsync.compute.threads import FEW, blas_for, pool_of
from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.metrics import offset_error
from otsync.progress import tell
from otsync.recordings import synchronize_scene
from otsync.simulate import matching_world
from otsync.types import Offsets
from recon.bench.fits import Protocol, Row
from recon.bench.fits import run as measure
from recon.fit.options import FitOptions
from recon.pipeline.plan import Plan
from recon.pipeline.verb import Outcome, reconstruct, true_seconds
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture

SIZE, CAMERAS, FRAMES, SEED = (96, 64), 5, 16, 3
"""Of the recording."""

ROWS = ("ours", "fixed", "w/o scaffold", "scaffold per video")
"""What is measured on it."""

PLAN = Plan(width=SIZE[0], views=8, backdrop_steps=300, fit=FitOptions(steps=300))

WHOLE: dict[str, Any] = {"cameras": 6, "held_out": 1, "frames": 60, "size": (320, 192), "offsets": 6.0}
"""The recordings of the whole run: images and calibration alone."""

SEEDS = (8, 11, 12)
"""Of them; offsets of a fit so short are a matter of luck, so that one recording tells little."""

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

SLOWER = 0.4
"""Share by which the speed of the whole run may fall."""


def run(out: Path, *, gate: bool = False, rebase: bool = False) -> int:
    """Film, measure, write ``recon_gate`` and ``recon_gate_whole`` (``.csv``, ``.json``) to ``out``; 1 where the gate
    finds something worse, else 0.

    gate: compare with the baseline. rebase: make this run the baseline, before it is compared.
    """
    rows = measured()
    record.write_rows(out, "recon_gate", rows, {"unit": "frames, dB, footprints"})
    print(record.table(rows))
    whole = whole_run()
    record.write_rows(out, "recon_gate_whole", [whole])
    print(record.table([whole]))
    figures = figures_of(rows) | figures_of_the_whole(whole)
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


def whole_run(seeds: Sequence[int] = SEEDS) -> dict[str, float]:
    """What ``otsync run`` makes of images alone: offsets by the motion and after the fit, held-out pictures, speed.

    Errors of offsets are counted twice: against the reference, whose own error is counted once a video, and without
    what they have in common. The fit is so short that its clocks are not settled (their sigma is .5 frame).
    """
    runs = [one_run(seed) for seed in seeds]
    with blas_for(FEW):  # its threads spin for longer than they compute, and would be the yardstick
        a, b, _ = matching_world(YARD, seed=1)
        yard = min(yardstick(a, b) for _ in range(5))
    gauges: dict[str, Literal["reference", "median"]] = {"": "reference", ", gauge-free": "median"}
    figures = {
        f"offset error{stage}{name}, frames": float(
            np.mean([offset_error(f.seconds, true_seconds(r.truth, f), float(f.fps[0]), gauge).mean for r, f in each])
        )
        for stage, each in (
            (" of the motion", [(r, r.coarse) for r in runs]),
            ("", [(r, r.outcome.fitted.offsets) for r in runs]),
        )
        for name, gauge in gauges.items()
    }
    figures["PSNR"] = float(np.mean([v.mean["psnr"] for r in runs for v in r.outcome.views if v.held_out]))
    speed = yard / float(np.mean([r.seconds for r in runs]))
    return {name: round(value, 4) for name, value in figures.items()} | {"speed": float(f"{speed:.3g}")}


@dataclass(frozen=True)
class WholeRun:
    """A whole run of a recording that was filmed here.

    Args:
        coarse: offsets by the motion. truth: true ones. seconds: of CPU time.
    """

    coarse: Offsets
    outcome: Outcome
    truth: Offsets
    seconds: float


def one_run(seed: int) -> WholeRun:
    """From images and calibration to offsets and a scene, by a short fit."""
    capture = synthetic(seed, **WHOLE)
    with tempfile.TemporaryDirectory() as name, pool_of(os.cpu_count() or 1) as pool:
        world, held = Path(name) / "world", [f.name for f in capture.held_out]
        write_capture(capture, world, masks=False, depth=False)
        scene, truth = open_scene(world), Offsets.load(world / "truth.json")
        cache, started = Cache(Path(name) / "stages"), time.process_time()
        train = scene.take([n for n in scene.names if n not in held])
        coarse = synchronize_scene(train, cache=cache, map=pool.map, tell=tell).offsets
        outcome = reconstruct(
            scene,
            coarse,
            Path(name) / "result",
            plan=replace(PLAN, width=WHOLE["size"][0]),
            held_out=held,
            truth=truth,
            cache=cache,
            map=pool.map,
        )
        return WholeRun(coarse, outcome, truth, time.process_time() - started)


def figures_of(rows: list[Row]) -> dict[str, float]:
    """The figures that the gate watches, by row and name; the offsets of a row that holds them are none of its own."""
    return {
        f"{row['configuration']}: {name}": float(row[key])
        for row in rows
        for key, name in WATCHED.items()
        if key != "mean" or row["configuration"] != "fixed"
    }


def figures_of_the_whole(run: dict[str, float]) -> dict[str, float]:
    """The figures of :func:`whole_run`, by the names that the baseline has for them."""
    return {f"whole run: {name}": value for name, value in run.items()}


def worse(key: str, found: float, baseline: float) -> bool:
    """Whether a figure of :func:`figures_of` is worse than the baseline's by more than the tolerance."""
    if "PSNR" in key:
        return found < baseline - DECIBELS
    if key.endswith("speed"):
        return found < (1 - SLOWER) * baseline
    return found > (1 + SHARE) * baseline + (FRAME if "frames" in key else PIXEL)
