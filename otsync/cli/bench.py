"""``otsync bench``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

SUITES = {
    "core": "otsync.bench.core",
    "match": "otsync.bench.match",
    "sync": "otsync.bench.sync",
    "raster": "recon.bench_raster",
}


@dataclass
class Bench:
    """What accuracy costs in time: tables, CSV, JSON and plots, with machine and versions.

    Example: otsync bench sync --out bench/out --gate

    On a truly synchronised recording: otsync bench panoptic recording/ --json
    """

    suite: tyro.conf.Positional[Literal["core", "match", "sync", "raster", "panoptic", "all"]]
    scene: tyro.conf.Positional[Path | None] = None
    """For panoptic: a truly synchronised recording (its folder or scene.json). "all" leaves it out."""
    out: Path = Path("bench/out")
    """Folder for CSV, JSON and plots."""
    gate: bool = False
    """Compare with the committed baseline; exit code 1 when something got worse."""
    rebase: bool = False
    """Make the figures of this run the baseline that --gate compares with."""
    promises: bool = False
    """For sync and match: measure what is promised, on fresh seeds, instead of the tables."""
    first_seed: int | None = None
    """For core, match and sync: where the seeds begin; for panoptic: its seed; default: the suite's own."""
    seeds: int | None = None
    """For core, match and sync: how many seeds; default: the suite's own."""
    json: bool = False
    """For panoptic: one line of JSON on standard output instead of tables."""
    cache: Path | None = None
    """For panoptic: where tracks and depth are kept; default: stages in --out."""

    def run(self) -> int:
        import importlib

        if self.gate and self.rebase:
            raise ValueError("--gate, --rebase: expected one of them; a run is no judge of itself.")
        drawn = self._seeds()
        if self.suite == "panoptic":
            if self.scene is None:
                raise ValueError("scene: expected a recording: otsync bench panoptic SCENE.")
            from ..bench import panoptic

            protocol = panoptic.Protocol() if self.first_seed is None else panoptic.Protocol(seed=self.first_seed)
            return panoptic.run(self.scene, self.out, json=self.json, cache=self.cache, protocol=protocol)
        if self.promises:
            from ..bench import match_limits
            from ..bench import sync as sync_bench

            if self.suite not in ("match", "sync"):
                raise ValueError(f"--promises: expected suite match or sync; found {self.suite}.")
            if self.suite == "match":
                return match_limits.run(self.out, **drawn)
            return sync_bench.run(self.out, promises=True, **drawn)
        suites = SUITES.values() if self.suite == "all" else [SUITES[self.suite]]
        modules = [importlib.import_module(name) for name in suites]
        return max(module.run(self.out, gate=self.gate, rebase=self.rebase, **drawn) for module in modules)

    def _seeds(self) -> dict[str, Any]:
        """The options that choose seeds, as far as they are given. ValueError where nothing would heed them."""
        drawn = {k: v for k, v in (("first_seed", self.first_seed), ("seeds", self.seeds)) if v is not None}
        for name, value in drawn.items():
            option, least = f"--{name.replace('_', '-')}", int(name == "seeds")
            heeded = ("core", "match", "sync", *(("panoptic",) if name == "first_seed" else ()))
            if self.suite not in heeded:
                raise ValueError(f"{option}: expected with suite {', '.join(heeded)}; found {self.suite}.")
            if self.gate or self.rebase:
                raise ValueError(
                    f"{option}: expected without --gate and --rebase: a baseline is of the suite's own seeds."
                )
            if value < least:
                raise ValueError(f"{option}: expected {least} or more; found {value}.")
        return drawn
