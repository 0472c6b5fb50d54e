"""polysync's sidecars: ``<video>.sync.json`` beside each video that it aligned by sound.

``delta_seconds``: the source's start on the reference's clock, positive where it started later, as ours. Sound travels
3 ms a metre: cameras far from each other hear it late, which no sidecar knows.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from ...files.arrays import read_json
from ..datasets.common import numbers, told
from .slot import Filmed, Known

SUFFIX = ".sync.json"
UNVERIFIED = 0.02
"""Seconds: sigma of an alignment that polysync did not verify: some 6 m of sound, and its own 10 ms."""

SOUND = 0.01
"""Seconds that are added to what polysync says of its spread: 3 m of sound."""


class Polysync:
    """polysync, aligned by sound."""

    name = "polysync"
    looks_for = f"a folder with *{SUFFIX}, or one such file"

    def claims(self, path: Path) -> bool:
        return bool(_sidecars(path))

    def edges(self, path: Path, filmed: Filmed) -> list[Known]:
        files = _sidecars(path)
        if not files:
            raise ValueError(f"{path}: expected {self.looks_for}; found none. Run polysync, or check the path.")
        return [told(file, "source, reference and delta_seconds", partial(_edge, file, filmed)) for file in files]


def _sidecars(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(path.glob(f"*{SUFFIX}"))
    return [path] if path.name.endswith(SUFFIX) else []


def _edge(file: Path, filmed: Filmed) -> Known:
    data = read_json(file)
    if data.get("schema_version") != 1:
        raise ValueError(
            f"{file}: schema_version: expected 1; found {data.get('schema_version')!r}. Use another polysync."
        )
    a, b = (filmed.index(Path(str(data[field])).name, f"{file}: {field}") for field in ("reference", "source"))
    if a == b:
        raise ValueError(f"{file}: expected two videos; source and reference are the same. Run polysync again.")
    late = float(numbers(data["delta_seconds"], (), f"{file}: delta_seconds"))
    checked = data.get("verification") or {}
    spread = checked.get("residual_spread_ms")
    sigma = UNVERIFIED
    if spread is not None:
        sigma = SOUND + abs(float(numbers(spread, (), f"{file}: verification.residual_spread_ms"))) / 1000
    return Known(a, b, late, sigma, str(file))
