"""``otsync bench``."""

from __future__ import annotations

import dataclasses
import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from ..bench import suites
from ..files.claim import refuse_others

BENCH_OPTIONS = (
    "scene",
    "gate",
    "rebase",
    "promises",
    "first_seed",
    "seeds",
    "only",
    "sizes",
    "limit",
    "features",
    "json",
    "cache",
    "against",
)
"""Options that a suite may take: each is handed on when it is set, and refused by suites that do not take it."""


def suite_names() -> Any:
    """The type of the suite: one of those that there are when the command line is parsed."""
    return Literal[(*suites(), "all")]


@dataclass
class Bench:
    """What accuracy costs in time: tables, CSV, JSON and plots, with machine and versions.

    Example: otsync bench sync --out bench/out --gate

    Your own matcher through the catalogue of hard cases: otsync --plugin mine.py bench hard-cases --only my-matcher

    On a truly synchronised recording: otsync bench panoptic recording/ --json
    """

    suite: tyro.conf.Positional[suite_names()]
    """Which benchmark; "all": every one that needs no recording, but for films, thresholds and scale, which take
    hours."""
    scene: tyro.conf.Positional[Path | None] = None
    """A truly synchronised recording (its folder or scene.json): of panoptic, audit, shifts, breaks, ball and budget;
    if you like, of chain, own-frames and calibrate."""
    out: Path = Path("bench/out")
    """Folder for CSV, JSON and plots."""
    gate: bool = False
    """Compare with the committed baseline; exit code 1 when something got worse."""
    rebase: bool = False
    """Make the figures of this run the baseline that --gate compares with."""
    promises: bool = False
    """For sync and match: measure what is promised, on fresh seeds, instead of the tables; for trust: exit code 1 where
    it is not kept."""
    first_seed: int | None = None
    """For core, match, sync, panoptic, chain, own-frames, trust, thresholds, calibrate, audit, shifts, breaks, scale
    and budget: where they begin; default: the suite's own."""
    seeds: int | None = None
    """For core, match, sync, chain, own-frames, trust, thresholds, calibrate, audit, shifts and breaks: how many;
    default: the suite's own."""
    only: tuple[str, ...] = ()
    """For match, hard-cases and chain: names of the solvers to run; for calibrate of the worlds, for trust of the
    classes, for thresholds of the limits, for scale of the sizes; default: all."""
    sizes: tuple[int, ...] = ()
    """For match: numbers of tracks; default: 200 to 50,000. For budget: seconds; default: 90 to 450."""
    limit: float | None = None
    """For match: CPU seconds that a matcher may take for a world; default: 60."""
    features: str | None = None
    """For panoptic: what describes tracks, as of --recording.features; default: the features of recordings."""
    json: bool = False
    """For panoptic and own-frames: one line of JSON on standard output instead of tables."""
    cache: Path | None = None
    """For panoptic, chain, own-frames, calibrate, audit, shifts and breaks: where tracks and depth are kept; default:
    stages in --out. For scale: where films are kept; default: films in --out."""
    against: tuple[Path, ...] = ()
    """For ball: offsets.json of finished answers on this recording, each held against what the ball tells."""

    def run(self) -> int:
        self._check()
        refuse_others(self.out, "otsync bench")
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        given = {n: getattr(self, n) for n in BENCH_OPTIONS if getattr(self, n) != defaults[n]}
        every = suites()
        if self.suite != "all":
            return self._run(self.suite, every[self.suite](), given)
        loaded = {name: load() for name, load in every.items()}
        alone = {
            n: suite for n, suite in loaded.items() if not needs_more(suite) and not getattr(suite, "APART", False)
        }
        return max(self._run(name, suite, given) for name, suite in alone.items())

    def _run(self, name: str, suite: Any, given: dict[str, Any]) -> int:
        takes = inspect.signature(suite.run).parameters
        anything = any(p.kind is p.VAR_KEYWORD for p in takes.values())
        for option in given:
            if option not in takes and not anything:
                options = ", ".join(spelled(o) for o in BENCH_OPTIONS if o in takes) or "none of them"
                raise ValueError(f"{spelled(option)}: benchmark {name} does not take it. It takes {options}.")
        if "scene" in needs_more(suite) and "scene" not in given:
            raise ValueError(f"scene: expected a recording: otsync bench {name} SCENE.")
        return suite.run(self.out, **given)

    def _check(self) -> None:
        if self.gate and self.rebase:
            raise ValueError("--gate, --rebase: expected one of them; a run is no judge of itself.")
        for name, least in (("first_seed", 0), ("seeds", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{spelled(name)}: expected {least} or more; found {value}.")
        if any(size < 1 for size in self.sizes):
            raise ValueError(f"--sizes: expected 1 or more; found {self.sizes}.")
        if self.limit is not None and not self.limit > 0:
            raise ValueError(f"--limit: expected seconds above 0; found {self.limit}.")
        for name in ("first_seed", "seeds", "only", "promises", "sizes", "limit", "features"):
            if (self.gate or self.rebase) and getattr(self, name) not in (None, (), False):
                raise ValueError(
                    f"{spelled(name)}: expected without --gate and --rebase: a baseline is of the suite's own runs."
                )


def needs_more(suite: Any) -> set[str]:
    """What a suite must be given besides the folder that it writes to."""
    parameters = inspect.signature(suite.run).parameters.values()
    required = [p for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
    return {p.name for p in required[1:]}


def spelled(option: str) -> str:
    """As on the command line."""
    return option if option == "scene" else f"--{option.replace('_', '-')}"
