"""What the commands of reconstruction share: opening a scene, running the pipeline, and its outcome in words."""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.cli.options import FitOptions
from recon.cli.tables import offset_table, view_table

if TYPE_CHECKING:
    from otsync.io import Scene
    from otsync.progress import Progress
    from otsync.types import Offsets


def tell(text: str) -> None:
    """A line of progress."""
    print(text, file=sys.stderr, flush=True)


def opened(path: Path, allow_outside: bool) -> Scene:
    """The scene at ``path``; what its reader assumed goes to stderr."""
    from otsync.io import open_scene

    scene = open_scene(path, allow_outside=allow_outside)
    for note in scene.notes:
        tell(f"note: {note}")
    return scene


def reconstructed(
    scene: Scene,
    offsets: Offsets,
    out: Path,
    options: FitOptions,
    *,
    tracks: Any = None,
    truth: Path | None = None,
    progress: Progress | None = None,
) -> int:
    """Prepare, fit, evaluate, write, and print what came out; the exit code."""
    from otsync.files.cache import Cache
    from otsync.progress import Progress
    from otsync.types import Offsets
    from recon.pipeline.verb import reconstruct

    known = None if truth is None else Offsets.load(truth)
    with ThreadPoolExecutor(options.workers or os.cpu_count() or 1) as pool:
        outcome = reconstruct(
            scene,
            offsets,
            out,
            plan=options.plan(),
            tracks=tracks,
            held_out=options.held_out,
            truth=known,
            cache=Cache(options.cache or out / "stages"),
            map=pool.map,
            progress=progress or Progress(tell),
            **options.length(),
        )
    print(offset_table(outcome))
    print(view_table(outcome.views, outcome.lpips_reason))
    print(f"wrote {out / 'scene.npz'}, {out / 'offsets.json'}, {out / 'metrics.json'} and {out / 'report.html'}")
    doubtful = [n for n, s in zip(outcome.coarse.names, outcome.coarse.status, strict=True) if not s.ok]
    if doubtful:
        print(f"begun from offsets that are not to be trusted: {', '.join(doubtful)}", file=sys.stderr)
    return 1 if doubtful or outcome.left_out else 0
