"""``recon lifting``: the worth of lifted features to the matcher, and the cost of lifting.

On a truly synchronised recording in metres. Two sources of tracks: optical flow, lifted by depth, as otsync uses it;
and the Gaussians of a fit of every video alone (:mod:`recon.features.tracks`). Two ways to their features from the same
maps: the mean over the pixels where a track is seen, and lifting by compositing weights. Each is thinned alike, matched
alike, and scored by the share of matches that are within 15 cm at the true time.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import binned_statistic

from otsync.bench.panoptic import MATCH_RADIUS, precision_near
from otsync.bench.record import table, write_rows
from otsync.compute.threads import get_threads, pool_of
from otsync.io import Scene
from otsync.progress import counted
from otsync.types import Offsets, TrackSet, Video
from otsync.types.checks import check_whole
from recon.bench.fits import Protocol, material_of
from recon.features.lift import FeatureFrame, lift_features
from recon.features.tracks import Alone, FeatureMaps, fit_alone, gaussian_tracks, lifted_frames, seen_weights
from recon.footage.footage import Footage
from recon.pipeline.feature_maps import maps_from
from recon.pipeline.plan import Plan
from recon.raster import render, set_threads
from recon.scene.gaussians4d import Gaussians4D, join

Row = dict[str, Any]
TOLD = {"lab": "Lab", "daisy": "DAISY"}
"""How tables name extractors; others by what the shell calls them."""
APART = (16.0, 12.0, 8.0, 6.0, 4.0)
"""Pixels at 640 of width between tracks: the first that leaves :data:`COUNT`, so that they cover all that moves. The 16
that synchronisation asks for leave some fifty in a clip of 1.6 s."""
COUNT = 200
BANDS = (0, 55, 95, 120, 181)
STUDY_MS = (20.0, 16.0)
"""Forward and backward of 64 channels, 9.4k Gaussians, 320 x 180, one thread, as the prototype did it."""


@dataclass(frozen=True)
class Lifting:
    """How lifting is measured."""

    cameras: int = 5
    """Videos, drawn at random; every pair of them is matched."""
    steps: int = 300
    """Steps of the fit of each video alone."""
    seed: int = 0
    """Of the draw of the videos."""
    width: int = 320
    """Working pixels of an image's width."""
    frames: tuple[int, int] | None = None
    """First and last (exclusive) frame of every video to use; default: all."""
    held_out: tuple[str, ...] = ()
    """Names of videos that take no part."""
    features: tuple[str, ...] = ("lab", "daisy")
    """Extractors of feature maps that are compared, as ``otsync run --features`` names them."""
    channels: int = 64
    """Feature channels of the map whose lifting is timed."""
    repeats: int = 15
    """How often it is timed; the median counts."""

    def __post_init__(self) -> None:
        for name, least in (("cameras", 2), ("steps", 0), ("seed", 0), ("width", 1), ("channels", 1), ("repeats", 1)):
            check_whole(name, getattr(self, name), least)
        if not self.features:
            raise ValueError("features: expected one extractor or more; found none.")
        _ = self.maps

    @property
    def maps(self) -> dict[str, FeatureMaps]:
        """The extractors by the names that tables give them. ValueError for one that there is not, or two of a name."""
        heads = [text.partition(":")[0] for text in self.features]
        if len(set(heads)) < len(heads):
            raise ValueError(f"features: expected extractors of different names; found {', '.join(heads)}.")
        return {TOLD.get(h, h): maps_from(text) for h, text in zip(heads, self.features, strict=True)}

    @property
    def protocol(self) -> Protocol:
        """How tracks and depth are made: as for fits, of all tracks."""
        return Protocol(Plan(width=self.width, frames=self.frames), self.held_out)


def run(
    scene: Scene,
    truth: Offsets,
    out: Path,
    *,
    lifting: Lifting,
    cache: Path | None = None,
    tell: Callable[[str], None] = print,
) -> tuple[list[Row], Row]:
    """Measure, and write ``lifting.csv`` and ``lifting.json`` to ``out``: precision by matching, cost of lifting."""
    from otsync.files.cache import Cache
    from otsync.progress import Progress
    from recon.pipeline.stages import read_footage

    if np.ptp(truth.seconds) > 0:
        raise ValueError(
            "truth: expected a truly synchronised recording, offsets all zero, for the lifting suite; found offsets of "
            f"up to {np.abs(truth.seconds).max():.4g} s."
        )
    kept, progress = Cache(cache or out / "stages"), Progress(tell)
    with pool_of(1) as pool:
        material = material_of(scene, truth, lifting.protocol, kept, pool.map, progress)
        by_name = {t.name: t for t in material.tracks}
        names = [n for n in material.train if n in by_name]
        if len(names) < 2:
            raise ValueError(f"scene: expected two or more videos with lifted tracks; found {len(names)}.")
        drawn = np.random.default_rng(lifting.seed).permutation(len(names))[: lifting.cameras]
        chosen = [names[v] for v in sorted(drawn)]
        videos = material.scene.take(chosen)
        footage = read_footage(videos, lifting.width, kept, pool.map, progress)
    sources, scenes, seconds = [], [], []
    for video, one in zip(videos.videos, footage, strict=True):
        began = time.process_time()
        sets, alone = sources_of(video, one, by_name[video.name], lifting)
        seconds.append(time.process_time() - began)
        sources.append(sets)
        scenes.append(alone)
        tell(f"video {video.name}: {len(alone)} Gaussians, {seconds[-1]:.1f} CPU seconds")
    rows = matched(sources, [v.camera for v in videos.videos])
    cost = lift_cost(scenes, footage[0], lifting)
    about = {
        "lifting": vars(lifting),
        "cameras": chosen,
        "cpu_seconds": seconds,
        "cost": cost,
    }
    write_rows(out, "lifting", rows, about)
    return rows, cost


def tables(rows: Sequence[Row], cost: Row) -> str:
    """The figures of :func:`run` as text."""
    title = f"Precision within {MATCH_RADIUS:g} m at the true time, by angle between the cameras:"
    return f"{title}\n{table(rows)}\n{table([cost])}"


def sources_of(
    video: Video, footage: Footage, flow: TrackSet, lifting: Lifting
) -> tuple[dict[str, TrackSet], Gaussians4D]:
    """Track sets of one video by name of source, thinned alike; and the scene that the Gaussians are from."""
    from recon.footage.depth import working_depth

    options = Alone(steps=lifting.steps)
    scene = fit_alone(footage, flow, working_depth(video, width=lifting.width), options=options)
    weights = seen_weights(scene, footage)

    out = {}
    for name, maps in lifting.maps.items():
        lifted = thinned(gaussian_tracks(scene, footage, flow, maps, options=options, weights=weights))
        out[f"flow, {name} averaged"] = averaged(thinned(flow), footage, maps, options.every)
        out[f"Gaussians, {name} averaged"] = averaged(lifted, footage, maps, options.every)
        out[f"Gaussians, {name} lifted"] = lifted
    return out, scene


def thinned(tracks: TrackSet) -> TrackSet:
    """At most :data:`COUNT` tracks, long-lived ones first, all over the image; which of equals is left to chance, since
    Gaussians come in the order of their places."""
    from otsync.geometry import seen_pixels
    from otsync.recordings.tracking import Selection

    assert tracks.camera is not None
    mixed = tracks.take(np.random.default_rng(0).permutation(len(tracks)))
    for apart in APART:
        select = Selection(apart=apart, count=COUNT)
        chosen = mixed.take(select(seen_pixels(mixed), tracks.camera.width, tracks.fps or 30.0))
        if len(chosen) >= COUNT:
            break
    return chosen


def averaged(tracks: TrackSet, footage: Footage, maps: FeatureMaps, every: float) -> TrackSet:
    """The tracks with unit means of the maps at the pixels where they were seen; without those never seen in a map."""
    assert tracks.uv is not None and tracks.camera is not None and footage.masks is not None
    scale = footage.size[0] / tracks.camera.width
    total: Any = 0.0
    for k in lifted_frames(footage, every):
        here = maps(footage.images[k], footage.masks[k])
        pixel = np.where(tracks.seen[:, k, None], tracks.uv[:, k] * scale, 0).astype(int)
        column, row = np.clip(pixel, 0, np.array(footage.size) - 1).T
        total = total + np.where(tracks.seen[:, k, None], here[row, column], 0)
    norm = np.linalg.norm(total, axis=1)
    keep = np.flatnonzero(norm > 0)
    return replace(tracks.take(keep), features=total[keep] / norm[keep, None])


def matched(sources: Sequence[dict[str, TrackSet]], cameras: Sequence[Any]) -> list[Row]:
    """A row for every matcher and source: precision by angle, over all pairs of the videos."""
    from otsync.costs.linear import Cosine
    from otsync.costs.positions import CurveDistance
    from otsync.geometry import common_target, view_angle
    from otsync.match.anchored import AnchoredFGW
    from otsync.match.candidates import Candidates
    from otsync.match.dense import FusedGromovWasserstein, OptimalTransport
    from otsync.recordings.stages import COLOUR

    both = (Cosine(weight=COLOUR, center=False), CurveDistance())
    matchers: dict[str, tuple[Any, int | None]] = {
        "EMD on features, best 100": (OptimalTransport(), 100),
        "FGW (paper), best 100": (FusedGromovWasserstein(), 100),
        "anchored FGW, best 100": (AnchoredFGW(), 100),
        "two partners, features + curve, best 200": (Candidates(2, 200, both), None),
    }
    target = common_target(list(cameras))
    pairs = list(itertools.combinations(range(len(sources)), 2))
    angle = np.array([view_angle(cameras[i], cameras[j], target) for i, j in pairs])
    count = np.histogram(angle, BANDS)[0]
    rows: list[Row] = [{"matching": "pairs", "tracks": "", "n": None} | _by_angle(count.tolist()) | {"all": len(pairs)}]

    def add(matching: str, source: str, scores: Sequence[tuple[float, int]]) -> None:
        precision, n = np.array(scores, float).T
        mean = binned_statistic(angle, precision, "mean", BANDS)[0]
        by_angle = _by_angle([round(float(x), 3) if np.isfinite(x) else None for x in mean])
        head = {"matching": matching, "tracks": source, "n": round(float(n.mean()), 1)}
        rows.append(head | by_angle | {"all": round(float(precision.mean()), 3)})

    for source in counted(sources[0], "partners within reach", "source"):
        add(
            "tracks that have a partner at all",
            source,
            [within_reach(sources[i][source], sources[j][source]) for i, j in pairs],
        )
    for matching, (matcher, most) in matchers.items():
        for source in sources[0]:
            scores = []
            for i, j in counted(pairs, f"{matching}, {source}", "pair"):
                a, b = sources[i][source], sources[j][source]
                matches = matcher(a, b)
                scores.append(precision_near(a, b, matches if most is None else matches.best(most)))
            add(matching, source, scores)
    return rows


def within_reach(a: TrackSet, b: TrackSet) -> tuple[float, int]:
    """(share of a's tracks with any of b's near it at the true time, tracks): what no matching can exceed by much."""
    xb, near = b.positions(), 0
    for track in a.positions():
        distance = np.linalg.norm(xb - track, axis=2)
        together = np.isfinite(distance).sum(1) >= 5
        near += bool((np.nanmedian(distance[together], axis=1) < MATCH_RADIUS).any())
    return near / max(1, len(a)), len(a)


def _by_angle(values: Sequence[Any]) -> Row:
    return {f"<{high}": value for high, value in zip(BANDS[1:], values, strict=True)}


def lift_cost(scenes: Sequence[Gaussians4D], footage: Footage, lifting: Lifting) -> Row:
    """Milliseconds to lift one map onto the Gaussians of all scenes, one thread: median, and its forward's part."""
    with torch.no_grad():
        gaussians = scenes[0].moving(float(np.mean(scenes[0].span)))
        for scene in scenes[1:]:
            gaussians = join(gaussians, scene.moving(float(np.mean(scene.span))))
    w, h = footage.size
    frame = FeatureFrame(
        0.0, replace(footage.camera, w2c=footage.pose(0)), np.ones((h, w, lifting.channels), np.float32)
    )
    camera = frame.camera
    views, Ks = (torch.as_tensor(m, dtype=torch.float32)[None] for m in (camera.w2c, camera.K))
    colors = torch.zeros(len(gaussians), lifting.channels + 1)
    splats = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors)
    raster, torches = get_threads(), torch.get_num_threads()
    set_threads(1)
    torch.set_num_threads(1)
    try:
        forward = _median_ms(lambda: render(*splats, views, Ks, w, h, depth=None), lifting.repeats)
        whole = _median_ms(lambda: lift_features(lambda t: gaussians, [frame]), lifting.repeats)
    finally:
        set_threads(raster)
        torch.set_num_threads(torches)
    return {
        "gaussians": len(gaussians),
        "channels": lifting.channels,
        "size": f"{w}x{h}",
        "forward_ms": round(forward, 1),
        "lift_ms": round(whole, 1),
        "study_ms": sum(STUDY_MS),
        "of_study": round(whole / sum(STUDY_MS), 2),
    }


def _median_ms(work: Callable[[], Any], repeats: int) -> float:
    """Median CPU milliseconds of this thread, after one call to warm up; others on the machine do not count."""
    work()
    times = []
    for _ in range(repeats):
        began = time.thread_time()
        work()
        times.append(time.thread_time() - began)
    return 1e3 * float(np.median(times))
