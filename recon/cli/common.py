"""Shared by the commands of reconstruction: opening a scene, running the pipeline, and printing its outcome."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from otsync.compute.threads import pool_of
from otsync.progress import Deadline, Progress, tell
from recon.cli.tables import offset_rows, offset_table, view_table

if TYPE_CHECKING:
    from otsync.io import Scene
    from otsync.types import Offsets
    from recon.pipeline.plan import Plan

BUDGET = 300.0
"""Seconds of a fit that the shell is told no length of."""


def deadline_of(plan: Plan) -> Deadline | None:
    """The end of the command, from now on, where --budget says how long it may take."""
    return None if plan.fit.budget is None else Deadline(plan.fit.budget)


def with_length(plan: Plan) -> Plan:
    """The plan with the shell's budget, where it has neither steps nor a budget."""
    if plan.fit.steps is not None or plan.fit.budget is not None:
        return plan
    return replace(plan, fit=replace(plan.fit, budget=BUDGET))


def opened(path: Path, allow_outside: bool) -> Scene:
    """The scene at ``path``; what its reader assumed goes to stderr."""
    from otsync.io import open_scene

    scene = open_scene(path, allow_outside=allow_outside)
    for note in scene.notes:
        tell(f"note: {note}")
    return scene


def print_json(document: Any) -> None:
    """One document on standard output; numbers that are none become null."""
    print(json.dumps(_plain(document), allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and value - value != 0 else value


def reconstructed(
    scene: Scene,
    offsets: Offsets,
    out: Path,
    plan: Plan,
    *,
    held_out: tuple[str, ...] = (),
    tracks: Any = None,
    truth: Path | None = None,
    priors: Any = None,
    cache: Path | None = None,
    workers: int = 0,
    as_json: bool = False,
    progress: Progress | None = None,
    deadline: Deadline | None = None,
    watch: Any = None,
) -> int:
    """Prepare, fit, evaluate, write, and print the outcome; the exit code."""
    from otsync.files.cache import Cache
    from otsync.types import Offsets, Status
    from recon.pipeline.verb import reconstruct
    from recon.result.folder import metrics_of
    from recon.result.page import SCENE_PAGE

    if workers < 0:
        raise ValueError(f"--workers: expected 0 (one per core) or more; found {workers}.")
    known = None if truth is None else Offsets.load(truth)
    with pool_of(workers or os.cpu_count() or 1) as pool:
        outcome = reconstruct(
            scene,
            offsets,
            out,
            plan=plan,
            tracks=tracks,
            held_out=held_out,
            truth=known,
            priors=priors,
            cache=Cache(cache or out / "stages"),
            map=pool.map,
            progress=progress or Progress(tell),
            deadline=deadline,
            watch=watch,
        )
    parts = [out / name for name in ("scene.npz", "offsets.json", "metrics.json", "report.html")]
    wrote = f"wrote {', '.join(map(str, parts))} and {out / SCENE_PAGE}, which plays the scene in a browser"
    # a start that is only coarse is what a fit is for: its own answer is judged by its own sigma
    fitted, before = outcome.fitted.offsets, dict(zip(outcome.coarse.names, outcome.coarse.flags, strict=True))
    begun = [n for n, end in zip(fitted.names, fitted.status, strict=True) if before[n] and not end.ok]
    # the fit's own doubts; after few steps it knows a clock no better than to a frame, which its sigma says
    raised = {
        n: [f for f in flags if f not in (*before[n], Status.COARSE)]
        for n, flags in zip(fitted.names, fitted.flags, strict=True)
    }
    doubtful = [n for n in fitted.names if n in begun or raised[n]]
    if as_json:
        figures = metrics_of(outcome.views, outcome.fitted.stats, outcome.lpips_reason)
        told = {"out": str(out), "offsets": offset_rows(outcome), "doubtful": doubtful, "metrics": figures}
        print_json(told | {"left_out": list(outcome.left_out)})
        tell(wrote)
    else:
        print(offset_table(outcome))
        print(view_table(outcome.views, outcome.lpips_reason))
        print(wrote)
    if begun:
        print(f"begun from offsets that are not to be trusted: {', '.join(begun)}", file=sys.stderr)
    for name, flags in raised.items():
        for flag in flags:
            print(f"{name}: {flag.code}: {flag}", file=sys.stderr)
    return 1 if doubtful or outcome.left_out else 0
