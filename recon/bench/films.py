"""``otsync bench films``: whether sigma holds on recordings, by route, and after the photometric fit.

Small scenes are filmed (``recon simulate``: two smooth bodies that turn and walk, whose tracks slide alike) and
synchronised from their images: with depth, from pixels, with depth by stereo. ``fit`` is the photometric fit that
begins from the answer with depth. An answer is wrong where it is off by more than a frame.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from otsync.bench.record import Row, table, write_rows
from otsync.bench.sync_acceptance import WRONG
from otsync.compute.threads import MapLike, pool_of
from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.io.scene import Scene
from otsync.progress import Progress, tell
from otsync.recordings.routes import synchronize_scene
from otsync.types import Offsets
from recon.fit.options import FitOptions
from recon.pipeline.plan import Plan
from recon.pipeline.verb import reconstruct
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture

APART = True
"""Takes long (a fit a scene): no part of ``otsync bench all``."""

FIRST_SEED = 120
"""Seeds below were looked at while sigma was built."""

FILMS = ((90, 6), (60, 4), (75, 5))
"""Frames and cameras of the scenes, in turns."""

MAX_OFFSET = 8.0

ROUTES: dict[str, Any] = {"depth": "tracks", "pixels": "epipolar", "stereo": "stereo"}

FIT = "fit"

PLAN = Plan(width=160, backdrop_steps=500, fit=FitOptions(steps=300))


def run(
    out: Path,
    *,
    seeds: int = 12,
    first_seed: int = FIRST_SEED,
    only: tuple[str, ...] = (),
    cache: Path | None = None,
) -> int:
    """Measure, print and write a row a video and a row a route; 1 where a trusted answer is wrong.

    Films, stages and fits are kept in ``cache``: a run that was killed goes on from there. Where the code of a stage or
    of the fit has changed, give another folder.

    Args:
        seeds: scenes. first_seed: where they begin. only: routes, of depth, pixels, stereo and fit; default: all.
        cache: default: ``films`` in ``out``.

    Raises:
        ValueError: for a route that there is not.
    """
    known = (*ROUTES, FIT)
    if unknown := [name for name in only if name not in known]:
        raise ValueError(f"--only: expected routes among {', '.join(known)}; found {unknown[0]}.")
    home = Path(cache or out / "films")
    rows: list[Row] = []
    with pool_of(os.cpu_count() or 1) as pool:
        for n in range(seeds):
            for row in answers(home, first_seed + n, FILMS[n % len(FILMS)], only or known, pool.map):
                rows.append(row)
    about = {"seeds": seeds, "first_seed": first_seed}
    write_rows(out, "films", rows, about)
    routes = [summary(route, [r for r in rows if r["route"] == route]) for route in only or known]
    write_rows(out, "films_routes", routes, about)
    print(table(routes), flush=True)
    return 1 if any(row["wrong"] for row in routes) else 0


def answers(home: Path, seed: int, film: tuple[int, int], routes: Sequence[str], map: MapLike) -> Iterator[Row]:
    """A row a video and a route of one scene."""
    frames, cameras = film
    folder = home / f"{seed}-{frames}-{cameras}"
    if not (folder / "recording" / "scene.json").exists():
        tell(f"film {seed}: {cameras} cameras, {frames} frames")
        capture = synthetic(seed, cameras=cameras, held_out=0, frames=frames, offsets=MAX_OFFSET)
        write_capture(capture, folder / "recording")
    scene, truth = open_scene(folder / "recording"), Offsets.load(folder / "recording" / "truth.json")
    cache = Cache(folder / "stages")
    found: Offsets | None = None
    depth: Offsets | None = None
    for route in routes:
        tell(f"film {seed}: {route}")
        if route == FIT:
            found = fitted(scene, depth or synchronized(scene, "depth", cache, map), folder / "result", cache, map)
        else:
            found = synchronized(scene, route, cache, map)
        depth = found if route == "depth" else depth
        yield from told(route, seed, scene.names, found, truth)


def synchronized(scene: Scene, route: str, cache: Cache, map: MapLike) -> Offsets | None:
    """None where stereo refuses a scene: it needs five cameras around it."""
    try:
        return synchronize_scene(scene, route=ROUTES[route], cache=cache, map=map).offsets
    except ValueError as error:
        if route != "stereo":
            raise
        tell(f"stereo refuses: {error}")
        return None


def fitted(scene: Scene, start: Offsets | None, out: Path, cache: Cache, map: MapLike) -> Offsets:
    """The clocks of the photometric fit."""
    assert start is not None
    quiet = Progress(lambda _: None)
    return reconstruct(scene, start, out, plan=PLAN, cache=cache, map=map, progress=quiet).fitted.offsets


def told(route: str, seed: int, names: Sequence[str], found: Offsets | None, truth: Offsets) -> Iterator[Row]:
    """A row for every video but the first, which is the reference; without error and sigma where there is no answer."""
    reference = truth.names.index(names[0])
    for name in names[1:]:
        row: dict[str, Any] = {
            "route": route,
            "seed": seed,
            "video": name,
            "error": None,
            "sigma": None,
            "trusted": False,
        }
        # a fit leaves out what was not synchronised
        v = found.names.index(name) if found is not None and name in found.names else None
        if found is None or v is None:
            yield row | {"flags": "refused"}
            continue
        row["flags"] = " ".join(flag.code for flag in found.flags[v])
        if np.isfinite(found.seconds[v]) and found.component[v] == 0:
            known = truth.between(reference, truth.names.index(name))
            row["error"] = float(abs(found.between(0, v) - known) * found.fps[0])
            row["sigma"] = float(found.sigma[v] * found.fps[0])
            row["trusted"] = found.status[v].ok
        yield row


def summary(route: str, rows: Sequence[Row]) -> Row:
    """How well sigma covers the answers of a route, trusted or not, and how many are trusted."""
    known = [r for r in rows if r["error"] is not None]
    error, sigma = (np.array([r[k] for r in known], float) for k in ("error", "sigma"))
    trusted = np.array([r["trusted"] for r in known], bool)

    def share(inside: np.ndarray) -> float | None:
        return float(inside.mean()) if len(inside) else None

    return {
        "route": route,
        "videos": len(rows),
        "answers": len(known),
        "1 sigma": share(error <= sigma),
        "2 sigma": share(error <= 2 * sigma),
        "median error": float(np.median(error)) if len(error) else None,
        "median sigma": float(np.median(sigma)) if len(error) else None,
        "over a frame": int((error > WRONG).sum()),
        "trusted": int(trusted.sum()),
        "wrong": int((error[trusted] > WRONG).sum()),
    }
