"""Benchmarks: accuracy against time, as tables, CSV, JSON and plots, with machine and versions.

core.py    the paper's ablation and its DTW, import time, the cost of no effect
match.py   every matcher at every size; match_limits.py: what matching promises
sync.py    aligners, refiners and graphs; sync_acceptance.py: what synchronisation promises
chain/     matchers x aligners x rematching, to frames of the offset; gate.py: the default chain alone
hard_cases/  the catalogue of hard cases, and running it
panoptic.py  the paper's protocol on a truly synchronised recording
own_frames.py  clock and pose without a common frame, on worlds and on a truly synchronised recording
calibrate.py  cameras from videos alone, against simulated and given ones
rig/  synchronised recordings: one camera moved, all videos begun at other frames, pictures lost and repeated, a ball as
      a witness of their clocks
trust/  whether "ok" is right: classes of worlds, claims and errors; thresholds.py: the limits behind the flags
record.py  tables on disk, machine and versions, the gate against a committed baseline
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial
from importlib.metadata import EntryPoint
from typing import Any

from ..plugins import entries, registered

OWN = {
    "core": "core",
    "match": "match",
    "sync": "sync",
    "hard-cases": "hard_cases.run",
    "panoptic": "panoptic",
    "chain": "chain.run",
    "own-frames": "own_frames",
    "trust": "trust.run",
    "thresholds": "trust.thresholds",
    "calibrate": "calibrate",
    "audit": "rig.audit",
    "shifts": "rig.shifts",
    "breaks": "rig.breaks",
    "ball": "rig.ball",
}
"""Our own suites, and where they are."""


def suites() -> dict[str, Callable[[], Any]]:
    """Benchmark suites by name, ours first, then plugins': call one to load it.

    What is loaded is a module, or an object, with ``run(out, *, gate=False, rebase=False, ...)`` -> exit code.
    ValueError names two suites of one name; a call raises it where a plugin does not import.
    """
    loaders: dict[str, Callable[[], Any]] = {
        name: partial(importlib.import_module, f"{__name__}.{place}") for name, place in OWN.items()
    }
    others = [(name, partial(_load, point)) for name, point in entries("benchmarks").items()]
    others += [(name, partial(_given, suite)) for name, suite in registered("benchmarks").items()]
    for name, loader in others:
        if name in loaders:
            raise ValueError(f"benchmarks: expected a name for each suite; found two named {name!r}. Rename one.")
        loaders[name] = loader
    return loaders


def _load(point: EntryPoint) -> Any:
    try:
        return _given(point.load())
    except ImportError as error:
        raise ValueError(
            f"benchmark {point.name}: expected {point.value} to import; found {error}. Install what it needs."
        ) from error


def _given(suite: Any) -> Any:
    """A suite that is a class is made."""
    return suite() if isinstance(suite, type) else suite
