"""Benchmark of the rasterizer: the back ends side by side in one run, against a committed baseline of ratios.

    otsync bench raster            # all sizes, 3 and 32 channels
    otsync bench raster --gate     # exit code 1 when a ratio fell behind

Times depend on the machine and on who else uses it; the ratio of two back ends, measured alternately in one process,
much less so. It is the ratio that the gate watches.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import itertools
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from otsync.bench import record
from otsync.files.arrays import atomic_write, read_json
from otsync.progress import counted, say
from recon.raster import Rendering, render, warmup

SIZES = ((128, 96, 2_000), (160, 120, 5_000), (320, 180, 20_000), (640, 360, 100_000))  # width, height, Gaussians
TOLERANCE = 0.35  # of the baseline's ratio: what a busy machine may cost before the gate closes
LEAST_RATIO = {3: 15.0, 32: 8.0}  # times the torch back end, by channels: the floor whatever the baseline
SETTLE = 0.01  # seconds before each measurement: torch's threads spin for a while after work, on other threads' cores
FLOPS_PER_PAIR = (30, 6)  # of a splat at a pixel, forward and backward: fixed part, and part per channel


def scene(width: int, height: int, n: int, channels: int, seed: int = 0) -> list[Tensor]:
    """Gaussians in view with about 50 splats a pixel: (means, quats, scales, opacities, colors, viewmats, Ks)."""
    g = torch.Generator().manual_seed(seed)
    f = 0.8 * width
    K = torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])[None]
    z = 2 + 6 * torch.rand(n, generator=g)
    u, v = ((torch.rand(n, generator=g) * 1.1 - 0.05) * size for size in (width, height))
    radius = math.sqrt(40 * width * height / n / 28)  # pixels
    scales = (radius * z / f)[:, None] * torch.exp(0.5 * torch.randn(n, 3, generator=g))
    quats = torch.randn(n, 4, generator=g)
    opacities = torch.sigmoid(1.5 * torch.randn(n, generator=g))
    c, s = math.cos(0.1), math.sin(0.1)
    view = torch.tensor([[c, 0, s, 0.2], [0, 1, 0, -0.1], [-s, 0, c, 0.3], [0, 0, 0, 1]])
    camera = torch.stack([(u - width / 2) / f * z, (v - height / 2) / f * z, z], -1)
    means = (camera - view[:3, 3]) @ view[:3, :3]
    return [means, quats, scales, opacities, torch.rand(n, channels, generator=g), view[None], K]


def splats_per_pixel(tensors: list[Tensor], width: int, height: int, samples: int = 128) -> float:
    """Mean number of splats composited at a pixel, counted exactly at `samples` pixels."""
    from recon.raster.projection import project
    from recon.raster.rendering import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Settings

    means, quats, scales, opacities, _, viewmats, Ks = tensors
    splats = project(means, quats, scales, opacities, viewmats, Ks, width, height, Settings())
    order = splats.depths[0].argsort()
    order = order[(splats.radii[0, order] > 0).all(-1)]
    g = torch.Generator().manual_seed(0)
    at = (torch.rand(samples, 2, generator=g) * torch.tensor([width, height])).floor() + 0.5
    d = at[:, None] - splats.means2d[0, order]
    var_x, slope, var_y = splats.rows[0, order].unbind(-1)
    power = -0.5 * ((d[..., 0] - slope * d[..., 1]) ** 2 / var_x + d[..., 1] ** 2 / var_y)
    alpha = (splats.opacities[0, order] * power.exp()).clamp_max(ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    drawn = (alpha > 0) & ((1 - alpha).cumprod(1) > TRANSMITTANCE_MIN)
    return float(drawn.sum(1).float().mean())


def peak_gflops(size: int = 1024) -> float:
    """What the machine's matrix product reaches in float32: the yardstick of the arithmetic bound."""
    a = torch.rand(size, size)
    best = min(_seconds(lambda: a @ a) for _ in range(6))
    return 2 * size**3 / best * 1e-9


def _seconds(f: Callable[[], Any]) -> float:
    start = time.perf_counter()
    f()
    return time.perf_counter() - start


def _resident(field: str) -> float:
    """VmRSS or VmHWM of this process in MB; nan where there is no /proc."""
    try:
        with open("/proc/self/status") as file:
            return next(int(line.split()[1]) / 1024 for line in file if line.startswith(field))
    except OSError:
        return float("nan")


def _peak_megabytes(f: Callable[[], Any]) -> float:
    """Memory that f takes beyond what the process holds already; free memory is handed back first, where possible."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    try:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")  # the peak begins anew
    except OSError:
        return float("nan")
    before = _resident("VmRSS")
    f()
    return max(0.0, _resident("VmHWM") - before)


class Case:
    """One scene on one back end: forward, and forward with all gradients."""

    def __init__(self, tensors: list[Tensor], width: int, height: int, backend: str) -> None:
        device = "cuda" if backend == "gsplat" else "cpu"
        self.leaves = [t.detach().to(device).requires_grad_(i < 6) for i, t in enumerate(tensors)]
        self.arguments: Any = (*self.leaves, width, height)
        self.backend: Any = backend
        g = torch.Generator().manual_seed(1)
        channels = tensors[4].shape[-1]
        self.weights = [torch.randn(1, height, width, d, generator=g).to(device) for d in (channels, 1)]

    def forward(self) -> Rendering:
        out = render(*self.arguments, backend=self.backend, depth="accumulated")
        if self.backend == "gsplat":
            torch.cuda.synchronize()
        return out

    def both(self) -> tuple[float, float]:
        """Milliseconds forward, and forward + backward."""
        for leaf in self.leaves:
            leaf.grad = None
        start = time.perf_counter()
        out = self.forward()
        middle = time.perf_counter()
        assert out.depths is not None
        torch.autograd.backward([out.colors, out.depths], self.weights)
        if self.backend == "gsplat":
            torch.cuda.synchronize()
        return 1e3 * (middle - start), 1e3 * (time.perf_counter() - start)


def backends() -> tuple[list[str], dict[str, str]]:
    """Back ends that can run here, and why the others cannot."""
    import importlib.util

    found, skipped = ["torch"], {}
    if importlib.util.find_spec("numba"):
        found.insert(0, "cpu")
    else:
        skipped["cpu"] = "numba is not installed"
    if not importlib.util.find_spec("gsplat"):
        skipped["gsplat"] = "gsplat is not installed"
    elif not torch.cuda.is_available():
        skipped["gsplat"] = "no CUDA device"
    else:
        found.append("gsplat")
    return found, skipped


def measure(size: tuple[int, int, int], channels: int, repeats: int, names: Sequence[str]) -> list[dict[str, Any]]:
    """One row per back end: median and least ms, ratio to torch, memory, parity with torch, arithmetic bound."""
    width, height, n = size
    tensors = scene(width, height, n, channels)
    cases = {name: Case(tensors, width, height, name) for name in names}
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    memory = {}
    for name, case in cases.items():
        memory[name] = _peak_megabytes(case.both)
    for _ in range(repeats):
        for name, case in cases.items():
            time.sleep(SETTLE)
            case.both()  # not counted: threads sleep after a rest, and in a fit one rendering follows the other
            times[name].append(case.both())
    truth = cases["torch"].forward()
    pairs = splats_per_pixel(tensors, width, height) * width * height
    bound = pairs * (FLOPS_PER_PAIR[0] + FLOPS_PER_PAIR[1] * (channels + 1)) / peak_gflops() * 1e-6
    torch_ms = np.array([t[1] for t in times["torch"]])
    rows = []
    for name in names:
        forward, total = (np.array(column) for column in zip(*times[name], strict=True))
        out = cases[name].forward()
        difference = (out.colors.detach().cpu() - truth.colors.detach()).abs().flatten()
        sample = difference[torch.linspace(0, len(difference) - 1, min(len(difference), 10**6)).long()]
        rows.append(
            {
                "width": width,
                "height": height,
                "gaussians": n,
                "channels": channels,
                "backend": name,
                "forward_ms": round(float(np.median(forward)), 3),
                "total_ms": round(float(np.median(total)), 3),
                "total_ms_min": round(float(total.min()), 3),
                # of each round, whose measurements lie side by side: the machine's speed changes between rounds
                "times_torch": round(float(np.median(torch_ms / total)), 2),
                "peak_mb": round(memory[name], 1),
                "bound_ms": round(bound, 3),
                "above_bound": round(float(np.median(total)) / bound, 1),
                "splats_per_pixel": round(pairs / width / height, 1),
                "difference_p999": float(f"{float(sample.quantile(0.999)):.2g}"),
            }
        )
    return rows


def fallen_behind(rows: list[dict[str, Any]], baseline: dict[str, float]) -> list[str]:
    """What fell behind: ratios below the floor, or below the baseline by more than TOLERANCE."""
    problems = []
    for row in rows:
        if row["backend"] != "cpu":
            continue
        key, ratio = _key(row), row["times_torch"]
        floor = LEAST_RATIO.get(row["channels"], 0.0)
        if ratio < floor:
            problems.append(f"{key}: {ratio} times the torch back end, the floor is {floor}")
        elif ratio < baseline.get(key, 0.0) * (1 - TOLERANCE):
            problems.append(f"{key}: {ratio} times the torch back end, the baseline is {baseline[key]}")
    return problems


def _key(row: dict[str, Any]) -> str:
    return f"{row['width']}x{row['height']}, {row['gaussians']} Gaussians, {row['channels']} channels"


def about() -> dict[str, Any]:
    """What the numbers depend on besides the machine that :mod:`otsync.bench.record` writes down."""
    return {
        "torch_threads": torch.get_num_threads(),
        "omp_wait_policy": os.environ.get("OMP_WAIT_POLICY"),
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def run(
    out: str | os.PathLike[str],
    *,
    scenes: Sequence[tuple[int, int, int]] = SIZES,
    channels: Sequence[int] = (3, 32),
    repeats: int = 15,
    gate: bool = False,
    with_fit: bool = True,
    rebase: bool = False,
) -> int:
    """Measure, print, and write raster.csv, raster.json and raster.png to the folder `out`; returns an exit code.

    gate: return 1 when a ratio is below its floor or fell behind the committed baseline, twice in a row.
    repeats: rounds of the largest size; smaller ones get more.
    with_fit: measure the toy fit of :mod:`recon.bench.toy` too. rebase: make this run the baseline.
    """
    out = Path(out)
    names, skipped = backends()
    for name, reason in skipped.items():
        print(f"{name}: skipped, {reason}")
    settings = about()
    warmup()
    rows: list[dict[str, Any]] = []
    print("   size              C  back end    forward     total       min  x torch  peak MB  x bound")
    baseline = read_json(record.baseline_path("raster"))["figures"] if gate and not rebase else {}
    for size, c in counted(list(itertools.product(scenes, channels)), "rasterizer", "size"):
        # small scenes are measured more often: a median over a second says little about a machine that others use
        rounds = repeats * max(1, round(math.sqrt(SIZES[-1][2] / size[2])))
        measured = measure(size, c, rounds, names)
        if gate and (problems := fallen_behind(measured, baseline)):
            # a slower renderer is slow both times, a machine that was busy for a while is not
            say(f"measured again, because of {'; '.join(problems)}")
            measured = measure(size, c, rounds, names)
        for row in measured:
            rows.append(row)
            say(
                f"{row['width']:4}x{row['height']:<4}{row['gaussians']:7} {c:4}  {row['backend']:7}"
                f"{row['forward_ms']:10.2f}{row['total_ms']:10.2f}{row['total_ms_min']:10.2f}"
                f"{row['times_torch']:9.1f}{row['peak_mb']:9.0f}{row['above_bound']:9.1f}"
            )
    fit = {"toy_fit": _toy_fit()} if with_fit else {}
    record.write_rows(out, "raster", rows, {**settings, "skipped": skipped, **fit})
    _plot(out, rows)
    if rebase:
        record.save_baseline("raster", {_key(row): row["times_torch"] for row in rows if row["backend"] == "cpu"})
    problems = fallen_behind(rows, baseline) if gate else []
    for problem in problems:
        print("behind:", problem)
    return 1 if problems else 0


def _toy_fit() -> dict[str, float]:
    from recon.bench import toy

    start, cpu = time.perf_counter(), time.process_time()
    result = toy.fit(toy.world())
    seconds = {"seconds": round(time.perf_counter() - start, 2), "cpu_seconds": round(time.process_time() - cpu, 2)}
    worst = float(result.errors.abs().max())
    print(f"toy fit: {seconds['cpu_seconds']} CPU-s, offsets to {worst:.4f} frame")
    return {**seconds, "largest_error_frames": round(worst, 5), "steps": result.steps}


def _plot(out: Path, rows: list[dict[str, Any]]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4))
    for name in dict.fromkeys(row["backend"] for row in rows):
        for c in dict.fromkeys(row["channels"] for row in rows):
            chosen = [row for row in rows if row["backend"] == name and row["channels"] == c]
            pixels = [row["width"] * row["height"] for row in chosen]
            axes.loglog(pixels, [row["total_ms"] for row in chosen], "o-", label=f"{name}, {c} channels")
    axes.set(xlabel="pixels (about 50 splats each)", ylabel="ms forward + backward")
    axes.legend()
    figure.tight_layout()
    with atomic_write(out / "raster.png") as file:
        figure.savefig(file, format="png", dpi=120)
    plt.close(figure)
