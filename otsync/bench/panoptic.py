"""``otsync bench panoptic SCENE``: the paper's protocol on a truly synchronised recording, with known shifts put in.

Shifts are whole frames, made by leaving out frames of the tracks (half-frame shifts: every second frame of both, odd
shifts), so the truth is exact up to the rig's own synchronisation. Depth comes from all synchronised cameras, as the
paper's did: the rows "paper" and "default" know more than a user with unsynchronised cameras does; "depth-free" does
not use it. Errors are in frames of the clips.
"""

from __future__ import annotations

import itertools
import json as json_module
import os
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..compute.threads import MapLike, pool_of
from ..costs.linear import Cosine
from ..costs.positions import CurveDistance, MedianPosition
from ..files.arrays import atomic_write
from ..files.cache import Cache
from ..files.digest import content_key
from ..geometry import common_target, seen_pixels, view_angle
from ..io import open_scene
from ..io.scene import Scene
from ..match.anchored import AnchoredFGW
from ..match.candidates import Candidates
from ..match.dense import FusedGromovWasserstein, OptimalTransport, PartialFGW
from ..match.slot import Matcher
from ..match.unbalanced import SemirelaxedFGW, UnbalancedFGW, UnbalancedOT
from ..plugins import available
from ..priors import DESCRIBERS
from ..priors.points import ChainedFlow
from ..priors.slots import Describer, cache_key
from ..priors.stereo import Rig
from ..priors.working import WorkingFrames
from ..progress import counted
from ..recordings.routes import pairs_in_pixels, pairs_in_space
from ..recordings.stages import COLOUR, Stages, stages_from
from ..recordings.tracking import pixel_tracks
from ..sync.method import PAPER
from ..sync.verb import synchronize
from ..types import Clock, Matches, Offsets, TrackSet
from . import record
from .record import table, write_rows

BANDS = ((1, 10), (11, 30), (31, 50))
SHORT = (51, 100)
LARGEST = 150.0
"""Frames that a missing answer counts as in means and quantiles: the recording's length."""

MATCH_RADIUS = 0.15
"""m: matched tracks that are nearer to each other at the true time follow the same place."""

PUBLISHED = {"route": "published", "pairs_by_band": [6.44, 8.57, 9.87], "graph_mean": 9.689, "graph_refined": 0.260}
NOTE = (
    "Depth was built from the synchronised frames of all cameras, as the paper's was; the depth-free row does not use "
    "it. Shifts are whole frames at the recording's rate, in frames of the clips."
)


@dataclass(frozen=True)
class Protocol:
    """How much is measured.

    Args:
        pairs: random camera pairs, each in the three bands, once more with a short overlap and once at half rate.
        graph_cameras, graph_seeds, graph_frames: of the many-video rows. largest: seeds with all cameras at once.
        matching: random pairs for the table of matchers.
    """

    pairs: int = 24
    graph_cameras: int = 8
    graph_seeds: int = 8
    graph_frames: int = 120
    largest: int = 1
    matching: int = 24
    seed: int = 9000


def run(
    out: Path,
    *,
    scene: str | os.PathLike[str],
    json: bool = False,
    cache: Path | None = None,
    first_seed: int | None = None,
    protocol: Protocol | None = None,
    features: str | None = None,
    routes: tuple[str, ...] = ("paper", "default", "depth-free"),
    gate: bool = False,
    rebase: bool = False,
) -> int:
    """Measure, print the table, write CSV, JSON and a plot to ``out``; with ``json`` one line on standard output.

    Args:
        features: what describes tracks, as the shell spells it; default: that of :class:`Stages`.
        gate: compare our own routes with the committed baseline, which is of the paper's basketball scene; 1 when
            something got worse. rebase: make this run the baseline. Neither measures the paper's route and the table
            of matchers.
    """
    protocol = protocol or Protocol()
    if gate:
        record.baseline_of("panoptic")  # that it is there is asked before the work
    if gate or rebase:
        protocol, routes = replace(protocol, matching=0), ("default", "depth-free")
    if first_seed is not None:
        protocol = replace(protocol, seed=first_seed)
    tell: Callable[[str], None] = (lambda text: None) if json else print
    stages = stages_from(features=features)
    opened = open_scene(scene)
    with pool_of(os.cpu_count() or 1) as pool:
        kept = Cache(cache or out / "stages")
        material = Material.of(opened, stages, kept, pool.map, tell)
        rows, details = [], []
        for route in routes:
            row, detail = measure(material, route, protocol, pool.map)
            rows.append(row)
            details += detail
            tell(table([row], list(row)))
        matched = []
        if protocol.matching:
            own = type(stages.tracking.features)
            for name, kind in available("describers", DESCRIBERS).items():
                describer = kind() if isinstance(kind, type) else kind
                try:
                    seen_by = material if kind is own else material.described_by(describer, kept, pool.map)
                except (ImportError, FileNotFoundError) as lacking:  # a learned prior without its package or weights
                    tell(f"table of matchers, without {name}: {lacking}")
                    continue
                matched += matching_table(seen_by, protocol, pool.map, name, every=kind is own)
    described = repr(stages.tracking.features)
    about = {"note": NOTE, "published": PUBLISHED, "protocol": vars(protocol), "features": described}
    about |= {"cameras": list(opened.names)}
    write_rows(out, "panoptic", rows, about)
    write_rows(out, "panoptic_pairs", details, about)
    if matched:
        write_rows(out, "panoptic_matching", matched, about)
        tell(f"Precision within {MATCH_RADIUS:g} m at the true time, by angle between the cameras:\n{table(matched)}")
    _plot(out / "panoptic.svg", details)
    tell(f"published: pairs by band 6.44 / 8.57 / 9.87, many videos 9.689, after photometric refinement .260\n{NOTE}")
    if json:
        print(json_module.dumps({"rows": rows}))
    figures = figures_of(rows, opened.names)
    if rebase:
        record.save_baseline("panoptic", figures)
    return record.gate("panoptic", figures, worse) if gate else 0


WATCHED = (
    "pairs_mean",
    "pairs_p90",
    "pairs_max",
    "short_overlap_mean",
    "graph_mean",
    "graph_max",
    "graph_apart",
    "graph_apart_max",
    "all_cameras_mean",
    "all_cameras_apart",
    "flagged",
)


def figures_of(rows: list[dict[str, Any]], cameras: tuple[str, ...]) -> dict[str, float]:
    """What the gate compares, by route, of this set of cameras: errors, doubts, and trusted answers that are wrong."""
    who = f"{len(cameras)} cameras"
    return {f"{who}, {r['route']}: {key}": r[key] for r in rows for key in (*WATCHED, "trusted_wrong")}


def worse(key: str, measured: float, baseline: float) -> bool:
    """Errors, and the share of doubted pairs, may grow by a fifth and .01; no more trusted answers may be wrong."""
    if key.endswith("trusted_wrong"):
        return measured > baseline
    return measured > 1.2 * baseline + 0.01


@dataclass(frozen=True, eq=False)
class Material:
    """Tracks of every camera over the whole recording, with depth from the synchronised rig."""

    scene: Scene
    stages: Stages
    uv: tuple[np.ndarray, ...]
    features: tuple[np.ndarray, ...]
    rich: tuple[np.ndarray, ...]
    rich_features: tuple[np.ndarray, ...]
    depth: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, scene: Scene, stages: Stages, cache: Cache, map: MapLike, tell: Callable[[str], None]) -> Material:
        started = time.perf_counter()

        def track(v: int) -> dict[str, np.ndarray]:
            # every camera seeds its grids in frames of its own, or the seeds' rhythm would tell the truth
            phase = zlib.crc32(scene.names[v].encode()) % ChainedFlow.every
            tracking = replace(stages.tracking, points=ChainedFlow(phase=phase))
            return tracking(scene.videos[v], None, cache)

        raw = list(map(track, range(len(scene.videos))))
        tell(f"tracks of {len(raw)} cameras: {time.perf_counter() - started:.0f} s")
        # masks, tracks and features of each, when they were made
        tell(f"features: {np.median([r['seconds'][2] for r in raw]):.2f} s a camera")
        wide = replace(stages.selection, count=3 * stages.selection.count, min_life=16, apart=6.0)
        chosen = [wide(r["uv"], v.camera.width, v.fps or 30.0) for r, v in zip(raw, scene.videos, strict=True)]
        rich = [r["uv"][c] for r, c in zip(raw, chosen, strict=True)]
        masks = list(
            map(lambda i: stages.tracking.masks(scene.videos[i], scene.masks[i], cache), range(len(scene.videos)))
        )
        rig = Rig.at(scene.videos, masks, np.zeros(len(raw)), stages.tracking.width)
        content = [stages.tracking.key(v, m) for v, m in zip(scene.videos, scene.masks, strict=True)]
        flat = [
            pixel_tracks(uv, None, v.camera, fps=v.fps, timestamps=v.timestamps)
            for uv, v in zip(rich, scene.videos, strict=True)
        ]
        straight = [seen_pixels(t) for t in flat]
        depth = stages.stereo(rig, straight, cache, tuple(content), map)
        tell(f"depth of {len(raw)} cameras: {time.perf_counter() - started:.0f} s")
        return cls(
            scene,
            stages,
            tuple(r["uv"] for r in raw),
            tuple(r["features"] for r in raw),
            tuple(rich),
            tuple(r["features"][c] for r, c in zip(raw, chosen, strict=True)),
            tuple(depth),
        )

    def described_by(self, describer: Describer, cache: Cache, map: MapLike) -> Material:
        """The same tracks with other features, those in space alone."""
        tracking = self.stages.tracking

        def describe(v: int) -> np.ndarray:
            video, given = self.scene.videos[v], self.scene.masks[v]
            masks = tracking.masks(video, given, cache)
            frames = WorkingFrames(video.frames, (video.camera.width, video.camera.height), tracking.width)
            uv = frames.from_full(self.rich[v].astype(float))
            key = (tracking.key(video, given), cache_key(describer), content_key(self.rich[v]), tracking.width)
            found = cache.arrays(
                "described", key, lambda: {"features": describer(frames, masks, uv, video.fps or 30.0)}
            )
            return found["features"].astype(np.float32)

        return replace(self, rich_features=tuple(map(describe, range(len(self.rich)))))

    def clip(self, v: int, start: int, stop: int, step: int, lifted: bool) -> TrackSet:
        """The tracks of camera v in frames start, start + step, ...; clocks begin at 0."""
        video, frames = self.scene.videos[v], slice(start, stop, step)
        fps = (video.fps or 30.0) / step
        source, features = (self.rich[v], self.rich_features[v]) if lifted else (self.uv[v], self.features[v])
        uv = source[:, frames]
        if not lifted:
            keep = self.stages.selection(uv, video.camera.width, fps)
            return pixel_tracks(
                uv[keep], features[keep], video.camera, fps=fps, name=video.name, frame=self.scene.frame
            )
        tracks = pixel_tracks(uv, features, video.camera, fps=fps, name=video.name, frame=self.scene.frame)
        tracks = self.stages.lift(tracks, self.depth[v][:, frames])
        return tracks.take(self.stages.selection(seen_pixels(tracks), video.camera.width, fps))

    @property
    def frames(self) -> int:
        return min(len(v.frames) for v in self.scene.videos)


def measure(
    material: Material, route: str, protocol: Protocol, map: MapLike
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """One row of figures, and the line of every pair behind it."""
    solve, lifted = _solver(route, material.stages), route != "depth-free"
    V = len(material.scene.videos)
    rng = np.random.default_rng(protocol.seed)
    started = time.perf_counter()
    pairs = list(itertools.combinations(range(V), 2))
    rng.shuffle(pairs)
    jobs = []
    for a, b in pairs[: protocol.pairs]:
        for kind, (low, high), step in (
            *((f"band {k}", band, 1) for k, band in enumerate(BANDS)),
            ("short", SHORT, 1),
            ("half", (1, 30), 2),
        ):
            shift = int(rng.integers(low, high + 1))
            if step == 2 and shift % 2 == 0:
                shift += 1
            jobs.append((a, b, kind, shift, step, bool(rng.integers(2))))
    target = common_target([v.camera for v in material.scene.videos])

    def pair(job: tuple[int, int, str, int, int, bool]) -> dict[str, Any]:
        a, b, kind, shift, step, later = job
        T = material.frames
        starts = (0, shift) if later else (shift, 0)
        tracks = [material.clip(v, s, T, step, lifted) for v, s in zip((a, b), starts, strict=True)]
        alignment = solve(tracks).alignments[0, 1]
        error = alignment.frames - (starts[1] - starts[0]) / step
        names = material.scene.names
        angle = view_angle(material.scene.videos[a].camera, material.scene.videos[b].camera, target)
        return {
            "route": route,
            "kind": kind,
            "a": names[a],
            "b": names[b],
            "angle": angle,
            "shift": shift if later else -shift,
            "error": _number(error),
            "sigma": _number(alignment.sigma * alignment.fps),
            "flags": " ".join(f.code for f in alignment.flags),
        }

    details = list(counted(map(pair, jobs), f"{route}: pairs", "pair", len(jobs)))
    seconds = time.perf_counter() - started
    graph, whole = [], []
    for n in counted(range(protocol.graph_seeds), f"{route}: graphs", "graph"):
        graph += _graph(material, solve, lifted, protocol, rng, min(protocol.graph_cameras, V), f"graph {n}", route)
    for n in range(protocol.largest):
        whole += _graph(material, solve, lifted, protocol, rng, V, f"all {n}", route)
    return _row(route, details, graph, whole, seconds / len(jobs)), details + graph + whole


BEST = (50, 100, 200)
"""How many of the best matches the table of matchers looks at; angles are those at the middle one."""


FACING = 120
"""Degrees from which on two cameras face each other and see two sides of everything."""


WITH_FEATURES = ("EMD on features", "FGW (paper)", "anchored FGW", "unbalanced OT, curve (default)")
"""Matchers of the table that are measured with every describer that there is, plugins' too."""


def matching_table(
    material: Material, protocol: Protocol, map: MapLike, features: str, every: bool = True
) -> list[dict[str, Any]]:
    """Share of the best matches within :data:`MATCH_RADIUS` at the true time (median over common frames).

    Args:
        features: name of what describes the tracks. every: all matchers, not only :data:`WITH_FEATURES`.
    """
    V = len(material.scene.videos)
    rng = np.random.default_rng(protocol.seed + 1)
    pairs = list(itertools.combinations(range(V), 2))
    rng.shuffle(pairs)
    target = common_target([v.camera for v in material.scene.videos])
    both = (Cosine(weight=COLOUR, center=False), CurveDistance())
    place = (Cosine(weight=COLOUR, center=False), MedianPosition())
    matchers: dict[str, Matcher] = {
        "EMD on features": OptimalTransport(),
        "FGW (paper)": FusedGromovWasserstein(costs=(Cosine(center=False),)),
        "anchored FGW": AnchoredFGW(),
        "EMD, median position": OptimalTransport(costs=place),
        "EMD, curve": OptimalTransport(costs=both),
        "FGW, curve (alpha 5)": FusedGromovWasserstein(alpha=5.0, costs=both),
        "partial FGW (mass .65), curve (alpha 5)": PartialFGW(alpha=5.0, costs=both),
        "unbalanced FGW, curve (alpha 5)": UnbalancedFGW(alpha=5.0, partners=2, costs=both),
        "semi-relaxed FGW, curve (alpha 5)": SemirelaxedFGW(alpha=5.0, partners=2, costs=both),
        "anchored FGW, curve": AnchoredFGW(costs=both),
        "cheapest partners, curve": Candidates(2, None, both),
        "unbalanced OT, curve (default)": UnbalancedOT(top=None, costs=both),
        "the same again at synchronised times": UnbalancedOT(top=None, costs=both).at(Clock()),
    }
    if not every:
        matchers = {name: matchers[name] for name in WITH_FEATURES}

    def pair(item: tuple[int, int]) -> dict[str, tuple[float, ...]]:
        a, b = (material.clip(int(v), 0, material.frames, 1, True) for v in item)
        angle = view_angle(a.camera, b.camera, target)  # type: ignore[arg-type]
        found = {}
        for name, matcher in matchers.items():
            started = time.thread_time()  # other pairs run in other threads
            matches = matcher(a, b)
            seconds = time.thread_time() - started
            found[name] = (angle, len(matches), seconds, *(precision_near(a, b, matches.best(n))[0] for n in BEST))
        return found

    chosen = pairs[: protocol.matching]
    by_matcher: dict[str, list[tuple[float, ...]]] = {name: [] for name in matchers}
    for answer in counted(map(pair, chosen), "matchers", "pair", len(chosen)):
        for name, value in answer.items():
            by_matcher[name].append(value)
    rows = []
    for name, values in by_matcher.items():
        angle, count, seconds, *precision = np.array(values).T
        row: dict[str, Any] = {"matching": name, "features": features, "matches": round(float(count.mean()), 1)}
        row |= {f"best {n}": round(float(p.mean()), 3) for n, p in zip(BEST, precision, strict=True)}
        beside = angle < FACING
        row |= {
            f"best {n}, <{FACING}": round(float(p[beside].mean()), 3) if beside.any() else None
            for n, p in zip(BEST, precision, strict=True)
        }
        for low, high in ((0, 55), (55, 95), (95, FACING), (FACING, 181)):
            inside = (angle >= low) & (angle < high)
            row[f"<{high}"] = round(float(precision[1][inside].mean()), 3) if inside.any() else None
        rows.append(row | {"cpu_s": round(float(np.median(seconds)), 3)})
    return rows


def precision_near(a: TrackSet, b: TrackSet, matches: Matches) -> tuple[float, int]:
    """For clips that start together: (share of near matches among those seen together in five frames, matches)."""
    i, j = matches.pairs.T
    distance = np.linalg.norm(a.positions()[i] - b.positions()[j], axis=2)
    together = np.isfinite(distance).sum(1) >= 5
    if not together.any():
        return 0.0, len(matches)
    return float((np.nanmedian(distance[together], axis=1) < MATCH_RADIUS).mean()), len(matches)


def _solver(route: str, stages: Stages) -> Callable[[list[TrackSet]], Offsets]:
    if route == "paper":
        return lambda tracks: synchronize(tracks, method=PAPER)
    if route == "default":
        return lambda tracks: pairs_in_space(tracks, 0, stages, Cache())
    if route == "depth-free":
        return lambda tracks: pairs_in_pixels(tracks, 0, stages, Cache())
    raise ValueError(f"routes: expected paper, default or depth-free; found {route!r}.")


def _graph(
    material: Material,
    solve: Callable[[list[TrackSet]], Offsets],
    lifted: bool,
    protocol: Protocol,
    rng: np.random.Generator,
    cameras: int,
    kind: str,
    route: str,
) -> list[dict[str, Any]]:
    """Errors of all but the reference for one draw of cameras and offsets 0-30."""
    chosen = rng.permutation(len(material.scene.videos))[:cameras]
    length = min(protocol.graph_frames, material.frames)
    starts = rng.integers(0, min(30, material.frames - length) + 1, cameras)
    tracks = [material.clip(int(v), int(s), int(s) + length, 1, lifted) for v, s in zip(chosen, starts, strict=True)]
    offsets = solve(tracks)
    error = offsets.frames - (starts - starts[0])
    return [
        {
            "route": route,
            "kind": kind,
            "a": offsets.names[0],
            "b": offsets.names[v],
            "shift": int(starts[v] - starts[0]),
            "error": _number(error[v]),
            "sigma": _number(offsets.sigma[v] * offsets.fps[v]),
            "flags": " ".join(f.code for f in offsets.flags[v]),
        }
        for v in range(1, cameras)
    ]


def _row(
    route: str, details: list[dict[str, Any]], graph: list[dict[str, Any]], whole: list[dict[str, Any]], seconds: float
) -> dict[str, Any]:
    """Figures of |error|; a missing answer counts as :data:`LARGEST`."""

    def errors(lines: list[dict[str, Any]], kind: str = "") -> np.ndarray:
        return np.array([error_of(d) for d in lines if d["kind"].startswith(kind)], float)

    def mean(x: np.ndarray) -> float | None:
        return round(float(x.mean()), 4) if x.size else None

    def at(x: np.ndarray, q: float) -> float | None:
        return round(float(np.quantile(x, q)), 4) if x.size else None

    def held(lines: list[dict[str, Any]]) -> list[float | None]:
        """Shares of the trusted answers within one sigma and within two."""
        z = np.array([error_of(d) / d["sigma"] for d in lines if not d["flags"] and d["sigma"]])
        return [mean(z <= k) for k in (1, 2)]

    long = errors(details, "band")
    below = errors([d for d in details if d["kind"].startswith("band") and d["angle"] < 95])
    return {
        "route": route,
        "pairs_mean": mean(long),
        "pairs_median": at(long, 0.5),
        "pairs_p90": at(long, 0.9),
        "pairs_max": at(long, 1.0),
        "pairs_by_band": [mean(errors(details, f"band {k}")) for k in range(len(BANDS))],
        "pairs_within_1": round(float((long <= 1).mean()), 4),
        "pairs_over_2_below_95_degrees": int((below > 2).sum()),
        "short_overlap_mean": mean(errors(details, "short")),
        "half_frame_mean": mean(errors(details, "half")),
        "graph_mean": mean(errors(graph)),
        "graph_max": at(errors(graph), 1.0),
        "graph_apart": mean(apart(graph)),
        "graph_apart_max": at(apart(graph), 1.0),
        "all_cameras_mean": mean(errors(whole)),
        "all_cameras_max": at(errors(whole), 1.0),
        "all_cameras_apart": mean(apart(whole)),
        "pairs_in_sigma": held(details),
        "graph_in_sigma": held([*graph, *whole]),
        "missing": int(sum(d["error"] is None for d in (*details, *graph, *whole))),
        "trusted_wrong": sum(not d["flags"] and error_of(d) > 1 for d in (*details, *graph, *whole)),
        "flagged": round(float(np.mean([bool(d["flags"]) for d in details if d["kind"].startswith("band")])), 4),
        "seconds": round(seconds, 4),
    }


def apart(lines: list[dict[str, Any]]) -> np.ndarray:
    """Errors of the cameras of every draw, the reference's 0 among them, less what all have in common: their median."""
    found = []
    for kind in dict.fromkeys(d["kind"] for d in lines):
        late = np.array([0.0, *(LARGEST if d["error"] is None else d["error"] for d in lines if d["kind"] == kind)])
        found.append(np.abs(late - np.median(late)))
    return np.concatenate(found) if found else np.zeros(0)


def error_of(line: dict[str, Any]) -> float:
    """|error| of a pair, frames."""
    return LARGEST if line["error"] is None else abs(line["error"])


def _number(x: float) -> float | None:
    """For files: None where there is no answer."""
    return float(x) if np.isfinite(x) else None


def _plot(path: Path, details: list[dict[str, Any]]) -> None:
    """Share of pairs within an error, per route."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    ax = figure.subplots()
    for route in dict.fromkeys(d["route"] for d in details):
        known = [d["error"] for d in details if d["route"] == route and d["kind"].startswith("band")]
        error = np.sort([np.inf if e is None else abs(e) for e in known])
        ax.step(np.maximum(error, 1e-3), (np.arange(len(error)) + 1) / len(error), where="post", label=route)
    ax.set(xscale="log", xlabel="|error|, frames", ylabel="share of pairs", ylim=(0, 1))
    ax.legend()
    ax.set_title("Depth (paper, default) was built from the synchronised frames", fontsize=8)
    with atomic_write(path, "w") as stream:
        figure.savefig(stream, format="svg")
