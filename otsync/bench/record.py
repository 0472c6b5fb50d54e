"""Shared by all benchmarks: machine and versions, tables on disk, the gate against a committed baseline."""

from __future__ import annotations

import csv
import io
import math
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from ..files.arrays import atomic_write, read_json, write_json

Row = Mapping[str, Any]

PACKAGES = ("otsync", "numpy", "scipy", "POT", "tslearn", "numba", "torch")


def machine() -> dict[str, Any]:
    """Processor, cores, memory, Python and package versions: without them a figure means nothing."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "load_at_start": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
    }


def write_rows(out: Path, name: str, rows: Sequence[Row], about: Mapping[str, Any] | None = None) -> None:
    """``name.csv`` and ``name.json`` (with the machine), atomically."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_write(out / f"{name}.csv", "w") as stream:
        stream.write(text.getvalue())
    write_json(out / f"{name}.json", {"machine": machine(), **(about or {}), "rows": list(rows)})


def table(rows: Sequence[Row], columns: Sequence[str] | None = None) -> str:
    """Rows as aligned text."""
    columns = columns or list(dict.fromkeys(key for row in rows for key in row))
    cells = [list(columns)] + [[_cell(row.get(c)) for c in columns] for row in rows]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    numeric = [all(isinstance(row.get(c), int | float | None) for row in rows) for c in columns]
    return "\n".join(
        "  ".join(
            cell.rjust(w) if right else cell.ljust(w) for cell, w, right in zip(line, widths, numeric, strict=True)
        )
        for line in cells
    )


def gate(name: str, measured: Mapping[str, float], worse: Callable[[str, float, float], bool]) -> int:
    """Compare figures with the committed baseline and print what got worse; 0 when nothing did, else 1.

    Figures that the baseline does not have are not compared; those of it that were not measured fail.

    Args:
        worse: ``worse(key, measured, baseline)``, with the tolerance that the figure's kind calls for.
    """
    baseline = baseline_of(name)
    missing = sorted(set(baseline) - set(measured))
    compared = {key: value for key, value in measured.items() if key in baseline}
    failed = [key for key, value in compared.items() if not math.isfinite(value) or worse(key, value, baseline[key])]
    for key in failed:
        print(f"gate {name}: {key}: {measured[key]:.4g}, baseline {baseline[key]:.4g}", file=sys.stderr)
    for key in missing:
        print(f"gate {name}: {key} is in the baseline and was not measured", file=sys.stderr)
    if not failed and not missing:
        print(f"gate {name}: {len(compared)} figure{'s'[: len(compared) != 1]} no worse than the baseline")
    return 1 if failed or missing else 0


def baseline_of(name: str) -> dict[str, float]:
    """The figures of a suite's baseline. ValueError where there is none."""
    path = baseline_path(name)
    if not path.exists():
        raise ValueError(f"{path}: expected a baseline; found none. Make one by --rebase.")
    return read_json(path)["figures"]


def save_baseline(name: str, figures: Mapping[str, float]) -> None:
    """Make the figures the baseline of the gate; commit the file."""
    write_json(baseline_path(name), {"machine": machine(), "figures": dict(figures)})


def baseline_path(name: str) -> Path:
    """The file of a suite's baseline, beside the code that it judges: in an installed package too."""
    return Path(__file__).parent / "baselines" / f"{name}.json"


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def run_python(code: str) -> str:
    """Output of a fresh interpreter."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
