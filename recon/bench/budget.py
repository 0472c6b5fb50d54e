"""``otsync bench budget SCENE``: what a second more of ``otsync run --budget`` buys, from images to the refined scene.

The recording is truly synchronised; the videos lose 0 to ``MOST`` frames at their start, drawn by the seed, and are
given images and calibration alone. Its first video is held out. Each budget is a whole run in a process of its own,
whose clocks are held against the frames that were lost, and whose scene against the held-out video. Seconds are the
machine's: let it be quiet.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from otsync.bench.record import Row, machine, table, write_rows
from otsync.files.arrays import atomic_write, read_json, write_json
from otsync.io import scene_from_document
from otsync.io.document import write_document
from otsync.io.scene import read_document
from otsync.metrics import offset_error
from otsync.progress import tell
from otsync.types import Offsets

BUDGETS = (90, 120, 180, 300, 450)
"""Seconds of the whole command."""

MOST = 15
"""Frames that a video loses at most."""

FIRST_SEED = 7800

RAN = (0, 1)
"""Exit codes of runs that came to their end; 1: an offset is not to be trusted."""

PANELS = (
    ("error", "offsets without the shift of all, frames"),
    ("psnr", "PSNR of the held-out video, dB"),
    ("mask_psnr", "the same where things move, dB"),
)


def run(
    out: Path, *, scene: str | os.PathLike[str], first_seed: int = FIRST_SEED, sizes: tuple[int, ...] = BUDGETS
) -> int:
    """Write a row a budget, and the plot. Exit code 1 where a run did not end with a scene.

    Rows are kept in ``out``: a bench that was stopped continues with the next budget.

    Args:
        scene: a truly synchronised recording. first_seed: which frames are lost. sizes: budgets, seconds.

    Raises:
        ValueError: for a recording of fewer than three videos, or of videos of ``2 * MOST`` frames and fewer.
    """
    # a folder of results may serve for more than one recording
    which = f"{zlib.crc32(str(Path(scene).resolve()).encode()):08x}-{first_seed}"
    recording, truth = cut(scene, out / f"recording-{which}", first_seed)
    rows: list[Row] = []
    for budget in sorted(sizes):
        kept = out / f"budget-{which}-{budget}.json"
        row = read_json(kept) if kept.is_file() else measured(recording, truth, budget, out / f"run-{which}-{budget}")
        if row["exit code"] in RAN:
            write_json(kept, row)
        rows.append(row)
    write_rows(out, "budget", rows, {"first_seed": first_seed, "frames lost at most": MOST, "scene": str(scene)})
    print(table(rows), flush=True)
    ended = [row for row in rows if row["exit code"] in RAN]
    if ended:
        plot(ended, out / "budget.svg")
    return 0 if len(ended) == len(rows) else 1


def cut(scene: str | os.PathLike[str], folder: Path, seed: int) -> tuple[Path, Path]:
    """The recording whose videos begin at other frames, and its truth: files of the same images, linked."""
    document, root = read_document(scene)
    opened = scene_from_document(document, root)
    shortest = min(len(v.frames) for v in opened.videos)
    if len(opened.videos) < 3 or shortest <= 2 * MOST:
        raise ValueError(
            f"{root}: expected three videos and more, of more than {2 * MOST} frames each; found "
            f"{len(opened.videos)}, of {shortest}. Film longer."
        )
    if folder.resolve().is_relative_to(root.resolve()):  # a copy of it would hold itself
        raise ValueError(f"--out: expected a folder outside of the recording {root}; found {folder.parent}.")
    late = np.random.default_rng(seed).integers(0, MOST + 1, len(opened.videos))
    videos: list[dict[str, Any]] = []
    for entry, video, lost in zip(document["videos"], opened.videos, late, strict=True):
        first = int(entry.get("range", [0])[0]) + int(lost)
        bare = {k: v for k, v in entry.items() if k not in ("depth", "masks", "tracks", "points")}
        videos.append({**bare, "range": [first, first + len(video.frames) - int(lost)]})
    if not (folder / "scene.json").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(root, folder, copy_function=_linked, ignore=shutil.ignore_patterns("scene.json"))
        write_document(folder / "scene.json", videos)
    # the first video is held out, so the second one's clock is the world's
    fps = float(opened.videos[0].fps or 30.0)
    known = Offsets.known(opened.names[1:], (late[1:] - late[1]) / fps, fps)
    known.save(folder / "truth.json")
    return folder, folder / "truth.json"


def _linked(source: str, target: str) -> None:
    """A file in two folders; a copy where the file system has no links, or the folders are on two of them."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def measured(recording: Path, truth: Path, budget: int, result: Path) -> Row:
    """One run from its beginning, in a process of its own."""
    shutil.rmtree(result, ignore_errors=True)
    held = read_json(recording / "scene.json")["videos"][0]["name"]
    command = [sys.executable, "-m", "otsync.cli", "run", str(recording), "--out", str(result)]
    command += ["--held-out", held, "--budget", str(budget)]
    tell(f"{budget} s ...")
    result.parent.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    with (result.parent / f"{result.name}.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            code = process.wait()
        finally:
            process.terminate()  # of an interrupt; one that has ended hears nothing
            process.wait()
    wall = time.perf_counter() - started
    row: Row = {"budget": budget, "wall s": round(wall, 1), "exit code": code}
    if code not in RAN or not (result / "metrics.json").is_file():
        return row
    ours, true, figures = Offsets.load(result / "offsets.json"), Offsets.load(truth), read_json(result / "metrics.json")
    seconds = np.array([true.seconds[true.names.index(n)] for n in ours.names])
    fps = float(ours.fps[ours.reference])
    error = offset_error(ours.seconds, seconds - seconds[ours.reference], fps, "median")
    told: Row = {
        "steps": int(figures["fit"]["steps"]),
        "error": round(float(error.mean), 4),
        "largest": round(float(error.max), 4),
        "sigma": round(float(np.nanmedian(np.delete(ours.sigma, ours.reference)) * fps), 4),
        "psnr": _rounded(figures["held_out"]["psnr"]),
        "mask_psnr": _rounded(figures["held_out"]["mask_psnr"]),
    }
    return {**row, **told}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def plot(rows: Sequence[Row], path: Path) -> None:
    """Error of the offsets and PSNR against the wall seconds of the whole command."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    with plt.rc_context({"svg.hashsalt": "otsync", "svg.fonttype": "none", "font.size": 9}):
        figure, all_axes = plt.subplots(1, len(PANELS), figsize=(10, 3.2), layout="constrained")
        for axes, (key, label) in zip(all_axes, PANELS, strict=True):
            points = [(r["wall s"], r[key]) for r in rows if r.get(key) is not None]
            axes.plot(*zip(*points, strict=True), ".-") if points else axes.set_xticks([])
            axes.set(xlabel="wall seconds of otsync run --budget", ylabel=label)
            axes.set_ylim(bottom=0) if key == "error" else None
            axes.grid(alpha=0.25)
        figure.suptitle(f"From images and calibration to the refined scene; {machine()['cores']} cores", fontsize=9)
        with atomic_write(path) as file:
            figure.savefig(file, format="svg", metadata={"Date": None})
        plt.close(figure)
