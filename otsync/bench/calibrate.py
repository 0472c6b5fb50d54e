"""Cameras from videos alone: simulated phones, and subsets of a recording whose calibration is known.

``otsync bench calibrate`` films rooms; ``otsync bench calibrate RECORDING`` takes cameras of a static rig, their lenses
given. A camera is right within 2 degrees and 20 cm, once all that were found are laid over the true ones.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from ..calibrate import CalibrateOptions, Calibration, calibrate
from ..calibrate.clips import Clip, Lens
from ..calibrate.document import calibrated_document
from ..calibrate.verb import calibrate_clips
from ..calibrate.world import centres, degrees, laid_over
from ..files.cache import Cache
from ..geometry import common_target
from ..io import open_scene
from ..io.readers import describe_folder
from ..io.scene import Scene, scene_from_document
from ..progress import tell
from ..recordings import synchronize_scene
from ..simulate.phones import Hand, PhoneTruth, Tripod, film
from ..types import Camera
from .record import table, write_rows

RIGHT_TURN, RIGHT_PLACE = 2.0, 0.2
"""Degrees and metres within which a camera is right."""

DISTANCE = 2.5
"""Metres from a simulated phone to where it looks: places are told as shares of it too."""

POINTS = 150
"""Of the scene, by which the cameras' residual is measured."""

BEHIND = 1e4
"""Pixels that a point behind a camera misses."""

LATE, CLIP = 30, 120
"""Frames by which clips of a rig begin late at the most, and how many they have."""

NEIGHBOURS = 8
"""Cameras of a rig that are calibrated together."""

KINDS: dict[str, dict[str, Any]] = {
    "walk 24": {},
    "walk 12": {"key_frames": 12},
    "no walk": {"walk": 0},
    "hands": {"held": Hand(), "phones": 6, "gap": 40.0, "walk": 0},
}
"""What is filmed: four tripods 80 degrees apart with a walk of so many key frames, and without; six phones in hands."""


def run(
    out: Path,
    *,
    scene: Path | None = None,
    first_seed: int = 9000,
    seeds: int = 3,
    only: tuple[str, ...] = (),
    cache: Path | None = None,
) -> int:
    """Measure and write ``calibrate.csv`` and ``calibrate.json``; 1 where a camera is wrong and not flagged.

    Args:
        only: of the simulated worlds (walk 24, walk 12, no walk, hands) and "sync".
    """
    wanted = only or (*KINDS, "sync")
    unknown = sorted(set(wanted) - {*KINDS, "sync"})
    if unknown:
        raise ValueError(f"--only: expected some of {', '.join((*KINDS, 'sync'))}; found {', '.join(unknown)}.")
    rows = []
    for seed in range(first_seed, first_seed + seeds):
        if scene is not None:
            rows += rig_rows(open_scene(scene), seed, Cache(cache or out / "stages"), "sync" in wanted)
        else:
            rows += room_rows(seed, wanted)
        print(table(rows), flush=True)
        write_rows(out, "calibrate", rows)
    return 1 if any(row["wrong_unflagged"] for row in rows) else 0


def errors(
    found: Calibration, truth: dict[str, Camera], fps: float = 30.0
) -> tuple[dict[str, tuple[float, float]], dict[str, float]]:
    """By video: (degrees, metres) of its worst frame; and the relative error of its focal length."""
    cameras = [camera for camera in found.cameras if camera.w2c is not None]
    if len(cameras) < 2:
        return {}, {}
    poses = {c.name: c.w2c.reshape(-1, 4, 4) for c in cameras if c.w2c is not None}
    true = {name: truth[name].w2c.reshape(-1, 4, 4) for name in poses}
    a, b = (np.concatenate([some[name][:: max(1, len(some[name]) // 20)] for name in poses]) for some in (poses, true))
    over = laid_over(a, b)
    worst = {}
    for name, w2c in poses.items():
        moved, there = over.camera(w2c), true[name]
        turn = degrees(moved[:, :3, :3] @ np.swapaxes(there[:, :3, :3], 1, 2))
        worst[name] = float(turn.max()), float(np.linalg.norm(centres(moved) - centres(there), axis=1).max())
    return worst, {c.name: abs(float(c.K[0, 0] / truth[c.name].K[0, 0] - 1)) for c in cameras}


def residual(found: Calibration, truth: dict[str, Camera], right: Collection[str], seed: int = 0) -> float | None:
    """Pixels at 640 of width that points of the scene miss, as the median over cameras that are right: points between
    the cameras are seen through the true ones, triangulated with those that were found, and projected again.

    None for fewer than two cameras. Pixels are those of ideal pinholes. Needs no frame in common, and tells what a
    reconstruction suffers.
    """
    named = [camera for camera in found.found if camera.name in right]
    if len(named) < 2:
        return None
    first = {c.name: (truth[c.name], Camera(c.K, _first(c.w2c), c.width, c.height, c.distortion)) for c in named}
    true, mine = zip(*first.values(), strict=True)
    middle = common_target(list(truth.values()))
    reach = 0.5 * float(np.median([np.linalg.norm(np.atleast_2d(c.center)[0] - middle) for c in truth.values()]))
    xyz = middle + np.random.default_rng(seed).uniform(-reach, reach, (POINTS, 3))
    seen = [replace(c, w2c=_first(c.w2c)).project(xyz[:, None])[:, 0] for c in true]
    inside = [((uv > 0) & (uv < [c.width, c.height])).all(1) for uv, c in zip(seen, true, strict=True)]
    off = []
    for p in np.flatnonzero(np.sum(inside, 0) >= 2):
        views = [v for v in range(len(mine)) if inside[v][p]]
        rays = [(mine[v], seen[v][p]) for v in views]
        xyz_found = _triangulated(rays)
        again = np.array([camera.project(xyz_found[None, None])[0, 0] for camera, _ in rays])
        wide = np.array([640 / camera.width for camera, _ in rays])
        off += (np.linalg.norm(again - [uv for _, uv in rays], axis=1) * wide).tolist()
    return round(float(np.median(off)), 3) if off else None


def _first(w2c: np.ndarray | None) -> np.ndarray:
    """The pose at the beginning."""
    assert w2c is not None
    return w2c.reshape(-1, 4, 4)[0]


def _triangulated(rays: Sequence[tuple[Camera, np.ndarray]]) -> np.ndarray:
    """The point whose pixels are nearest to those given, by least squares from the linear answer."""
    rows = []
    for camera, uv in rays:
        P = camera.K @ camera.w2c[:3]
        rows += [uv[0] * P[2] - P[0], uv[1] * P[2] - P[1]]
    start = np.linalg.svd(np.array(rows))[2][-1]

    def off(xyz: np.ndarray) -> np.ndarray:
        missed = np.concatenate([camera.project(xyz[None, None])[0, 0] - uv for camera, uv in rays])
        return np.nan_to_num(missed, nan=BEHIND)

    return np.asarray(least_squares(off, start[:3] / start[3], max_nfev=20).x)


def row(what: str, seed: int, found: Calibration, truth: dict[str, Camera], seconds: float) -> dict[str, Any]:
    """One line of the table."""
    worst, focal = errors(found, truth)
    right = {name for name, (turn, place) in worst.items() if turn < RIGHT_TURN and place < RIGHT_PLACE}

    def most(values: list[float]) -> float | None:
        """Of cameras that are right; None where none is."""
        return round(max(values), 4) if values else None

    return {
        "what": what,
        "seed": seed,
        "cameras": len(found),
        "found": len(found.found),
        "right": len(right),
        "trusted": sum(camera.ok for camera in found.cameras),
        "wrong_unflagged": sum(c.ok and c.name not in right for c in found.cameras),
        "degrees_max": most([worst[name][0] for name in right]),
        "metres_max": most([worst[name][1] for name in right]),
        "focal_max": most([focal[name] for name in right]),
        "residual_px": residual(found, truth, right),
        "cpu_seconds": round(seconds),
    }


def room_rows(seed: int, wanted: Sequence[str]) -> list[dict[str, Any]]:
    """The simulated worlds of one seed."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="otsync-phones-") as home:
        for what, kind in KINDS.items():
            if what in wanted:
                more = {name: value for name, value in kind.items() if name != "key_frames"}
                folder = Path(home) / what
                filmed: dict[str, Any] = {"frames": 90, "walk": 300, "held": Tripod()} | more
                truth = film(folder, seed, **filmed)
                cameras = dict(zip(truth.names, truth.cameras, strict=True))
                options, started = CalibrateOptions(key_frames=kind.get("key_frames", 24)), time.process_time()
                found = calibrate(folder, options, tell=tell)
                rows.append(row(what, seed, found, cameras, time.process_time() - started))
                if "sync" in wanted and what in ("walk 24", "hands") and found.ok:
                    rows[-1] |= offset_errors(folder, found, truth)
    return rows


def offset_errors(folder: Path, found: Calibration, truth: PhoneTruth) -> dict[str, float]:
    """Errors in frames of the offsets that follow from the cameras that were found."""
    scene = scene_from_document(calibrated_document(describe_folder(folder), found), folder)
    offsets = synchronize_scene(scene).offsets
    off = np.abs(offsets.frames - truth.offsets * truth.fps)[1:]
    return {"offset_mean": round(float(off.mean()), 3), "offset_max": round(float(off.max()), 3)}


def rig_rows(scene: Scene, seed: int, cache: Cache, sync: bool) -> list[dict[str, Any]]:
    """The neighbours of one camera, the same with focal lengths 2 % off, and as many anywhere in the rig.

    sync: of the first, offsets too.
    """
    truth = {video.name: video.camera for video in scene.videos}
    names, rng = list(truth), np.random.default_rng(seed)
    middle = "5" if "5" in truth and seed % 2 == 0 else names[int(rng.integers(len(names)))]
    near = sorted(names, key=lambda name: float(np.linalg.norm(truth[name].center - truth[middle].center)))
    anywhere = [names[int(n)] for n in rng.permutation(len(names))[:NEIGHBOURS]]
    rows = []
    for what, chosen, off in (
        (f"{NEIGHBOURS} around {middle}", near[:NEIGHBOURS], 0.0),
        (f"{NEIGHBOURS} around {middle}, f 2 %", near[:NEIGHBOURS], 0.02),
        (f"{NEIGHBOURS} anywhere", anywhere, 0.0),
    ):
        clips = []
        for video in scene.take(chosen).videos:
            K = video.camera.K * np.array([[1 + off * rng.normal()], [1 + off * rng.normal()], [1]])
            if off:
                K[1, 1] = K[0, 0]
            size = (video.camera.width, video.camera.height)
            clips.append(Clip(video.name, {}, video.frames, size, video.fps or 30.0, Lens(K, None, "given")))
        started = time.process_time()
        found = calibrate_clips(clips, CalibrateOptions(seed=seed), cache=cache, tell=tell)
        rows.append(row(what, seed, found, truth, time.process_time() - started))
        if sync and len(rows) == 1 and len(found.found) > 1:
            rows[-1] |= rig_offsets(scene.take(chosen), found, seed, cache)
    return rows


def rig_offsets(scene: Scene, found: Calibration, seed: int, cache: Cache) -> dict[str, float]:
    """Errors in frames of the offsets of clips that begin up to a second late, from images and the cameras that were
    found, and beside them from the true ones; the first camera's clip is the reference.
    """
    rng = np.random.default_rng([seed, 5])
    late = [0, *(int(k) for k in rng.integers(0, LATE + 1, len(scene.videos) - 1))]
    taken = {camera.name: camera for camera in found.found}
    doubtful = {camera.name: camera.doubt for camera in found.found if camera.doubt}
    out: dict[str, float] = {}
    for which in ("", "_given"):
        videos = []
        for video, k in zip(scene.videos, late, strict=True):
            if video.name not in taken:
                continue
            length = min(len(video.frames) - LATE, CLIP)
            clip = replace(video, frames=video.frames[k : k + length], timestamps=None, fps=video.fps or 30.0)
            own = taken[video.name]
            if not which:
                clip = replace(
                    clip, camera=replace(video.camera, K=own.K, w2c=np.asarray(own.w2c), distortion=own.distortion)
                )
            videos.append((clip, k))
        names = [video.name for video, _ in videos]
        part = replace(scene.take(names), videos=tuple(video for video, _ in videos))
        part = replace(part, masks=(None,) * len(videos), doubtful={} if which else doubtful)
        offsets = synchronize_scene(part, cache=cache, tell=tell).offsets
        true = np.array([k - videos[0][1] for _, k in videos], float)
        off = np.abs(offsets.frames - true)[1:]
        out |= {f"offset_mean{which}": round(float(off.mean()), 3), f"offset_max{which}": round(float(off.max()), 3)}
    return out
