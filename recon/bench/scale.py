"""``otsync bench scale``: what ``otsync run`` costs as recordings grow: seconds and memory by cameras and frames.

One rig is filmed once, at its largest; a smaller size is every so many of its cameras and its first frames. Images and
calibration alone are given. Each size is a run of its own; the system tells the CPU time of its processes and the
largest memory that they have together. The fit is as long for all (``STEPS``), since its length is the user's choice:
what grows is the way to it. The law is fitted to all sizes, seconds = a * cameras^c * frames^f.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from otsync.bench.record import Row, table, write_rows
from otsync.compute.indices import evenly
from otsync.files.arrays import atomic_write, read_json, write_json
from otsync.io.document import write_document
from otsync.progress import counted, tell
from otsync.simulate.observation import stream
from otsync.types import Camera, Offsets
from recon.simulate.camera import FilmingCamera
from recon.simulate.capture import ring_camera
from recon.simulate.world import FPS, World, draw_world

APART = True
"""Takes more than an hour: no part of ``otsync bench all``."""

SIZES = ((7, 150), (14, 150), (14, 300), (31, 300), (31, 900))
"""Cameras and frames."""

PIXELS = (320, 192)

STEPS = 300

RAN = (0, 1)
"""Exit codes of runs that came to their end; 1: an offset is not to be trusted."""

LATE = 20.0
"""Frames that videos begin apart at most."""

FIRST_SEED = 7700

AT_ONCE = 30
"""Frames that are filmed before they are written."""

NOISE = 7919
"""Between the seeds of the noise of one block of frames and the next."""


def run(out: Path, *, first_seed: int = FIRST_SEED, only: tuple[str, ...] = (), cache: Path | None = None) -> int:
    """Write a row a size and the laws of growth. Exit code 1 where a run failed.

    Films are kept in ``cache``, results of sizes in ``out``: a run that was stopped continues with the next size.

    Args:
        only: sizes by name (``14x150``); default: all. cache: default: ``films`` in ``out``.

    Raises:
        ValueError: for a size that there is not, and on systems without /proc.
    """
    names = {named(*size): size for size in SIZES}
    if unknown := [name for name in only if name not in names]:
        raise ValueError(f"--only: expected sizes among {', '.join(names)}; found {unknown[0]}.")
    if not Path("/proc/self/status").is_file():
        raise ValueError("scale: expected Linux, whose /proc tells the memory of a process; found none. Run it there.")
    chosen = [names[name] for name in only or names]
    whole = film(Path(cache or out / "films") / str(first_seed), first_seed, *largest(chosen))
    rows: list[Row] = []
    for cameras, frames in chosen:
        kept = out / f"scale-{named(cameras, frames)}.json"
        row = read_json(kept) if kept.is_file() else {}
        part = {"seed": first_seed, "rig": whole.name}  # cameras of another rig stand elsewhere
        if {name: row.get(name) for name in part} != part:
            row = {**part, **measured(whole, cameras, frames, out)}
            write_json(kept, row)
        rows.append(row)
    grown = laws(rows)
    write_rows(out, "scale", rows, {"first_seed": first_seed, "pixels": PIXELS, "steps": STEPS, "laws": grown})
    print(table(rows))
    for name, law in grown.items():
        print(f"{name}: cameras^{law['cameras']:.2f} * frames^{law['frames']:.2f}")
    return 1 if any(row["exit code"] not in RAN for row in rows) else 0


def named(cameras: int, frames: int) -> str:
    return f"{cameras}x{frames}"


def largest(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Cameras and frames that hold every size."""
    return max(c for c, _ in sizes), max(f for _, f in sizes)


def film(folder: Path, seed: int, cameras: int, frames: int) -> Path:
    """The folder of images and truth of the whole rig; a camera that is complete is not filmed again."""
    world = draw_world(seed)
    late = stream(seed, "scale").uniform(-LATE, LATE, cameras) / FPS
    late -= late[0]
    videos: list[dict[str, Any]] = []
    home = folder / f"of-{cameras}"
    for c in counted(range(cameras), "filming", "camera", cameras):
        lens = ring_camera(c, cameras, 0, PIXELS, seed)
        name = f"cam{c}"
        _film_one(home / "images" / name, world, lens, c, seed, np.arange(frames) / FPS + late[c])
        camera = {"K": lens.K.tolist(), "w2c": lens.w2c.tolist(), "width": PIXELS[0], "height": PIXELS[1]}
        videos.append({"name": name, "frames": f"images/{name}/*.jpg", "fps": FPS, "camera": camera})
    Offsets.known([v["name"] for v in videos], late, FPS).save(home / "truth.json")
    write_document(home / "scene.json", videos)
    return home


def _film_one(folder: Path, world: World, lens: Camera, c: int, seed: int, times: np.ndarray) -> None:
    """JPEG files of one camera; those that are there stay, and what is filmed now is what it would have been."""
    import cv2

    there = len(list(folder.glob("*.jpg")))
    for block in range(there // AT_ONCE, -(-len(times) // AT_ONCE)):
        first = block * AT_ONCE
        filming = FilmingCamera.of(world, lens, c, (), seed + NOISE * block)
        for k, image in enumerate(filming.film(times[first : first + AT_ONCE]).images, first):
            ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
            assert ok
            with atomic_write(folder / f"{k:06d}.jpg") as file:
                file.write(data.tobytes())


def measured(whole: Path, cameras: int, frames: int, out: Path) -> Row:
    """One run in a process of its own: seconds, memory, and how far its clocks are off."""
    document = read_json(whole / "scene.json")
    part = [document["videos"][c] for c in evenly(len(document["videos"]), cameras)]
    scene = whole / f"scene-{named(cameras, frames)}.json"
    write_document(scene, [{**video, "range": [0, frames]} for video in part])
    result = out / f"run-{named(cameras, frames)}"
    shutil.rmtree(result, ignore_errors=True)  # what is measured is a run from its beginning
    command = [sys.executable, "-m", "otsync.cli", "run", str(scene), "--out", str(result)]
    command += ["--steps", str(STEPS), "--views", "12", "--truth", str(whole / "truth.json")]
    tell(f"{cameras} cameras x {frames} frames ...")
    started = time.perf_counter()
    with (out / f"scale-{named(cameras, frames)}.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        used = MemoryOf(process.pid)
        try:
            while process.poll() is None:
                used.look()
                time.sleep(0.2)
        finally:
            process.terminate()  # of an interrupt; one that has ended hears nothing
            process.wait()
    wall = time.perf_counter() - started
    answered = (result / "offsets.json").is_file()
    error = _error(result / "offsets.json", whole / "truth.json") if answered else None
    return {
        "cameras": cameras,
        "frames": frames,
        "wall s": round(wall, 1),
        "CPU s": round(used.seconds, 1),
        "memory MB": round(used.own),
        "with files MB": round(used.all),
        "error": None if error is None else round(error, 4),
        "exit code": process.returncode if answered else 2,
    }


class MemoryOf:
    """The largest memory and the CPU time of a process and of those that it began, looked at now and then.

    own: MB that are the processes' own. all: MB with the pages of files that they look at, which the system may take
    back; what several look at counts for each. seconds: CPU time.
    """

    def __init__(self, pid: int):
        self.pid, self.own, self.all, self.seconds = pid, 0.0, 0.0, 0.0

    def look(self) -> None:
        own = everything = seconds = 0.0
        for pid in family(self.pid):
            try:
                status = Path(f"/proc/{pid}/status").read_text()
                fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            except OSError:  # it has ended
                continue
            told = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
            if "RssAnon" in told:
                own += int(told["RssAnon"].split()[0]) / 1000
                everything += int(told["VmRSS"].split()[0]) / 1000
            # its own time, and that of processes it began that have ended
            seconds += sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
        self.own, self.all = max(self.own, own), max(self.all, everything)
        self.seconds = max(self.seconds, seconds)


def family(pid: int) -> list[int]:
    """A process and all that it and these began."""
    found = [pid]
    for one in found:
        for path in Path(f"/proc/{one}/task").glob("*/children"):
            try:
                found += [int(child) for child in path.read_text().split()]
            except OSError:  # a thread that has ended
                continue
    return found


def _error(found: Path, true: Path) -> float:
    """Mean error in frames without the shift that all cameras share."""
    from otsync.metrics import offset_error

    ours, truth = Offsets.load(found), Offsets.load(true)
    seconds = np.array([truth.seconds[truth.names.index(n)] for n in ours.names])
    return float(offset_error(ours.seconds, seconds - seconds[ours.reference], FPS, "median").mean)


def laws(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """By what power of cameras and of frames each cost grows; least squares of logarithms. {} from two sizes."""
    good = [row for row in rows if row["exit code"] in RAN]
    if len(good) < 3:
        return {}
    A = np.array([[1.0, math.log(r["cameras"]), math.log(r["frames"])] for r in good])
    out = {}
    for name in ("wall s", "CPU s", "memory MB"):
        _, c, f = np.linalg.lstsq(A, np.log([r[name] for r in good]), rcond=None)[0]
        out[name] = {"cameras": float(c), "frames": float(f)}
    return out
