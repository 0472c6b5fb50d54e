"""The time that effects take: one that is not in the tuple takes none, each other one only its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import Any

from ..progress import counted
from ..simulate import PRESETS, simulate


def effect_costs(motion: str = "juggle", tracks: int = 140, repeats: int = 15) -> list[dict[str, Any]]:
    """Milliseconds of two videos without effects, with each effect of the hardest preset alone, and with all.

    The first row is a world whose preset has no effects, the second one of the hardest preset with ``effects=()``:
    their ratio is the price of absent effects, 1 but for noise. Runs are interleaved, so that a busy machine slows all
    rows alike; medians over ``repeats``.
    """
    brutal = PRESETS["brutal"]
    bare = replace(brutal, effects=())

    def world(preset: Any, effects: Any) -> Callable[[int], Any]:
        return lambda seed: simulate(motion, preset=preset, effects=effects, tracks=tracks, seed=seed)

    cases = {"none": world(bare, None), "absent": world(brutal, ())}
    cases |= {type(e).__name__: world(brutal, (e,)) for e in brutal.effects}
    cases["all"] = world(brutal, None)
    taken: dict[str, list[float]] = {name: [] for name in cases}
    for run in cases.values():
        run(0)
    for seed in counted(range(repeats), "effects", "round"):
        for name, run in cases.items():
            start = time.perf_counter()
            run(seed)
            taken[name].append(1e3 * (time.perf_counter() - start))
    base = median(taken["none"])
    return [{"effects": n, "ms": median(ts), "times none": median(ts) / base} for n, ts in taken.items()]
